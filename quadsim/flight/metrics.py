"""Pure functions from a flight to the numbers of its summary.

Errors are the true state minus the filtered reference at the control samples: RMS, largest, final, overshoot; of
commands the range of speeds and steps; of the controller its statuses and times.  `quadsim.rollout.flown.summarise`
collects them for summary.json.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from quadsim.controller import ACCEPTED, MISSED, NO_OPTIMUM, NO_SOLVER, Phase
from quadsim.flight.departure import departure_numbers
from quadsim.flight.log import RESIDUALS, ControlLog, FlightLog, TimingLog
from quadsim.flight.phase import AIRBORNE, TAKEOFF_RISE, Outline, clearance, takeoff_time, touchdown
from quadsim.state import (
    INDEX,
    REFERENCE_NAMES,
    REFERENCE_STATES,
    REFERENCE_UNITS,
    STATE_NAMES,
    STATE_UNITS,
    Array,
    wrapped,
)

SETTLING_BAND: Final = 0.05  # half-width of the settling band, as a share of the step

UNRECOVERED: Final = 1.0
"""Time in fallback at the end of a flight that counts as permanent [s]: the default limit on one shifted plan."""
TAKEOFF_PATIENCE: Final = 3.0
"""Time on the ground under a course in the air after which a vehicle has not taken off [s]; cold rotors need some of it
to spin up, up to 2.2 s with the paper's bound on steps."""


@dataclass(frozen=True, kw_only=True)
class CourseStep:
    """A step of the unfiltered course in one channel; angles in rad, lengths in m."""

    channel: str  # `x`, `y`, `z` or `yaw`
    time: float  # time of the step [s]
    before: float  # previous value; at the start of a flight, the vehicle's
    after: float  # new value
    until: float
    """When the controller first sees the channel's next step, or the planned end of the flight [s]."""


def tracking(log: ControlLog) -> dict[str, Any]:
    """Tracking errors, real minus reference, against the filtered reference at the control samples.

    Returns:
        `rmse`, `max_error` (largest magnitude), `final_error` (last sample, signed) and `overshoot` (how far the
        channel leaves the range spanned by its reference and its start), each by channel x, y, z [m], yaw [rad];
        `position_error`, of the distance from the reference: its mean, its root mean square, and the largest [m].
    """
    state = log.truth[:, REFERENCE_STATES]
    error = log.tracking_error
    distance = np.linalg.norm(error[:, :3], axis=1)
    lowest = np.minimum(log.reference.min(axis=0), state[0])
    highest = np.maximum(log.reference.max(axis=0), state[0])
    beyond = np.maximum((state - highest).max(axis=0), (lowest - state).max(axis=0))
    by_channel = {
        "rmse": np.sqrt(np.mean(error**2, axis=0)),
        "max_error": np.abs(error).max(axis=0),
        "final_error": error[-1],
        "overshoot": np.maximum(beyond, 0.0),
    }
    numbers: dict[str, Any] = {"unit": dict(zip(REFERENCE_NAMES, REFERENCE_UNITS, strict=True))}
    for name, values in by_channel.items():
        numbers[name] = dict(zip(REFERENCE_NAMES, values.tolist(), strict=True))
    numbers["position_error"] = {  # papers often print the mean of the distance as RMSE
        "mean": float(distance.mean()),
        "rms": math.sqrt(float(np.mean(np.square(distance)))),
        "max": float(distance.max()),
    }
    return numbers


def settling(t: Array, outputs: Array, steps: Sequence[CourseStep]) -> list[dict[str, Any]]:
    """Compute the settling time of each step of the course.

    It runs from the step of the unfiltered course to the first control sample after which the output stays within
    `SETTLING_BAND` of the step around its new value.  Samples count up to `until`: a controller with a preview moves
    before the next step, on purpose.  Disturbances by steps of other channels count.  The time is None if the output
    does not settle, the flight ends too early, or the next step is in view at once.

    Returns:
        One entry per step, in order: the step's fields, and `settled` [s].
    """
    entries = []
    for step in steps:
        entries.append(
            {
                "channel": step.channel,
                "time": step.time,
                "before": step.before,
                "after": step.after,
                "settled": _settling_time(t, outputs[:, REFERENCE_NAMES.index(step.channel)], step),
            }
        )
    return entries


def _settling_time(t: Array, output: Array, step: CourseStep) -> float | None:
    """Return the settling time of one step [s], from the output of its channel (K,) at times (K,) [s]."""
    if t.size < 2 or t[-1] + (t[1] - t[0]) <= step.until - 1e-9:
        return None
    in_window = (t >= step.time - 1e-9) & (t <= step.until + 1e-9)
    error = output[in_window] - step.after
    size = step.after - step.before
    if step.channel == "yaw":
        error = wrapped(error)
        size = wrapped(size)
    outside = np.flatnonzero(np.abs(error) > SETTLING_BAND * abs(size))
    first = 0  # sample from which on the output stays within the band
    if outside.size:
        first = int(outside[-1]) + 1
    if first == error.size:
        return None
    return round(float(t[in_window][first] - step.time), 9)


def peak_tilt(state: Array) -> float:
    """Largest magnitude of roll or pitch in states (K, 12) [deg]; each has its own bound, Eq. (35)."""
    return float(np.degrees(np.abs(state[:, [INDEX["roll"], INDEX["pitch"]]]).max()))


def control(log: ControlLog) -> dict[str, float]:
    """Extremes of the commanded speeds [rad/s] and of their steps per period [rad/s], over all rotors.

    `total_variation` is the sum of the magnitudes of all steps of all rotors [rad/s].
    """
    return {
        "speed_min": float(log.speeds.min()),
        "speed_max": float(log.speeds.max()),
        "slew_min": float(log.slews.min()),
        "slew_max": float(log.slews.max()),
        "total_variation": float(np.abs(log.slews).sum()),
    }


def percentiles(values: Array) -> dict[str, Any]:
    """Return the median, 95th and 99th percentile and maximum of the values that there are, not NaN; None for none."""
    known = values[~np.isnan(values)]
    if not known.size:
        return dict.fromkeys(("p50", "p95", "p99", "max"))
    p50, p95, p99 = np.percentile(known, [50, 95, 99])
    return {"p50": float(p50), "p95": float(p95), "p99": float(p99), "max": float(known.max())}


def controller(log: ControlLog, timing: TimingLog, deadline_ms: float) -> dict[str, Any]:
    """Count statuses, answerers and fallbacks; `unrecovered`, `never_took_off`, iterations, residuals, times [ms].

    `iterations` covers the periods that the QP solver answered, None if there are none, or several solvers;
    `iterations_by` lists every answerer that iterates.  Each residual has its largest value among accepted answers, and
    the number of these periods in which it was computed.  What a controller does not report, the time of its optimum
    and the active constraints there, is None.
    """
    answerers = set(log.answered_by)
    iterations_by = _iterations_by(log)
    solvers = answerers - NO_SOLVER
    iterations = None
    if len(solvers) == 1:
        iterations = iterations_by.get(solvers.pop())
    active_max = None
    active_periods = None
    if answerers - NO_OPTIMUM or log.active.any():
        active_max = int(log.active.max())
        active_periods = int(np.count_nonzero(log.active))
    return {
        "statuses": dict(sorted(Counter(log.status).items())),
        "fallbacks": {str(level): count for level, count in sorted(Counter(log.fallback.tolist()).items())},
        "unrecovered": unrecovered(log),
        "never_took_off": never_took_off(log),
        "answered_by": dict(sorted(Counter(log.answered_by).items())),
        "iterations": iterations,
        "iterations_by": iterations_by,
        "active_max": active_max,
        "active_periods": active_periods,
        "residuals": _residuals(log),
        "solve_ms": percentiles(timing.solve_ms),
        "step_ms": percentiles(timing.step_ms),
        "deadline_ms": deadline_ms,
        "deadline_misses": int(np.count_nonzero(timing.step_ms > deadline_ms)),
    }


def _iterations_by(log: ControlLog) -> dict[str, dict[str, Any]]:
    """Return the mean and the largest number of iterations of each answerer that iterates, by name."""
    answered_by = np.array(log.answered_by)
    numbers = {}
    for answerer in sorted(set(log.answered_by)):
        counts = log.iterations[answered_by == answerer]
        if counts.any() or answerer not in NO_SOLVER:
            numbers[answerer] = {"mean": float(counts.mean()), "max": int(counts.max())}
    return numbers


def _residuals(log: ControlLog) -> dict[str, dict[str, Any]]:
    """Return the largest value of each residual among accepted answers, None without one, and their number."""
    accepted = np.array([status in ACCEPTED for status in log.status])
    numbers = {}
    for name in RESIDUALS:
        values = getattr(log, name)[accepted]
        computed = values[np.isfinite(values)]
        largest = None
        if computed.size:
            largest = float(computed.max())
        numbers[name] = {"max": largest, "periods": computed.size}
    return numbers


def unrecovered(log: ControlLog) -> int:
    """Return the periods in fallback at the end of a flight that never recovered; 0 if they are too short to count.

    They count from `UNRECOVERED` on, or if the whole flight was in fallback.
    """
    without_fallback = np.flatnonzero(log.fallback == 0)
    if not without_fallback.size:
        return log.t.size
    periods = log.t.size - 1 - int(without_fallback[-1])
    if periods and periods * float(log.t[1] - log.t[0]) >= UNRECOVERED - 1e-9:
        return periods
    return 0


def failure(log: ControlLog) -> str | None:
    """Return how a flight failed apart from its audit; None if it did not.

    `crash`, `permanent fallback` (see `unrecovered`) or `no take-off` (see `never_took_off`).
    """
    if log.crashed:
        return "crash"
    if never_took_off(log) is not None:
        return "no take-off"
    if unrecovered(log):
        return "permanent fallback"
    return None


def never_took_off(log: ControlLog) -> float | None:
    """Return when a vehicle was told to leave the ground that it stands on at the end [s]; None if it need not, or did.

    It is told by a reference `TAKEOFF_RISE` above the place where it stands, and counts once such a reference has
    lasted `TAKEOFF_PATIENCE`.  A crash is another failure.
    """
    start = 0  # first of the periods on the ground at the end
    for k, phase in enumerate(log.phase):
        if phase == Phase.FLYING:
            start = k + 1
    if log.crashed or log.t.size - start < 2:
        return None
    heights = log.truth[start:, INDEX["z"]]
    references = log.reference[start:, REFERENCE_NAMES.index("z")]
    above = np.flatnonzero(references > heights.min() + TAKEOFF_RISE)
    lasted = above.size * float(log.t[1] - log.t[0])
    if lasted >= TAKEOFF_PATIENCE - 1e-9:
        return float(log.t[start + above[0]])
    return None


def computation(log: ControlLog) -> dict[str, Any]:
    """Simulated times from measurement to command [ms], and the number of commands that came too late."""
    return {"delay_ms": percentiles(1e3 * log.delay), "missed": log.status.count(MISSED)}


def estimation(log: ControlLog) -> dict[str, Any]:
    """Errors of the measured state, measured minus true, by state: RMS, and the largest magnitude.

    Samples that are not numbers, as from a failed sensor, are counted and excluded.
    """
    error = log.measured_error
    finite = np.isfinite(error)
    known = np.where(finite, error, 0.0)
    counted = np.maximum(finite.sum(axis=0), 1)
    rmse = np.sqrt((known**2).sum(axis=0) / counted)
    max_error = np.abs(known).max(axis=0)
    return {
        "unit": dict(zip(STATE_NAMES, STATE_UNITS, strict=True)),
        "rmse": dict(zip(STATE_NAMES, rmse.tolist(), strict=True)),
        "max_error": dict(zip(STATE_NAMES, max_error.tolist(), strict=True)),
        "not_finite": int(np.count_nonzero(~finite.all(axis=1))),
    }


def ground(log: FlightLog, outline: Outline) -> dict[str, Any]:
    """Summarise take-off and touchdown, from plant rows at the physics rate.

    Returns:
        `started`, `landed` or `flying`; `takeoff_time` [s] and `touchdown`, of feet or hull, each None if there was
        none; `phase`, the last one; `crashed`.
    """
    feet = clearance(log.plant.state, outline.feet, outline.foot_radius, outline.floor)
    hull = clearance(log.plant.state, outline.hull, 0.0, outline.floor)
    started = Phase.FLYING
    if feet[0] <= AIRBORNE:
        started = Phase.LANDED
    last_phase = None
    if log.control.phase:
        last_phase = log.control.phase[-1]
    return {
        "started": str(started),
        "takeoff_time": takeoff_time(log.plant.t, feet),
        "touchdown": touchdown(log.plant.t, log.plant.state, np.minimum(feet, hull)),
        "phase": last_phase,
        "crashed": log.control.crashed,
    }


def flight_numbers(log: FlightLog, deadline_ms: float, course: Sequence[CourseStep] = ()) -> dict[str, Any]:
    """Return `tracking`, `control` and `controller` of a summary; each is empty if no period was flown."""
    if not log.control.t.size:
        return {"tracking": {}, "control": {}, "controller": {}}
    errors = tracking(log.control)
    departure = departure_numbers(log.control)
    if departure is not None:
        errors["departure"] = departure
    errors["settling"] = settling(log.control.t, log.control.truth[:, REFERENCE_STATES], course)
    return {
        "tracking": errors,
        "control": control(log.control),
        "controller": controller(log.control, log.timing, deadline_ms),
    }
