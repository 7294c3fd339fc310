"""A scenario for a vehicle: a controller, a course that it can fly, and the source of every number.

`first_scenario` writes the file that `quadsim scenario --for VEHICLE` prints: the controller by `rules.py` and
`controller_text.py`, the course by `courses_by_rule.py` or `any_course.py`, the vehicle's effects, and the constraints
that are audited: the tilt and rotor speeds, the floor, and the largest error along x, y and z.
"""

from __future__ import annotations

import json
import math
import re
import tomllib
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from quadsim.errors import UnknownNameError, printable
from quadsim.features.design.controller_text import controller_text, tilt_bound
from quadsim.features.design.courses_by_rule import FirstCourse, course_by_rule, in_digits, lowest_centre
from quadsim.features.design.rules import LAG_RATIO, PERIOD_SHARE, Design, delay_margin, design_for
from quadsim.sim.effects import Disturbance
from quadsim.vehicle import Vehicle

if TYPE_CHECKING:
    from quadsim.scenarios.schema.scenario import Scenario

DESIGNED_LAWS: Final = ("robust", "lqr", "pid", "geometric", "nonlinear", "rates")
"""Controllers: `nonlinear` is nonlinear MPC of rotor speeds, `rates` the same of thrust and body rates, through the
vehicle's autopilot."""
DISTURBANCE_UNITS: Final = {
    "force": "N, world x, y, z",
    "torque": "N m, body x, y, z",
    "force_noise": "N s^0.5, white, each axis",
    "torque_noise": "N m s^0.5, white, each axis",
    "force_deviation": "N, standard deviation, world x, y, z",
    "force_time": "s, time constant with which it decays",
    "torque_deviation": "N m, standard deviation, body x, y, z",
    "torque_time": "s, time constant with which it decays",
}
"""What a disturbance has, and in which unit."""


@dataclass(frozen=True, kw_only=True)
class FirstScenario:
    """A scenario for a vehicle."""

    text: str  # its commented file
    size: float  # of the course [m]: the step, or the figure's length; for hover a step's

    @property
    def notes(self) -> tuple[str, ...]:
        """Comments above the scenario: the figures it is based on."""
        head, _, _ = self.text.partition("\n\n")
        return tuple(line.removeprefix("#").strip() for line in head.splitlines())

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
        vehicle: its numbers.
        file: the vehicle's file, as the scenario is to name it.
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
    duration = ""
    if course.duration is not None:
        duration = f"duration = {course.duration}  # s\n"
    text = f"""{_notes(vehicle, design, course, law)}
name = {_quoted(name)}
description = {_quoted(f"{vehicle.name}: {course.about}")}
{duration}control_period = {design.period}  # s, tau: the longest of the usual ones with tau w <= {PERIOD_SHARE:g}

[vehicle]
file = {_quoted(file)}  # made for its numbers: remake this file when they change

[initial]
{course.initial}
[plant]
limit_speeds = true  # rotors saturate at their lowest and highest speed

{course.reference}
{controller_text(law, vehicle, design, course)}
{_rotors(vehicle)}
[effects.air]  # drag of the vehicle file
{_disturbance(disturbance)}{course.tables}{_constraints(law, vehicle, design, course)}"""
    return FirstScenario(text=text, size=course.size)


def _notes(vehicle: Vehicle, design: Design, course: FirstCourse, law: str) -> str:
    """Return the comments above the file: the figures it is based on."""
    authority = design.authority
    limits = {
        "lag": f"the rotors' lag: 1 / ({LAG_RATIO:g} (T + tau / 2)), T = {1e3 * authority.lag:.3g} ms",
        "torque": "torque: 0.5 sqrt(alpha / tilt bound), alpha the smaller of roll's and pitch's",
        "period": f"what a period of {1e3 * design.period:g} ms can serve",
    }
    options = course.options
    if law == "robust":
        subject = "The loop's bandwidth for x and y"
        closing = (
            f"Without bounds it tolerates {1e3 * delay_margin(vehicle, design):.3g} ms more delay than its model has.\n"
            "# Weights by Bryson's rule, 1 / (largest accepted deviation)^2; sources: quadsim/features/design/rules.py."
        )
    else:
        options += f" --controller {law}"
        subject = "The course is made for a robust MPC, whose bandwidth for x and y"
        closing = "The controller's own rules: docs/own-vehicle.md."
    if design.tilt_stated:
        options += f" --tilt {tilt_bound(design):g}"
    course_notes = "".join(f"# {line}\n" for line in course.notes)
    turning_x, turning_y, turning_z = authority.turning
    return f"""# A first flight of {printable(f"{vehicle.name}: {course.about}")}.
# Made by: quadsim scenario --for VEHICLE {options}
{course_notes}#
# Thrust to weight {authority.thrust_to_weight:.3g}: at most {math.degrees(authority.steady_tilt):.3g} deg \
of steady tilt; angular acceleration in reserve at hover
# {turning_x:.3g}, {turning_y:.3g}, {turning_z:.3g} rad/s^2 about x, y, z.
# {subject} is w = {design.bandwidth:.3g} rad/s,
# limited by {limits[design.limited_by]};
# {design.height:.3g} rad/s for z, {design.heading:.3g} rad/s for yaw. {closing}
"""


def _rotors(vehicle: Vehicle) -> str:
    """Return `[effects.rotors]`; rotors that change their speed at once can have no inertia."""
    if vehicle.rotor_inertia and not (vehicle.rotor_rise and vehicle.rotor_fall):
        return "[effects.rotors]\ninertia = 0.0  # kg m^2; that of the vehicle file needs its rotor_rise and fall\n"
    return "[effects.rotors]  # lag and inertia of the vehicle file\n"


def _disturbance(disturbance: Disturbance | None) -> str:
    """Return `[effects.disturbance]` with its fields that are not zero; empty without a disturbance."""
    if disturbance is None:
        return ""
    text = "\n[effects.disturbance]  # of the vehicle file: what its flights met\n"
    for name, unit in DISTURBANCE_UNITS.items():
        value = getattr(disturbance, name)
        if value is not None and np.any(value):
            text += f"{name} = {json.dumps(value)}  # {unit}\n"
    return text


def _constraints(law: str, vehicle: Vehicle, design: Design, course: FirstCourse) -> str:
    """Return the audited constraints that are not bounds of the controller."""
    text = "\n# Audited without an entry: every bound of the controller.\n"
    if law == "rates":  # it bounds the thrust of all rotors together
        text += _entry("speed", "speed", vehicle.speed_min, vehicle.speed_max, "rad/s, what the rotors hold")
    elif law not in ("robust", "nonlinear"):  # baselines bound the tilt that they command, and overshoot it
        tilt = tilt_bound(design)
        for name in ("roll", "pitch"):
            text += _entry(name, name, -tilt, tilt, "deg, the tilt bound, at every instant")
    if not course.has_floor:
        hull = "m, radius of the ball about the hull: the lowest centre that keeps all of the vehicle above the ground"
        text += _entry("floor", "z", lowest_centre(vehicle), None, f"{hull}, z = 0")
    if course.allowed:
        allowed = in_digits(course.allowed)
        why = f"m, {course.why_allowed}: the same for every controller"
        for axis in "xyz":
            text += _entry(f"hold_{axis}", f"{axis}_error", -allowed, allowed, why)
    return text + course.constraints


def _entry(name: str, signal: str, lower: float, upper: float | None, comment: str) -> str:
    """Return an entry of `[[constraints]]`."""
    text = f'\n[[constraints]]\nname = "{name}"\nsignal = "{signal}"\nlower = {lower}  # {comment}\n'
    if upper is not None:
        text += f"upper = {upper}\n"
    return text


def _quoted(text: str) -> str:
    """Return a text as TOML."""
    return json.dumps(text, ensure_ascii=False)
