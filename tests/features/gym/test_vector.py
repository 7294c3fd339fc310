"""Many environments at once: each is a single one, whatever their number, and ends by itself."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.error import ClosedEnvironmentError, ResetNeeded
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers.vector import RecordEpisodeStatistics

import quadsim
import quadsim.gym
from quadsim.errors import InputError, ParameterError
from quadsim.state import Array

pytestmark = pytest.mark.slow("gym")

MASS = {"name": "mass", "fields": ["actual.mass"], "distribution": "uniform", "low": 0.6, "high": 0.8}
PLACE = {"name": "x", "fields": ["initial.position.0"], "distribution": "normal", "mean": 0.0, "deviation": 0.5}
KEPT = ("margins", "margins_sampled", "constraint_values", "constraint_violation", "cost", "time", "phase", "reason")


def short(name: str, duration: float = 1.0, **changes: Any) -> quadsim.Scenario:
    return quadsim.load(name).replace({"duration": duration, **changes})


def same(one: Any, other: Any) -> bool:
    """Whether values of `info` are the same, bit for bit."""
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(same(one[key], other[key]) for key in one)
    return bool(np.array_equal(one, other, equal_nan=isinstance(one, float)))


def at_place(info: dict[str, Any], place: int) -> dict[str, Any]:
    """What the `info` of many has of one environment."""
    return {
        key: at_place(value, place) if isinstance(value, dict) else value[place]
        for key, value in info.items()
        if not key.startswith("_") and info[f"_{key}"][place]
    }


NOISY = {"sensors.position.rate": 100.0, "sensors.position.noise": 0.01, "sensors.rates.rate": 500.0}
NOISY |= {"sensors.rates.noise": 1.0, "sensors.attitude.rate": 200.0, "sensors.attitude.delay": 0.01}
DISTURBED = {"effects.disturbance.force_noise": 0.01, "effects.thrust_noise": {"deviation": 0.02}}
PUSHED = {"events": [{"type": "push", "at": 0.333, "duration": 0.2, "force": [0.5, 0.0, 0.0]}]}
AIR = {"linear_drag": [0.1, 0.1, 0.1], "wind": [2.0, 1.0, 0.0], "turbulence": {"wind_speed_20ft": 5.0}}
SCENARIOS: dict[str, tuple[str, dict[str, Any]]] = {
    "own method": ("hummingbird-figure-eight", {"plant.integrator": "rk4"}),
    "MuJoCo's step": ("hummingbird-figure-eight", {}),
    "sensors": ("hummingbird-figure-eight", NOISY),
    "noise": ("hummingbird-figure-eight", {**DISTURBED, "plant.integrator": "rk4"}),
    "events within periods": ("hummingbird-figure-eight", PUSHED),
    "turbulence": ("hummingbird-figure-eight", {"effects.air": AIR}),
    "battery": ("battery", {}),
    "turned heading": ("paper-constrained", {}),
    "late commands": ("late-commands", {}),
    "an estimator": ("motion-capture", {}),
}


@pytest.mark.parametrize("case", SCENARIOS)
@pytest.mark.parametrize("action", ["rates", "deviations"])
def test_each_environment_is_a_single_one_bit_for_bit(case: str, action: str) -> None:
    """Observations, ends and `info`, through ends and resets; rewards but for rounding."""
    name, changes = SCENARIOS[case]
    scenario = short(name, 0.6, **changes)
    options = {"action": action, "preview": 3, "observation": ("state", "ahead", "preview", "command")}
    count = 3
    envs = quadsim.gym.make_vec(scenario, count, threads=2, **options)
    singles = [quadsim.gym.QuadrotorEnv(scenario, **options) for _ in range(count)]
    observed, infos = envs.reset(seed=11)
    for place, env in enumerate(singles):
        start, info = env.reset(seed=11 + place)
        assert np.array_equal(observed[place], start)
        assert same(at_place(infos, place), info)
    rng = np.random.default_rng(0)
    over = np.zeros(count, bool)
    for _ in range(30):
        actions = rng.uniform(-0.3, 0.3, (count, 4)).astype(np.float32)
        observed, rewards, terminated, truncated, infos = envs.step(actions)
        for place, env in enumerate(singles):
            if over[place]:
                expected, info = env.reset()
                reward = 0.0
                ends = (False, False)
            else:
                expected, reward, *ends, info = env.step(actions[place])
            assert np.array_equal(observed[place], expected, equal_nan=True)
            assert rewards[place] == pytest.approx(reward, rel=1e-12)
            assert [terminated[place], truncated[place]] == list(ends)
            assert same(at_place(infos, place), info)
        over = terminated | truncated
    assert envs.obstacle == {"late commands": "computation time", "an estimator": "an estimator"}.get(case)
    envs.close()


def flown(count: int, threads: int = 1, **options: Any) -> tuple[Array, Array]:
    """Observations and rewards of the first three of some environments."""
    scenario = short("hummingbird-figure-eight", 0.5, **DISTURBED, **{"plant.integrator": "rk4"})
    envs = quadsim.gym.make_vec(scenario, count, threads=threads, **options)
    observations = [envs.reset(seed=3)[0][:3]]
    rewards = []
    for step in range(25):
        actions = np.full((count, 4), 0.1 * np.sin(step), np.float32)
        observed, reward, *_ = envs.step(actions)
        observations.append(observed[:3])
        rewards.append(reward[:3])
    envs.close()
    return np.stack(observations), np.stack(rewards)


def test_neither_their_number_nor_that_of_threads_changes_a_bit() -> None:
    few = flown(3)
    for count, threads in ((8, 1), (8, 3), (3, 7)):
        many = flown(count, threads)
        assert np.array_equal(few[0], many[0])
        assert np.array_equal(few[1], many[1])
    assert not np.array_equal(few[0][:, 0], few[0][:, 1])


@pytest.mark.parametrize("action", ["rotors", "thrust", "attitude", "speeds"])
def test_every_action_is_flown_as_by_a_single_environment(action: str) -> None:
    scenario = short("hummingbird-figure-eight", 0.5, **{"plant.integrator": "rk4"})
    envs = quadsim.gym.make_vec(scenario, 2, action=action)
    env = quadsim.gym.QuadrotorEnv(scenario, action=action)
    observed = envs.reset(seed=0)[0]
    start = env.reset(seed=0)[0]
    low = envs.single_action_space.low
    high = envs.single_action_space.high
    rng = np.random.default_rng(1)
    for _ in range(10):
        assert np.array_equal(observed[0], start)
        taken = (0.5 * (low + high) + 0.1 * (high - low) * rng.uniform(-1.0, 1.0, 4)).astype(low.dtype)
        observed = envs.step(np.stack([taken, taken]))[0]
        start = env.step(taken)[0]
    envs.close()


def test_attitudes_and_thrusts_mean_what_they_say() -> None:
    scenario = short("hummingbird-figure-eight", 2.0, **{"plant.integrator": "rk4", "constraints": []})
    envs = quadsim.gym.make_vec(scenario, 3, action="attitude", observation=("state",))
    envs.reset(seed=0)
    for _ in range(15):
        observed = envs.step(np.array([[0, 0.3, 0, 0], [0, 0, -0.4, 0], [0, 0, 0, 0.5]], np.float32))[0]
    assert np.degrees(observed[0, 6]) == pytest.approx(0.3 * 35.0, abs=0.1)
    assert np.degrees(observed[1, 8]) == pytest.approx(-0.4 * 35.0, abs=0.1)
    assert observed[2, 11] == pytest.approx(1.0, abs=0.05)  # half of 2 rad/s
    env = quadsim.gym.QuadrotorEnv(scenario, action="thrust")
    env.reset(seed=0)
    vehicle = env.started.vehicle
    hover, low, high = (vehicle.thrusts(speeds) for speeds in (vehicle.hover_speeds, np.zeros(4), np.full(4, 838.0)))
    speeds = env.actions.command(np.array([0.0, 0.5, -0.5, 1.0]), 1).speeds
    expected = [hover[0], 0.5 * (hover[1] + high[1]), 0.5 * (hover[2] + low[2]), high[3]]
    assert vehicle.thrusts(speeds) == pytest.approx(expected)
    assert env.actions.of(speeds) == pytest.approx([0.0, 0.5, -0.5, 1.0], abs=1e-6)
    envs.close()


ZERO = np.zeros((3, 4), np.float32)


def falling(mode: AutoresetMode | str) -> tuple[Any, Array]:
    """Three environments, of which the second tumbles at once; and their actions."""
    scenario = short("hummingbird-figure-eight", 0.4, **{"plant.integrator": "rk4", "lost.tilt": 30.0})
    envs = quadsim.gym.make_vec(scenario, 3, action="rates", observation=("state",), autoreset_mode=mode)
    actions = ZERO.copy()
    actions[1, 1] = 1.0
    return envs, actions


def test_an_ended_episode_is_reset_in_the_next_step() -> None:
    envs, actions = falling("NextStep")
    start, _ = envs.reset(seed=0)
    ended = []
    while not ended:
        observed, rewards, terminated, _, infos = envs.step(actions)
        ended = np.flatnonzero(terminated).tolist()
    assert ended == [1]
    assert "tilt" in infos["reason"][1]
    assert abs(observed[1, 6]) > np.radians(30.0)
    observed, rewards, terminated, _, infos = envs.step(actions)
    assert np.array_equal(observed[1], start[1])
    assert rewards[1] == 0.0
    assert infos["reason"].tolist() == ["", "", ""]
    assert infos["time"][1] == 0.0 < infos["time"][0]
    assert not terminated.any()
    envs.close()


def test_an_ended_episode_is_reset_at_once_and_keeps_its_end() -> None:
    envs, actions = falling(AutoresetMode.SAME_STEP)
    start, _ = envs.reset(seed=0)
    while True:
        observed, rewards, terminated, _, infos = envs.step(actions)
        if terminated.any():
            break
    assert terminated.tolist() == [False, True, False]
    assert np.array_equal(observed[1], start[1])
    assert infos["_final_obs"].tolist() == [False, True, False]
    assert infos["final_obs"][0] is None
    assert abs(infos["final_obs"][1][6]) > np.radians(30.0)
    assert "tilt" in infos["final_info"]["reason"][1]
    assert infos["final_info"]["_time"].tolist() == [False, True, False]
    assert infos["reason"][1] == ""
    assert rewards[1] > 0.0
    flight = envs.flight(1, ended=True)
    assert "tilt" in flight.reason
    assert np.array_equal(flight.log.plant.state[-1], infos["final_obs"][1])
    envs.close()


def test_without_autoreset_a_mask_resets() -> None:
    envs, actions = falling("Disabled")
    start, _ = envs.reset(seed=0)
    terminated = np.zeros(3, bool)
    while not terminated.any():
        observed, _, terminated, _, _ = envs.step(actions)
    with pytest.raises(ResetNeeded, match=r"\[1\]"):
        envs.step(actions)
    again, infos = envs.reset(options={"reset_mask": terminated})
    assert np.array_equal(again[[0, 2]], observed[[0, 2]])
    assert np.array_equal(again[1], start[1])
    assert infos["_time"].tolist() == [False, True, False]
    envs.step(actions)
    for mask in (np.zeros(3, bool), [1, 0, 0], np.ones(2, bool)):
        with pytest.raises(ParameterError, match="reset_mask"):
            envs.reset(options={"reset_mask": mask})
    envs.close()


def test_all_episodes_are_truncated_at_the_duration_or_before() -> None:
    scenario = short("hummingbird-figure-eight", 0.2, **{"plant.integrator": "rk4"})
    envs = quadsim.gym.make_vec(scenario, 2)
    envs.reset(seed=0)
    assert [envs.step(ZERO[:2])[3].tolist() for _ in range(5)] == [[False] * 2] * 3 + [[True] * 2, [False] * 2]
    envs.close()
    for name in ("hover", "late-commands"):
        envs = quadsim.gym.make_vec(name, 2, max_episode_steps=3)
        envs.reset(seed=0)
        assert [envs.step(ZERO[:2])[3].tolist() for _ in range(3)] == [[False] * 2] * 2 + [[True] * 2]
        envs.close()


def test_gymnasium_makes_them_by_id() -> None:
    envs = gymnasium.make_vec("quadsim/HummingbirdFigureEight-v0", 4, action="rates")
    assert isinstance(envs, quadsim.gym.QuadrotorVectorEnv)
    observed, _ = envs.reset(seed=1)
    assert observed in envs.observation_space
    assert envs.observation_space.shape[0] == envs.action_space.shape[0] == 4
    envs.close()


@pytest.mark.parametrize("vary", [[MASS, PLACE]])
def test_each_environment_draws_its_own_episodes(vary: Sequence[dict[str, Any]]) -> None:
    scenario = short("hummingbird-figure-eight", 0.2, **{"plant.integrator": "rk4"})
    envs = quadsim.gym.make_vec(scenario, 3, action="rates", vary=vary)
    env = quadsim.gym.QuadrotorEnv(scenario, action="rates", vary=vary)
    observed, infos = envs.reset(seed=4)
    start, info = env.reset(seed=5)
    assert np.array_equal(observed[1], start)
    assert at_place(infos, 1)["draw"] == info["draw"]
    assert env.scenario.actual.mass == info["draw"]["mass"]
    assert len(set(infos["draw"]["mass"].tolist())) == 3
    assert infos["draw"]["x"] == pytest.approx(observed[:, 0])
    for _ in range(4):
        envs.step(ZERO)
        env.step(ZERO[0])
    before = infos["draw"]["mass"].copy()
    observed, *_, after = envs.step(ZERO)  # all are reset
    start, info = env.reset()
    assert np.array_equal(observed[1], start)
    assert after["draw"]["mass"][1] == info["draw"]["mass"]
    assert infos["draw"]["mass"].tolist() == before.tolist() != after["draw"]["mass"].tolist()
    envs.close()


def test_a_campaign_varies_them_by_its_name() -> None:
    envs = quadsim.gym.make_vec("paper-constrained", 2, vary="paper-nominal", observation=("state",))
    _, infos = envs.reset(options={"flight": 3})
    assert infos["flight"].tolist() == [3, 3]
    envs.close()


def test_what_cannot_be_flown_together_is_refused() -> None:
    scenario = short("hummingbird-figure-eight", 0.2, **{"plant.integrator": "rk4"})
    period = {"name": "period", "fields": ["control_period"], "distribution": "grid", "values": [0.05, 0.1]}
    envs = quadsim.gym.make_vec(scenario, 1, vary=[period])
    envs.reset(options={"flight": 0})
    with pytest.raises(InputError, match="another control period"):
        envs.reset(options={"flight": 1})
    with pytest.raises(ParameterError, match="options"):
        envs.reset(options={"flights": 1})
    envs.close()


@pytest.mark.parametrize("action", ["rates", "attitude", "speeds"])
def test_a_bad_number_has_the_reason_that_a_single_environment_gives(action: str) -> None:
    scenario = short("hummingbird-figure-eight", 0.2, **{"plant.integrator": "rk4"})
    envs = quadsim.gym.make_vec(scenario, 2, action=action)
    env = quadsim.gym.QuadrotorEnv(scenario, action=action)
    envs.reset(seed=0)
    env.reset(seed=0)
    wrong = np.full((2, 4), np.nan)
    info = env.step(wrong[0])[4]
    infos = envs.step(wrong)[4]
    assert infos["reason"][0] == info["reason"]
    assert "not finite" in info["reason"]
    envs.close()


def test_gymnasiums_wrappers_take_them() -> None:
    scenario = short("hummingbird-figure-eight", 0.2, **{"plant.integrator": "rk4"})
    envs = quadsim.gym.make_vec(scenario, 2, action="rates", autoreset_mode="SameStep")
    recorded = RecordEpisodeStatistics(envs)
    recorded.reset(seed=0)
    for _ in range(4):
        *_, infos = recorded.step(ZERO[:2])
    assert infos["episode"]["l"].tolist() == [4, 4]
    recorded.close()


def test_rewards_may_use_margins() -> None:
    def reward(state: Array, reference: Array, speeds: Array, margins: dict[str, Any]) -> Any:
        return -np.abs(state[..., 4] - reference[..., 2]) + np.minimum(margins["roll"], 0.0)

    scenario = short("hummingbird-figure-eight", 0.5, **{"plant.integrator": "rk4"})
    envs = quadsim.gym.make_vec(scenario, 2, action="rates", reward=reward)
    env = quadsim.gym.QuadrotorEnv(scenario, action="rates", reward=reward)
    envs.reset(seed=0)
    env.reset(seed=0)
    for _ in range(7):
        actions = np.array([[0.2, 0.9, 0.0, 0.0]] * 2, np.float32)
        _, rewards, *_, infos = envs.step(actions)
        single = env.step(actions[0])
        assert rewards[0] == pytest.approx(single[1], rel=1e-12)
    assert infos["margins"]["roll"][0] < 0.0
    assert infos["cost"].tolist() == [single[4]["cost"]] * 2
    envs.close()
    envs = quadsim.gym.make_vec(scenario, 2, reward=lambda state, reference, speeds: 1.0)
    envs.reset(seed=0)
    with pytest.raises(ParameterError, match="one for each environment"):
        envs.step(ZERO[:2])
    envs.close()
    with pytest.raises(ParameterError, match="function of state"):
        quadsim.gym.make_vec(scenario, 2, reward=lambda state: 1.0)
    with pytest.raises(ParameterError, match="margins must be True for a reward"):
        quadsim.gym.make_vec(scenario, 2, margins=False, reward=lambda state, reference, speeds, margins: state[..., 2])


def test_a_flight_of_one_of_them_is_flown_again_by_its_actions() -> None:
    scenario = short("hummingbird-figure-eight", 0.5, **DISTURBED, **{"plant.integrator": "rk4"})
    envs = quadsim.gym.make_vec(scenario, 3, observation=("state",))
    with pytest.raises(ResetNeeded):
        envs.flight(0)
    envs.reset(seed=2)
    rng = np.random.default_rng(0)
    seen = [envs.step(rng.uniform(-0.1, 0.1, (3, 4)).astype(np.float32))[0][1] for _ in range(9)]
    flight = envs.flight(1)
    assert np.array_equal(flight.log.plant.state[50::50], seen)
    with pytest.raises(ResetNeeded, match="ended"):
        envs.flight(1, ended=True)
    last = [envs.step(ZERO)[0][1] for _ in range(3)]  # the end, a reset, and a step
    assert np.array_equal(envs.flight(1, ended=True).log.plant.state[50::50], [*seen, last[0]])
    assert np.array_equal(envs.flight(1).log.plant.state[50::50], last[2:])
    with pytest.raises(ParameterError, match="place"):
        envs.flight(3)
    envs.close()


def test_bad_actions_are_refused_and_a_bad_number_ends_its_own_episode() -> None:
    scenario = short("hummingbird-figure-eight", 1.0, **{"plant.integrator": "rk4"})
    envs = quadsim.gym.make_vec(scenario, 3, action="rates", observation=("state",))
    with pytest.raises(ResetNeeded):
        envs.step(ZERO)
    envs.reset(seed=0)
    for wrong in (ZERO[0], ZERO[:2], np.zeros((3, 5))):
        with pytest.raises(ParameterError, match=r"action must be of shape \(3, 4\)"):
            envs.step(wrong)
    with pytest.raises(ParameterError, match="of numbers"):
        envs.step(np.full((3, 4), "up"))
    wild = ZERO.copy()
    wild[2, 1] = 1.5
    with pytest.raises(ParameterError, match=r"action\[2\]\[1\] must be from -1 to 1, the action space.*got 1.5"):
        envs.step(wild)
    before, *_, infos = envs.step(ZERO)
    assert infos["time"].tolist() == pytest.approx([0.05] * 3)  # nothing refused was flown
    wild[2, 1] = np.nan
    observed, rewards, terminated, _, infos = envs.step(wild)
    assert terminated.tolist() == [False, False, True]
    assert "not finite" in infos["reason"][2]
    assert rewards[2] == 0.0 < rewards[0]
    assert np.array_equal(observed[2], before[2])
    assert np.isinf(infos["constraint_values"][2]).all()
    observed, _, terminated, _, _ = envs.step(ZERO)
    assert not terminated.any()
    envs.close()
    envs.close()
    for use in (lambda: envs.step(ZERO), envs.reset, lambda: envs.flight(0)):
        with pytest.raises(ClosedEnvironmentError, match="closed"):
            use()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"num_envs": 0}, "num_envs must be a whole number"),
        ({"num_envs": 1.5}, "num_envs must be a whole number"),
        ({"threads": 0}, "threads must be a whole number"),
        ({"autoreset_mode": "later"}, "autoreset_mode must be one of"),
        ({"render_mode": "rgb_array"}, "render_mode must be None: .* films an episode"),
        ({"action": "torque"}, "no action named 'torque'"),
        ({"vary": [{**MASS, "low": 0.9}]}, "low must be below high"),
        ({"vary": [{**MASS, "fields": ["actual.mas"]}]}, "mas"),
        ({"vary": "nothing"}, "nothing"),
    ],
)
def test_a_wrong_option_is_named(options: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        quadsim.gym.make_vec("hummingbird-figure-eight", **{"num_envs": 2, **options})


def test_wrong_seeds_are_named() -> None:
    envs = quadsim.gym.make_vec("hummingbird-figure-eight", 2)
    for seed in (-1, [1], [1, -2], [0.5, 1], 2**63 - 1):
        with pytest.raises(ParameterError, match="seed"):
            envs.reset(seed=seed)
    first = envs.reset(seed=[7, None])[1]["seed"].tolist()
    assert first == [7, envs.scenario.seed + 1]
    envs.close()
