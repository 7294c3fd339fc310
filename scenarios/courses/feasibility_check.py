"""Whether a scenario's course can be flown, reported before the flight."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from quadsim.flight.audit import Mask
from quadsim.flight.feasibility import STENCIL, Feasibility, assess, demand
from quadsim.state import Array
from quadsim.vehicle import Vehicle
from scenarios.courses.make import build_course, filtered, initial_pose
from scenarios.courses.smoothing import within_rounding
from scenarios.schema.optimisation import ANGLES, BoundedSpec

if TYPE_CHECKING:
    from scenarios.schema.scenario import Scenario


def report(scenario: Scenario, vehicle: Vehicle) -> Feasibility:
    """What the filtered course asks for, against the vehicle's limits and the controller's bounds.

    A table that was rounded is taken for the smoothest one within its last decimal: differences of the fourth order
    would make of 0.1 mm steps of tens of rad/s, which no controller flies.

    Raises:
        InputError: the course cannot be built.
    """
    course, period = build_course(scenario), scenario.control_period
    samples = scenario.periods + 1
    flown = filtered(course, scenario, samples + STENCIL)
    poses = np.vstack([np.tile(course.initial, (STENCIL, 1)), flown])  # before the flight the vehicle is at rest
    t: Array = period * np.arange(-STENCIL, samples + STENCIL, dtype=np.float64)
    raw = np.vstack([np.tile(course.initial, (STENCIL, 1)), course.sample(t[STENCIL:])])
    changes = np.any(raw[1:] != raw[:-1], axis=1)
    away = () if np.allclose(initial_pose(scenario), course.initial, rtol=0.0, atol=1e-9) else (0.0,)
    jumps = sorted({time for time in (*course.jumps, *away) if time < scenario.duration})
    jumped, kinked = _touched(t, course.jumps) & changes, _touched(t, _isolated(course.kinks, period))
    channels = zip(poses.T, course.resolution, strict=True)
    smooth = np.column_stack([within_rounding(values, unit, jumped | kinked) for values, unit in channels])
    needed = demand(smooth, period, vehicle, jumps=jumped, kinks=kinked)
    return assess(needed, vehicle, bounds=_bounds(scenario), jumps=jumps)


def _touched(t: Array, instants: ArrayLike) -> Mask:
    """(M - 1,) whether one of the instants is in the interval between a time and the next, its ends included."""
    at = np.sort(np.asarray(instants, dtype=np.float64))
    before = np.searchsorted(at, np.round(t[:-1], 9), side="left")
    after = np.searchsorted(at, np.round(t[1:], 9), side="right")
    return after > before


def _isolated(kinks: Sequence[float], period: float) -> Array:
    """Kinks but those with others as close as a control period on both sides: these are rows of something smooth."""
    at = np.unique(kinks)
    gaps = np.concatenate([[math.inf], np.diff(at), [math.inf]])
    return at[np.maximum(gaps[1:], gaps[:-1])[: at.size] > period * (1.0 + 1e-6)]


def _bounds(scenario: Scenario) -> dict[str, tuple[float, float]]:
    """The controller's bounds, SI."""
    spec = scenario.controller
    if not isinstance(spec, BoundedSpec):
        return {}
    scales = {name: math.radians(1.0) if name in ANGLES else 1.0 for name in spec.output_bounds}
    bounds = {name: (scales[name] * lower, scales[name] * upper) for name, (lower, upper) in spec.output_bounds.items()}
    return bounds | {
        "speed": (spec.input_bounds.speed[0], spec.input_bounds.speed[1]),
        "slew": (spec.input_bounds.slew[0], spec.input_bounds.slew[1]),
    }
