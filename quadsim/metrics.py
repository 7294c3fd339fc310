"""Pure functions from a flight to the numbers of its summary."""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np

from quadsim.controller import SOLVED
from quadsim.flightlog import ControlLog, FlightLog, TimingLog
from quadsim.state import REFERENCE_NAMES, REFERENCE_STATES, REFERENCE_UNITS, Array


def tracking(log: ControlLog) -> dict[str, Any]:
    """Tracking errors, real minus reference, against the filtered reference at the control samples.

    Returns:
        `rmse`, `max_error` (largest magnitude), `final_error` (last sample, signed) and `overshoot` (how far the
        channel leaves the range spanned by its reference and its start), each by channel x, y, z [m], yaw [rad].
    """
    state = log.state[:, REFERENCE_STATES]
    error = state - log.reference
    lowest = np.minimum(log.reference.min(axis=0), state[0])
    highest = np.maximum(log.reference.max(axis=0), state[0])
    beyond = np.maximum((state - highest).max(axis=0), (lowest - state).max(axis=0))
    return {
        "unit": dict(zip(REFERENCE_NAMES, REFERENCE_UNITS, strict=True)),
        "rmse": _by_channel(np.sqrt(np.mean(error**2, axis=0))),
        "max_error": _by_channel(np.abs(error).max(axis=0)),
        "final_error": _by_channel(error[-1]),
        "overshoot": _by_channel(np.maximum(beyond, 0.0)),
    }


def control(log: ControlLog) -> dict[str, float]:
    """Extremes of the commanded speeds [rad/s] and of their steps per period [rad/s], over all rotors."""
    return {
        "speed_min": float(log.speeds.min()),
        "speed_max": float(log.speeds.max()),
        "slew_min": float(log.slews.min()),
        "slew_max": float(log.slews.max()),
    }


def percentiles(values: Array) -> dict[str, float]:
    """Median, 95th and 99th percentile and maximum."""
    p50, p95, p99 = np.percentile(values, [50, 95, 99])
    return {"p50": float(p50), "p95": float(p95), "p99": float(p99), "max": float(values.max())}


def controller(log: ControlLog, timing: TimingLog, deadline_ms: float) -> dict[str, Any]:
    """Counts of solver statuses and fallbacks, iterations, residuals, and times against the deadline [ms].

    Residuals are those of the periods solved: a back end that gave up may report none, or infinite ones.
    """
    solved = np.array([status == SOLVED for status in log.status])
    return {
        "statuses": dict(sorted(Counter(log.status).items())),
        "fallbacks": {str(level): count for level, count in sorted(Counter(log.fallback.tolist()).items())},
        "iterations": {"mean": float(log.iterations.mean()), "max": int(log.iterations.max())},
        "active_max": int(log.active.max()),
        "active_periods": int(np.count_nonzero(log.active)),
        "residual_max": {
            "primal": float(np.max(log.primal_residual[solved], initial=0.0)),
            "dual": float(np.max(log.dual_residual[solved], initial=0.0)),
        },
        "solve_ms": percentiles(timing.solve_ms),
        "step_ms": percentiles(timing.step_ms),
        "deadline_ms": deadline_ms,
        "deadline_misses": int(np.count_nonzero(timing.step_ms > deadline_ms)),
    }


def flight_numbers(log: FlightLog, deadline_ms: float) -> dict[str, Any]:
    """`tracking`, `control` and `controller` of a summary; each is empty when no period was flown."""
    if not log.control.t.size:
        return {"tracking": {}, "control": {}, "controller": {}}
    return {
        "tracking": tracking(log.control),
        "control": control(log.control),
        "controller": controller(log.control, log.timing, deadline_ms),
    }


def _by_channel(values: Array) -> dict[str, float]:
    return dict(zip(REFERENCE_NAMES, values.tolist(), strict=True))
