"""The safety filter around an environment: a random agent behind it holds what it loses without."""

from __future__ import annotations

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

ROOT = Path(__file__).resolve().parents[3]
sys.path.insert(0, str(ROOT / "examples"))

from safety_filter import filtered_air  # noqa: E402


def test_a_random_agent_holds_five_degrees_of_tilt_behind_it() -> None:
    """Which it does not without: tests/test_learning_examples.py."""
    scenario = filtered_air("turbulence").replace({"duration": 5.0})
    env = quadsim.gym.MPCSafetyFilter(quadsim.gym.make_env(scenario))
    env.reset(seed=0)
    env.action_space.seed(0)
    steps = [env.step(env.action_space.sample()) for _ in range(100)]
    assert [step[2:4] for step in steps] == [(False, False)] * 99 + [(False, True)]
    infos: list[dict[str, Any]] = [step[4] for step in steps]
    assert min(info["margins"]["tilt"] for info in infos) >= 0.0
    stepped_in = [info["filter"]["intervened"] for info in infos]
    assert 0 < sum(stepped_in) < len(infos) == env.steps
    assert env.interventions == sum(stepped_in)
    assert all((info["filter"]["correction"] > 0.0) == info["filter"]["intervened"] for info in infos)
    status = env.unwrapped.flight().log.control.status
    assert [each != "unconstrained" for each in status] == stepped_in


def test_what_is_safe_passes_to_the_bit() -> None:
    env = quadsim.gym.MPCSafetyFilter(quadsim.gym.make_env(filtered_air("gust"), action="speeds"))
    env.reset(seed=0)
    wanted = env.unwrapped.started.vehicle.hover_speed + np.array([0.5, 0.25, -0.5, 0.125])
    info = env.step(wanted)[4]
    assert info["filter"] == {"intervened": False, "correction": 0.0, "fallback": 0}
    assert np.array_equal(env.unwrapped.flight().command[0], wanted)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_an_action_that_is_not_finite_is_not_flown(value: float) -> None:
    env = quadsim.gym.MPCSafetyFilter(quadsim.gym.make_env("robust", action="speeds"))
    with pytest.raises(ResetNeeded, match="reset"):
        env.step(np.zeros(4))
    env.reset(seed=0)
    for _ in range(10):
        _, _, terminated, _, info = env.step(np.array([400.0, value, 400.0, 400.0]))
        assert not terminated
        assert info["filter"]["intervened"]
        assert info["filter"]["fallback"] > 0
    assert np.isfinite(env.unwrapped.flight().command).all()


def test_what_cannot_be_filtered_is_refused() -> None:
    with pytest.raises(ParameterError, match="an environment of quadsim"):
        quadsim.gym.MPCSafetyFilter(gymnasium.make("Pendulum-v1"))
    with pytest.raises(ParameterError, match="deviations or speeds"):
        quadsim.gym.MPCSafetyFilter(quadsim.gym.make_env("robust", action="rates"))
    with pytest.raises(ParameterError, match=r"controller.type must be robust"):
        quadsim.gym.MPCSafetyFilter(quadsim.gym.make_env("paper-constrained"))
    env = quadsim.gym.MPCSafetyFilter(quadsim.gym.make_env("forest"))
    with pytest.raises(ParameterError, match="no half-spaces"):
        env.reset()
