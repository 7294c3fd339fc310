"""The numbers of a summary, by hand."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from support import small_log

from quadsim.controller import Phase
from quadsim.flight import metrics
from quadsim.flight.log import ControlLog, TimingLog
from quadsim.flight.metrics import CourseStep
from quadsim.state import Array


def control(z: list[float], reference: list[float]) -> ControlLog:
    """A log where z [m] and its reference are as given and all else is zero."""
    log = small_log(len(z)).control
    state = np.zeros_like(log.state)
    desired = np.zeros_like(log.reference)
    state[:, 4] = z
    desired[:, 2] = reference
    return replace(log, truth=state, reference=desired)


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
    extremes = {"speed_min": 200.0, "speed_max": 230.0, "slew_min": -30.0, "slew_max": 30.0}
    # Four rotors step from 195 to 200; then one goes to 230 and back.
    assert metrics.control(log) == {**extremes, "total_variation": 4 * 5.0 + 30.0 + 30.0}


def settled(t: Array, x: Array, *, before: float, after: float, start: float = 0.0, until: float) -> float | None:
    """Settling time of x [m], all other channels at rest."""
    outputs = np.zeros((t.size, 4))
    outputs[:, 0] = x
    step = CourseStep(channel="x", time=start, before=before, after=after, until=until)
    (entry,) = metrics.settling(t, outputs, [step])
    assert {name: entry[name] for name in ("channel", "time", "before", "after")} == {
        "channel": "x", "time": start, "before": before, "after": after,
    }  # fmt: skip
    return entry["settled"]


@pytest.mark.parametrize("tau", [0.1, 0.7, 2.0])
@pytest.mark.parametrize(("before", "after"), [(0.0, 10.0), (3.0, -1.0)])
def test_a_first_order_response_settles_after_tau_ln_20(tau: float, before: float, after: float) -> None:
    """exp(-t / tau) = 0.05 at t = tau ln 20, whatever the step; the first sample from then on counts."""
    period = 0.05
    start = 2.0
    t = np.arange(400) * period
    x = np.where(t < start, before, after + (before - after) * np.exp(-(t - start) / tau))
    expected = period * math.ceil(tau * math.log(20.0) / period)
    result = settled(t, x, before=before, after=after, start=start, until=20.0)
    assert result == pytest.approx(expected, abs=1e-9)


def test_an_output_that_leaves_the_band_again_has_not_settled_before() -> None:
    t = np.arange(10.0)
    x = np.array([0.0, 1.0, 1.0, 1.0, 0.9, 1.0, 1.0, 1.0, 1.0, 1.0])
    assert settled(t, x, before=0.0, after=1.0, until=10.0) == 5.0
    assert settled(t, x, before=0.0, after=1.0, until=3.0) == 1.0  # what comes after is the next step's
    assert settled(t, np.where(t < 9.0, x, 0.5), before=0.0, after=1.0, until=10.0) is None


def test_a_flight_that_ended_before_has_not_settled() -> None:
    t = np.arange(5.0)
    x = np.array([0.0, 1.0, 1.0, 1.0, 1.0])
    assert settled(t, x, before=0.0, after=1.0, until=5.0) == 1.0
    assert settled(t, x, before=0.0, after=1.0, until=6.0) is None
    assert settled(t, x, before=0.0, after=1.0, start=7.0, until=9.0) is None
    assert settled(t[:0], x[:0], before=0.0, after=1.0, until=5.0) is None
    assert settled(t[:1], x[:1], before=1.0, after=0.0, until=40.0) is None


def test_peak_tilt_is_the_larger_of_roll_and_pitch() -> None:
    state = np.zeros((3, 12))
    state[1, 6] = math.radians(3.0)
    state[2, 8] = math.radians(-7.0)
    state[2, 10] = 2.0
    assert metrics.peak_tilt(state) == pytest.approx(7.0)


def test_the_controllers_counts_and_times() -> None:
    log = replace(
        small_log(4).control,
        status=("solved", "max_iterations", "unconstrained", "solved"),
        fallback=np.array([0, 1, 0, 0]),
        iterations=np.array([3, 100, 4, 5]),
        active=np.array([0, 0, 7, 2]),
        answered_by=("piqp-dense", "fallback", "core", "piqp-dense"),
        reported_primal=np.array([1e-9, math.inf, math.nan, 0.0]),
        infeasibility=np.array([2e-9, 0.1, 3e-9, 0.0]),
        kkt_dual=np.full(4, math.nan),
    )
    timing = TimingLog(t=log.t, solve_ms=np.array([1.0, 2.0, 3.0, 4.0]), step_ms=np.array([50.0, 50.1, 3.0, 70.0]))
    numbers = metrics.controller(log, timing, deadline_ms=50.0)
    assert numbers["statuses"] == {"max_iterations": 1, "solved": 2, "unconstrained": 1}
    assert numbers["fallbacks"] == {"0": 3, "1": 1}
    assert numbers["answered_by"] == {"core": 1, "fallback": 1, "piqp-dense": 2}
    assert numbers["iterations"] == {"mean": 4.0, "max": 5}  # of the QP solver alone
    assert numbers["iterations_by"] == {
        "core": {"mean": 4.0, "max": 4},
        "fallback": {"mean": 100.0, "max": 100},
        "piqp-dense": {"mean": 4.0, "max": 5},
    }
    assert (numbers["active_max"], numbers["active_periods"]) == (7, 2)
    assert numbers["solve_ms"]["p50"] == 2.5
    assert numbers["step_ms"]["max"] == 70.0
    assert (numbers["deadline_ms"], numbers["deadline_misses"]) == (50.0, 2)
    assert numbers["residuals"]["reported_primal"] == {"max": 1e-9, "periods": 2}  # of accepted answers alone
    assert numbers["residuals"]["infeasibility"] == {"max": 3e-9, "periods": 3}
    assert numbers["residuals"]["kkt_dual"] == {"max": None, "periods": 0}  # absent, not 0
    json.dumps(numbers, allow_nan=False)
    several = replace(log, answered_by=("piqp-dense", "fallback", "core", "daqp"))
    assert metrics.controller(several, timing, deadline_ms=50.0)["iterations"] is None


@pytest.mark.parametrize(
    ("levels", "expected"),
    [
        ([0] * 20, 0),
        ([2, *[0] * 19], 0),  # it recovered
        ([0] * 11 + [1] * 9, 0),  # 0.9 s, too short to count
        ([0] * 10 + [1] * 9 + [3], 10),
        ([1] * 5 + [0] + [1] * 14, 14),
        ([2, 2, 1], 3),  # the whole of a short flight
        ([], 0),
    ],
)
def test_fallback_for_good_is_the_last_second_at_least_or_the_whole_flight(levels: list[int], expected: int) -> None:
    log = replace(small_log(len(levels)).control, fallback=np.array(levels, np.int64))
    assert metrics.unrecovered(log) == expected


GROUND = [Phase.LANDED] * 10
UP = [Phase.ARMED] * 30


@pytest.mark.parametrize(
    ("phases", "expected"),
    [
        (GROUND + UP, 1.0),
        (GROUND + UP[:-1], None),  # 2.9 s, too short to count
        (GROUND + UP + [Phase.FLYING], None),
        (GROUND + UP + [Phase.CRASHED], None),  # another failure
        ([Phase.FLYING] * 5 + GROUND + UP, 1.5),  # not again
        ([Phase.LANDED] * 40, None),  # not told
        (GROUND + UP + GROUND, 1.0),  # told, and called off
        ([Phase.FLYING] * 40, None),
        ([], None),
    ],
)
def test_no_take_off_counts_three_seconds_after_it_was_told(phases: list[Phase], expected: float | None) -> None:
    height = [0.2 if phase is Phase.ARMED else 0.12 for phase in phases]
    log = replace(control([0.1] * len(phases), height), phase=tuple(map(str, phases)))
    assert metrics.never_took_off(log) == expected


def test_a_flight_of_no_period_has_no_numbers() -> None:
    assert metrics.flight_numbers(small_log(0), 50.0) == {"tracking": {}, "control": {}, "controller": {}}
    assert all(metrics.flight_numbers(small_log(1), 50.0).values())


def test_what_a_law_does_not_report_is_absent() -> None:
    """A PID controller has no optimum: neither its time nor its active constraints are 0."""
    log = replace(small_log(3).control, status=("commanded",) * 3, answered_by=("law",) * 3, active=np.zeros(3, int))
    timing = TimingLog(t=log.t, solve_ms=np.full(3, math.nan), step_ms=np.array([1.0, 2.0, 3.0]))
    numbers = metrics.controller(log, timing, deadline_ms=50.0)
    assert numbers["solve_ms"] == {"p50": None, "p95": None, "p99": None, "max": None}
    assert (numbers["active_max"], numbers["active_periods"]) == (None, None)
    assert numbers["step_ms"]["p50"] == 2.0
    some = replace(timing, solve_ms=np.array([math.nan, 3.0, 1.0]))
    assert metrics.controller(log, some, deadline_ms=50.0)["solve_ms"]["p50"] == 2.0
