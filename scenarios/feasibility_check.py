"""Check before the flight whether a scenario's course can be flown."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from mpc.bounded import Bounded
from mpc.robust.settings import Robust
from quadsim.errors import ParameterError
from quadsim.flight.audit import Mask
from quadsim.flight.feasibility import STENCIL, Feasibility, assess, demand
from quadsim.state import STATE_NAMES, Array
from quadsim.vehicle import Vehicle
from scenarios.courses.course import Course
from scenarios.courses.csv_course import Csv
from scenarios.courses.smoothing import within_rounding
from scenarios.schema.events import SetpointEvent

if TYPE_CHECKING:
    from scenarios.assembly import Assembly
    from scenarios.schema.scenario import Scenario

Range = tuple[float, float]


def report(assembly: Assembly) -> Feasibility:
    """Compare the filtered course's demands, up to a set-point, with the vehicle's limits and the controller's bounds.

    A rounded table is replaced by the smoothest one within its last decimal: fourth differences would turn 0.1 mm into
    steps of tens of rad/s, which no controller flies.

    Raises:
        InputError: the course cannot be built.
    """
    course, followed = assembly.course, _followed(assembly.scenario)
    required = _required(course, assembly, duration=followed)
    sentence = required.sentence
    if followed < course.end < math.inf and not _sampled(assembly.scenario):
        sentence += f" It lasts until {course.end:g} s, but the flight follows it for {followed:g} s."
    return replace(required, sentence=sentence, advice=fitting(assembly) if required.problems else "")


def _sampled(scenario: Scenario) -> bool:
    """Return whether the course was sampled for this flight, to the end of its last preview."""
    return isinstance(scenario.reference, Csv) and scenario.reference.content is not None


def fitting(assembly: Assembly) -> str:
    """Find two ways to fly a course that exceeds limits or bounds within them, by speed, response time or size.

    The course is flown more slowly, made smaller about its start, or filtered more, to the nearest percent; jumps are
    excluded as in `report`.

    Returns:
        A sentence; empty if the course fits as it is, or not even at a tenth.
    """
    scenario, course = assembly.scenario, assembly.course
    duration, filtered_by = _followed(scenario), scenario.reference.response_time

    def slower(share: float) -> bool:
        return not _required(_scaled(course, pace=share), assembly, duration=duration / share).problems

    def smaller(share: float) -> bool:
        return not _required(_scaled(course, size=share), assembly, duration=duration).problems

    def smoother(share: float) -> bool:
        changed = replace(scenario.reference, response_time=filtered_by / share)
        softened = assembly.of(scenario.altered(reference=changed))
        return not _required(course, softened, duration=duration).problems

    if smaller(1.0):
        return ""
    ways = []
    if (share := _largest(slower)) is not None:
        ways.append(f"at {100.0 * share:.0f} % of its speed")
    if filtered_by > 0.0 and (share := _largest(smoother)) is not None:
        ways.append(f"with a response time of {filtered_by / share:.3g} s")
    if len(ways) < 2 and (share := _largest(smaller)) is not None:
        ways.append(f"at {100.0 * share:.0f} % of its size")
    return f"It would fit {', or '.join(ways)}." if ways else ""


def _followed(scenario: Scenario) -> float:
    """Time for which the course is followed [s]: up to the first set-point."""
    until = min((event.at for event in scenario.events if isinstance(event, SetpointEvent)), default=scenario.duration)
    return max(until, scenario.control_period)


def _largest(fits: Callable[[float], bool]) -> float | None:
    """Return the largest whole percentage that fits, as a share, by bisection; None if a tenth does not fit."""
    low, high = 10, 100
    if not fits(0.01 * low):
        return None
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if fits(0.01 * middle) else (low, middle)
    return 0.01 * low


def _scaled(course: Course, *, pace: float = 1.0, size: float = 1.0) -> Course:
    """Return a course at a share of its speed, or of its size about its start."""
    scale = np.array([size, size, size, 1.0])

    def sample(t: Array) -> Array:
        return np.asarray(course.initial + scale * (course.sample(pace * t) - course.initial))

    return replace(
        course,
        sample=sample,
        jumps=tuple(time / pace for time in course.jumps),
        kinks=tuple(time / pace for time in course.kinks),
        resolution=tuple((scale * course.resolution).tolist()),
    )


def _required(course: Course, assembly: Assembly, *, duration: float) -> Feasibility:
    """Return the demands of a course that replaces the scenario's for this duration [s]."""
    scenario, vehicle = assembly.scenario, assembly.vehicle
    period = scenario.control_period
    samples = round(duration / period) + 1
    poses_along = assembly.followed(course).first(samples + STENCIL)
    poses = np.vstack([np.tile(course.initial, (STENCIL, 1)), poses_along])  # the vehicle is at rest before the flight
    t: Array = period * np.arange(-STENCIL, samples + STENCIL, dtype=np.float64)
    raw = np.vstack([np.tile(course.initial, (STENCIL, 1)), course.sample(t[STENCIL:])])
    changes = np.any(raw[1:] != raw[:-1], axis=1)
    away = () if np.allclose(assembly.initial_pose, course.initial, rtol=0.0, atol=1e-9) else (0.0,)
    jumps = sorted({time for time in (*course.jumps, *away) if time < duration})
    jumped, kinked = _touched(t, course.jumps) & changes, _touched(t, _isolated(course.kinks, period))
    channels = zip(poses.T, course.resolution, strict=True)
    smooth = np.column_stack([within_rounding(values, unit, jumped | kinked) for values, unit in channels])
    needed = demand(smooth, period, vehicle, jumps=jumped, kinks=kinked)
    bounds, tightened = _bounds(scenario, vehicle)
    return assess(needed, vehicle, bounds=bounds, tightened=tightened, jumps=jumps)


def _touched(t: Array, instants: ArrayLike) -> Mask:
    """Return (M - 1,) whether an instant lies in the interval between successive times, ends included."""
    at = np.sort(np.asarray(instants, dtype=np.float64))
    before = np.searchsorted(at, np.round(t[:-1], 9), side="left")
    after = np.searchsorted(at, np.round(t[1:], 9), side="right")
    return after > before


def _isolated(kinks: Sequence[float], period: float) -> Array:
    """Drop kinks with neighbours within a control period on both sides: they are samples of a smooth curve."""
    at = np.unique(kinks)
    gaps = np.concatenate([[math.inf], np.diff(at), [math.inf]])
    return at[np.maximum(gaps[1:], gaps[:-1])[: at.size] > period * (1.0 + 1e-6)]


def _bounds(scenario: Scenario, vehicle: Vehicle) -> tuple[dict[str, Range], dict[str, Range]]:
    """Return the controller's bounds, and those on outputs after tightening at the end of the horizon; SI."""
    spec = scenario.controller
    if not isinstance(spec, Bounded):
        return {}, {}
    bounds, names = spec.bounds(), [name for name in STATE_NAMES if name in spec.output_bounds]
    (u_min, u_max), (delta_min, delta_max) = spec.input_bounds.speed, spec.input_bounds.slew
    whole = dict(zip(names, zip(bounds.y_min.tolist(), bounds.y_max.tolist(), strict=True), strict=True))
    inputs = {"speed": (u_min, u_max), "slew": (delta_min, delta_max)}
    margins = None
    with contextlib.suppress(ParameterError):  # reported when the controller is built
        margins = spec.margins(vehicle, scenario.control_period) if isinstance(spec, Robust) else None
    if margins is None:
        return whole | inputs, {}
    last = dict(zip(names, margins[-1].tolist(), strict=True))
    return whole | inputs, {name: (low + last[name], high - last[name]) for name, (low, high) in whole.items()}
