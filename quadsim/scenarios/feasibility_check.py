"""Check before the flight whether a scenario's course can be flown."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from quadsim.assets import vehicle_path
from quadsim.errors import ParameterError
from quadsim.flight.audit import Mask
from quadsim.flight.feasibility import STENCIL, Feasibility, assess, demand
from quadsim.mpc.laws.robust import Robust
from quadsim.mpc.tables.bounded import Bounded
from quadsim.mpc.tables.controller import Range
from quadsim.scenarios.courses.course import Course
from quadsim.scenarios.courses.csv_course import Csv
from quadsim.scenarios.courses.smoothing import within_rounding
from quadsim.scenarios.schema.events import SetpointEvent, first_period
from quadsim.sim.effects.load import Load, mass_properties
from quadsim.state import INDEX, REFERENCE_NAMES, STATE_NAMES, STATE_UNITS, Array, shown_unit
from quadsim.vehicle import example_notes, span

if TYPE_CHECKING:
    from quadsim.scenarios.assembly import Assembly
    from quadsim.scenarios.schema.scenario import Scenario


def report(assembly: Assembly) -> Feasibility:
    """Compare the demands of what is flown with the vehicle's limits and the controller's bounds.

    That is the filtered course; a set-point replaces it on its axes, as in flight.  A rounded table is replaced by the
    smoothest one within its last decimal: fourth differences would turn 0.1 mm into steps of tens of rad/s, which no
    controller flies.

    Raises:
        InputError: the course cannot be built.
    """
    scenario = assembly.scenario
    course = assembly.course
    required = _required(course, assembly, duration=scenario.duration)
    sentence = required.sentence
    until = _left(assembly)
    if until < course.end < math.inf and not _sampled(scenario):
        sentence += f" It lasts until {course.end:g} s, but the flight follows it for {until:g} s."
    advice = fitting(assembly) if required.problems else ""
    return replace(required, sentence=sentence, advice=advice, notes=(*notes(assembly), *course.notes))


def hover_speeds(assembly: Assembly) -> Array:
    """Return the rotor speeds (4,) [rad/s] at which the actual vehicle hovers, with its load at the start."""
    vehicle = assembly.actual
    load = assembly.effects.load or Load()
    return vehicle.hover_speeds * math.sqrt(mass_properties(vehicle, load, load.payloads).mass / vehicle.mass)


def notes(assembly: Assembly) -> tuple[str, ...]:
    """Return what no controller can do, or what nobody can mean, as `run` says before it flies."""
    return (*leftover_notes(assembly), *hover_notes(assembly), *floor_notes(assembly))


def leftover_notes(assembly: Assembly) -> tuple[str, ...]:
    """Return what the vehicle's file still has of an example; nothing of a run, whose numbers are its scenario's."""
    scenario = assembly.scenario
    if scenario.recorded is not None:
        return ()
    return example_notes(vehicle_path(scenario.vehicle.file), scenario.vehicle.overrides())


def hover_notes(assembly: Assembly) -> tuple[str, ...]:
    """Return a note if hover needs rotor speeds outside the controller's bounds."""
    hover = hover_speeds(assembly)
    lower, upper = assembly.bounds.get("speed", (0.0, math.inf))
    if lower <= hover.min() and hover.max() <= upper:
        return ()
    if hover.max() > upper:
        bound, side = (upper, "")
    else:
        bound, side = (lower, "at least ")
    return (f"hover needs {span(hover)} rad/s, the bound is {side}{bound:.4g}: no controller can hold altitude",)


def floor_notes(assembly: Assembly) -> tuple[str, ...]:
    """Return a note if the course is below the floor, unless it only lands; without a floor, if z is never above 0.

    A landing asks for a height below the floor at a place, at the end: it does not move on there.
    """
    scenario = assembly.scenario
    t = scenario.control_period * np.arange(scenario.periods + 1, dtype=np.float64)
    x, y, z = assembly.course.sample(t)[:, :3].T
    below = z < 0.0
    ground = scenario.effects.ground
    if ground is None:
        is_meant = not below.all() or scenario.initial.position[2] >= 0.0
        what = f"The course stays below z = 0, at {z.max():.3g} m and lower"
    else:
        moving = np.hypot(np.diff(x), np.diff(y)) > 1e-6
        is_meant = not (moving & below[1:] & below[:-1]).any() and below.mean() < 0.5
        what = f"The course is below the floor, by up to {-z.min():.3g} m"
    if is_meant:
        return ()
    if not below[0]:
        since = f", from {t[below][0]:.3g} s on"
    else:
        since = ""
    advice = "where z points down, as in PX4 and ArduPilot, the signs of y, z and yaw have to be turned"
    return (f"{what}{since}: z points up here; {advice}.",)


def _sampled(scenario: Scenario) -> bool:
    """Return whether the course was sampled for this flight, to the end of its last preview."""
    return isinstance(scenario.reference, Csv) and scenario.reference.content is not None


def fitting(assembly: Assembly) -> str:
    """Find two ways to fly a course that exceeds limits or bounds within them, by speed, response time or size.

    The course is flown more slowly, set-points later in proportion, or made smaller about its start, or filtered more,
    to the nearest percent; jumps are excluded as in `report`.  This is computed as `report` is, not flown.

    Returns:
        A sentence; empty if the course fits as it is, or not even at a tenth.
    """
    scenario = assembly.scenario
    course = assembly.course
    duration = scenario.duration
    filtered_by = scenario.reference.response_time

    def slower(share: float) -> bool:
        return not _required(_scaled(course, pace=share), assembly, duration=duration / share, pace=share).problems

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
    if ways:
        return f"It would fit {', or '.join(ways)}."
    return ""


def _setpoints(scenario: Scenario) -> list[SetpointEvent]:
    """Return the set-points in order of time."""
    return sorted((e for e in scenario.events if isinstance(e, SetpointEvent)), key=lambda event: event.at)


def _left(assembly: Assembly) -> float:
    """Time for which the course is followed [s]: until set-points have replaced it on every axis that it moves."""
    scenario = assembly.scenario
    course = assembly.course
    t = scenario.control_period * np.arange(scenario.periods + 1, dtype=np.float64)
    moving = []
    for n, values in zip(REFERENCE_NAMES, course.sample(t).T, strict=True):
        if np.ptp(values) > 0.0:
            moving.append(n)
    taken = {name: event.at for event in reversed(_setpoints(scenario)) for name in event.values}
    return max((min(taken.get(name, math.inf), scenario.duration) for name in moving), default=scenario.duration)


def _largest(fits: Callable[[float], bool]) -> float | None:
    """Return the largest whole percentage that fits, as a share, by bisection; None if a tenth does not fit."""
    low = 10
    high = 100
    if not fits(0.01 * low):
        return None
    while high - low > 1:
        middle = (low + high) // 2
        if fits(0.01 * middle):
            low, high = (middle, high)
        else:
            low, high = (low, middle)
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


def _required(course: Course, assembly: Assembly, *, duration: float, pace: float = 1.0) -> Feasibility:
    """Return the demands of a course that replaces the scenario's for this duration [s]; set-points come at a pace."""
    scenario = assembly.scenario
    vehicle = assembly.vehicle
    period = scenario.control_period
    samples = round(duration / period) + 1
    given = [(event.at / pace, event.values) for event in _setpoints(scenario)]
    changes = [(first_period(at, period), values) for at, values in given]
    # the vehicle is at rest before the flight
    before = np.tile(course.initial, (STENCIL, 1))
    count = samples + STENCIL
    unfiltered, poses_along = assembly.followed(course).flown(count, changes)
    poses = np.vstack([before, poses_along])
    raw = np.vstack([before, unfiltered])
    t: Array = period * np.arange(-STENCIL, samples + STENCIL, dtype=np.float64)
    changed = np.any(raw[1:] != raw[:-1], axis=1)
    away = () if np.allclose(assembly.initial_pose, course.initial, rtol=0.0, atol=1e-9) else (0.0,)
    replaced = np.zeros_like(changed)  # by a set-point, between a sample and the next
    replaced[[STENCIL + k for k, _ in changes if k + 1 < count]] = True
    jumps = sorted({time for time in (*course.jumps, *away, *(at for at, _ in given)) if time < duration})
    jumped = (replaced | _touched(t, course.jumps)) & changed
    kinked = _touched(t, _isolated(course.kinks, period))
    channels = zip(poses.T, course.resolution, strict=True)
    smooth = np.column_stack([within_rounding(values, unit, jumped | kinked) for values, unit in channels])
    needed = demand(smooth, period, vehicle, jumps=jumped, kinks=kinked)
    bounds = assembly.bounds if isinstance(scenario.controller, Bounded) else {}
    return assess(needed, vehicle, bounds=bounds, tightened=_tightened(assembly), jumps=jumps)


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


def _tightened(assembly: Assembly) -> dict[str, Range]:
    """Return the controller's bounds on outputs after tightening at the end of the horizon, in file units."""
    spec = assembly.scenario.controller
    if not isinstance(spec, Robust):
        return {}
    margins = None
    with contextlib.suppress(ParameterError):  # reported when the controller is built
        margins = spec.margins(assembly.vehicle, assembly.scenario.control_period)
    if margins is None:
        return {}
    tightened: dict[str, Range] = {}
    names = [name for name in STATE_NAMES if name in spec.output_bounds]
    for name, margin in zip(names, margins[-1].tolist(), strict=True):
        lower, upper = assembly.bounds[name]
        _, scale = shown_unit(STATE_UNITS[INDEX[name]])
        tightened[name] = (lower + scale * margin, upper - scale * margin)
    return tightened
