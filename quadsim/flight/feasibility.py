"""The demands of a course on a vehicle, computed before the flight by differential flatness.

A quadrotor's attitude, rates, torques and rotor speeds follow from its position, its yaw, and their derivatives
(Mellinger & Kumar 2011, Sec.  III). Derivatives are central differences at the control period, of the samples that the
controller receives: it knows nothing in between, and a corner demands a turn within one period.  Three effects are left
out, because differences would be meaningless:

- around a jump of the course, acceleration (hover is assumed);
- around a kink, where the velocity or its derivative may jump, torque;
- wind and drag.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from quadsim.flight.audit import Mask
from quadsim.rotation import euler_to_body_rates
from quadsim.state import (
    ANGLE_RATES,
    ANGLES,
    EULER,
    EULER_RATE,
    INDEX,
    N_STATES,
    POSITION,
    STATE_UNITS,
    VELOCITY,
    Array,
    shown_unit,
    tilt,
    wrapped,
)
from quadsim.vehicle import Vehicle

STENCIL: Final = 2  # samples on either side that a torque depends on
DIFFERENCE_ROUNDING: Final = 1e-6
"""Tolerances of a bound, relative and absolute, for rounding in the differences."""


BODY_RATES: Final = ("body_rate_x", "body_rate_y", "body_rate_z")
"""Bounds on body rates, by their signals."""


@dataclass(frozen=True, kw_only=True)
class Demand:
    """The demands of flying a course exactly, at K samples."""

    state: Array  # (K, 12) the states of `quadsim.state`, SI
    acceleration: Array  # (K, 3) world [m/s^2]
    thrust: Array  # (K,) of all rotors together [N]
    torque: Array  # (K, 3) body [N m]; 0 around kinks and jumps
    thrusts: Array  # (K, 4) thrust per rotor [N]; negative ones are impossible
    speeds: Array  # (K, 4) rotor speeds [rad/s]; 0 where a thrust is negative
    slews: Array  # (K - 1, 4) speed steps from sample to sample [rad/s], NaN next to an omitted torque


@dataclass(frozen=True, kw_only=True, repr=False)
class Feasibility:
    """A course compared with a vehicle's limits and a controller's bounds; peaks over the whole course."""

    tilt: float  # largest [deg]
    velocity: float  # largest magnitude [m/s]
    acceleration: float  # largest magnitude [m/s^2]
    yaw: float  # largest magnitude, wrapped to +-180 [deg]; a model linearised at zero yaw is valid near 0
    yaw_rate: float  # largest magnitude [deg/s]
    rotor_min: float  # lowest rotor speed [rad/s]; 0 where a rotor's thrust is negative
    rotor_max: float  # highest rotor speed [rad/s]
    thrust_to_weight: float  # largest
    thrust_min: float  # least thrust of a rotor [N]; negative: not flyable, whatever the rotors' limits
    jumps: tuple[float, ...]  # times of jumps of the course [s]; the peaks exclude them
    problems: tuple[str, ...]
    """One line per exceeded limit or bound; empty for a course that can be flown exactly."""
    sentence: str  # summary for the user
    advice: str  # the speed, response time or size that would be within limits and bounds, in a sentence
    notes: tuple[str, ...]  # what no controller can do, and doubts about the course's numbers

    def __repr__(self) -> str:
        lines = [self.sentence, *self.problems, *self.notes]
        if self.advice:
            lines.append(self.advice)
        return "\n ".join(["<Feasibility", *lines]) + ">"


def demand(
    course: Array, period: float, vehicle: Vehicle, *, jumps: Mask | None = None, kinks: Mask | None = None
) -> Demand:
    """Compute the demands of flying a sampled course exactly.

    With f = a + g e_z, and a frame turned by the yaw psi, the thrust is m |f| along body z = f / |f|, so that
    roll = asin(-f_y / |f|), pitch = atan2(f_x, f_z).  Body rates are those of the attitudes half a period before and
    after, and tau = J d(w)/dt + w x J w; rotor speeds come from thrust and torque by the inverse allocation.

    Args:
        course: (K + 4, 4) x, y, z [m], yaw [rad], world, with two extra samples on either side.
        period: sample period [s].
        vehicle: mass, inertia, gravity, rotors.
        jumps: (K + 3,) whether the course jumps between a sample and the next.
        kinks: (K + 3,) whether its velocity, or the derivative of that, may jump there.
    """
    intervals = course.shape[0] - 1
    if jumps is None:
        jumps = np.zeros(intervals, bool)
    kinks = jumps if kinks is None else jumps | kinks
    velocity = np.diff(course, axis=0) / period
    usable = ~(jumps[1:] | jumps[:-1])
    acceleration = np.where(usable[:, None], np.diff(velocity[:, :3], axis=0) / period, 0.0)
    pushed = acceleration + np.array([0.0, 0.0, vehicle.gravity])
    force = np.linalg.norm(pushed, axis=1)
    euler = _attitudes(pushed, course[1:-1, 3])

    euler_rates = np.diff(euler, axis=0) / period
    body_rates = euler_to_body_rates(0.5 * (euler[1:] + euler[:-1]), euler_rates)
    smooth = ~(kinks[3:] | kinks[2:-1] | kinks[1:-2] | kinks[:-3])
    rates = 0.5 * (body_rates[1:] + body_rates[:-1])
    torque = vehicle.momentum(np.diff(body_rates, axis=0)) / period + np.cross(rates, vehicle.momentum(rates))
    torque = np.where(smooth[:, None], torque, 0.0)

    inner = slice(1, -1)
    wrench = np.column_stack([vehicle.mass * force[inner], torque])
    squared = np.linalg.solve(vehicle.allocation, wrench.T).T
    thrusts = vehicle.coefficients * squared
    speeds = vehicle.speeds(np.maximum(thrusts, 0.0))
    between = smooth[1:] & smooth[:-1]

    state = np.zeros((smooth.size, N_STATES))
    mean_velocity = 0.5 * (velocity[1:] + velocity[:-1])
    state[:, POSITION] = course[STENCIL:-STENCIL, :3]
    state[:, VELOCITY] = np.where(usable[:, None], mean_velocity[:, :3], 0.0)[inner]
    state[:, EULER] = euler[inner]
    turning = usable[2:] & usable[1:-1] & usable[:-2]
    state[:, EULER_RATE] = np.where(turning[:, None], 0.5 * (euler_rates[1:] + euler_rates[:-1]), 0.0)
    return Demand(
        state=state,
        acceleration=acceleration[inner],
        thrust=wrench[:, 0],
        torque=torque,
        thrusts=thrusts,
        speeds=speeds,
        slews=np.where(between[:, None], np.diff(speeds, axis=0), np.nan),
    )


def assess(
    needed: Demand,
    vehicle: Vehicle,
    *,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    tightened: Mapping[str, tuple[float, float]] | None = None,
    jumps: Sequence[float] = (),
) -> Feasibility:
    """Compare demands with the vehicle's rotor speeds and a controller's bounds.

    Args:
        needed: the demands.
        vehicle: its rotor limits count.
        bounds: lower and upper bounds by name, in file units: a state of `quadsim.state`, `speed` [rad/s] of the rotors
            or `slew` [rad/s per period]; or `thrust` [N] and the `BODY_RATES` [deg/s] of an autopilot's targets;
            `climb_acceleration` [m/s^2].
        tightened: the bounds on states after tightening at the end of the horizon; checked if the bounds themselves
            hold.
        jumps: times [s] at which the course jumps.
    """
    bounds = bounds or {}
    tilts = []
    for name in ("roll", "pitch"):
        if name in bounds:
            for side in bounds[name]:
                tilts.append(abs(side))
    peaks = {
        "tilt": math.degrees(float(tilt(needed.state).max())),
        "velocity": float(np.linalg.norm(needed.state[:, VELOCITY], axis=1).max()),
        "acceleration": float(np.linalg.norm(needed.acceleration, axis=1).max()),
        "yaw": math.degrees(float(np.abs(wrapped(needed.state[:, INDEX["yaw"]])).max())),
        "yaw_rate": math.degrees(float(np.abs(needed.state[:, INDEX["yaw_rate"]]).max())),
        "rotor_min": float(needed.speeds.min()),
        "rotor_max": float(needed.speeds.max()),
        "thrust_to_weight": float(needed.thrust.max()) / (vehicle.mass * vehicle.gravity),
        "thrust_min": float(needed.thrusts.min()),
    }
    problems = _problems(needed, vehicle, bounds, tightened or {})
    sentence = _sentence(peaks, vehicle, min(tilts, default=None), jumps, problems)
    return Feasibility(**peaks, jumps=tuple(jumps), problems=problems, sentence=sentence, advice="", notes=())


def _attitudes(pushed: Array, yaw: Array) -> Array:
    """(M, 3) roll, pitch, yaw [rad] with body z along the specific force (M, 3) [m/s^2]."""
    cos = np.cos(yaw)
    sin = np.sin(yaw)
    forward = cos * pushed[:, 0] + sin * pushed[:, 1]
    left = cos * pushed[:, 1] - sin * pushed[:, 0]
    pitch = np.unwrap(np.arctan2(forward, pushed[:, 2]))  # upside down, pitch continues beyond 180 deg
    roll = np.arctan2(-left, np.hypot(forward, pushed[:, 2]))
    return np.stack([roll, pitch, yaw], axis=1)


def _problems(
    needed: Demand,
    vehicle: Vehicle,
    bounds: Mapping[str, tuple[float, float]],
    tightened: Mapping[str, tuple[float, float]],
) -> tuple[str, ...]:
    """Return one line per side of a limit or bound that the demands exceed."""
    least = vehicle.speed_min
    most = vehicle.speed_max
    problems = _beyond("rotor speed", "rad/s", needed.speeds, (least, most), "limit")
    thrust = float(needed.thrusts.min())
    if thrust < -DIFFERENCE_ROUNDING * vehicle.mass * vehicle.gravity:
        problems.append(f"not flyable: a rotor would need a negative thrust, down to {thrust:.4g} N")
    for name, (lower, upper) in bounds.items():
        if name == "speed":  # an equally narrow vehicle limit is already listed
            tighter = (lower if lower > least else -math.inf, upper if upper < most else math.inf)
            problems += _beyond("rotor speed", "rad/s", needed.speeds, tighter, "bound")
        elif name == "slew":
            slews = needed.slews[np.isfinite(needed.slews)]
            problems += _beyond("change of rotor speed", "rad/s per period", slews, (lower, upper), "bound")
        elif name == "thrust":
            problems += _beyond("thrust", "N", needed.thrust, (lower, upper), "bound")
        elif name == "climb_acceleration":
            problems += _beyond("climb acceleration", "m/s^2", needed.acceleration[:, 2], (lower, upper), "bound")
        elif name in BODY_RATES:
            rates = euler_to_body_rates(needed.state[:, ANGLES], needed.state[:, ANGLE_RATES])
            about_axis = np.degrees(rates[:, BODY_RATES.index(name)])
            problems += _beyond(name, "deg/s", about_axis, (lower, upper), "bound")
        else:
            unit, scale = shown_unit(STATE_UNITS[INDEX[name]])
            values = scale * needed.state[:, INDEX[name]]
            beyond = _beyond(name, unit, values, (lower, upper), "bound")
            if not beyond and name in tightened:
                beyond = _beyond(name, unit, values, tightened[name], f"bound {upper:.4g}, tightened to")
            problems += beyond
    return tuple(problems)


def _beyond(name: str, unit: str, values: Array, allowed: tuple[float, float], kind: str) -> list[str]:
    if not values.size:
        return []
    lower, upper = allowed
    low = float(values.min())
    high = float(values.max())
    problems = []
    if high > upper + DIFFERENCE_ROUNDING * (1.0 + abs(upper)):
        problems.append(f"{name} up to {high:.4g} {unit} ({kind} {upper:.4g})")
    if low < lower - DIFFERENCE_ROUNDING * (1.0 + abs(lower)):
        problems.append(f"{name} down to {low:.4g} {unit} ({kind} {lower:.4g})")
    return problems


def _sentence(
    peaks: Mapping[str, float],
    vehicle: Vehicle,
    allowed: float | None,
    jumps: Sequence[float],
    problems: Sequence[str],
) -> str:
    if problems:
        if len(problems) > 1:
            more = f" and {len(problems) - 1} more"
        else:
            more = ""
        return f"The course cannot be followed exactly: {problems[0]}{more}."
    if allowed is None:
        bound = ""
    else:
        bound = f" (bound {allowed:.4g} deg)"
    times = ", ".join(f"{time:g}" for time in jumps[:4]) + (", ..." if len(jumps) > 4 else "")
    if peaks["yaw"] > 0.5:
        turned = f", a yaw of {round(peaks['yaw'], 1):g} deg"
    else:
        turned = ""
    if jumps:
        subject = f"The course steps (at {times} s); the rest requires"
    else:
        subject = "The course requires"
    return (
        f"{subject} up to {round(peaks['tilt'], 2):g} deg of tilt{bound}, "
        f"{round(peaks['velocity'], 2):g} m/s{turned}, "
        f"and rotor speeds of {peaks['rotor_min']:.4g} to {peaks['rotor_max']:.4g} rad/s "
        f"(limits {vehicle.speed_min:.4g} and {vehicle.speed_max:.4g})."
    )
