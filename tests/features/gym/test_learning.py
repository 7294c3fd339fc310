"""The safety filter, and the examples that need it: a random agent, and a student that is audited like its teacher."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.error import ResetNeeded

import quadsim
import quadsim.gym
from quadsim.errors import ParameterError
from quadsim.state import INDEX

ROOT = Path(__file__).resolve().parents[3]
sys.path.insert(0, str(ROOT / "examples"))

import imitation  # noqa: E402
import safety_filter  # noqa: E402

pytestmark = pytest.mark.slow("gym")


def random_episode(env: gymnasium.Env[Any, Any], seed: int) -> tuple[list[dict[str, Any]], bool]:
    env.reset(seed=seed)
    env.action_space.seed(seed)
    infos = []
    ended = False
    while not ended:
        _, _, terminated, truncated, info = env.step(env.action_space.sample())
        infos.append(info)
        ended = terminated or truncated
    return infos, terminated


def test_a_random_agent_holds_five_degrees_of_tilt_behind_it_and_crashes_without() -> None:
    scenario = safety_filter.filtered_air("turbulence").replace({"duration": 5.0})
    env = quadsim.gym.MPCSafetyFilter(quadsim.gym.make_env(scenario))
    infos, terminated = random_episode(env, seed=0)
    assert not terminated
    assert min(info["margins"]["tilt"] for info in infos) >= 0.0
    stepped_in = [info["filter"]["intervened"] for info in infos]
    assert 0 < sum(stepped_in) < len(infos) == env.steps
    assert env.interventions == sum(stepped_in)
    assert all((info["filter"]["correction"] > 0.0) == info["filter"]["intervened"] for info in infos)
    status = env.unwrapped.flight().log.control.status
    assert [each != "unconstrained" for each in status] == stepped_in
    infos, terminated = random_episode(quadsim.gym.make_env(scenario), seed=0)
    assert terminated
    assert "tilted" in infos[-1]["reason"]


def test_the_guides_filter_protects_to_the_end_of_the_episode() -> None:
    """The block on the page; and whoever pushes always the same way, until that leads out of the reference's reach."""
    page = (ROOT / "docs" / "gym.md").read_text(encoding="utf-8")
    (block,) = [text for text in re.findall(r"```python\n(.*?)```", page, re.DOTALL) if "MPCSafetyFilter(" in text]
    names: dict[str, Any] = {"quadsim": quadsim}
    exec(block.replace("env.close()", ""), names)  # it is flown once more below
    env = names["env"]
    safe = names["safe"]
    flight = env.unwrapped.flight()
    assert env.steps == flight.time.size == round(safe.duration / safe.control_period)
    assert names["violations"] == 0
    assert 0 < env.interventions < env.steps
    assert {finding.limit.name for finding in flight.audit} == {"roll", "pitch", "yaw_rate", "vz", "speed", "slew"}
    assert flight.satisfied
    assert min(flight.margins["roll"].min(), flight.margins["pitch"].min()) > 0.0
    vehicle, (slowest, fastest) = env.unwrapped.started.vehicle, safe.controller.input_bounds.speed
    arm = vehicle.arm_length * vehicle.thrust_coefficient / min(vehicle.inertia[:2])
    assert arm * (fastest**2 - slowest**2) <= safe.controller.tightening.turning
    env.reset(seed=1)
    ended = False
    while not ended:
        _, _, terminated, truncated, info = env.step(np.array([0.0, 1.0, 0.0, -1.0], np.float32))
        assert info["filter"]["intervened"]
        assert not info["constraint_violation"]
        ended = terminated or truncated
    assert terminated == ("distance from the reference" in info["reason"])


def test_a_filter_whose_model_has_rotor_lag_finds_its_plans() -> None:
    """Its terminal condition is about the rotors' speeds at rest, far from zero."""
    bounds = {"roll": [-5.0, 5.0], "pitch": [-5.0, 5.0], "yaw_rate": [-60.0, 60.0], "vz": [-1.0, 1.0]}
    changes = {"constraints": [], "controller.input_bounds.speed": [430.0, 476.0], "controller.output_bounds": bounds}
    env = quadsim.gym.MPCSafetyFilter(quadsim.gym.make_env(quadsim.load("playground").replace(changes)))
    infos, terminated = random_episode(env, seed=0)
    assert not terminated
    assert not any(info["filter"]["fallback"] for info in infos)
    assert 0 < env.interventions < env.steps


@pytest.mark.representative("gym")
def test_what_is_safe_passes_to_the_bit() -> None:
    env = quadsim.gym.MPCSafetyFilter(quadsim.gym.make_env(safety_filter.filtered_air("gust"), action="speeds"))
    env.reset(seed=0)
    desired = env.unwrapped.started.vehicle.hover_speed + np.array([0.5, 0.25, -0.5, 0.125])
    info = env.step(desired)[4]
    assert info["filter"] == {"intervened": False, "correction": 0.0, "fallback": 0}
    assert np.array_equal(env.unwrapped.flight().command[0], desired)


def test_an_action_that_is_not_finite_is_not_flown() -> None:
    env = quadsim.gym.MPCSafetyFilter(quadsim.gym.make_env("robust", action="speeds"))
    with pytest.raises(ResetNeeded, match="reset"):
        env.step(np.zeros(4))
    env.reset(seed=0)
    for value in 3 * [np.nan, np.inf, -np.inf]:
        _, _, terminated, _, info = env.step(np.array([400.0, value, 400.0, 400.0]))
        assert not terminated
        assert info["filter"]["intervened"]
        assert info["filter"]["fallback"] > 0
    assert np.isfinite(env.unwrapped.flight().command).all()


@pytest.mark.parametrize("action", ["deviations", "rates"])
def test_after_an_action_that_is_not_finite_the_next_one_is_filtered(action: str) -> None:
    env = quadsim.gym.MPCSafetyFilter(quadsim.gym.make_env("robust", action=action))
    env.reset(seed=0)
    fallbacks = []
    for value in (0.1, np.nan, 0.1, -0.1):
        info = env.step(np.full(4, value, np.float32))[4]
        fallbacks.append(info["filter"]["fallback"])
    assert fallbacks == [0, 1, 0, 0]


GENTLE = {
    "controller.input_bounds.speed": [185.0, 200.0],
    "controller.output_bounds": {
        "roll": [-5.0, 5.0],
        "pitch": [-5.0, 5.0],
        "yaw_rate": [-30.0, 30.0],
        "vz": [-1.0, 1.0],
    },
    "controller.tightening": {"turning": 14.0},
    "constraints": [],
    "lost.departure": False,
    "duration": 10.0,
}
"""The scenario `robust` with bounds that the filter can hold between samples: see the page on learning."""


def test_random_body_rates_hold_every_bound_behind_the_filter_and_not_without() -> None:
    scenario = quadsim.load("robust").replace(GENTLE)
    env = quadsim.gym.MPCSafetyFilter(quadsim.gym.make_env(scenario, action="rates"))
    infos, terminated = random_episode(env, seed=0)
    assert not terminated
    assert len(infos) == env.steps == 200
    assert not any(info["constraint_violation"] for info in infos)
    assert not any(info["filter"]["fallback"] for info in infos)
    assert 0 < env.interventions <= env.steps
    assert env.unwrapped.flight().satisfied
    infos, terminated = random_episode(quadsim.gym.make_env(scenario, action="rates"), seed=0)
    assert terminated or any(info["constraint_violation"] for info in infos)


def test_gentle_body_rates_pass_and_are_reached_at_the_end_of_the_period() -> None:
    """To the rates at which their loop arrives, without the filter, from the same state; and to its thrust."""
    scenario = quadsim.load("robust").replace(GENTLE)
    flown = []
    for env in (
        quadsim.gym.MPCSafetyFilter(quadsim.gym.make_env(scenario, action="rates")),
        quadsim.gym.make_env(scenario, action="rates"),
    ):
        env.reset(seed=0)
        info = env.step(np.array([0.05, 0.002, -0.001, 0.003], np.float32))[4]
        state = env.unwrapped.flight().log.plant.state[-1]
        rates = env.unwrapped.started.observation.moment.body_rates
        flown.append([*rates, state[INDEX["vz"]]])
        assert info.get("filter", {"intervened": False})["intervened"] is False
    behind, alone = flown
    assert np.abs(behind).min() > 1e-3
    np.testing.assert_allclose(behind, alone, rtol=0.02)


def test_a_vector_of_filtered_environments_is_each_of_them_to_the_bit() -> None:
    def make() -> gymnasium.Env[Any, Any]:
        return quadsim.gym.MPCSafetyFilter(quadsim.gym.make_env("robust", action="rates"))

    actions = np.array([[0.1, 0.5, 0.0, 0.0], [0.0, 0.0, -0.01, 0.01]], np.float32)
    envs = gymnasium.vector.SyncVectorEnv([make, make])
    observed, _ = envs.reset(seed=4)
    for _ in range(5):
        observed, *_, infos = envs.step(actions)
    for place in range(2):
        env = make()
        env.reset(seed=4 + place)
        for _ in range(5):
            alone, *_, info = env.step(actions[place])
        np.testing.assert_array_equal(observed[place], alone)
        assert infos["filter"]["intervened"][place] == info["filter"]["intervened"]
        assert infos["filter"]["correction"][place] == info["filter"]["correction"]


def test_what_cannot_be_filtered_is_refused() -> None:
    with pytest.raises(ParameterError, match=r"action must be one of .*rates.* become rotor speeds"):
        quadsim.gym.MPCSafetyFilter(quadsim.gym.make_env("robust", action="attitude"))
    with pytest.raises(ParameterError, match="environment"):
        quadsim.gym.MPCSafetyFilter(gymnasium.make("Pendulum-v1"))
    with pytest.raises(ParameterError, match=r"controller\.type"):
        quadsim.gym.MPCSafetyFilter(quadsim.gym.make_env("paper-constrained"))
    env = quadsim.gym.MPCSafetyFilter(quadsim.gym.make_env("forest"))
    with pytest.raises(ParameterError, match="half-spaces"):
        env.reset()


def test_a_student_is_audited_like_its_teacher(capsys: pytest.CaptureFixture[str]) -> None:
    student = imitation.learn(courses=1, rounds=0)
    assert "600 samples, RMS error 0." in capsys.readouterr().out
    flights = imitation.compared(student, flights=1, duration=3.0)
    assert [flights[name][0].controller for name in ("teacher", "student")] == ["constrained", "student"]
    limits = [{finding.limit.name for finding in each[0].audit} for each in flights.values()]
    assert limits == [{"roll", "pitch", "speed", "slew"}] * 3
    assert flights["teacher"][0].satisfied
    assert imitation.beyond(flights["student"][0]) > imitation.TOLERANCE  # hardly taught at all
    assert imitation.beyond(flights["student behind the filter"][0]) < imitation.TOLERANCE


def test_the_filter_is_needed(capsys: pytest.CaptureFixture[str]) -> None:
    safety_filter.main(["gust"])
    behind, alone = capsys.readouterr().out.splitlines()
    assert behind.startswith("gust: 180 steps, tilt up to 4.")
    assert "flown; stepped in" in behind
    assert alone.endswith("lost; no filter")


def test_the_teacher_labels_its_own_flight_and_the_students() -> None:
    scenario = imitation.course(0).replace({"duration": 1.0})
    hover = quadsim.load_vehicle("lopes2011").hover_speed
    own = imitation.Lesson(scenario, hover)
    flight = quadsim.fly(scenario, controller=own, progress=False)
    assert np.array_equal(flight.command, quadsim.fly(scenario, progress=False).command)
    assert np.array_equal(own.speeds, flight.command)
    other = imitation.Lesson(scenario, hover, imitation.Student(np.ones((imitation.INPUTS, 4)), hover))
    quadsim.fly(scenario, controller=other, progress=False)
    assert len(other.seen) == len(other.speeds) > 1
    assert np.array_equal(other.speeds[0], own.speeds[0])
    assert not np.array_equal(other.speeds[1], own.speeds[1])


def test_a_filter_of_an_autopilot_s_targets_is_refused() -> None:
    weights = {"thrust": 0.1, "body_rate": 0.1}
    controller = {"type": "robust", "commands": "rates", "horizon": 10, "output_weights": {"x": 1.0}}
    controller |= {"target_weights": weights, "inner_lag": [0.0, 0.05, 0.05, 0.1]}
    env = quadsim.gym.make_env("hover", action="speeds")
    with env, pytest.raises(ParameterError, match=r"controller\.commands must be rotors, for a safety filter"):
        quadsim.gym.MPCSafetyFilter(env, controller=controller)
