"""A scenario for a vehicle: a controller, a course that it can fly, and the source of every number."""

from __future__ import annotations

import json
import math
import re
import tomllib
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np

from quadsim.errors import ParameterError, UnknownNameError, printable
from quadsim.features.design.rules import (
    HEADING_RATIO,
    HEADING_STEP,
    HEIGHT_RATIO,
    HEIGHT_STEP,
    HORIZON_TIMES,
    LAG_RATIO,
    MOVE_RATIO,
    PERIOD_SHARE,
    THRUST_SHARE,
    Design,
    delay_margin,
    design_for,
)
from quadsim.mpc.laws.parts.bandwidths import lag_to_allow_for
from quadsim.mpc.problem.model import SHORTEST_LAG
from quadsim.sim.effects import Disturbance
from quadsim.vehicle import AIR_MOMENT, Vehicle, span

if TYPE_CHECKING:
    from quadsim.scenarios.schema.scenario import Scenario

COURSES: Final = ("hover", "step", "figure-eight")
DESIGNED_LAWS: Final = ("robust", "lqr", "pid", "geometric", "nonlinear", "rates")
"""Controllers: `nonlinear` is nonlinear MPC of rotor speeds, `rates` the same of thrust and body rates, through the
vehicle's autopilot."""
NODE: Final = 0.04  # shortest time between its nodes [s]
AHEAD: Final = 0.8  # its horizon [s]
SHARE: Final = 0.6
"""Share of what the vehicle can do that a figure eight requires: of the largest acceleration within the tilt bound, or
of the fastest level speed where that is reached first."""
EIGHT_RATIO: Final = 0.3
"""Turns of a figure eight per time [rad/s] over the loop's bandwidth: across it moves twice as fast."""
STEP_RATIO: Final = 0.28  # bandwidth of the filter of steps over the loop's
STEP: Final = 1.0  # [m]
TURNED_FROM: Final = 5.0
"""Angular acceleration by `rotor_moment` at hover [rad/s^2 per m/s] from which first flights count on it: it makes
hover unstable, with poles of size (g TURNED_FROM)^(1/3), 3.7 rad/s, of about the loop's own bandwidth."""
BALANCED_SPEED: Final = 0.01
BALANCED_MOVE: Final = 0.25
"""Weights of speeds and of their changes, over those by rule, where the hover model has the moment: what balances it in
steady motion would otherwise cost as much as a deviation, and the vehicle would lag."""
OBSERVED_LAG_SHARE: Final = 0.3
"""`LAG_SHARE` where the torque of the air is observed: the loop then has to be faster than that torque grows."""
LEAST_SIZE = 0.01
LARGEST_SIZE = 1e4
"""Range of a course's size that is stated [m]."""
ALLOWED_SHARE: Final = 0.15
"""The tracking requirement, the same for every controller: the largest error along x, y and z over the course's size.
The robust controller's is 11 % on steps and 5 % on figure eights, at most (docs/own-vehicle.md)."""
HEIGHT_OVER_ERROR: Final = 1.5
"""Height of the course above the floor over the largest error allowed, where that is more than `LOWEST`."""
LOWEST: Final = 1.0  # height of a course [m]
SOFT_WEIGHTS: Final = (2e4, 1e3)
"""l1 and l2 of the tilt bounds over the weight of x, as the defaults have them with the paper's weight of 10."""
AVOIDANCE_WEIGHTS: Final = (4e3, 80.0)
"""The same of half-spaces, by flights through trees: with those of the tilt bounds, planes that change from period to
period cost tilt."""
LQR_TILT: Final = 30.0
BASELINE_SHARE: Final = 0.8
"""Tilt [deg] that an LQR is limited to, and share of the tilt bound that every baseline is: they limit only the tilt
that they command, and overshoot it."""
LAG_SHARE: Final = 0.5
"""Lag that the gains of PID and geometric control allow for, over the rotors' (or half a period, if that is longer):
half of a time constant counts as dead time (the half rule of SIMC, Skogestad, 2003).  The laws' own default is 1."""
PREVIEW: Final = 2.0
"""Preview, times w, from which baselines take the reference's velocity, and all but the LQR its acceleration."""
GRID: Final = 0.2  # durations are multiples of it [s], and so of every control period
DISTURBANCE_UNITS: Final = {
    "force": "N, world x, y, z",
    "torque": "N m, body x, y, z",
    "force_noise": "N s^0.5, white, each axis",
    "torque_noise": "N m s^0.5, white, each axis",
    "force_deviation": "N, standard deviation, world x, y, z",
    "force_time": "s, with which it is forgotten",
    "torque_deviation": "N m, standard deviation, body x, y, z",
    "torque_time": "s, with which it is forgotten",
}
"""What a disturbance has, and in which unit."""
_EIGHT_PEAK: Final = float(np.hypot(np.sin(angle := np.linspace(0.0, math.pi, 721)), 2.0 * np.sin(2.0 * angle)).max())
"""Largest |d2p/dt2| of the figure eight (a sin wt, a/2 sin 2wt), over a w^2."""


@dataclass(frozen=True, kw_only=True)
class FirstScenario:
    """A scenario for a vehicle."""

    text: str  # its commented file
    size: float  # of the course [m]: the step, or the figure's length; for hover a step's

    @property
    def notes(self) -> tuple[str, ...]:
        """Comments above the scenario: the figures it is based on."""
        return tuple(line.removeprefix("#").strip() for line in self.text.partition("\n\n")[0].splitlines())

    @property
    def scenario(self) -> Scenario:
        """The parsed scenario."""
        from quadsim.scenarios.loading import parse_scenario

        return parse_scenario(self.to_data())

    def to_data(self) -> dict[str, Any]:
        """As nested tables."""
        return tomllib.loads(self.text)

    def to_toml(self) -> str:
        """As a commented file."""
        return self.text


@dataclass(frozen=True, kw_only=True)
class FirstCourse:
    """What of a scenario depends on its course, as text of a file."""

    name: str  # in the scenario's name
    options: str  # of the command, that ask for it
    about: str  # a description
    initial: str  # the fields of `[initial]`
    reference: str  # the table `[reference]`
    duration: float | None  # of the flight [s]; None: to the end of the course
    size: float  # [m]: the step, or the longest side
    allowed: float  # largest error along x, y and z [m]
    why_allowed: str  # where that is from
    lasts: bool = False  # whether it goes on turning, for what that needs
    clearance: float | None = None  # added to that of obstacles and regions [m]; None: there are none
    has_floor: bool = False  # whether it states a lowest height, or touches the ground
    tables: str = ""  # further tables
    constraints: str = ""  # further entries of `[[constraints]]`
    notes: tuple[str, ...] = ()  # for the head of the file


def first_scenario(
    vehicle: Vehicle,
    file: str,
    *,
    course: str | FirstCourse = "hover",
    law: str = "robust",
    tilt: float | None = None,
    disturbance: Disturbance | None = None,
) -> FirstScenario:
    """Return a scenario that the vehicle flies well, with numbers derived from the vehicle; see `quadsim.scenario`.

    Args:
        vehicle: the numbers.
        file: where these are, as the scenario is to name it.
        course: one of `COURSES`, or one made for the vehicle by `quadsim.features.design.any_course`.
        law: one of `DESIGNED_LAWS`.
        tilt: bound [deg] that replaces that of the rules.
        disturbance: acts as the vehicle's file states it; None for none.

    Raises:
        UnknownNameError: there is no such course or controller.
        ParameterError: the vehicle cannot be controlled, or not at this tilt.
    """
    if law not in DESIGNED_LAWS:
        raise UnknownNameError("controller", law, DESIGNED_LAWS)
    design = design_for(vehicle, tilt)
    if isinstance(course, str):
        course = course_by_rule(course, vehicle, design)
    name = re.sub(r"[^a-z0-9._-]+", "-", f"first-{vehicle.name}-{course.name}".lower())[:80]
    if course.duration is None:
        for_duration = ""
    else:
        for_duration = f"duration = {course.duration}  # s\n"
    text = f"""{_notes(vehicle, design, course, law)}
name = {_text(name)}
description = {_text(f"{vehicle.name}: {course.about}")}
{for_duration}control_period = {design.period}  # s, tau: the longest of the usual ones with tau w <= {PERIOD_SHARE:g}

[vehicle]
file = {_text(file)}  # made for its numbers: remake this file when they change

[initial]
{course.initial}
[plant]
limit_speeds = true  # rotors saturate at their lowest and highest speed

{course.reference}
{_controller(law, vehicle, design, course)}
{_rotors(vehicle)}
[effects.air]  # drag of the vehicle file
{_disturbance(disturbance)}{course.tables}{_constraints(law, vehicle, design, course)}"""
    return FirstScenario(text=text, size=course.size)


def _rotors(vehicle: Vehicle) -> str:
    """`[effects.rotors]`; rotors that change their speed at once can have no inertia."""
    if vehicle.rotor_inertia and not (vehicle.rotor_rise and vehicle.rotor_fall):
        return "[effects.rotors]\ninertia = 0.0  # kg m^2; that of the vehicle file needs its rotor_rise and fall\n"
    return "[effects.rotors]  # lag and inertia of the vehicle file\n"


def _disturbance(disturbance: Disturbance | None) -> str:
    """`[effects.disturbance]` with what differs from none; empty without."""
    if disturbance is None:
        return ""
    text = "\n[effects.disturbance]  # of the vehicle file: what its flights met\n"
    for name, unit in DISTURBANCE_UNITS.items():
        value = getattr(disturbance, name)
        if value is not None and np.any(value):
            text += f"{name} = {json.dumps(value)}  # {unit}\n"
    return text


def _notes(vehicle: Vehicle, design: Design, course: FirstCourse, law: str) -> str:
    """Return the comments above the file: the figures it is based on."""
    can = design.authority
    limits = {
        "lag": f"the rotors' lag: 1 / ({LAG_RATIO:g} (T + tau / 2)), T = {1e3 * can.lag:.3g} ms",
        "torque": "torque: 0.5 sqrt(alpha / tilt bound), alpha the smaller of roll's and pitch's",
        "period": f"what a period of {1e3 * design.period:g} ms can serve",
    }
    if design.tilt_stated:
        stated = f" --tilt {_tilt(design):g}"
    else:
        stated = ""
    option = ""
    what = "The loop's bandwidth for x and y"
    then = (
        f"Without bounds it tolerates {1e3 * delay_margin(vehicle, design):.3g} ms more delay than it knows of.\n"
        "# Weights by Bryson's rule, 1 / (largest accepted deviation)^2; sources: quadsim/features/design/rules.py."
    )
    if law != "robust":
        option = f" --controller {law}"
        what = "The course is made for a robust MPC, whose bandwidth for x and y"
        then = "The controller's own rules: docs/own-vehicle.md."
    about = "".join(f"# {line}\n" for line in course.notes)
    return f"""# A first flight of {printable(f"{vehicle.name}: {course.about}")}.
# Made by: quadsim scenario --for VEHICLE {course.options}{option}{stated}
{about}#
# Thrust to weight {can.thrust_to_weight:.3g}: at most {math.degrees(can.steady_tilt):.3g} deg of steady tilt; \
angular acceleration in reserve at hover
# {can.turning[0]:.3g}, {can.turning[1]:.3g}, {can.turning[2]:.3g} rad/s^2 about x, y, z.
# {what} is w = {design.bandwidth:.3g} rad/s,
# limited by {limits[design.limited_by]};
# {design.height:.3g} rad/s for z, {design.heading:.3g} rad/s for yaw. {then}
"""


def largest_eight(vehicle: Vehicle, design: Design) -> tuple[float, Literal["tilt", "speed"]]:
    """The largest level acceleration [m/s^2] of a figure eight that the vehicle can fly, and what is reached there."""
    tilting = vehicle.gravity * design.acceleration
    # Of (a sin wt, a/2 sin 2wt) the largest speed is sqrt(2) a w.
    moving = design.fastest * _EIGHT_PEAK * EIGHT_RATIO * design.bandwidth / math.sqrt(2.0)
    if moving < tilting:
        return (moving, "speed")
    return (tilting, "tilt")


def _eight_limit(vehicle: Vehicle, design: Design) -> str:
    if largest_eight(vehicle, design)[1] == "speed":
        return f"the fastest level speed, {design.fastest:.3g} m/s"
    return "the largest acceleration within the tilt bound"


def course_by_rule(name: str, vehicle: Vehicle, design: Design, size: float | None = None) -> FirstCourse:
    """Return one of `COURSES` for a vehicle, of a size [m], or by rule.

    Raises:
        UnknownNameError: there is no such course.
        ParameterError: hover has no size.
    """
    if name not in COURSES:
        raise UnknownNameError("course", name, COURSES)
    require_size(size)
    options = f"--course {name}" + ("" if size is None else f" --size {size:g}")
    if name == "hover":
        if size is not None:
            raise ParameterError("", "--size", size, "absent with --course hover")
        height = _height(vehicle, ALLOWED_SHARE * STEP)
        reference = "[reference]  # no steps: every axis holds its initial position, yaw at 0\n"
        return _by_rule(vehicle, name, options, f"hover at {height:g} m", reference, 4.0, STEP, ALLOWED_SHARE * STEP)
    if name == "step":
        return _steps(vehicle, design, options, STEP if size is None else size)
    return _eight(vehicle, design, options, size)


def require_size(size: float | None) -> None:
    """Refuse a size [m] that no course has.

    Raises:
        ParameterError: it is out of range.
    """
    if size is not None and not LEAST_SIZE <= size <= LARGEST_SIZE:
        raise ParameterError("", "--size", size, f"between {LEAST_SIZE:g} and {LARGEST_SIZE:g} [m]")


def _by_rule(
    vehicle: Vehicle,
    name: str,
    options: str,
    about: str,
    reference: str,
    duration: float | None,
    size: float,
    allowed: float,
    *,
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


def step_bandwidth(design: Design, size: float) -> float:
    """Return the bandwidth [rad/s] of the filter of steps of a size [m].

    A step of s through a filter of bandwidth w_f lets the reference's velocity jump by w_f s: by no more than that of a
    step of `STEP`.
    """
    return STEP_RATIO * min(design.bandwidth, design.height) * min(1.0, STEP / size)


def _steps(vehicle: Vehicle, design: Design, options: str, size: float) -> FirstCourse:
    """Return steps in x, y and z."""
    slowest = min(design.bandwidth, design.height)
    why = f"3 / ({STEP_RATIO:g} times {slowest:.3g} rad/s, the slower of w and that of z)"
    if size > STEP:
        why += f", times {size:g}"
    response = round(3.0 / step_bandwidth(design, size), 2)
    start = later(max(1.0, 3.0 / design.bandwidth))
    hold = later(max(1.5, 1.2 * response))
    above = round(_height(vehicle, ALLOWED_SHARE * size) + size, 9)
    first, second, third, last = (round(start + i * hold, 9) for i in range(4))
    text = f"""[reference]
response_time = {response}  # s, 95 % of a step: {why}
x = [{{ start = {first}, stop = {third}, value = {size} }}]  # s, s, m
y = [{{ start = {second}, stop = {last}, value = {size} }}]  # s, s, m
z = [{{ start = {first}, stop = {third}, value = {above} }}]  # s, s, m
"""
    about = f"steps of {size:g} m in x, y and z"
    duration = round(start + 4.0 * hold, 9)
    return _by_rule(vehicle, "step", options, about, text, duration, size, ALLOWED_SHARE * size)


def _eight(vehicle: Vehicle, design: Design, options: str, size: float | None) -> FirstCourse:
    """Return a figure eight: of a size [m], as fast as `SHARE` permits, or of that at which it turns with the loop."""
    acceleration = SHARE * largest_eight(vehicle, design)[0]
    by_rule = eight_length(vehicle, design)
    limit = _eight_limit(vehicle, design)
    length = by_rule
    why = f"such that it turns with {EIGHT_RATIO:g} w"
    about = f"a figure eight at {100.0 * SHARE:g} % of {limit}"
    if size is not None:
        length = size
        why = "as --size states it"
        rate = min(
            EIGHT_RATIO * design.bandwidth,
            math.sqrt(2.0 * SHARE * vehicle.gravity * design.acceleration / (_EIGHT_PEAK * length)),
            math.sqrt(2.0) * SHARE * design.fastest / length,
        )
        acceleration = 0.5 * _EIGHT_PEAK * length * rate**2
        about = (
            f"a figure eight of {size:g} m at {100.0 * SHARE:g} % of the vehicle's limits, or slower where it is small"
        )
        limit = "the vehicle's limits"
    turn = round(math.tau * math.sqrt(0.5 * length * _EIGHT_PEAK / acceleration), 3)
    text = f"""[reference]
type = "figure_eight"
start = 1.0  # s
length = {length}  # m, end to end: {why}; width half of it
period = {turn}  # s: at most {acceleration:.3g} m/s^2, at {100.0 * SHARE:g} % of {limit}
ramp = {round(0.5 * turn, 3)}  # s, half a turn to gain its speed, and to lose it
"""
    allowed = ALLOWED_SHARE * by_rule
    return _by_rule(vehicle, "figure-eight", options, about, text, None, length, allowed, lasts=True)


def eight_length(vehicle: Vehicle, design: Design) -> float:
    """Return the length [m] of the figure eight that turns with `EIGHT_RATIO` w at `SHARE` of the limits."""
    acceleration = SHARE * largest_eight(vehicle, design)[0]
    return in_digits(2.0 * acceleration / (_EIGHT_PEAK * (EIGHT_RATIO * design.bandwidth) ** 2), 3)


def _controller(law: str, vehicle: Vehicle, design: Design, course: FirstCourse) -> str:
    if law in ("nonlinear", "rates"):
        return _nonlinear(law, vehicle, design) + _nonlinear_avoidance(course)
    return f"""{_robust(vehicle, design) if law == "robust" else _baseline(law, vehicle, design, course)}
[controller.input_bounds]
speed = {[vehicle.speed_min, vehicle.speed_max]}  # rad/s, what the rotors hold; hover is {span(vehicle.hover_speeds)}
slew = {[*_slew(design)]}  # rad/s per period: what a rotor's own speed makes in one, from hover towards its limits
{_avoidance(course, design)}"""


def _nonlinear_avoidance(course: FirstCourse) -> str:
    """Return the same of a nonlinear MPC."""
    if course.clearance is None:
        return ""
    return f"\n[controller.avoidance]\nmargin = {course.clearance}  # m, added\nsoft = {{}}\n"


def _avoidance(course: FirstCourse, design: Design) -> str:
    """Return the table that keeps clear of obstacles, and within regions, where there are any."""
    if course.clearance is None:
        return ""
    place = design.weights[0]
    return f"""
[controller.avoidance]  # planes between the plan and each obstacle
margin = {course.clearance}  # m, added

[controller.avoidance.soft]
linear = {in_digits(AVOIDANCE_WEIGHTS[0] * place)}  # l1: {AVOIDANCE_WEIGHTS[0]:g} times the weight of x
quadratic = {in_digits(AVOIDANCE_WEIGHTS[1] * place)}  # l2: {AVOIDANCE_WEIGHTS[1]:g} times the weight of x
"""


def _nonlinear(law: str, vehicle: Vehicle, design: Design) -> str:
    """The table of nonlinear MPC, of rotor speeds or through the autopilot."""
    stride = math.ceil(NODE / design.period - 1e-9)
    nodes = math.ceil(AHEAD / (stride * design.period) - 1e-9)
    flown_by = "the vehicle's autopilot: its file's [autopilot], or by rule"
    commands = f'commands = "rates"  # thrust and body rates, flown by {flown_by}\n'
    bounds = ""
    if law == "nonlinear":
        lag, known = _predicted_lag(vehicle)
        commands = f"rotor_lag = {lag}  # {known}\n"
        if _turns_in_air(vehicle):
            commands += "moment = true  # the air's torque and loss of thrust are predicted\n"
        bounds = f"""
[controller.input_bounds]
speed = {[vehicle.speed_min, vehicle.speed_max]}  # rad/s, what the rotors hold; hover is {span(vehicle.hover_speeds)}
"""
    return f"""[controller]
type = "nonlinear"
{commands}horizon = {stride * nodes}  # periods, {stride * nodes * design.period:.3g} s
node = {round(stride * design.period, 9)}  # s, whole periods of {NODE:g} s or more
terminal = "lqr"
tilt = {_tilt(design)}  # deg, the bound of the linear controllers

[controller.soft]

[controller.disturbance]  # unknown force, drag, and how much thrust the rotors give for a command: batteries sag
{bounds}"""


def _predicted_lag(vehicle: Vehicle) -> tuple[str, str]:
    """The rotors' lag that an MPC predicts, as TOML, and why, as a comment."""
    if vehicle.rotor_rise is not None and vehicle.rotor_rise >= SHORTEST_LAG:
        return '"vehicle"', "the vehicle's rotor_rise is predicted"
    return "0.0", "the vehicle gives no lag"


def _why_tilt(design: Design) -> str:
    """Where the tilt bound is from, as a comment."""
    if design.tilt_stated:
        return "as --tilt states it"
    held = math.degrees(math.acos(min(1.0, 1.0 / (THRUST_SHARE * design.authority.thrust_to_weight))))
    return f"the limit of the linear model, or {held:.3g} deg, what {100 * THRUST_SHARE:g} % of the thrust holds"


def _robust(vehicle: Vehicle, design: Design) -> str:
    place, height, heading = (in_digits(weight) for weight in design.weights)
    speed = in_digits(design.speed_weight)
    w = design.bandwidth
    tilt = _tilt(design)
    why = f"1 / ({speed**-0.5:.3g} rad/s)^2: with it four integrators have the bandwidth w, (g beta)^2 x / w^8"
    move = in_digits(design.move_weight)
    why_move = f"as much as speed costs at {MOVE_RATIO:g} w, speed / ({MOVE_RATIO:g} w tau)^2"
    moment = ""
    if vehicle.turned_by_air >= TURNED_FROM:
        turned = f"{vehicle.turned_by_air:.3g} rad/s^2 per m/s"
        moment = f"moment = true  # the air's torque is in the model: at hover {turned}\n"
        speed = in_digits(BALANCED_SPEED * speed)
        why = f"{BALANCED_SPEED:g} of that by rule: motion needs torque"
        move = in_digits(BALANCED_MOVE * move)
        why_move = f"{BALANCED_MOVE:g} of those by rule, likewise"
    lag, known = _predicted_lag(vehicle)
    return f"""[controller]
type = "robust"
horizon = {design.horizon}  # N, periods: {HORIZON_TIMES:g} / w = {HORIZON_TIMES / w:.3g} s
rotor_lag = {lag}  # {known}
{moment}heading = true  # the hover model is turned by the present yaw
move_weight = {move}  # of changes: {why_move}

[controller.offset_free]  # force and torque that the model does not know are estimated and compensated

[controller.soft]
linear = {in_digits(SOFT_WEIGHTS[0] * place)}  # l1: {SOFT_WEIGHTS[0]:g} times the weight of x
quadratic = {in_digits(SOFT_WEIGHTS[1] * place)}  # l2: {SOFT_WEIGHTS[1]:g} times the weight of x

[controller.output_weights]
x = {place}  # 1 / (g tan(tilt bound) / w^2)^2: {design.deviation:.3g} m is what the tilt bound answers
y = {place}  # as x
z = {height}  # for {design.height:.3g} rad/s, at most {HEIGHT_RATIO:g} w; \
all thrust in reserve answers {HEIGHT_STEP:g} m or more
yaw = {heading}  # for {design.heading:.3g} rad/s, at most {HEADING_RATIO:g} w; \
all torque in reserve answers {math.degrees(HEADING_STEP):.3g} deg or more

[controller.input_weights]
speed = {speed}  # {why}

[controller.output_bounds]
roll = {[-tilt, tilt]}  # deg: {_why_tilt(design)}
pitch = {[-tilt, tilt]}  # as roll
"""


def _baseline(law: str, vehicle: Vehicle, design: Design, course: FirstCourse) -> str:
    rules = "  # weights by Bryson's rule, its defaults; it tracks pose and velocity, not acceleration"
    steepest = BASELINE_SHARE * _tilt(design)
    w = design.bandwidth
    tilt = round(min(LQR_TILT, steepest) if law == "lqr" else steepest, 3)
    text = f"""[controller]
type = {_text(law)}{rules if law == "lqr" else ""}
tilt = {tilt}  # deg, largest that it commands; below the audit's, which it overshoots
horizon = {math.ceil(PREVIEW / (w * design.period))}  # periods of preview for the reference's velocity: \
{PREVIEW:g} / w = {PREVIEW / w:.3g} s
"""
    turned = vehicle.turned_by_air >= TURNED_FROM
    observed = law == "geometric" and turned and not course.lasts
    if law != "lqr":
        lag = lag_to_allow_for(vehicle, design.period)
        share = OBSERVED_LAG_SHARE if observed else LAG_SHARE
        text += f"lag = {in_digits(share * lag)}  # s that its gains allow for: {share:g} times "
        text += f"{1e3 * lag:.3g} ms, the rotors' lag or half a period\n"
    if law in ("lqr", "pid") and turned:
        text += "moment = true  # what the air does to the vehicle is balanced\n"
    if law != "geometric":
        return text
    if observed:  # the reference of steps has no jerk and snap that are worth feeding forward
        lag = vehicle.rotor_rise or 0.0
        if lag > 0.0:
            lagging = f"rotor_lag = {lag}  # s, the vehicle's rotor_rise\n"
        else:
            lagging = ""
        return text + f"\n[controller.disturbance]  # the air's torque, too, is observed and compensated\n{lagging}"
    text += "integral = true  # against drag and what else is not modelled\n"
    if course.lasts and _turns_in_air(vehicle):
        text += "feedforward = true  # of the reference's jerk and snap\n"
        text += "moment = true  # the air's torque on the vehicle at the reference's motion is balanced\n"
    return text


def _turns_in_air(vehicle: Vehicle) -> bool:
    """Whether the file states what the air does by `moment`."""
    return any(np.any(getattr(vehicle, name) or 0.0) for name in AIR_MOMENT)


def _constraints(law: str, vehicle: Vehicle, design: Design, course: FirstCourse) -> str:
    """Return the audited constraints that are not bounds of the controller."""
    tilt = _tilt(design)
    off = in_digits(course.allowed)

    def entry(name: str, signal: str, lower: float, upper: float | None, why: str) -> str:
        text = f'\n[[constraints]]\nname = "{name}"\nsignal = "{signal}"\nlower = {lower}  # {why}\n'
        return text + ("" if upper is None else f"upper = {upper}\n")

    hull = (
        "m, radius of the ball about the hull: the lowest centre that keeps all of the vehicle above the ground, z = 0"
    )
    note = f"m, {course.why_allowed}: the same for every controller"
    entries = ["\n# Audited without an entry: every bound of the controller.\n"]
    if law == "rates":  # it bounds the thrust of all rotors together
        entries += [entry("speed", "speed", vehicle.speed_min, vehicle.speed_max, "rad/s, what the rotors hold")]
    elif law not in ("robust", "nonlinear"):  # baselines bound the tilt that they command, and overshoot it
        why = "deg, the tilt bound, at every instant"
        entries += [entry(name, name, -tilt, tilt, why) for name in ("roll", "pitch")]
    if not course.has_floor:
        entries += [entry("floor", "z", lowest_centre(vehicle), None, hull)]
    if course.allowed:
        entries += [entry(f"hold_{axis}", f"{axis}_error", -off, off, note) for axis in "xyz"]
    return "".join([*entries, course.constraints])


def lowest_centre(vehicle: Vehicle) -> float:
    """Lowest z [m] of the centre of mass at which no attitude brings the hull to the ground, to a millimetre above."""
    return math.ceil(1e3 * vehicle.enclosing_radius - 1e-6) / 1e3


def _height(vehicle: Vehicle, allowed: float) -> float:
    """Height [m] of the lowest points of a course with an allowed error [m], to a decimetre above."""
    return max(LOWEST, math.ceil(10.0 * (lowest_centre(vehicle) + HEIGHT_OVER_ERROR * allowed) - 1e-6) / 10.0)


def _tilt(design: Design) -> float:
    """The tilt bound [deg], by rule a whole number where it is above 5."""
    degrees = math.degrees(design.tilt) + 1e-9
    if design.tilt_stated:
        return round(degrees, 6)
    if degrees > 5.0:
        return float(math.floor(degrees))
    return in_digits(degrees)


def _slew(design: Design) -> tuple[float, float]:
    return in_digits(design.slew[0], 4), in_digits(design.slew[1], 4)


def later(time: float) -> float:
    """The next multiple of `GRID`."""
    return round(GRID * math.ceil(round(time / GRID, 6)), 9)


def in_digits(number: float, digits: int = 3) -> float:
    """Return a number to some significant digits."""
    return float(f"{number:.{digits}g}")


def _text(text: str) -> str:
    """A text as TOML."""
    return json.dumps(text, ensure_ascii=False)
