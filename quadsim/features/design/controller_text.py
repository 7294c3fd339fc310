"""The `[controller]` of a first scenario as text, each number with its unit and its source.

A robust MPC takes its weights from `rules.py`; nonlinear MPC, LQR, PID and geometric control have rules of their own
and take from it the tilt bound and the time scale.  `first_scenario.py` places the text in the file.
"""

from __future__ import annotations

import json
import math
from typing import Final

import numpy as np

from quadsim.features.design.courses_by_rule import FirstCourse, in_digits
from quadsim.features.design.rules import (
    HEADING_RATIO,
    HEADING_STEP,
    HEIGHT_RATIO,
    HEIGHT_STEP,
    HORIZON_TIMES,
    MOVE_RATIO,
    THRUST_SHARE,
    Design,
)
from quadsim.mpc.laws.parts.bandwidths import lag_to_allow_for
from quadsim.mpc.problem.model import SHORTEST_LAG
from quadsim.vehicle import AIR_MOMENT, Vehicle, span

NODE: Final = 0.04  # shortest time between the nodes of nonlinear MPC [s]
AHEAD: Final = 0.8  # its horizon [s]
TURNED_FROM: Final = 5.0
"""Angular acceleration by `rotor_moment` at hover [rad/s^2 per m/s] from which first flights count on it: it makes
hover unstable, with poles of size (g TURNED_FROM)^(1/3), 3.7 rad/s, of about the loop's own bandwidth."""
BALANCED_SPEED: Final = 0.01
BALANCED_MOVE: Final = 0.25
"""Weights of speeds and of their changes, over those by rule, where the hover model has the moment: what balances it in
steady motion would otherwise cost as much as a deviation, and the vehicle would lag."""
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
half of a time constant counts as dead time (the half rule of SIMC, Skogestad, 2003).  The controllers' own default is
1."""
OBSERVED_LAG_SHARE: Final = 0.3
"""`LAG_SHARE` where the torque of the air is observed: the loop then has to be faster than that torque grows."""
PREVIEW: Final = 2.0
"""Preview, times w, from which baselines take the reference's velocity, and all but the LQR its acceleration."""


def controller_text(law: str, vehicle: Vehicle, design: Design, course: FirstCourse) -> str:
    """Return `[controller]` and its tables, for one of `DESIGNED_LAWS`."""
    if law in ("nonlinear", "rates"):
        return _nonlinear(law, vehicle, design) + _nonlinear_avoidance(course)
    if law == "robust":
        controller = _robust(vehicle, design)
    else:
        controller = _baseline(law, vehicle, design, course)
    down, up = design.slew
    slews = [in_digits(down, 4), in_digits(up, 4)]
    return f"""{controller}
[controller.input_bounds]
{_speed_bounds(vehicle)}slew = {slews}  # rad/s per period: what a rotor's own speed makes in one, \
from hover towards its limits
{_avoidance(course, design)}"""


def tilt_bound(design: Design) -> float:
    """Return the tilt bound [deg], by rule a whole number where it is above 5."""
    degrees = math.degrees(design.tilt) + 1e-9
    if design.tilt_stated:
        return round(degrees, 6)
    if degrees > 5.0:
        return float(math.floor(degrees))
    return in_digits(degrees)


def _speed_bounds(vehicle: Vehicle) -> str:
    """Return the line of the bounds on rotor speeds."""
    speeds = [vehicle.speed_min, vehicle.speed_max]
    return f"speed = {speeds}  # rad/s, what the rotors hold; hover is {span(vehicle.hover_speeds)}\n"


def _robust(vehicle: Vehicle, design: Design) -> str:
    """Return the tables of the linear MPC that `rules.py` designs, without its bounds on inputs."""
    position = in_digits(design.weights[0])
    height = in_digits(design.weights[1])
    heading = in_digits(design.weights[2])
    speed, why_speed = _speed_weight(vehicle, design)
    move, why_move = _move_weight(vehicle, design)
    lag, why_lag = _predicted_lag(vehicle)
    tilt = tilt_bound(design)
    moment = ""
    if _unstable_in_air(vehicle):
        turned = f"{vehicle.turned_by_air:.3g} rad/s^2 per m/s"
        moment = f"moment = true  # the air's torque is in the model: at hover {turned}\n"
    return f"""[controller]
type = "robust"
horizon = {design.horizon}  # N, periods: {HORIZON_TIMES:g} / w = {HORIZON_TIMES / design.bandwidth:.3g} s
rotor_lag = {lag}  # {why_lag}
{moment}heading = true  # the hover model is turned by the present yaw
move_weight = {move}  # of changes: {why_move}

[controller.offset_free]  # force and torque that the model does not know are estimated and compensated

[controller.soft]
linear = {in_digits(SOFT_WEIGHTS[0] * position)}  # l1: {SOFT_WEIGHTS[0]:g} times the weight of x
quadratic = {in_digits(SOFT_WEIGHTS[1] * position)}  # l2: {SOFT_WEIGHTS[1]:g} times the weight of x

[controller.output_weights]
x = {position}  # 1 / (g tan(tilt bound) / w^2)^2: {design.deviation:.3g} m is what the tilt bound answers
y = {position}  # as x
z = {height}  # for {design.height:.3g} rad/s, at most {HEIGHT_RATIO:g} w; \
all thrust in reserve answers {HEIGHT_STEP:g} m or more
yaw = {heading}  # for {design.heading:.3g} rad/s, at most {HEADING_RATIO:g} w; \
all torque in reserve answers {math.degrees(HEADING_STEP):.3g} deg or more

[controller.input_weights]
speed = {speed}  # {why_speed}

[controller.output_bounds]
roll = {[-tilt, tilt]}  # deg: {_why_tilt(design)}
pitch = {[-tilt, tilt]}  # as roll
"""


def _speed_weight(vehicle: Vehicle, design: Design) -> tuple[float, str]:
    """Return the weight of a rotor's speed, and its source as a comment."""
    weight = in_digits(design.speed_weight)
    if _unstable_in_air(vehicle):
        return in_digits(BALANCED_SPEED * weight), f"{BALANCED_SPEED:g} of that by rule: motion needs torque"
    accepted = weight**-0.5
    return weight, (f"1 / ({accepted:.3g} rad/s)^2: with it four integrators have the bandwidth w, (g beta)^2 x / w^8")


def _move_weight(vehicle: Vehicle, design: Design) -> tuple[float, str]:
    """Return the weight of changes of a rotor's speed, and its source as a comment."""
    weight = in_digits(design.move_weight)
    if _unstable_in_air(vehicle):
        return in_digits(BALANCED_MOVE * weight), f"{BALANCED_MOVE:g} of those by rule, likewise"
    return weight, f"as much as speed costs at {MOVE_RATIO:g} w, speed / ({MOVE_RATIO:g} w tau)^2"


def _why_tilt(design: Design) -> str:
    """Return the source of the tilt bound, as a comment."""
    if design.tilt_stated:
        return "as --tilt states it"
    held = math.degrees(math.acos(min(1.0, 1.0 / (THRUST_SHARE * design.authority.thrust_to_weight))))
    return f"the limit of the linear model, or {held:.3g} deg, what {100 * THRUST_SHARE:g} % of the thrust holds"


def _avoidance(course: FirstCourse, design: Design) -> str:
    """Return the table that keeps clear of obstacles, and within regions; empty where there are none."""
    if course.clearance is None:
        return ""
    position = design.weights[0]
    linear, quadratic = AVOIDANCE_WEIGHTS
    return f"""
[controller.avoidance]  # planes between the plan and each obstacle
margin = {course.clearance}  # m, added

[controller.avoidance.soft]
linear = {in_digits(linear * position)}  # l1: {linear:g} times the weight of x
quadratic = {in_digits(quadratic * position)}  # l2: {quadratic:g} times the weight of x
"""


def _nonlinear(law: str, vehicle: Vehicle, design: Design) -> str:
    """Return the tables of nonlinear MPC, of rotor speeds or of thrust and body rates through the autopilot."""
    stride = math.ceil(NODE / design.period - 1e-9)  # periods from node to node
    nodes = math.ceil(AHEAD / (stride * design.period) - 1e-9)
    horizon = stride * nodes
    if law == "rates":
        flown_by = "the vehicle's autopilot: its file's [autopilot], or by rule"
        commands = f'commands = "rates"  # thrust and body rates, flown by {flown_by}\n'
        bounds = ""
    else:
        lag, why_lag = _predicted_lag(vehicle)
        commands = f"rotor_lag = {lag}  # {why_lag}\n"
        if _states_air_moment(vehicle):
            commands += "moment = true  # the air's torque and loss of thrust are predicted\n"
        bounds = f"\n[controller.input_bounds]\n{_speed_bounds(vehicle)}"
    return f"""[controller]
type = "nonlinear"
{commands}horizon = {horizon}  # periods, {horizon * design.period:.3g} s
node = {round(stride * design.period, 9)}  # s, whole periods of {NODE:g} s or more
terminal = "lqr"
tilt = {tilt_bound(design)}  # deg, the bound of the linear controllers

[controller.soft]

[controller.disturbance]  # unknown force, drag, and how much thrust the rotors give for a command: batteries sag
{bounds}"""


def _nonlinear_avoidance(course: FirstCourse) -> str:
    """Return the table with which nonlinear MPC keeps clear of obstacles; empty where there are none."""
    if course.clearance is None:
        return ""
    return f"\n[controller.avoidance]\nmargin = {course.clearance}  # m, added\nsoft = {{}}\n"


def _predicted_lag(vehicle: Vehicle) -> tuple[str, str]:
    """Return the rotors' lag that an MPC predicts, as TOML, and its source, as a comment."""
    if vehicle.rotor_rise is not None and vehicle.rotor_rise >= SHORTEST_LAG:
        return '"vehicle"', "the vehicle's rotor_rise is predicted"
    return "0.0", "the vehicle gives no lag"


def _baseline(law: str, vehicle: Vehicle, design: Design, course: FirstCourse) -> str:
    """Return the tables of an LQR, PID or geometric controller, without its bounds on inputs."""
    tilt = BASELINE_SHARE * tilt_bound(design)
    rules = ""
    if law == "lqr":
        tilt = min(LQR_TILT, tilt)
        rules = "  # weights by Bryson's rule, its defaults; it tracks pose and velocity, not acceleration"
    w = design.bandwidth
    text = f"""[controller]
type = {json.dumps(law)}{rules}
tilt = {round(tilt, 3)}  # deg, largest that it commands; below the audit's, which it overshoots
horizon = {math.ceil(PREVIEW / (w * design.period))}  # periods of preview for the reference's velocity: \
{PREVIEW:g} / w = {PREVIEW / w:.3g} s
"""
    unstable = _unstable_in_air(vehicle)
    observed = law == "geometric" and unstable and not course.lasts
    if observed:
        text += _allowed_lag(OBSERVED_LAG_SHARE, vehicle, design)
    elif law != "lqr":
        text += _allowed_lag(LAG_SHARE, vehicle, design)
    if observed:  # the reference of steps has no jerk and snap that are worth feeding forward
        text += _observer(vehicle)
    elif law == "geometric":
        text += _integral(vehicle, course)
    elif unstable:
        text += "moment = true  # what the air does to the vehicle is balanced\n"
    return text


def _allowed_lag(share: float, vehicle: Vehicle, design: Design) -> str:
    """Return the line of the lag that the gains of PID and geometric control allow for."""
    lag = lag_to_allow_for(vehicle, design.period)
    return (
        f"lag = {in_digits(share * lag)}  # s that its gains allow for: {share:g} times "
        f"{1e3 * lag:.3g} ms, the rotors' lag or half a period\n"
    )


def _observer(vehicle: Vehicle) -> str:
    """Return the table with which a geometric controller observes force and torque."""
    lag = vehicle.rotor_rise or 0.0
    text = "\n[controller.disturbance]  # the air's torque, too, is observed and compensated\n"
    if lag > 0.0:
        text += f"rotor_lag = {lag}  # s, the vehicle's rotor_rise\n"
    return text


def _integral(vehicle: Vehicle, course: FirstCourse) -> str:
    """Return the fields of a geometric controller with integral action, and feedforward on courses that last."""
    text = "integral = true  # against drag and what else is not modelled\n"
    if course.lasts and _states_air_moment(vehicle):
        text += "feedforward = true  # of the reference's jerk and snap\n"
        text += "moment = true  # the air's torque on the vehicle at the reference's motion is balanced\n"
    return text


def _unstable_in_air(vehicle: Vehicle) -> bool:
    """Return whether the air's torque makes hover as unstable as `TURNED_FROM` states."""
    return vehicle.turned_by_air >= TURNED_FROM


def _states_air_moment(vehicle: Vehicle) -> bool:
    """Return whether the vehicle's file states the torque of the air, which `moment = true` balances."""
    return any(np.any(getattr(vehicle, name) or 0.0) for name in AIR_MOMENT)
