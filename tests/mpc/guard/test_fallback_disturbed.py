"""The fallback contract with an estimated disturbance: each level holds against it."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from scripted_controller import Pressed, Scripted, advance, at_rest, call, failing, guard, model, pressed

from quadsim.state import INDEX


@pytest.mark.parametrize("yaw", [0.0, 2.0])
def test_every_level_compensates_the_disturbance(yaw: float) -> None:
    guarded = guard(Pressed(failing(range(1, 200))))
    guarded.reset(pressed().speeds)
    state = at_rest(yaw)
    levels = []
    for _ in range(200):
        command = call(guarded, state)
        levels.append(command.fallback)
        state = advance(state, command.speeds, pressed())
        if command.fallback < 3:
            np.testing.assert_allclose(state, at_rest(yaw), atol=1e-9)
    assert sorted(set(levels)) == [0, 1, 2, 3]
    assert state[INDEX["vz"]] == pytest.approx(-0.5, abs=1e-3)
    np.testing.assert_allclose(np.delete(state - at_rest(yaw), [INDEX["z"], INDEX["vz"]]), 0.0, atol=1e-3)


def test_missing_channels_follow_the_disturbance() -> None:
    inner = Pressed()
    guarded = guard(inner)
    guarded.reset(pressed().speeds)
    state = at_rest(2.0) + 0.01
    for k in range(25):
        call(guarded, state if k < 3 else np.full(12, math.nan))
        np.testing.assert_allclose(inner.calls[-1][1], state, atol=1e-9)
        state = advance(state, pressed().speeds, pressed())


def test_the_last_trim_holds_while_nothing_is_measured() -> None:
    inner = Pressed()
    guarded = guard(inner)
    guarded.reset(pressed().speeds)
    state = at_rest(0.0)
    for k in range(100):
        command = call(guarded, state if k < 3 else np.full(12, math.nan))
        state = advance(state, command.speeds, pressed())
    assert command.status == "state_unknown"
    assert len(inner.calls) < 40
    np.testing.assert_allclose(state, at_rest(0.0), atol=1e-9)


@pytest.mark.parametrize("trim", [None, 3.0, "absent", RuntimeError("no")])
def test_a_controller_without_a_valid_trim_hovers_level(trim: Any) -> None:
    class Silent(Scripted):
        def __getattr__(self, name: str) -> Any:
            if trim == "absent" or name != "trim":
                raise AttributeError(name)
            if isinstance(trim, Exception):
                raise trim
            return trim

    guarded = guard(Silent())
    assert guarded.guard is not None
    estimate = guarded.guard.trim(guarded.law)
    np.testing.assert_array_equal(estimate.speeds, model().u_bar)
    assert estimate.lean(0.0) == (0.0, 0.0)


def test_its_own_predictions_turn_with_the_heading() -> None:
    states = np.array([at_rest(2.0), at_rest(-1.0)])
    plans = np.tile(pressed().speeds, (2, 30, 1))
    np.testing.assert_allclose(guard(Pressed()).predict(states, plans), states[:, None].repeat(30, 1), atol=1e-9)
