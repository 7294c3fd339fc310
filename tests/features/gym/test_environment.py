"""Environments: the field's conventions, correct constraint information, and the bytes of `quadsim run`."""

from __future__ import annotations

import copy
import itertools
import pickle
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import gymnasium
import imageio.v2
import numpy as np
import pytest
from gymnasium.error import ClosedEnvironmentError, DependencyNotInstalled, ResetNeeded
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers import RecordVideo
from support import decode

import quadsim
import quadsim.gym
from quadsim.errors import InputError, ParameterError, RenderingUnavailableError
from quadsim.features.campaign.plan import load_plan
from quadsim.report.film.video import rendering_backend
from quadsim.scenarios.catalogue import scenario_names
from quadsim.state import INDEX

pytestmark = pytest.mark.slow("gym")

HOVER = np.zeros(4, np.float32)


def short(name: str, duration: float = 1.0, **changes: Any) -> quadsim.Scenario:
    return quadsim.load(name).replace({"duration": duration, **changes})


def flown(env: gymnasium.Env[Any, Any], seed: int | None = None) -> list[dict[str, Any]]:
    """An episode of the scenario's own controller: `info` of the start and of each step."""
    _, info = env.reset(seed=seed)
    infos = [info]
    ended = False
    while not ended:
        observed, reward, terminated, truncated, info = env.step(env.unwrapped.controller_action())
        assert observed in env.observation_space
        assert 0.0 < reward <= 1.0
        infos.append(info)
        ended = terminated or truncated
    return infos


def test_every_scenario_of_the_library_has_an_id_and_its_duration() -> None:
    specs = {name: gymnasium.spec(quadsim.gym.environment_id(name)) for name in scenario_names()}
    assert specs["hummingbird-figure-eight"].id == "quadsim/HummingbirdFigureEight-v0"
    assert len({spec.id for spec in specs.values()}) == len(specs)
    for name in ("paper-constrained", "robust-lag50", "torrente-loop8-all"):
        assert specs[name].max_episode_steps == quadsim.load(name).periods


@pytest.mark.parametrize("action", ["deviations", "rates"])
def test_the_checker_finds_nothing_and_pictures_follow_the_vehicle(action: str) -> None:
    env = quadsim.gym.make_env("motion-capture", action=action, render_mode="rgb_array", width=80, height=60)
    try:
        rendering_backend()
    except RenderingUnavailableError as error:
        check_env(env.unwrapped, skip_render_check=True)
        pytest.skip(str(error))
    check_env(env.unwrapped)
    env.reset()
    first = env.render()
    for _ in range(5):
        env.step(np.array([0.2, -0.2, 0.2, -0.2], np.float32))
    second = env.render()
    env.close()
    assert first.shape == second.shape == (60, 80, 3)
    assert first.std() > 5.0
    assert not np.array_equal(first, second)


def test_actions_are_within_the_controllers_bounds_or_the_vehicles() -> None:
    env = quadsim.gym.make_env("paper-constrained", action="speeds")
    assert env.action_space == gymnasium.spaces.Box(0.0, 250.0, (4,), dtype=np.float64)
    actions = quadsim.gym.QuadrotorEnv("hover").actions
    speeds = actions.command(np.array([-1.0, -0.3, 0.0, 1.0]), 1).speeds
    assert speeds[[0, 3]].tolist() == [0.0, 250.0]
    assert actions.of(speeds) == pytest.approx([-1.0, -0.3, 0.0, 1.0], abs=1e-7)
    free = quadsim.gym.make_env("torrente-loop4-drag", action="speeds").unwrapped
    vehicle = quadsim.load_vehicle(free.scenario.vehicle.file)
    assert free.action_space.high.tolist() == [vehicle.speed_max] * 4


@pytest.mark.parametrize(
    ("name", "action"),
    [
        pytest.param("motion-capture", "deviations", marks=pytest.mark.representative("gym")),
        ("late-commands", "speeds"),
        ("torrente-loop4-drag", "speeds"),
    ],
)
def test_an_episode_of_the_own_controller_has_the_bytes_of_a_run(name: str, action: str, tmp_path: Path) -> None:
    scenario = short(name)
    env = quadsim.gym.make_env(scenario, action=action)
    flight = quadsim.fly(env.unwrapped.scenario.replace({"seed": 7}), progress=False)
    flight.save(tmp_path / "run", video=False, recording=False, figures=False)
    infos = flown(env, seed=7)
    env.unwrapped.flight().save(tmp_path / "episode", video=False, recording=False, figures=False)
    for file in ("flight.parquet", "plant.parquet"):
        assert (tmp_path / "run" / file).read_bytes() == (tmp_path / "episode" / file).read_bytes()
    for i, finding in enumerate(flight.audit):
        worst = min(info["margins"][finding.limit.name] for info in infos)
        assert worst == -max(info["constraint_values"][i] for info in infos)
        assert worst == pytest.approx(finding.worst_margin, abs=1e-9) or not finding.limit.holds_at(flight.time).any()


def test_margins_see_a_violation_that_samples_miss() -> None:
    """The paper's controller bounds samples of a linear model, and is beyond 5 deg of roll between some of them."""
    env = quadsim.gym.make_env("paper-constrained")
    infos = flown(env)
    missed = [
        now["margins"]["roll"]
        for before, now in itertools.pairwise(infos)
        if now["margins"]["roll"] < 0.0 <= min(before["margins_sampled"]["roll"], now["margins_sampled"]["roll"])
    ]
    assert len(missed) == pytest.approx(40, abs=5)
    assert min(missed) == pytest.approx(-0.018, abs=0.002)
    assert all(info["constraint_values"][0] == -info["margins"]["roll"] for info in infos)
    plant = env.unwrapped.flight().plant
    assert np.degrees(np.abs(plant["roll"])).max() == pytest.approx(5.0 - min(i["margins"]["roll"] for i in infos))


def test_cost_counts_required_constraints_beyond_their_tolerance() -> None:
    limit = {"name": "height", "signal": "z", "upper": 1.0, "tolerance": 0.01, "tolerance_sampled": 0.01}
    limits = [limit, {**limit, "name": "wish", "required": False}, {**limit, "name": "later", "start": 0.9}]
    limits += [{"name": name, "signal": name, "required": False} for name in ("roll", "pitch", "speed", "slew")]
    env = quadsim.gym.make_env(short("hover", 1.0, constraints=limits))
    env.reset()
    infos = [env.step(np.full(4, 0.5, np.float32))[4] for _ in range(20)]
    heights = env.unwrapped.flight().plant
    for k, info in enumerate(infos):
        highest = heights["z"][50 * k + 1 : 50 * k + 51].max()
        assert info["margins"]["height"] == pytest.approx(1.0 - highest, abs=1e-12)
        beyond = bool(highest > 1.01)
        assert info["cost"] == beyond + (beyond and info["time"] > 0.89)
        assert info["constraint_violation"] == int(beyond)
        assert np.isinf(info["margins"]["later"]) == (info["time"] < 0.89)
    assert infos[0]["cost"] == 0.0
    assert infos[-1]["cost"] == 2.0


@pytest.mark.representative("gym")
def test_a_lost_vehicle_terminates_and_time_truncates() -> None:
    env = quadsim.gym.make_env(short("hover", 3.0))
    env.reset()
    ended = False
    while not ended:
        observed, _, terminated, truncated, info = env.step(np.array([1, -1, 0, 0], np.float32))
        ended = terminated or truncated
    assert terminated
    assert not truncated
    assert "lost" in info["reason"]
    assert observed in env.observation_space
    with pytest.raises(ResetNeeded, match="lost"):
        env.unwrapped.step(HOVER)
    env.reset()
    steps = [env.step(HOVER)[2:4] for _ in range(60)]
    assert steps == [(False, False)] * 59 + [(False, True)]
    with pytest.raises(ResetNeeded, match="over"):
        env.unwrapped.step(HOVER)
    with pytest.raises(ResetNeeded, match="reset"):
        quadsim.gym.QuadrotorEnv("hover").step(HOVER)
    env.reset()
    _, reward, terminated, _, info = env.step(np.full(4, np.nan))
    assert (reward, terminated) == (0.0, True)
    assert "not finite" in info["reason"]


def test_observations_follow_the_layout() -> None:
    parts = ("command", "ahead", "preview", "state")
    env = quadsim.gym.QuadrotorEnv("paper-constrained", observation=parts, preview=2)
    observed, _ = env.reset()
    named = dict(zip([entry.name for entry in env.observations.layout], observed, strict=True))
    assert named["yaw"] == pytest.approx(np.radians(30.0))
    assert named["yaw[2] ahead"] == pytest.approx(named["yaw[2]"] - named["yaw"])
    assert named["u1"] == pytest.approx(env.started.vehicle.hover_speed)
    assert {entry.unit for entry in env.observations.layout} == {"m", "m/s", "rad", "rad/s"}
    for _ in range(3):
        seen = env.step(HOVER)[0]
    assert np.array_equal(seen[-12:], env.started.observation.state)


def test_seeds_are_those_of_the_scenario() -> None:
    env = quadsim.gym.QuadrotorEnv(short("motion-capture", seed=5))
    first, second, again, last = ((env.reset(seed=seed)[0], env.scenario.seed) for seed in (None, None, 5, None))
    assert first[1] == again[1] == 5
    assert second[1] == last[1] != 5
    assert np.array_equal(first[0], again[0])
    assert not np.array_equal(first[0], second[0])


def test_a_campaign_varies_each_episode() -> None:
    env = quadsim.gym.QuadrotorEnv("paper-constrained", vary="paper-robustness")
    plan = load_plan("paper-robustness")
    env.reset(options={"flight": 3})
    drawn = plan.of(3)
    assert env.scenario.effects == drawn.effects
    assert env.scenario.seed == drawn.seed
    assert env.started.vehicle.name == "lopes2011"
    env.reset(seed=1)
    first = env.scenario
    env.reset()
    assert env.scenario.effects != first.effects
    env.reset(seed=1)
    assert env.scenario == first


def test_a_campaigns_duration_truncates(tmp_path: Path) -> None:
    campaign = tmp_path / "brief.toml"
    campaign.write_text('name = "brief"\nscenario = "hover"\nflights = 2\nset = { duration = 0.1, constraints = [] }\n')
    env = quadsim.gym.make_env("hover", vary=str(campaign))
    env.reset()
    assert [env.step(HOVER)[2:4] for _ in range(2)] == [(False, False), (False, True)]


def test_a_drawn_course_is_flown_to_its_end(tmp_path: Path) -> None:
    settings = ["constraints=[]", "reference.period=2.0", "reference.ramp=0.5", "lost.tilt=180.0"]
    eight = quadsim.load("hummingbird-figure-eight", [*settings, "reference.length=0.1", "reference.turns=0.5"])
    eight = eight.replace({"duration": None})
    entry = '[[vary]]\nname = "turns"\nfields = ["reference.turns"]\ndistribution = "grid"\nvalues = [1.5]\n'
    campaign = tmp_path / "turns.toml"
    campaign.write_text(f'name = "turns"\nscenario = "hover"\nflights = 1\n{entry}')
    env = quadsim.gym.make_env(eight, vary=str(campaign), action="deviations")
    assert env.spec is not None
    assert env.spec.max_episode_steps is None
    drawn = eight.replace({"reference.turns": 1.5})
    assert drawn.periods == eight.periods + 40
    assert len(flown(env)) == drawn.periods + 1


SLOW = quadsim.load("hover").replace({"controller.input_bounds.speed": [0.0, 150.0]})


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"action": "torque"}, "no action named 'torque'"),
        ({"observation": ("wind",)}, "no part of the observation named 'wind'"),
        ({"observation": ()}, "observation must be one or more"),
        ({"observation": "state"}, "observation must be a list of parts.*got 'state'"),
        ({"preview": 51}, "preview must be from 1 to controller.horizon = 50"),
        ({"preview": 1.5}, "preview must be from 1 to controller.horizon = 50.*got 1.5"),
        ({"vary": 3}, "vary must be a campaign's name or file, or a list of tables.*got 3"),
        ({"vary": {"name": "mass"}}, "vary must be a campaign's name or file, or a list of tables"),
        ({"render_mode": "ansi"}, "render_mode must be rgb_array"),
        ({"scenario": SLOW}, "below and above the hover speed"),
    ],
)
def test_a_wrong_option_is_named(options: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        quadsim.gym.QuadrotorEnv(**{"scenario": "hover", **options})


@pytest.mark.parametrize("returned", [None, np.zeros(12)])
def test_a_reward_that_is_not_one_number_is_refused(returned: Any) -> None:
    env = quadsim.gym.QuadrotorEnv("hover", reward=lambda state, reference, speeds: returned)
    env.reset(seed=0)
    with pytest.raises(ParameterError, match="reward must be a function that returns one number"):
        env.step(np.zeros(4, np.float32))
    env.close()


def test_wrong_arguments_are_named() -> None:
    env = quadsim.gym.QuadrotorEnv("hover")
    with pytest.raises(ParameterError, match="seed"):
        env.reset(seed=-1)
    with pytest.raises(ParameterError, match="options"):
        env.reset(options={"flight": 1})
    env.reset()
    with pytest.raises(ParameterError, match="action"):
        env.step(np.zeros(3))
    with pytest.raises(ParameterError, match=r"action\[1\] must be from -1 to 1.*got 1.5"):
        env.step(np.array([0.0, 1.5, 0.0, 0.0]))
    varied = quadsim.gym.QuadrotorEnv("paper-constrained", vary="paper-nominal")
    for options in ({"flight": -1}, {"flight": 1.5}, {"wind": 1}):
        with pytest.raises(ParameterError, match="options"):
            varied.reset(options=options)


def test_the_inner_loop_flies_thrust_and_body_rates() -> None:
    scenario = short("hover", constraints=[])
    env = quadsim.gym.QuadrotorEnv(scenario, action="rates", observation=("state",))
    observed, _ = env.reset()
    for _ in range(10):
        observed = env.step(np.array([0.2, 0.1, -0.05, 0.1], np.float32))[0]
    plant = env.flight().log.plant
    vehicle = env.started.vehicle
    body = env.started.observation.moment.body_rates
    assert body == pytest.approx([0.6, -0.3, 0.2], abs=0.02)
    thrust = vehicle.thrust_coefficient * np.sum(plant.speeds[-2] ** 2)
    weight = vehicle.mass * vehicle.gravity
    most = vehicle.thrust_coefficient * 4 * 250.0**2
    assert thrust == pytest.approx(weight + 0.2 * (most - weight), rel=1e-7)
    assert observed[INDEX["vz"]] > 0.5
    with pytest.raises(ParameterError, match="deviations"):
        env.controller_action()


@pytest.mark.representative("gym")
def test_a_closed_environment_says_so_and_keeps_its_flight() -> None:
    env = quadsim.gym.QuadrotorEnv(short("hover"), render_mode="rgb_array")
    env.reset(seed=0)
    env.step(HOVER)
    env.close()
    env.close()
    for use in (env.reset, env.render, env.controller_action, lambda: env.step(HOVER)):
        with pytest.raises(ClosedEnvironmentError, match="closed"):
            use()
    assert len(env.flight().time) == 1
    filtered = quadsim.gym.MPCSafetyFilter(quadsim.gym.QuadrotorEnv(short("robust")))
    filtered.reset(seed=0)
    filtered.close()
    with pytest.raises(ClosedEnvironmentError):
        filtered.step(HOVER)


@pytest.mark.parametrize("copied", [lambda env: pickle.loads(pickle.dumps(env)), copy.deepcopy])
@pytest.mark.parametrize("filtered", [False, True])
def test_a_copy_of_a_reset_environment_flies_the_same_after_its_own_reset(copied: Any, filtered: bool) -> None:
    """The episode stays behind: the copy says so."""
    env = quadsim.gym.make_env(short("robust"))
    env = quadsim.gym.MPCSafetyFilter(env) if filtered else env
    env.reset(seed=3)
    env.step(HOVER)
    other = copied(env)
    with pytest.raises(ResetNeeded, match="pickled"):
        other.step(HOVER)
    starts = [one.reset(seed=3)[0] for one in (env, other)]
    steps = [one.step(HOVER)[0] for one in (env, other)]
    env.close()
    other.close()
    assert np.array_equal(*starts)
    assert np.array_equal(*steps)


def test_an_action_that_is_not_of_numbers_is_refused() -> None:
    env = quadsim.gym.QuadrotorEnv(short("hover"))
    env.reset()
    with pytest.raises(ParameterError, match="action"):
        env.step(np.array([object()] * 4))


def test_without_gymnasium_the_extra_is_named() -> None:
    code = "import sys; sys.modules['gymnasium'] = None\nimport quadsim.errors\n"
    code += "try:\n    import quadsim.gym\nexcept quadsim.errors.MissingPackageError as error:\n    print(error)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "quadsim.gym needs the package 'gymnasium': pip install 'quadsim[gym]'"


class Clip:
    """As much of moviepy as gymnasium calls; moviepy itself wants another Pillow than the rest."""

    def __init__(self, frames: list[np.ndarray], fps: float) -> None:
        self.frames = frames
        self.fps = fps

    def write_videofile(self, path: str, logger: object) -> None:
        imageio.v2.mimwrite(path, self.frames, fps=self.fps)


def test_record_video_films_an_episode(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    try:
        rendering_backend()
    except RenderingUnavailableError as error:
        pytest.skip(str(error))
    for name in ("moviepy", "moviepy.video", "moviepy.video.io", "moviepy.video.io.ImageSequenceClip"):
        monkeypatch.setitem(sys.modules, name, ModuleType(name))
    monkeypatch.setattr(sys.modules["moviepy.video.io.ImageSequenceClip"], "ImageSequenceClip", Clip, raising=False)
    env = RecordVideo(
        quadsim.gym.make_env(short("hover", 0.5, control_period=0.1), render_mode="rgb_array", width=320, height=240),
        str(tmp_path / "films"),
    )
    infos = flown(env)
    env.close()
    film = tmp_path / "films" / "rl-video-episode-0.mp4"
    pictures, of_film = decode(film)
    assert pictures.shape == (len(infos), 240, 320, 3) == (6, 240, 320, 3)
    assert of_film["fps"] == 10.0  # as fast as it is flown
    assert pictures[0].std() > 10.0  # something is seen


def test_record_video_names_what_it_lacks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "moviepy", None)
    env = quadsim.gym.make_env("hover", render_mode="rgb_array")
    with pytest.raises(DependencyNotInstalled, match=r"(?i)moviepy is not installed"):
        RecordVideo(env, str(tmp_path / "films"))


def test_a_bound_on_the_climb_acceleration_has_margins_and_is_flown_apart() -> None:
    bound = {"name": "climb", "signal": "climb_acceleration", "lower": -0.5, "upper": 0.5}
    scenario = short("hover", 0.3, constraints=[bound])
    with quadsim.gym.make_env(scenario) as env:
        env.reset(seed=0)
        action = env.action_space.high
        _, _, _, _, info = env.step(action)
        assert np.isfinite(info["margins"]["climb"])
        assert info["margins"]["climb"] < 0.0
    envs = quadsim.gym.make_vec(scenario, 2)
    assert envs.obstacle == "a constraint whose margins Python computes"
    envs.close()


def test_a_scenario_of_an_autopilot_s_targets_is_an_environment() -> None:
    """With the vehicle's bounds, as the controller has none on rotor speeds."""
    controller = {"type": "robust", "commands": "rates", "horizon": 10, "output_weights": {"x": 1.0}}
    controller |= {"target_weights": {"thrust": 0.1, "body_rate": 0.1}, "inner_lag": [0.0, 0.05, 0.05, 0.1]}
    scenario = short("hover", 0.2, controller=controller, autopilot={}, constraints=[])
    with quadsim.gym.make_env(scenario, action="rates") as env:
        env.reset(seed=0)
        observation, *_ = env.step(env.action_space.sample())
        assert np.isfinite(observation).all()
