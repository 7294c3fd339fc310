"""The demands of a course on a vehicle, computed before the flight by differential flatness.

A quadrotor's attitude, rates, torques and rotor speeds follow from its position, its yaw, and their derivatives
(Mellinger & Kumar 2011, Sec.  III). `demand` computes them, `assess` compares them with limits and bounds, and
`quadsim.scenarios.feasibility_check` calls both for a scenario.
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
"""Tolerance for rounding in the differences: of a bound b, this times 1 + |b|."""
BODY_RATES: Final = ("body_rate_x", "body_rate_y", "body_rate_z")
"""Bounds on body rates, by their signals."""
_NUMERALS: Final = ("two", "three", "four", "five", "six", "seven", "eight", "nine", "ten", "eleven", "twelve")
"""Words for counts from two on."""


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
    """What the course needs beyond each exceeded limit, as phrases that continue `it needs`; empty for a course that
    can be flown exactly."""
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
    after; rotor speeds come from thrust and torque by the inverse allocation.

    Derivatives are central differences at the control period, of the samples that the controller receives: it knows
    nothing in between, and a corner demands a turn within one period.  Three effects are left out, because differences
    would be meaningless: acceleration around a jump of the course (hover is assumed); torque around a kink, where the
    velocity or its derivative may jump; wind and drag.

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
    if kinks is None:
        kinks = jumps
    else:
        kinks = jumps | kinks

    # Each difference has one row less: the course has K + 4, velocities K + 3, attitudes K + 2, rates K + 1, torques K.
    velocity = np.diff(course, axis=0) / period
    usable = ~(jumps[1:] | jumps[:-1])  # no jump on either side of the sample
    acceleration = np.where(usable[:, None], np.diff(velocity[:, :3], axis=0) / period, 0.0)
    specific_force = acceleration + np.array([0.0, 0.0, vehicle.gravity])
    euler = _attitudes(specific_force, course[1:-1, 3])
    euler_rates = np.diff(euler, axis=0) / period
    mean_euler = 0.5 * (euler[1:] + euler[:-1])
    body_rates = euler_to_body_rates(mean_euler, euler_rates)
    smooth = ~(kinks[3:] | kinks[2:-1] | kinks[1:-2] | kinks[:-3])  # no kink in the four intervals of a torque
    torque = np.where(smooth[:, None], _torques(body_rates, period, vehicle), 0.0)

    inner = slice(1, -1)  # of K + 2 rows, those of the K samples
    thrust = vehicle.mass * np.linalg.norm(specific_force, axis=1)[inner]
    wrench = np.column_stack([thrust, torque])
    squared_speeds = np.linalg.solve(vehicle.allocation, wrench.T).T
    thrusts = vehicle.coefficients * squared_speeds
    speeds = vehicle.speeds(np.maximum(thrusts, 0.0))
    both_smooth = smooth[1:] & smooth[:-1]
    return Demand(
        state=_states(course, velocity, euler, euler_rates, usable),
        acceleration=acceleration[inner],
        thrust=thrust,
        torque=torque,
        thrusts=thrusts,
        speeds=speeds,
        slews=np.where(both_smooth[:, None], np.diff(speeds, axis=0), np.nan),
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
    peaks = _peaks(needed, vehicle)
    problems = _problems(needed, vehicle, bounds, tightened or {})
    sentence = _sentence(peaks, vehicle, _narrowest_tilt(bounds), jumps, problems)
    return Feasibility(**peaks, jumps=tuple(jumps), problems=problems, sentence=sentence, advice="", notes=())


def _peaks(needed: Demand, vehicle: Vehicle) -> dict[str, float]:
    """Return the peaks of the demands, by the names and in the units of `Feasibility`."""
    speeds = np.linalg.norm(needed.state[:, VELOCITY], axis=1)
    accelerations = np.linalg.norm(needed.acceleration, axis=1)
    yaws = np.abs(wrapped(needed.state[:, INDEX["yaw"]]))
    yaw_rates = np.abs(needed.state[:, INDEX["yaw_rate"]])
    weight = vehicle.mass * vehicle.gravity
    return {
        "tilt": math.degrees(float(tilt(needed.state).max())),
        "velocity": float(speeds.max()),
        "acceleration": float(accelerations.max()),
        "yaw": math.degrees(float(yaws.max())),
        "yaw_rate": math.degrees(float(yaw_rates.max())),
        "rotor_min": float(needed.speeds.min()),
        "rotor_max": float(needed.speeds.max()),
        "thrust_to_weight": float(needed.thrust.max()) / weight,
        "thrust_min": float(needed.thrusts.min()),
    }


def _narrowest_tilt(bounds: Mapping[str, tuple[float, float]]) -> float | None:
    """Return the narrowest bound on roll or pitch [deg]; None without one."""
    magnitudes = []
    for name in ("roll", "pitch"):
        if name in bounds:
            lower, upper = bounds[name]
            magnitudes += [abs(lower), abs(upper)]
    return min(magnitudes, default=None)


def _attitudes(specific_force: Array, yaw: Array) -> Array:
    """(M, 3) roll, pitch, yaw [rad] with body z along the specific force (M, 3) [m/s^2]."""
    cos = np.cos(yaw)
    sin = np.sin(yaw)
    forward = cos * specific_force[:, 0] + sin * specific_force[:, 1]
    left = cos * specific_force[:, 1] - sin * specific_force[:, 0]
    up = specific_force[:, 2]
    pitch = np.unwrap(np.arctan2(forward, up))  # upside down, pitch continues beyond 180 deg
    roll = np.arctan2(-left, np.hypot(forward, up))
    return np.stack([roll, pitch, yaw], axis=1)


def _torques(body_rates: Array, period: float, vehicle: Vehicle) -> Array:
    """Return (M - 1, 3) tau = J d(w)/dt + w x J w [N m], of body rates w (M, 3) [rad/s] a period apart."""
    mean_rates = 0.5 * (body_rates[1:] + body_rates[:-1])
    accelerating = vehicle.momentum(np.diff(body_rates, axis=0)) / period
    gyroscopic = np.cross(mean_rates, vehicle.momentum(mean_rates))
    return accelerating + gyroscopic


def _states(course: Array, velocity: Array, euler: Array, euler_rates: Array, usable: Mask) -> Array:
    """Return the states (K, 12) at the samples of a course (K + 4, 4).

    Args:
        course: x, y, z [m], yaw [rad].
        velocity: (K + 3, 4) its differences from sample to sample, per second.
        euler: (K + 2, 3) attitudes [rad], without the first and the last sample.
        euler_rates: (K + 1, 3) their differences from sample to sample [rad/s].
        usable: (K + 2,) whether there is no jump beside a sample; beside a jump, velocities and rates are 0.
    """
    inner = slice(1, -1)
    mean_velocity = 0.5 * (velocity[1:] + velocity[:-1])
    mean_rates = 0.5 * (euler_rates[1:] + euler_rates[:-1])
    turning = usable[2:] & usable[1:-1] & usable[:-2]  # a rate depends on three attitudes
    state = np.zeros((course.shape[0] - 2 * STENCIL, N_STATES))
    state[:, POSITION] = course[STENCIL:-STENCIL, :3]
    state[:, VELOCITY] = np.where(usable[:, None], mean_velocity[:, :3], 0.0)[inner]
    state[:, EULER] = euler[inner]
    state[:, EULER_RATE] = np.where(turning[:, None], mean_rates, 0.0)
    return state


def _problems(
    needed: Demand,
    vehicle: Vehicle,
    bounds: Mapping[str, tuple[float, float]],
    tightened: Mapping[str, tuple[float, float]],
) -> tuple[str, ...]:
    """Return a phrase for each side of a limit or bound that the demands exceed; arguments as `assess`."""
    problems = _rotor_problems(needed, vehicle)
    for name, allowed in bounds.items():
        quantity, unit, values = _bounded(name, needed)
        if name == "speed":
            allowed = _narrower_than_rotors(allowed, vehicle)
        beyond = _exceeded(quantity, unit, values, allowed)
        if not beyond and name in tightened:
            beyond = _exceeded(quantity, unit, values, tightened[name], stated=allowed)
        problems += beyond
    return tuple(problems)


def _rotor_problems(needed: Demand, vehicle: Vehicle) -> list[str]:
    """Return a phrase for each side of the rotors' limits that the demands exceed."""
    limits = (vehicle.speed_min, vehicle.speed_max)
    problems = _exceeded("rotor speed", "rad/s", needed.speeds, limits, whose="rotor ")
    lowest = float(needed.thrusts.min())
    if lowest < -DIFFERENCE_ROUNDING * vehicle.mass * vehicle.gravity:
        problems.append(f"{lowest:.3g} N of thrust from a rotor, which is not flyable")
    return problems


def _bounded(name: str, needed: Demand) -> tuple[str, str, Array]:
    """Return the bounded quantity in words, its unit, and its values over the course."""
    if name == "speed":
        return "rotor speed", "rad/s", needed.speeds
    if name == "slew":
        return "rotor speed change per period", "rad/s", needed.slews[np.isfinite(needed.slews)]
    if name == "thrust":
        return "thrust", "N", needed.thrust
    if name == "climb_acceleration":
        return "climb acceleration", "m/s^2", needed.acceleration[:, 2]
    if name in BODY_RATES:
        rates = euler_to_body_rates(needed.state[:, ANGLES], needed.state[:, ANGLE_RATES])
        return name, "deg/s", np.degrees(rates[:, BODY_RATES.index(name)])
    unit, scale = shown_unit(STATE_UNITS[INDEX[name]])
    return name, unit, scale * needed.state[:, INDEX[name]]


def _narrower_than_rotors(bound: tuple[float, float], vehicle: Vehicle) -> tuple[float, float]:
    """Return a bound on rotor speeds without the sides that are no narrower than the rotors' limits, checked before."""
    lower, upper = bound
    if lower <= vehicle.speed_min:
        lower = -math.inf
    if upper >= vehicle.speed_max:
        upper = math.inf
    return lower, upper


def _exceeded(
    quantity: str,
    unit: str,
    values: Array,
    allowed: tuple[float, float],
    *,
    whose: str = "",
    stated: tuple[float, float] | None = None,
) -> list[str]:
    """Return a phrase for each side on which values are beyond what is allowed, e.g. `19.1 deg of roll (limit 5 deg)`.

    Args:
        quantity: in words.
        unit: of all numbers.
        values: over the course, of any shape.
        allowed: lower and upper limit.
        whose: `rotor ` where the limit is the rotors', empty where it is the controller's.
        stated: the bounds that were tightened to `allowed`; None if they were not.
    """
    if not values.size:
        return []
    lower, upper = allowed
    stated_lower, stated_upper = stated or (None, None)
    highest = float(values.max())
    lowest = float(values.min())
    phrases = []
    if highest > upper + DIFFERENCE_ROUNDING * (1.0 + abs(upper)):
        limit = _limit_text(upper, unit, whose, stated_upper)
        phrases.append(f"{_distinct_from(upper, highest)} {unit} of {quantity} ({limit})")
    if lowest < lower - DIFFERENCE_ROUNDING * (1.0 + abs(lower)):
        limit = _limit_text(lower, unit, whose, stated_lower)
        phrases.append(f"{_distinct_from(lower, lowest)} {unit} of {quantity} ({limit})")
    return phrases


def _limit_text(limit: float, unit: str, whose: str, stated: float | None) -> str:
    """Return one side of a limit in words, with the bound that was tightened to it, if there is one."""
    if stated is not None:
        return f"limit {stated:.4g} {unit}, tightened to {limit:.4g} {unit}"
    return f"{whose}limit {limit:.4g} {unit}"


def _distinct_from(limit: float, value: float) -> str:
    """Return a value as text with three significant digits, or more.

    It has all digits before the decimal point, and as many as it takes to be on the right side of the limit.
    """
    digits = 3
    if math.isfinite(value):
        digits = max(digits, len(str(round(abs(value)))))
    text = f"{value:.{digits}g}"
    while float(text) == limit or (float(text) > limit) != (value > limit):
        digits += 1
        text = f"{value:.{digits}g}"
    return text


def _sentence(
    peaks: Mapping[str, float],
    vehicle: Vehicle,
    allowed: float | None,
    jumps: Sequence[float],
    problems: Sequence[str],
) -> str:
    """Return what the course needs beyond limits, or its peaks where it is within them.

    Args:
        peaks: by the names of `Feasibility`.
        vehicle: its rotor limits are named.
        allowed: the narrowest bound on roll or pitch [deg]; None without one.
        jumps: times of its jumps [s].
        problems: what it needs beyond limits.
    """
    if problems:
        return f"The course needs {problems[0]}{_further(len(problems) - 1)}."
    subject = "The course requires"
    if jumps:
        times = ", ".join(f"{time:g}" for time in jumps[:4])
        if len(jumps) > 4:
            times += ", ..."
        subject = f"The course steps (at {times} s); the rest requires"
    bound = ""
    if allowed is not None:
        bound = f" (bound {allowed:.4g} deg)"
    yaw = ""
    if peaks["yaw"] > 0.5:
        yaw = f", a yaw of {round(peaks['yaw'], 1):g} deg"
    return (
        f"{subject} up to {round(peaks['tilt'], 2):g} deg of tilt{bound}, "
        f"{round(peaks['velocity'], 2):g} m/s{yaw}, "
        f"and rotor speeds of {peaks['rotor_min']:.4g} to {peaks['rotor_max']:.4g} rad/s "
        f"(limits {vehicle.speed_min:.4g} and {vehicle.speed_max:.4g})."
    )


def _further(count: int) -> str:
    """Say how many limits are exceeded besides the one that is named."""
    if count == 0:
        return ""
    if count == 1:
        return "; another limit is exceeded, too"
    number = str(count)
    place = count - 2  # of the word for it
    if place < len(_NUMERALS):
        number = _NUMERALS[place]
    return f"; {number} other limits are exceeded, too"
