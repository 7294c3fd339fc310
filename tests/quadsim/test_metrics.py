"""The numbers of a summary, by hand."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from support import small_log

from quadsim import metrics
from quadsim.flightlog import ControlLog, TimingLog


def control(z: list[float], reference: list[float]) -> ControlLog:
    """A log where z [m] and its reference are as given and all else is zero."""
    log = small_log(len(z)).control
    state, wanted = np.zeros_like(log.state), np.zeros_like(log.reference)
    state[:, 4], wanted[:, 2] = z, reference
    return replace(log, state=state, reference=wanted)


def test_tracking_errors_are_real_minus_reference() -> None:
    numbers = metrics.tracking(control([0.0, 1.0, 3.0, 1.5], [0.0, 2.0, 2.0, 2.0]))
    assert numbers["rmse"]["z"] == pytest.approx(math.sqrt((0.0 + 1.0 + 1.0 + 0.25) / 4.0))
    assert numbers["max_error"]["z"] == 1.0
    assert numbers["final_error"]["z"] == -0.5
    assert numbers["unit"] == {"x": "m", "y": "m", "z": "m", "yaw": "rad"}
    for name in ("rmse", "max_error", "final_error", "overshoot"):
        assert numbers[name]["x"] == numbers[name]["y"] == numbers[name]["yaw"] == 0.0


@pytest.mark.parametrize(
    ("z", "reference", "overshoot"),
    [
        ([0.0, 1.0, 3.0, 2.0], [0.0, 2.0, 2.0, 2.0], 1.0),  # above the highest reference
        ([0.0, -0.5, 1.0, 2.0], [0.0, 2.0, 2.0, 2.0], 0.5),  # below where it started
        ([5.0, 4.0, 2.0, 2.0], [2.0, 2.0, 2.0, 2.0], 0.0),  # coming from outside the reference is none
        ([-1.0, 0.0, 2.0, 2.0], [2.0, 2.0, 2.0, 2.0], 0.0),
        ([5.0, 4.0, 2.0, 1.75], [2.0, 2.0, 2.0, 2.0], 0.25),
    ],
)
def test_overshoot_is_what_leaves_the_range_of_reference_and_start(
    z: list[float], reference: list[float], overshoot: float
) -> None:
    assert metrics.tracking(control(z, reference))["overshoot"]["z"] == overshoot


def test_extremes_of_speeds_and_steps() -> None:
    log = small_log(3).control
    log.speeds[:] = 200.0
    log.speeds[1, 2] = 230.0
    log.speeds_before[:] = 195.0
    expected = {"speed_min": 200.0, "speed_max": 230.0, "slew_min": -30.0, "slew_max": 30.0}
    assert metrics.control(log) == expected


def test_percentiles() -> None:
    values = np.arange(101.0)[::-1]
    assert metrics.percentiles(values) == {"p50": 50.0, "p95": 95.0, "p99": 99.0, "max": 100.0}


def test_the_controllers_counts_and_times() -> None:
    log = replace(
        small_log(4).control,
        status=("solved", "max_iterations", "solved", "solved"),
        fallback=np.array([0, 1, 0, 0]),
        iterations=np.array([3, 100, 4, 5]),
        active=np.array([0, 0, 7, 2]),
        primal_residual=np.array([1e-9, math.inf, 3e-9, 0.0]),
        dual_residual=np.array([1e-8, math.nan, 0.0, 2e-8]),
    )
    timing = TimingLog(t=log.t, solve_ms=np.array([1.0, 2.0, 3.0, 4.0]), step_ms=np.array([50.0, 50.1, 3.0, 70.0]))
    numbers = metrics.controller(log, timing, deadline_ms=50.0)
    assert numbers["statuses"] == {"max_iterations": 1, "solved": 3}
    assert numbers["fallbacks"] == {"0": 3, "1": 1}
    assert numbers["iterations"] == {"mean": 28.0, "max": 100}
    assert (numbers["active_max"], numbers["active_periods"]) == (7, 2)
    assert numbers["solve_ms"]["p50"] == 2.5
    assert numbers["step_ms"]["max"] == 70.0
    assert (numbers["deadline_ms"], numbers["deadline_misses"]) == (50.0, 2)
    assert numbers["residual_max"] == {"primal": 3e-9, "dual": 2e-8}  # of the periods solved
    json.dumps(numbers, allow_nan=False)


def test_nothing_solved_has_no_residual() -> None:
    log = replace(small_log(2).control, status=("numerics", "numerics"), primal_residual=np.full(2, math.nan))
    assert metrics.controller(log, small_log(2).timing, 50.0)["residual_max"] == {"primal": 0.0, "dual": 0.0}


def test_a_flight_of_no_period_has_no_numbers() -> None:
    assert metrics.flight_numbers(small_log(0), 50.0) == {"tracking": {}, "control": {}, "controller": {}}
    assert all(metrics.flight_numbers(small_log(1), 50.0).values())
