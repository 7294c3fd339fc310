"""The loops of a multirotor autopilot, one in the other: position P, velocity PID, attitude P, rate PID, mixer.

The structure is PX4's (PositionControl, AttitudeControl, RateControl); ArduPilot's differs in names.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from mpc.baselines.allocation import Allocation, allocate, wrench_of
from mpc.baselines.attitude import attitude_for, limit_force, prioritised_error
from mpc.baselines.bandwidths import Bandwidths
from mpc.baselines.preview import Target
from quadsim.state import (
    EULER,
    EULER_RATE,
    POSITION,
    VELOCITY,
    Array,
    body_to_world,
    euler_to_body_rates,
)
from quadsim.vehicle import Vehicle

HORIZONTAL_MARGIN: Final = 0.3
"""Share of the largest thrust that climbing leaves to horizontal acceleration: PX4's MPC_THR_XY_MARG."""
LARGEST_THRUST: Final = 0.85
"""Share of all rotors' highest thrust that is asked for: PX4's mixer takes back up to 15 % of it for yaw."""
LEAST_LIFT: Final = 0.2
"""Share of the weight below which thrust is not asked to fall, so that torques keep their authority.  Ours."""


@dataclass(frozen=True, kw_only=True)
class Gains:
    """Gains and limits of the loops; all loops are normalised by mass and inertia."""

    bandwidths: Bandwidths  # proportional gains [1/s]
    velocity_integral: float  # integral gain of the velocity loop over its proportional gain [1/s]
    rate_integral: float  # the same of the rate loop [1/s]
    velocity_derivative: float  # share of the measured acceleration that the velocity loop takes back
    rate_derivative: float  # share of the measured angular acceleration that the rate loop takes back
    # share of the heading error that a thrust direction to be reached leaves; see `prioritised_error`
    yaw_weight: float
    tilt_max: float  # largest tilt commanded [rad]
    velocity_max: float  # largest velocity commanded, horizontal and vertical [m/s]
    rate_max: tuple[float, float, float]  # largest body rates commanded, roll, pitch, yaw [rad/s]


@dataclass(frozen=True, kw_only=True)
class Memory:
    """What the loops remember from one period to the next."""

    velocity_integral: Array  # (3,) world [m/s^2]
    rate_integral: Array  # (3,) body [rad/s^2]
    velocity: Array | None = None  # (3,) measured before, world [m/s]; None in the first period
    rates: Array | None = None  # (3,) measured before, body [rad/s]; None in the first period


def fresh_memory() -> Memory:
    """The memory before the first period."""
    return Memory(velocity_integral=np.zeros(3), rate_integral=np.zeros(3))


def velocity_wanted(gains: Gains, position: Array, target: Target) -> Array:
    """(3,) velocity to fly at [m/s]: the target's, and a share of the position error per second, within limits."""
    wanted = target.velocity + gains.bandwidths.position * (target.position - position)
    horizontal = math.hypot(wanted[0], wanted[1])
    wanted[:2] *= min(1.0, gains.velocity_max / max(horizontal, 1e-9))
    wanted[2] = np.clip(wanted[2], -gains.velocity_max, gains.velocity_max)
    return wanted


def force_within(force: Array, *, weight: float, largest: float, tilt: float) -> Array:
    """A wanted force (3,) [N], world, as a vehicle can give it, height before horizontal motion.

    Args:
        force: wanted.
        weight: m g [N].
        largest: thrust to command [N].
        tilt: largest tilt [rad].
    """
    upright = limit_force(force, least=LEAST_LIFT * weight, tilt=tilt)
    horizontal = math.hypot(upright[0], upright[1])
    spared = min(horizontal, HORIZONTAL_MARGIN * largest)
    upward = min(upright[2], math.sqrt(largest**2 - spared**2))
    allowed = min(math.sqrt(largest**2 - upward**2), upward * math.tan(tilt))
    share = 1.0 if horizontal <= allowed else allowed / horizontal
    return np.array([share * upright[0], share * upright[1], upward])


@dataclass(frozen=True, kw_only=True)
class Body:
    """What the loops know of the vehicle."""

    mass: float  # [kg]
    gravity: float  # [m/s^2]
    inertia: Array  # (3,) principal moments [kg m^2]
    thrust_max: float  # largest thrust to command [N]
    allocation: Allocation  # see there


def make_body(vehicle: Vehicle, allocation: Allocation, speed_max: float) -> Body:
    """The vehicle's numbers, with rotors that turn at `speed_max` [rad/s] at most."""
    return Body(
        mass=vehicle.mass,
        gravity=vehicle.gravity,
        inertia=np.array(vehicle.inertia),
        thrust_max=LARGEST_THRUST * 4.0 * vehicle.thrust_coefficient * speed_max**2,
        allocation=allocation,
    )


def fly_cascade(
    gains: Gains,
    body: Body,
    memory: Memory,
    state: Array,
    target: Target,
    *,
    lower: Array,
    upper: Array,
    period: float,
    integrate: bool = True,
) -> tuple[Array, Memory]:
    """One period of all loops.

    Args:
        gains: see there.
        body: see there.
        memory: of the period before.
        state: (12,) measured.
        target: what to follow now.
        lower: (4,) lowest speeds within reach [rad/s].
        upper: (4,) highest speeds within reach [rad/s].
        period: tau_s [s].
        integrate: whether the integrals move; on the ground they had better not.

    Returns:
        (4,) rotor speeds [rad/s], and what to remember.
    """
    velocity, euler = state[list(VELOCITY)], state[list(EULER)]
    attitude, rates = body_to_world(euler), euler_to_body_rates(euler, state[list(EULER_RATE)])
    force, velocity_integral = _velocity_loop(gains, body, memory, state[list(POSITION)], velocity, target, period)
    rates_wanted = _attitude_loop(gains, attitude, force, target)
    k = gains.bandwidths
    turning = np.zeros(3) if memory.rates is None else (rates - memory.rates) / period
    error = rates_wanted - rates
    proportional = np.array([k.rate, k.rate, k.yaw_rate])
    acceleration = proportional * error + memory.rate_integral - gains.rate_derivative * turning
    wrench = np.concatenate([[np.linalg.norm(force)], body.inertia * acceleration])
    speeds = allocate(body.allocation, wrench, lower, upper)
    # What the mixer could not give stops an integral from asking for more of it.
    missed = acceleration - wrench_of(body.allocation, speeds)[1:] / body.inertia
    windup = missed * error > 1e-9 * (1.0 + np.abs(acceleration)) * np.abs(error)
    rate_integral = memory.rate_integral + period * gains.rate_integral * proportional * np.where(windup, 0.0, error)
    return speeds, Memory(
        velocity_integral=velocity_integral if integrate else memory.velocity_integral,
        rate_integral=rate_integral if integrate else memory.rate_integral,
        velocity=velocity,
        rates=rates,
    )


def _velocity_loop(
    gains: Gains, body: Body, memory: Memory, position: Array, velocity: Array, target: Target, period: float
) -> tuple[Array, Array]:
    """The force (3,) to command [N], world, and the velocity integral (3,) [m/s^2] of the next period."""
    proportional = gains.bandwidths.velocity
    error = velocity_wanted(gains, position, target) - velocity
    measured = np.zeros(3) if memory.velocity is None else (velocity - memory.velocity) / period
    wanted = (
        target.acceleration
        + proportional * error
        + memory.velocity_integral
        - gains.velocity_derivative * measured
        + np.array([0.0, 0.0, body.gravity])
    )
    weight = body.mass * body.gravity
    force = force_within(body.mass * wanted, weight=weight, largest=body.thrust_max, tilt=gains.tilt_max)
    # Tracking anti-windup: the integral is drawn to where it just saturates; PX4's gain, after Rundqwist (1990).
    error = error - 2.0 / proportional * (wanted - force / body.mass)
    integral = memory.velocity_integral + period * gains.velocity_integral * proportional * error
    return force, np.clip(integral, -body.gravity, body.gravity)


def _attitude_loop(gains: Gains, attitude: Array, force: Array, target: Target) -> Array:
    """(3,) body rates to turn at [rad/s]."""
    k = gains.bandwidths
    error = prioritised_error(attitude, attitude_for(force, target.yaw), gains.yaw_weight)
    heading = attitude[2] * target.yaw_rate  # a turn about world z, seen from the body
    limit = np.array(gains.rate_max)
    return np.clip(np.array([k.attitude, k.attitude, k.yaw]) * error + heading, -limit, limit)
