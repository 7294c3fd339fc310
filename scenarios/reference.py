"""From `[reference]` to a course, and to what the controller is given of it."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from mpc.flatness import motion_along
from quadsim.flight.metrics import CourseStep
from quadsim.motion import Motion
from quadsim.space import Corridor, Fence
from quadsim.state import REFERENCE_NAMES, Array
from quadsim.vehicle import Vehicle
from scenarios.courses.course import Course
from scenarios.courses.followed import FollowedCourse
from scenarios.courses.steps import Steps, switches
from scenarios.parts.vehicle import build_vehicle
from scenarios.schema.events import SetpointEvent

if TYPE_CHECKING:
    from scenarios.schema.scenario import Scenario


def build_course(scenario: Scenario) -> Course:
    """The course before its filter.

    Raises:
        InputError: its file is wrong, or it does not suit the initial position.
    """
    return scenario.reference.build(initial_pose(scenario), build_vehicle(scenario).gravity)


def initial_pose(scenario: Scenario) -> Array:
    """(4,) x, y, z [m], yaw [rad] of the vehicle at t = 0."""
    return np.array([*scenario.initial.position, math.radians(scenario.initial.euler[2])])


def build_reference(scenario: Scenario, samples: int) -> Array:
    """(samples, 4) filtered reference x, y, z [m], yaw [rad] at t_k = k tau_s, but for set-points.  Eqs. (30)-(31)."""
    return filtered(build_course(scenario), scenario, samples)


def follow_course(scenario: Scenario) -> FollowedCourse:
    """The same row by row, with set-points in flight, not known in advance."""
    course, response_time = build_course(scenario), scenario.reference.response_time
    return FollowedCourse(course, response_time=response_time, period=scenario.control_period)


def filtered(course: Course, scenario: Scenario, samples: int) -> Array:
    """(samples, 4) of a course at t_k = k tau_s, through the scenario's filter.  Eq. (31)."""
    followed = FollowedCourse(course, response_time=scenario.reference.response_time, period=scenario.control_period)
    return followed.first(samples)


def timed_regions(scenario: Scenario) -> tuple[Corridor | Fence, ...]:
    """The corridors, each with a window of time, then the fence.

    The reference is known before the flight, and where it is along its path never falls: a window of the one is a
    window of the other.

    Raises:
        InputError: the reference's path is over before a window begins, or cannot be built.
    """
    regions = scenario.regions
    if all(isinstance(region, Fence) or region.path is None for region in regions):
        return regions
    reference = build_reference(scenario, scenario.periods + 1)[:, :3]
    t = scenario.control_period * np.arange(len(reference), dtype=np.float64)
    return tuple(region if isinstance(region, Fence) else region.timed(t, reference) for region in regions)


def build_motion(scenario: Scenario, vehicle: Vehicle) -> Motion | None:
    """The reference motion at t_k = k tau_s, to the course's end; None where the course states positions alone."""
    course, period = build_course(scenario), scenario.control_period
    if course.derivatives is None:
        return None
    t = np.arange(max(math.floor(course.end / period + 1e-6), 1) + 1, dtype=np.float64) * period
    velocity, acceleration = course.derivatives(t)
    yaw = float(course.initial[3]) if course.free_heading else np.full(len(t), course.initial[3])
    return motion_along(course.sample(t)[:, :3], velocity, acceleration, period=period, vehicle=vehicle, yaw=yaw)


def build_course_steps(scenario: Scenario) -> tuple[CourseStep, ...]:
    """The steps of the unfiltered course, channel by channel; a start away from the course is a step at 0.

    Only a course of windows has steps whose settling can be watched, and only on axes that no set-point takes from it.
    """
    if not isinstance(scenario.reference, Steps):
        return ()
    initial = initial_pose(scenario)
    taken = {name for event in scenario.events if isinstance(event, SetpointEvent) for name in event.values}
    preview = scenario.controller.horizon * scenario.control_period
    found = []
    channels = scenario.reference.channels(initial)
    for name, (windows, elsewhere), start in zip(REFERENCE_NAMES, channels, initial.tolist(), strict=True):
        if name in taken:
            continue
        flown = [step for step in switches(windows, elsewhere, initial=start) if step[0] < scenario.duration]
        ends = [*(time - preview for time, _, _ in flown[1:]), scenario.duration]
        for (time, before, after), until in zip(flown, ends, strict=False):
            found.append(CourseStep(channel=name, time=time, before=before, after=after, until=until))
    return tuple(found)
