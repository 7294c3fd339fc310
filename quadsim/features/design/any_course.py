"""A course of the library, of a scenario file or of a table, scaled for a vehicle.

Lengths are scaled by the vehicles' bounding balls, so that a gap is as many vehicles wide as before; times such that
the course asks for `SHARE` of each limit of the vehicle (`_share`); heights are raised until the lowest point keeps the
allowed error and the hull above the ground.  Fields are scaled by their units (`quadsim.scenarios.scaling`).  The
result is a `FirstCourse` for `first_scenario.py`; what is no part of a course is left out and named in the file.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from scipy.signal import lfilter

from quadsim.errors import ParameterError, UnknownNameError
from quadsim.features.design.courses_by_rule import (
    ALLOWED_SHARE,
    COURSES,
    EIGHT_RATIO,
    HEIGHT_OVER_ERROR,
    SHARE,
    STEP,
    FirstCourse,
    course_by_rule,
    eight_length,
    in_digits,
    later,
    lowest_centre,
    require_size,
    size_option,
    step_bandwidth,
)
from quadsim.features.design.first_scenario import DESIGNED_LAWS
from quadsim.features.design.rules import HEADING_STEP, Design, design_for
from quadsim.flight.audit import Limit
from quadsim.mpc.space import Avoidance
from quadsim.scenarios.assembly import Assembly
from quadsim.scenarios.catalogue import scenario_names
from quadsim.scenarios.courses.course import Course
from quadsim.scenarios.courses.csv_course import Csv, read_course_table
from quadsim.scenarios.courses.smoothing import within_rounding
from quadsim.scenarios.courses.steps import Steps
from quadsim.scenarios.courses.table import ReferenceTable
from quadsim.scenarios.loading import load_scenario, parse_scenario
from quadsim.scenarios.scaling import Scale, scaled_limit, scaled_table
from quadsim.scenarios.schema.scenario import Scenario
from quadsim.scenarios.schema.writing import stated_lines
from quadsim.state import REFERENCE_NAMES, Array
from quadsim.vehicle import Vehicle

_REST: Final = 1.0  # after the end of a table [s]
_SAMPLES: Final = 4000  # of a course, from which its demands are computed
_SHARPEST: Final = 0.05
"""Change of velocity between two samples, over the largest velocity, that counts as a corner."""
_FREQUENCY_RATIO: Final = 1.5 * EIGHT_RATIO
"""Largest acceleration over largest speed of a course [rad/s], over w: of a figure eight 1.5 times its turns."""
_LEAST_FACTOR = 1e-3
_LARGEST_FACTOR = 1e3
"""Range of the factor of times."""
_HALVINGS: Final = 40
_YAW_ALLOWED: Final = 90.0 * ALLOWED_SHARE
"""Least allowed error of the heading [deg]: that of a quarter turn."""
AVOIDING: Final = ("robust", "nonlinear", "rates")
"""Designed controllers that keep clear of obstacles."""
_ERRORS: Final = tuple(f"{name}_error" for name in REFERENCE_NAMES)
_CARRIED: Final = ("x", "y", "z", "vx", "vy", "vz", *_ERRORS)
"""Signals of the constraints that belong to a course."""
_BOUNDED: Final = ("roll", "pitch", "speed", "slew")
"""Signals that the new scenario bounds itself, under these names: entries on them are not listed as left out, and
entries of such a name are renamed."""
_NO_COURSE: Final = ("forces", "computation", "sensors", "estimator", "events", "actual")
"""Tables that are no part of a course."""


def course_for(
    name: str, vehicle: Vehicle, file: str, *, law: str, tilt: float | None = None, size: float | None = None
) -> FirstCourse:
    """Return a course by rule, or one of a scenario or a table made for a vehicle.

    Args:
        name: one of `COURSES`; a scenario of the library, or a path to one (.toml); or a path to a table (.csv).
        vehicle: its numbers.
        file: the vehicle's file.
        law: one of `DESIGNED_LAWS`.
        tilt: bound [deg] that replaces that of the rules.
        size: longest side of the course [m]; None: by rule.

    Raises:
        InputError: there is no such course, it cannot be read, or such a controller cannot fly it.
    """
    if law not in DESIGNED_LAWS:
        raise UnknownNameError("controller", law, DESIGNED_LAWS)
    require_size(size)
    design = design_for(vehicle, tilt)
    if name in COURSES:
        return course_by_rule(name, vehicle, design, size)
    if not is_trajectory(name) and not name.endswith(".toml") and name not in scenario_names():
        hint = "or give a path ending in .toml or .csv"
        raise UnknownNameError("course", name, course_names(), hint=hint)
    return fitted_course(name, vehicle, file, design, avoids=law in AVOIDING, size=size)


def is_trajectory(course: str) -> bool:
    """Return whether a course is the path of a table."""
    return course.lower().endswith(".csv")


def course_names() -> list[str]:
    """Return what `--course` takes by name: courses by rule, then the library's scenarios."""
    others = [name for name in scenario_names() if name not in COURSES]
    return [*COURSES, *others]


def fitted_course(
    name: str, vehicle: Vehicle, file: str, design: Design, *, avoids: bool, size: float | None = None
) -> FirstCourse:
    """Return a course made for a vehicle.

    Args:
        name: of a scenario of the library, or a path to a scenario file (.toml) or to a table (.csv).
        vehicle: its numbers.
        file: the vehicle's file.
        design: of its controller.
        avoids: whether the controller can keep clear of obstacles.
        size: longest side of the course [m]; None: by the rules of this module.

    Raises:
        InputError: the course cannot be read, or such a controller cannot fly it.
    """
    if is_trajectory(name):
        base = _of_table(name, file, design)
    else:
        base = load_scenario(name)
    assembly = Assembly(base)
    _require_upright(name, base)
    if _has_obstacles(base) and not avoids:
        rule = f"flown by --controller {' or '.join(AVOIDING)}, which keep clear of its obstacles and regions"
        raise ParameterError("", "--course", name, rule)
    own = is_trajectory(name) or (name.endswith(".toml") and _same(base, assembly, vehicle, file))
    samples = _sampled(base, assembly)
    if own:
        by_extent = 1.0
    else:
        by_extent = vehicle.enclosing_radius / assembly.vehicle.enclosing_radius
    length = _length_factor(name, samples, size, by_extent)
    time, response = _time_factor(samples, length, vehicle, design)
    if _has_obstacles(base):  # no more acceleration than is stated: what it takes to avoid them is not known beforehand
        time = max(time, math.sqrt(length))
    allowed = ALLOWED_SHARE * eight_length(vehicle, design)
    lift = 0.0
    if not _touches_ground(base):
        lift = _lift(length * float(samples.poses[:, 2].min()), vehicle, allowed)
    adaptation = Adaptation(
        scale=Scale(length=in_digits(length, 4), time=in_digits(time, 4), lift=lift),
        response_time=response,
        allowed=allowed,
        own=own,
    )
    return _first_course(name, size, base, assembly, samples, adaptation)


def _has_obstacles(base: Scenario) -> bool:
    """Return whether a scenario has obstacles or regions."""
    return bool(base.obstacles or base.regions)


def _touches_ground(base: Scenario) -> bool:
    """Return whether a scenario's vehicle may stand on the ground."""
    return base.effects.ground is not None and base.effects.ground.contact


def _lift(lowest: float, vehicle: Vehicle, allowed: float) -> float:
    """Return by how much a course is raised [m], in decimetres.

    Args:
        lowest: height of its lowest point [m].
        vehicle: whose hull is to stay above the ground.
        allowed: error [m].
    """
    least = lowest_centre(vehicle) + HEIGHT_OVER_ERROR * allowed
    return max(0.0, math.ceil(10.0 * (least - lowest) - 1e-6) / 10.0)


def _of_table(path: str, file: str, design: Design) -> Scenario:
    """Return a scenario that flies a table, from its first row."""
    table = read_course_table(Path(path))
    x, y, z, yaw = table.poses[0].tolist()
    tables = {
        "name": "table",
        "description": "a table",
        "control_period": design.period,
        "duration": later(float(table.t[-1]) + 2.0 * _REST),
        "vehicle": {"file": file},
        "initial": {"position": [x, y, z], "euler": [0.0, 0.0, round(math.degrees(yaw), 6)]},
        "reference": {"type": "csv", "file": path, "start": _REST},
        "controller": {"type": "pid"},
    }
    return parse_scenario(tables, source=path)


def _require_upright(name: str, base: Scenario) -> None:
    """Refuse a course that turns or starts upside down."""
    roll, pitch, _ = base.initial.euler
    if base.lost.tilt is False or max(abs(roll), abs(pitch)) > 90.0:
        rule = "one that stays upright: the designed controllers bound the tilt (copy its file, and set vehicle.file)"
        raise ParameterError("", "--course", name, rule)


def _same(base: Scenario, assembly: Assembly, vehicle: Vehicle, file: str) -> bool:
    """Return whether a scenario was stated for this vehicle."""
    if base.vehicle.file == file:
        return True
    return Path(base.vehicle.file).name == Path(file).name and assembly.vehicle == vehicle


@dataclass(frozen=True, kw_only=True)
class SampledCourse:
    """A course at equal intervals, as its scenario states it."""

    poses: Array  # (M, 4) x, y, z [m], yaw [rad], before the filter
    interval: float  # [s]
    response_time: float  # of the filter [s]; 0 for none
    jumps: bool  # whether the pose itself jumps, as steps do
    largest_jump: float  # of the position [m]
    shortest: float  # shortest time between two jumps [s]; infinite without
    corners: bool  # whether the velocity jumps

    @property
    def size(self) -> float:
        """Longest side of the box about it [m]."""
        return float(np.ptp(self.poses[:, :3], axis=0).max())

    @property
    def moves(self) -> bool:
        """Whether it moves or turns at all."""
        return bool(np.ptp(self.poses, axis=0).max() > 0.0)


@dataclass(frozen=True, kw_only=True)
class Adaptation:
    """How a course is changed for a vehicle."""

    scale: Scale  # of lengths, times and heights
    response_time: float  # of the filter that its corners need [s]; 0: it keeps its own
    allowed: float  # error that the vehicle's own figure eight is allowed [m]
    own: bool  # whether the course was stated for this vehicle: its lengths and errors stay


def _sampled(base: Scenario, assembly: Assembly) -> SampledCourse:
    """Return the samples of a scenario's course, over its flight."""
    course = assembly.course
    end = min(base.duration, course.end)
    if not end > 0.0:
        end = base.duration
    t, interval = np.linspace(0.0, end, _SAMPLES, retstep=True)
    stated = course.sample(t)
    smooth_everywhere = np.zeros(_SAMPLES - 1, bool)
    channels = []
    for values, resolution in zip(stated.T, course.resolution, strict=True):
        channels.append(within_rounding(values, resolution, smooth_everywhere))
    poses = np.column_stack(channels)
    moved = _moved_by_jumps(course)
    has_jumps = isinstance(base.reference, Steps) and bool(np.abs(moved).max(initial=0.0) > 0.0)
    shortest = math.inf
    if has_jumps:
        shortest = float(np.diff(course.jumps).min(initial=math.inf))
    velocity = np.diff(poses[:, :3], axis=0)
    fastest = float(np.linalg.norm(velocity, axis=1).max())
    bends = np.linalg.norm(np.diff(velocity, axis=0), axis=1)
    return SampledCourse(
        poses=poses,
        interval=float(interval),
        response_time=base.reference.response_time,
        jumps=has_jumps,
        largest_jump=float(np.abs(moved[:, :3]).max(initial=0.0)),
        shortest=shortest,
        corners=bool(fastest > 0.0 and bends.max() > _SHARPEST * fastest),
    )


def _moved_by_jumps(course: Course) -> Array:
    """Return the changes (J, 4) of x, y, z [m], yaw [rad] at the jumps of a course."""
    if not course.jumps:
        return np.empty((0, 4))
    times = np.array(course.jumps)
    before = course.sample(times - 1e-6)
    after = course.sample(times + 1e-6)
    return after - before


def _length_factor(name: str, samples: SampledCourse, size: float | None, by_extent: float) -> float:
    """Return the factor of lengths."""
    if size is None:
        return by_extent
    if not samples.size > 0.0:
        raise ParameterError("", "--size", size, f"absent with --course {name}, which does not move")
    return size / samples.size


def _time_factor(samples: SampledCourse, length: float, vehicle: Vehicle, design: Design) -> tuple[float, float]:
    """Return the factor of times, and the response time [s] of a filter that the course needs; 0 for its own.

    The course asks for `SHARE` of the limits, and its filter is as slow as that of steps by rule, at least.
    """
    by_rule = 3.0 / step_bandwidth(design, max(length * samples.largest_jump, STEP))
    is_sharp = samples.jumps or samples.corners
    response = 0.0
    if is_sharp and not samples.response_time:
        response = round(by_rule, 2)
    if not samples.moves:
        return 1.0, response

    def largest_share(time: float) -> float:
        filtered = response or time * samples.response_time
        shares = [_share(samples, length, time, filtered, vehicle, design)]
        if is_sharp and not response:
            shares.append(by_rule / filtered)
        if samples.jumps and response:
            shares.append(1.2 * filtered / (time * samples.shortest))
        return max(shares)

    return _least_factor(largest_share), response


def _least_factor(share: Callable[[float], float]) -> float:
    """Return the factor of times, `_LEAST_FACTOR` to `_LARGEST_FACTOR`, from which on a falling share is at most 1."""
    low = math.log(_LEAST_FACTOR)
    high = math.log(_LARGEST_FACTOR)
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        if share(math.exp(middle)) > 1.0:
            low = middle
        else:
            high = middle
    return math.exp(high)


def _share(
    samples: SampledCourse, length: float, time: float, response_time: float, vehicle: Vehicle, design: Design
) -> float:
    """Return the largest demand of a course, with factors of lengths and times, over what it may ask for.

    It may ask for `SHARE` of the fastest level speed, of the rate of turning, of the acceleration within the tilt bound
    and of climb and sink; and for as much acceleration over its largest speed as a figure eight, `_FREQUENCY_RATIO` w.
    """
    velocity, acceleration = _motion(samples, length, time, response_time)
    fastest = float(np.linalg.norm(velocity[:, :3], axis=1).max())
    turning = float(np.abs(velocity[:, 3]).max())
    shares = [
        fastest / (SHARE * design.fastest),
        turning / (SHARE * HEADING_STEP * design.heading),
    ]
    if not samples.jumps:  # of steps the filter's bandwidth is the measure
        level = float(np.hypot(acceleration[:, 0], acceleration[:, 1]).max())
        shares.append(level / (SHARE * vehicle.gravity * design.acceleration))
        vertical = float(np.abs(acceleration[:, 2]).max())
        shares.append(vertical / (SHARE * min(design.authority.climb, design.authority.sink)))
        largest = float(np.linalg.norm(acceleration[:, :3], axis=1).max())
        if fastest > 0.0 and not samples.corners:
            shares.append(largest / fastest / (_FREQUENCY_RATIO * design.bandwidth))
    return max(shares)


def _motion(samples: SampledCourse, length: float, time: float, response_time: float) -> tuple[Array, Array]:
    """Return velocity and acceleration (M, 4) of a course with factors of lengths and times, behind its filter.

    With a filter of first order, of time constant T = response_time / 3, v' = (v_stated - v) / T.
    """
    interval = time * samples.interval
    poses = samples.poses * np.array([length, length, length, 1.0])
    stated = np.diff(poses, axis=0, prepend=poses[:1]) / interval
    if not response_time:
        return stated, np.diff(stated, axis=0, append=stated[-1:]) / interval
    lag = response_time / 3.0
    keep = math.exp(-interval / lag)
    start = stated[0] * keep
    filtered, _ = lfilter([1.0 - keep], [1.0, -keep], stated, axis=0, zi=start[None, :])
    velocity = np.asarray(filtered)
    return velocity, (stated - velocity) / lag


def _first_course(
    name: str,
    size: float | None,
    base: Scenario,
    assembly: Assembly,
    samples: SampledCourse,
    adaptation: Adaptation,
) -> FirstCourse:
    """Return the course as text.

    Args:
        name: of the scenario, or the path to its file or table.
        size: stated longest side of the course [m]; None without.
        base: the scenario.
        assembly: the same, assembled.
        samples: of its course.
        adaptation: to the vehicle.
    """
    scale = adaptation.scale
    allowed = adaptation.allowed
    explained: set[object] = set()
    reference = _reference(base, adaptation)
    tables = _space(base, scale, explained)
    if _touches_ground(base):
        tables = _ground(base, assembly) + tables
    carried = [entry for entry in base.constraints if entry.signal in _CARRIED and entry.has_bounds]
    constraints = "".join([_constraint(entry, adaptation) for entry in carried])
    required = allowed
    if any(entry.signal in _ERRORS for entry in carried):
        required = 0.0  # its own constraints limit the errors
    stem = Path(name).stem
    about = stem
    if samples.moves:
        about += f" at {100.0 * SHARE:g} % of its limits"
    duration = None
    if not base.ends_with_course:
        duration = later(scale.time * base.duration + adaptation.response_time)
    return FirstCourse(
        name=stem.lower(),
        options=f"--course {name}{size_option(size)}",
        about=about,
        initial=_initial(base, scale),
        reference="\n".join(stated_lines("[reference]", reference, explained)) + "\n",
        duration=duration,
        size=scale.length * samples.size,
        allowed=required,
        why_allowed=f"{100 * ALLOWED_SHARE:g} % of its own figure eight, {in_digits(allowed / ALLOWED_SHARE):g} m",
        lasts=samples.moves and not samples.jumps,
        clearance=_clearance(base, scale),
        has_floor=_touches_ground(base) or any(map(_is_floor, base.constraints)),
        tables=tables,
        constraints=constraints,
        notes=(*_scale_notes(adaptation), *_left_out(base)),
    )


def _reference(base: Scenario, adaptation: Adaptation) -> ReferenceTable:
    """Return the table `[reference]`, scaled and filtered; of a table of samples without its check sum."""
    reference = scaled_table(base.reference, adaptation.scale)
    if adaptation.response_time:
        reference = replace(reference, response_time=adaptation.response_time)
    if isinstance(reference, Csv):
        stated = base.tables["reference"]["file"]
        reference = replace(reference, file=stated, sha256=None)
    return reference


def _ground(base: Scenario, assembly: Assembly) -> str:
    """Return the table of the ground; its effect on thrust needs the rotor radius of its vehicle."""
    ground = base.effects.ground
    assert ground is not None
    has_effect = ground.effect and assembly.vehicle.rotor_radius is not None
    lines = stated_lines("[effects.ground]", replace(ground, effect=has_effect), set())
    return "\n" + "\n".join(lines)


def _clearance(base: Scenario, scale: Scale) -> float | None:
    """Return the clearance that the controller adds [m]: that of the scenario's, scaled, or by default."""
    if not _has_obstacles(base):
        return None
    stated = vars(base.controller).get("avoidance") or Avoidance()
    return scale.number(stated.margin, "m")


def _initial(base: Scenario, scale: Scale) -> str:
    """Return the fields of `[initial]`."""
    x, y, z = base.initial.position
    position = [scale.number(x, "m"), scale.number(y, "m"), scale.height(z)]
    lines = [f"position = {position}  # m, world"]
    _, _, yaw = base.initial.euler
    if yaw:
        lines.append(f"euler = [0.0, 0.0, {yaw}]  # deg: roll, pitch, yaw")
    if base.initial.cold:
        lines.append("cold = true  # rotors at rest")
    return "\n".join(lines) + "\n"


def _space(base: Scenario, scale: Scale, explained: set[object]) -> str:
    """Return obstacles, corridors and fence."""
    lines: list[str] = []
    for header, shapes in (("[[obstacles]]", base.obstacles), ("[[corridors]]", base.corridors)):
        for shape in shapes:
            lines += ["", *stated_lines(header, scaled_table(shape, scale), explained)]
    if base.keep_in is not None:
        lines += ["", *stated_lines("[keep_in]", scaled_table(base.keep_in, scale), explained)]
    if lines:
        return "\n".join([*lines, ""])
    return ""


def _is_floor(entry: Limit) -> bool:
    """Return whether a constraint is a lowest height throughout."""
    return entry.signal == "z" and math.isfinite(entry.lower) and entry.start <= 0.0 and math.isinf(entry.stop)


def _constraint(entry: Limit, adaptation: Adaptation) -> str:
    """Return an entry of `[[constraints]]` at a scale; errors are allowed what the vehicle needs."""
    limit = scaled_limit(entry, adaptation.scale)
    why = "scaled with the course"
    if entry.signal in _ERRORS and not adaptation.own:
        if entry.signal == "yaw_error":
            least = _YAW_ALLOWED
        else:
            least = in_digits(adaptation.allowed)
        lower = min(limit.lower, -least)
        upper = max(limit.upper, least)
        if (lower, upper) != (limit.lower, limit.upper):
            why = f"at least what the vehicle's own figure eight is allowed, {least:g}"
        limit = replace(limit, lower=lower, upper=upper)
    if limit.name in _BOUNDED:
        limit = replace(limit, name=f"course_{limit.name}")
    explained: set[object] = {(Limit, name) for name in Limit.__dataclass_fields__}  # so no comments
    header, *fields = stated_lines("[[constraints]]", limit, explained)
    return "\n".join(["", f"{header}  # {limit.unit}: {why}", *fields]) + "\n"


def _scale_notes(adaptation: Adaptation) -> list[str]:
    """Return lines on what was scaled."""
    scale = adaptation.scale
    response = adaptation.response_time
    if adaptation.own and scale.length == 1.0:
        lengths = "as stated"
    else:
        lengths = f"times {scale.length:g}"
    notes = [f"Lengths {lengths}, times by {scale.time:g}, heights raised by {scale.lift:g} m."]
    if response:
        notes.append(f"Its corners are filtered: the response time of {response:g} s is that of steps by rule.")
    return notes


def _left_out(base: Scenario) -> list[str]:
    """Return a line that names the parts of the scenario that are no part of its course; none if there are none."""
    effects = base.effects
    names = [name for name in _NO_COURSE if getattr(base, name)]
    if effects.air is not None and (any(effects.air.wind) or effects.air.turbulence is not None):
        names.append("wind")
    for name in ("battery", "disturbance", "load"):
        if getattr(effects, name, None) is not None:
            names.append(name)
    for entry in base.constraints:
        if entry.signal not in (*_CARRIED, *_BOUNDED):
            names.append(entry.name)
    if base.polytopes:
        names.append("controller.polytopes")
    if not names:
        return []
    return [f"Left out, as no part of the course: {', '.join(names)}."]
