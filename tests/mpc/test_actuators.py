"""What actuators can take: speeds and steps within their bounds, and bounds that leave something."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scripted_controller import (
    bounds,
    model,
)

from quadsim.errors import ParameterError


def test_reach_keeps_speeds_and_steps() -> None:
    lower, upper = bounds().reach(np.array([0.0, 5.0, 192.8, 248.0]))
    np.testing.assert_allclose(lower, [0.0, 0.0, 182.8, 238.0])
    np.testing.assert_allclose(upper, [5.0, 10.0, 197.8, 250.0])


@pytest.mark.parametrize(("before", "only"), [(-100.0, 0.0), (400.0, 250.0)])
def test_speeds_come_before_steps(before: float, only: float) -> None:
    for end in bounds().reach(np.full(4, before)):
        np.testing.assert_array_equal(end, np.full(4, only))


def test_a_plan_in_reach_stays_and_any_other_is_brought_into_it() -> None:
    before = model().u_bar
    steady = before + np.linspace(0.0, 40.0, 9)[:, None]
    np.testing.assert_array_equal(bounds().clip_plan(steady, before), steady)
    wild = np.random.default_rng(0).uniform(-500.0, 500.0, (30, 4))
    clipped = bounds().clip_plan(wild, before)
    steps = np.diff(clipped, axis=0, prepend=before[None])
    assert clipped.min() >= 0.0
    assert clipped.max() <= 250.0
    assert steps.min() >= -10.0 - 1e-12
    assert steps.max() <= 5.0 + 1e-12


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"u_max": [1.0]}, r"controller\.u_max must be 4 numbers; got \[1\.0\]"),
        ({"delta_min": [math.nan] * 4}, r"controller\.delta_min must be 4 numbers"),
        ({"u_max": [math.inf] * 4}, r"controller\.u_min must be finite and below a finite u_max"),
        ({"u_min": [250.0] * 4}, r"controller\.u_min must be finite and below"),
        ({"delta_max": [-1.0] * 4}, r"controller\.delta_min must be <= 0 and delta_max = .* so that a speed can be"),
    ],
)
def test_impossible_bounds_are_refused(change: dict[str, list[float]], message: str) -> None:
    with pytest.raises(ParameterError, match=message):
        replace(bounds(), **change)  # type: ignore[arg-type]
