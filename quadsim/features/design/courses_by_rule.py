"""Courses that a vehicle can fly by rule: hover, steps and a figure eight, as text of a scenario file.

A figure eight (a sin wt, a/2 sin 2wt) requires `SHARE` of the largest level acceleration within the tilt bound, or of
the fastest level speed; steps pass a filter of bandwidth `STEP_RATIO` w, w the bandwidth that `rules.py` designs.
`first_scenario.py` writes the file around the course; `any_course.py` makes courses of scenarios and tables.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from quadsim.errors import ParameterError, UnknownNameError
from quadsim.features.design.rules import Design
from quadsim.vehicle import Vehicle

COURSES: Final = ("hover", "step", "figure-eight")
SHARE: Final = 0.6
"""Share of what the vehicle can do that a figure eight requires: of the largest acceleration within the tilt bound, or
of the fastest level speed where that is reached first."""
EIGHT_RATIO: Final = 0.3
"""Turns of a figure eight per time [rad/s] over the loop's bandwidth: across it moves twice as fast."""
STEP_RATIO: Final = 0.28  # bandwidth of the filter of steps over the loop's
STEP: Final = 1.0  # [m]
LEAST_SIZE = 0.01
LARGEST_SIZE = 1e4
"""Range of a course's size that is stated [m]."""
ALLOWED_SHARE: Final = 0.15
"""The tracking requirement, the same for every controller: the largest error along x, y and z over the course's size.
The robust controller's is 11 % on steps and 5 % on figure eights, at most (docs/own-vehicle.md)."""
HEIGHT_OVER_ERROR: Final = 1.5
"""Height of the course above the floor over the largest error allowed, where that is more than `LOWEST`."""
LOWEST: Final = 1.0  # height of a course [m]
GRID: Final = 0.2  # durations are multiples of it [s], and so of every control period
_PHASES: Final = np.linspace(0.0, math.pi, 721)
_EIGHT_PEAK: Final = float(np.hypot(np.sin(_PHASES), 2.0 * np.sin(2.0 * _PHASES)).max())
"""Largest |d2p/dt2| of the figure eight (a sin wt, a/2 sin 2wt), over a w^2."""


@dataclass(frozen=True, kw_only=True)
class FirstCourse:
    """The part of a scenario that depends on its course, as text of a file."""

    name: str  # in the scenario's name
    options: str  # of the command that asks for it
    about: str  # a description
    initial: str  # the fields of `[initial]`
    reference: str  # the table `[reference]`
    duration: float | None  # of the flight [s]; None: to the end of the course
    size: float  # [m]: the step, or the longest side
    allowed: float  # largest error along x, y and z [m]
    why_allowed: str  # the source of that number
    lasts: bool = False  # whether it keeps turning, so that controllers need the feedforward of jerk and snap
    clearance: float | None = None  # added to that of obstacles and regions [m]; None: there are none
    has_floor: bool = False  # whether it states a lowest height, or touches the ground
    tables: str = ""  # further tables
    constraints: str = ""  # further entries of `[[constraints]]`
    notes: tuple[str, ...] = ()  # for the head of the file


def course_by_rule(name: str, vehicle: Vehicle, design: Design, size: float | None = None) -> FirstCourse:
    """Return one of `COURSES` for a vehicle, of a size [m], or by rule.

    Raises:
        UnknownNameError: there is no such course.
        ParameterError: hover has no size.
    """
    if name not in COURSES:
        raise UnknownNameError("course", name, COURSES)
    require_size(size)
    options = f"--course {name}{size_option(size)}"
    if name == "hover":
        if size is not None:
            raise ParameterError("", "--size", size, "absent with --course hover")
        return _hover(vehicle, options)
    if name == "figure-eight":
        return _eight(vehicle, design, options, size)
    if size is None:
        size = STEP
    return _steps(vehicle, design, options, size)


def require_size(size: float | None) -> None:
    """Refuse a size [m] that no course has.

    Raises:
        ParameterError: it is out of range.
    """
    if size is not None and not LEAST_SIZE <= size <= LARGEST_SIZE:
        raise ParameterError("", "--size", size, f"between {LEAST_SIZE:g} and {LARGEST_SIZE:g} [m]")


def size_option(size: float | None) -> str:
    """Return the option of the command that states a size [m], after a blank; empty without one."""
    if size is None:
        return ""
    return f" --size {size:g}"


def _hover(vehicle: Vehicle, options: str) -> FirstCourse:
    """Return hover, with the error that is allowed on steps by rule."""
    allowed = ALLOWED_SHARE * STEP
    return _above_origin(
        vehicle,
        name="hover",
        options=options,
        about=f"hover at {_height(vehicle, allowed):g} m",
        reference="[reference]  # no steps: every axis holds its initial position, yaw at 0\n",
        duration=4.0,
        size=STEP,
        allowed=allowed,
    )


def _steps(vehicle: Vehicle, design: Design, options: str, size: float) -> FirstCourse:
    """Return steps in x, y and z."""
    slowest = min(design.bandwidth, design.height)
    why = f"3 / ({STEP_RATIO:g} times {slowest:.3g} rad/s, the slower of w and that of z)"
    if size > STEP:
        why += f", times {size:g}"
    response = round(3.0 / step_bandwidth(design, size), 2)
    hold = later(max(1.5, 1.2 * response))
    first = later(max(1.0, 3.0 / design.bandwidth))
    second = round(first + hold, 9)
    third = round(first + 2 * hold, 9)
    last = round(first + 3 * hold, 9)
    allowed = ALLOWED_SHARE * size
    above = round(_height(vehicle, allowed) + size, 9)
    reference = f"""[reference]
response_time = {response}  # s, 95 % of a step: {why}
x = [{{ start = {first}, stop = {third}, value = {size} }}]  # s, s, m
y = [{{ start = {second}, stop = {last}, value = {size} }}]  # s, s, m
z = [{{ start = {first}, stop = {third}, value = {above} }}]  # s, s, m
"""
    return _above_origin(
        vehicle,
        name="step",
        options=options,
        about=f"steps of {size:g} m in x, y and z",
        reference=reference,
        duration=round(first + 4.0 * hold, 9),
        size=size,
        allowed=allowed,
    )


def step_bandwidth(design: Design, size: float) -> float:
    """Return the bandwidth [rad/s] of the filter of steps of a size [m].

    A step of s through a filter of bandwidth w_f lets the reference's velocity jump by w_f s: by no more than that of a
    step of `STEP`.
    """
    return STEP_RATIO * min(design.bandwidth, design.height) * min(1.0, STEP / size)


def _eight(vehicle: Vehicle, design: Design, options: str, size: float | None) -> FirstCourse:
    """Return a figure eight: of a size [m], as fast as `SHARE` permits, or of that at which it turns with the loop."""
    by_rule = eight_length(vehicle, design)
    if size is None:
        length = by_rule
        why = f"such that it turns with {EIGHT_RATIO:g} w"
        largest, reached = largest_eight(vehicle, design)
        acceleration = SHARE * largest
        if reached == "speed":
            limit = f"the fastest level speed, {design.fastest:.3g} m/s"
        else:
            limit = "the largest acceleration within the tilt bound"
        about = f"a figure eight at {100.0 * SHARE:g} % of {limit}"
    else:
        length = size
        why = "as --size states it"
        acceleration = 0.5 * _EIGHT_PEAK * length * _eight_rate(vehicle, design, length) ** 2
        limit = "the vehicle's limits"
        about = f"a figure eight of {size:g} m at {100.0 * SHARE:g} % of {limit}, or slower where it is small"
    turn = round(math.tau * math.sqrt(0.5 * length * _EIGHT_PEAK / acceleration), 3)
    reference = f"""[reference]
type = "figure_eight"
start = 1.0  # s
length = {length}  # m, end to end: {why}; width half of it
period = {turn}  # s: at most {acceleration:.3g} m/s^2, at {100.0 * SHARE:g} % of {limit}
ramp = {round(0.5 * turn, 3)}  # s, half a turn to gain its speed, and to lose it
"""
    return _above_origin(
        vehicle,
        name="figure-eight",
        options=options,
        about=about,
        reference=reference,
        duration=None,
        size=length,
        allowed=ALLOWED_SHARE * by_rule,
        lasts=True,
    )


def _eight_rate(vehicle: Vehicle, design: Design, length: float) -> float:
    """Return the largest w [rad/s] of a figure eight (a sin wt, a/2 sin 2wt) of length 2 a [m].

    Its acceleration is `_EIGHT_PEAK` a w^2 at most, its speed sqrt(2) a w.
    """
    by_loop = EIGHT_RATIO * design.bandwidth
    by_tilt = math.sqrt(2.0 * SHARE * vehicle.gravity * design.acceleration / (_EIGHT_PEAK * length))
    by_speed = math.sqrt(2.0) * SHARE * design.fastest / length
    return min(by_loop, by_tilt, by_speed)


def largest_eight(vehicle: Vehicle, design: Design) -> tuple[float, Literal["tilt", "speed"]]:
    """Return the largest level acceleration [m/s^2] of a figure eight for a vehicle, and the limit reached there."""
    at_tilt_bound = vehicle.gravity * design.acceleration
    # Of (a sin wt, a/2 sin 2wt) the largest speed is sqrt(2) a w.
    at_fastest = design.fastest * _EIGHT_PEAK * EIGHT_RATIO * design.bandwidth / math.sqrt(2.0)
    if at_fastest < at_tilt_bound:
        return (at_fastest, "speed")
    return (at_tilt_bound, "tilt")


def eight_length(vehicle: Vehicle, design: Design) -> float:
    """Return the length [m] of the figure eight that turns with `EIGHT_RATIO` w at `SHARE` of the limits."""
    largest, _ = largest_eight(vehicle, design)
    acceleration = SHARE * largest
    return in_digits(2.0 * acceleration / (_EIGHT_PEAK * (EIGHT_RATIO * design.bandwidth) ** 2), 3)


def _above_origin(
    vehicle: Vehicle,
    *,
    name: str,
    options: str,
    about: str,
    reference: str,
    duration: float | None,
    size: float,
    allowed: float,
    lasts: bool = False,
) -> FirstCourse:
    """Return a course that starts above the origin, as low as the error that is allowed permits [m]."""
    return FirstCourse(
        name=name,
        options=options,
        about=about,
        initial=f"position = [0.0, 0.0, {_height(vehicle, allowed)}]  # m, world; at rest\n",
        reference=reference,
        duration=duration,
        size=size,
        allowed=allowed,
        why_allowed=f"{100 * ALLOWED_SHARE:g} % of the course's size, {in_digits(allowed / ALLOWED_SHARE):g} m",
        lasts=lasts,
    )


def _height(vehicle: Vehicle, allowed: float) -> float:
    """Return the height [m] of the lowest points of a course with an allowed error [m], to a decimetre above."""
    least = lowest_centre(vehicle) + HEIGHT_OVER_ERROR * allowed
    return max(LOWEST, math.ceil(10.0 * least - 1e-6) / 10.0)


def lowest_centre(vehicle: Vehicle) -> float:
    """Return the lowest z [m] of the centre of mass at which no attitude brings the hull to the ground.

    It is rounded up to a millimetre.
    """
    return math.ceil(1e3 * vehicle.enclosing_radius - 1e-6) / 1e3


def later(time: float) -> float:
    """Return a time [s], or the next multiple of `GRID` after it."""
    return round(GRID * math.ceil(round(time / GRID, 6)), 9)


def in_digits(number: float, digits: int = 3) -> float:
    """Return a number to some significant digits."""
    return float(f"{number:.{digits}g}")
