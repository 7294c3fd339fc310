"""From `[reference]` to a course, and to what the controller is given of it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from pathlib import Path as FilePath
from typing import TYPE_CHECKING

import numpy as np

from mpc.flatness import motion_along
from quadsim.errors import FileError, ParameterError
from quadsim.flight.metrics import CourseStep
from quadsim.motion import Motion
from quadsim.space import Corridor, Fence
from quadsim.state import REFERENCE_NAMES, Array
from quadsim.vehicle import Vehicle
from scenarios.courses.course import Course, Path, begin
from scenarios.courses.csv_course import read_table, through_rows
from scenarios.courses.followed import FollowedCourse
from scenarios.courses.legs import Turn, Waypoint, waypoints, yaw_turns
from scenarios.courses.loops import circle, figure_eight, fly_round
from scenarios.courses.minimum_snap import minimum_snap
from scenarios.courses.ramped import circle_curve, fly_ramped, lemniscate_curve, ramped_phase, upright_circle_curve
from scenarios.courses.steps import Window, steps, switches
from scenarios.parts.vehicle import build_vehicle
from scenarios.schema import course as specs
from scenarios.schema.events import SetpointEvent

if TYPE_CHECKING:
    from scenarios.schema.scenario import Scenario


def build_course(scenario: Scenario) -> Course:
    """The course before its filter.

    Raises:
        InputError: its file is wrong, or it does not suit the initial position.
    """
    spec, initial = scenario.reference, initial_pose(scenario)
    if isinstance(spec, specs.StepsSpec):
        return _steps(scenario)
    if isinstance(spec, specs.YawTurnsSpec):
        turns = [
            Turn(start=turn.start, yaw=math.radians(turn.yaw), rate=math.radians(turn.rate)) for turn in spec.turns
        ]
        return begin(yaw_turns(initial, turns), start=0.0, initial=initial)
    if isinstance(spec, specs.CsvSpec):
        return _csv(spec, initial)
    if isinstance(spec, specs.WaypointsSpec):
        path = _waypoints(spec, initial)
    elif isinstance(spec, specs.MinimumSnapSpec):
        path = _minimum_snap(spec, initial)
    elif isinstance(spec, specs.RampedCircleSpec | specs.RampedLemniscateSpec):
        path = _ramped(spec, initial, gravity=build_vehicle(scenario).gravity)
    else:
        path = _loop(spec, initial)
    return begin(path, start=spec.start, initial=initial)


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
    if not isinstance(scenario.reference, specs.StepsSpec):
        return ()
    taken = {name for event in scenario.events if isinstance(event, SetpointEvent) for name in event.values}
    preview = scenario.controller.horizon * scenario.control_period
    found = []
    for name, (windows, elsewhere), start in zip(
        REFERENCE_NAMES, _channels(scenario, scenario.reference), initial_pose(scenario).tolist(), strict=True
    ):
        if name in taken:
            continue
        flown = [step for step in switches(windows, elsewhere, initial=start) if step[0] < scenario.duration]
        ends = [*(time - preview for time, _, _ in flown[1:]), scenario.duration]
        for (time, before, after), until in zip(flown, ends, strict=False):
            found.append(CourseStep(channel=name, time=time, before=before, after=after, until=until))
    return tuple(found)


def _steps(scenario: Scenario) -> Course:
    assert isinstance(scenario.reference, specs.StepsSpec)
    channels = _channels(scenario, scenario.reference)
    instants = {
        time for windows, elsewhere in channels for time, _, _ in switches(windows, elsewhere, initial=elsewhere)
    }

    def sample(t: Array) -> Array:
        return np.stack([steps(t, windows, elsewhere) for windows, elsewhere in channels], axis=1)

    initial = np.array([elsewhere for _, elsewhere in channels])
    return Course(sample=sample, initial=initial, jumps=tuple(sorted(instants)))


def _channels(scenario: Scenario, spec: specs.StepsSpec) -> list[tuple[list[Window], float]]:
    """Windows of x, y, z [m] and yaw [rad], each with the value outside them."""
    x, y, z = scenario.initial.position

    def held(windows: list[specs.WindowSpec], scale: float = 1.0) -> list[Window]:
        return [Window(start=window.start, stop=window.stop, value=scale * window.value) for window in windows]

    return [(held(spec.x), x), (held(spec.y), y), (held(spec.z), z), (held(spec.yaw, math.radians(1.0)), 0.0)]


def _waypoints(spec: specs.WaypointsSpec, initial: Array) -> Path:
    points = [
        Waypoint(pose=pose, speed=spec.speed if point.speed is None else point.speed, hold=point.hold)
        for point, pose in zip(spec.points, _poses(spec.points, initial), strict=True)
    ]
    return waypoints(initial, points)


def _minimum_snap(spec: specs.MinimumSnapSpec, initial: Array) -> Path:
    poses = _poses(spec.points, initial)
    if spec.speed is None:
        assert spec.times is not None
        return minimum_snap(initial, poses, spec.times)
    lengths = np.linalg.norm(np.diff(np.vstack([initial, poses])[:, :3], axis=0), axis=1)
    if lengths[0] < specs.CLOSEST:
        rule = f"{specs.CLOSEST} m or more from the initial position, where the course begins"
        rule += " (or give times instead of speed)"
        raise ParameterError("reference", "points.0.position", spec.points[0].position, rule)
    return minimum_snap(initial, poses, (np.cumsum(lengths) / spec.speed).tolist())


def _loop(spec: specs.CircleSpec | specs.HelixSpec | specs.FigureEightSpec, initial: Array) -> Path:
    clockwise, angle = spec.turns < 0.0, math.radians(spec.angle)
    height = float(initial[2]) if spec.height is None else spec.height
    if isinstance(spec, specs.FigureEightSpec):
        from_centre = (0.0, 0.0)
        half_length, half_width = spec.half_axes
        make = partial(figure_eight, half_length=half_length, half_width=half_width)
    else:
        from_centre = (spec.radius * math.cos(angle), spec.radius * math.sin(angle))
        climb = spec.climb if isinstance(spec, specs.HelixSpec) else 0.0
        make = partial(circle, radius=spec.radius, climb_per_turn=climb)
    centre = initial[:2] - from_centre if spec.centre is None else spec.centre
    loop = make(centre=np.array([*centre, height]), angle=angle, clockwise=clockwise)
    return fly_round(
        loop,
        turn_time=spec.turn_time,
        turns=abs(spec.turns),
        ramp=spec.ramp,
        yaw=float(initial[3]) if spec.yaw is None else math.radians(spec.yaw),
        along=spec.yaw_along_path,
    )


def _ramped(spec: specs.RampedCircleSpec | specs.RampedLemniscateSpec, initial: Array, *, gravity: float) -> Path:
    if isinstance(spec, specs.RampedLemniscateSpec):
        curve = lemniscate_curve(spec.radius)
    elif spec.plane == "vertical":
        curve = upright_circle_curve(spec.radius, float(initial[3]))
    else:
        curve = circle_curve(spec.radius)
    phase = ramped_phase(
        rate=spec.speed / spec.radius,
        acceleration=spec.acceleration / spec.radius,
        ramp=spec.ramp,
        step=spec.sampling,
    )
    return fly_ramped(curve, phase, initial=initial, gravity=gravity, free_heading=spec.heading == "free")


def _csv(spec: specs.CsvSpec, initial: Array) -> Course:
    table = read_table(FilePath(spec.file))
    if spec.sha256 not in (None, table.sha256):
        raise FileError(spec.file, f"is not the file of the scenario: its SHA-256 is not {spec.sha256}")
    return begin(through_rows(table), start=spec.start + float(table.t[0]), initial=initial)


def located(spec: specs.CsvSpec, directory: FilePath) -> specs.CsvSpec:
    """The table's whole path and its hash, so that a resolved scenario defines its flight.

    Raises:
        FileError: what is there is no such table.
    """
    for path in (directory / spec.file, FilePath(spec.file)):
        if path.is_file():
            sha256 = spec.sha256 or read_table(path).sha256
            return spec.model_copy(update={"file": str(path.resolve()), "sha256": sha256})
    return spec


def _poses(points: Sequence[specs.WaypointSpec] | Sequence[specs.SnapPointSpec], initial: Array) -> Array:
    """(n, 4) x, y, z [m], yaw [rad] of points; a yaw that is left out is that before."""
    poses, yaw = [], float(initial[3])
    for point in points:
        yaw = yaw if point.yaw is None else math.radians(point.yaw)
        poses.append([*point.position, yaw])
    return np.array(poses)
