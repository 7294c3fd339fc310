"""Cascaded PID as autopilots fly it: position P, velocity PID, attitude P, rate PID, mixer.

The structure is PX4's (PositionControl, AttitudeControl, RateControl); ArduPilot's is the same by other names.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Final, Literal

import numpy as np
from annotated_types import doc

from quadsim.controller import Command, Phase, StepInputs
from quadsim.fields import Positive
from quadsim.mpc.laws import register
from quadsim.mpc.laws.parts.attitude import (
    LEAST_THRUST_SHARE,
    Measured,
    attitude_for,
    limit_force,
    motion_of,
    prioritised_error,
)
from quadsim.mpc.laws.parts.bandwidths import Bandwidths, bandwidths, lag_to_allow_for
from quadsim.mpc.laws.parts.feedback import FeedbackLaw, Tuned
from quadsim.mpc.laws.parts.preview import Target, target_of
from quadsim.mpc.pilot.allocation import allocate, make_allocation, thrust_to_command
from quadsim.mpc.space import Shape
from quadsim.state import Array
from quadsim.vehicle import Vehicle

HORIZONTAL_MARGIN: Final = 0.3  # share of the largest thrust that climbing leaves to the sides: PX4's MPC_THR_XY_MARG
LARGEST_THRUST: Final = 0.85
"""Share of the rotors' total thrust that is demanded at most, see `thrust_to_command`: PX4's mixer gives up to 15 % of
it to yaw."""


YAW_WEIGHT: Final = 0.4  # share of the heading error corrected while turning the thrust; PX4's MC_YAW_WEIGHT
LARGEST_BODY_RATES: Final = (220.0, 220.0, 200.0)  # body rates commanded [deg/s]; PX4's MC_ROLLRATE_MAX


@dataclass(frozen=True, kw_only=True)
class PIDGains:
    """Gains of a cascade; `pid_gains` derives them from a vehicle and a period."""

    bandwidths: Bandwidths  # proportional gains of the loops [1/s]
    velocity_integral: float  # integral over proportional gain of the velocity loop [1/s]; 0 for none
    rate_integral: float  # the same of the rate loop [1/s]
    velocity_derivative: float = 0.1  # gain on the measured acceleration
    rate_derivative: float = 0.05  # gain on the measured angular acceleration; late by a period, less than 1


def pid_gains(vehicle: Vehicle, *, period: float, lag: float | None = None) -> PIDGains:
    """Return gains that follow from the period and the lag [s], by default the vehicle's."""
    if lag is None:
        lag = lag_to_allow_for(vehicle, period)
    speeds = bandwidths(period=period, lag=lag)
    return PIDGains(bandwidths=speeds, velocity_integral=0.25 * speeds.position, rate_integral=0.5 * speeds.position)


@dataclass(frozen=True, kw_only=True)
class Memory:
    """The state of the loops between periods."""

    velocity_integral: Array  # (3,) world [m/s^2]
    rate_integral: Array  # (3,) body [rad/s^2]
    velocity: Array | None = None  # (3,) last measurement, world [m/s]; None in the first period
    rates: Array | None = None  # (3,) last measurement, body [rad/s]; None in the first period


class CascadedPID(FeedbackLaw):
    """Position P, velocity PID, attitude P by quaternions, rate PID, mixer, all normalised by mass and inertia.

    Attributes:
        gains: of the loops.
        allocation: the mixer.

    Examples:
        >>> import numpy as np
        >>> import quadsim
        >>> vehicle = quadsim.load_vehicle("lopes2011")
        >>> controller = quadsim.load("hover", {"controller": "pid"}).controller.law(vehicle, 0.05)
        >>> command = controller.step(quadsim.StepInputs(), np.zeros(12), np.zeros((controller.horizon, 4)))
        >>> bool(np.allclose(command.speeds, vehicle.hover_speeds))
        True
    """

    name: Final = "pid"

    def __init__(self, vehicle: Vehicle, period: float, settings: PID) -> None:
        self.gains = pid_gains(vehicle, period=period, lag=settings.lag)
        self._vehicle = vehicle
        if settings.moment:
            vehicle.require_moment("controller")
        self._largest_velocity = settings.velocity
        self._largest_tilt = math.radians(settings.tilt)
        self._moment = settings.moment
        super().__init__(vehicle, period, settings)
        self.allocation = make_allocation(vehicle)
        highest = vehicle.level_thrust(float(self.bounds.u_max.min()))
        self._largest = thrust_to_command(highest, vehicle.mass * vehicle.gravity, LARGEST_THRUST)

    def reset(self, speeds: Array) -> None:
        """Restart after the command u(-1) (4,) [rad/s]."""
        super().reset(speeds)
        self._memory = Memory(velocity_integral=np.zeros(3), rate_integral=np.zeros(3))

    def adopt(self, previous: object) -> None:
        """Take over the integrals of the previous PID."""
        if isinstance(previous, CascadedPID):
            self._memory = previous._memory

    def _command(self, now: StepInputs, state: Array, reference: Array, before: Array) -> Command:
        """Run all loops for one period; the integrals hold until the vehicle flies."""
        target = target_of(reference, self._operator)
        reach = self.bounds.reach(before)
        speeds, after = self.fly(self._memory, state, target, *reach)
        if now.phase is not Phase.FLYING:
            memory = self._memory
            after = replace(after, velocity_integral=memory.velocity_integral, rate_integral=memory.rate_integral)
        self._memory = after
        return self._held_for_a_period(speeds)

    def fly(self, memory: Memory, state: Array, target: Target, lower: Array, upper: Array) -> tuple[Array, Memory]:
        """Run all loops for one period, from a state (12,) and reachable speeds `lower` to `upper` (4,) [rad/s].

        Returns:
            (4,) rotor speeds [rad/s], and the loops' new state.
        """
        motion = motion_of(state)
        k = self.gains.bandwidths
        period = self._period
        force, velocity_integral = self._velocity_loop(memory, motion, target)
        if memory.rates is None:
            turning = np.zeros(3)
        else:
            turning = (motion.rates - memory.rates) / period
        desired = self._desired_rates(motion, force, target)
        error = desired - motion.rates
        proportional = np.array([k.rate, k.rate, k.yaw_rate])
        acceleration = proportional * error + memory.rate_integral - self.gains.rate_derivative * turning
        wrench = np.concatenate([[np.linalg.norm(force)], self._vehicle.momentum(acceleration)])
        by_air = self._air(motion, wrench[0], desired)
        wrench -= by_air
        speeds = allocate(self.allocation, wrench, lower, upper)
        # Anti-windup: an integral stops where it would ask for more than the mixer can give.
        achieved = self._vehicle.angular_acceleration(self.allocation.wrench(speeds)[1:] + by_air[1:])
        missed = acceleration - achieved
        windup = missed * error > 1e-9 * (1.0 + np.abs(acceleration)) * np.abs(error)
        summed = np.where(windup, 0.0, error)
        return speeds, Memory(
            velocity_integral=velocity_integral,
            rate_integral=memory.rate_integral + period * self.gains.rate_integral * proportional * summed,
            velocity=motion.velocity,
            rates=motion.rates,
        )

    def _air(self, motion: Measured, thrust: float, desired: Array) -> Array:
        """(4,) thrust and torque that the air adds [N, N m] at the measured velocity and desired rates (3,) [rad/s].

        The speeds are those of hover, times the root of the thrust [N] over the weight.
        """
        if not self._moment:
            return np.zeros(4)
        vehicle = self._vehicle
        velocity = motion.attitude.T @ motion.velocity
        speeds = vehicle.hover_speeds * math.sqrt(thrust / (vehicle.mass * vehicle.gravity))
        wrench = -vehicle.lost_to_inflow(speeds, velocity, desired)
        wrench[1:] += vehicle.air_moment(float(speeds.sum()), velocity, desired)
        return wrench

    def _velocity_loop(self, memory: Memory, motion: Measured, target: Target) -> tuple[Array, Array]:
        """Return the force (3,) [N] to command, world, and the velocity integral (3,) [m/s^2] of the next period."""
        gains = self.gains
        mass = self._vehicle.mass
        gravity = self._vehicle.gravity
        period = self._period
        proportional = gains.bandwidths.velocity
        desired = desired_velocity(gains.bandwidths.position, self._largest_velocity, motion.position, target)
        error = desired - motion.velocity
        if memory.velocity is None:
            measured = np.zeros(3)
        else:
            measured = (motion.velocity - memory.velocity) / period
        demanded_acceleration = (
            target.acceleration
            + proportional * error
            + memory.velocity_integral
            - gains.velocity_derivative * measured
            + np.array([0.0, 0.0, gravity])
        )
        demanded = mass * demanded_acceleration
        force = force_within(demanded, weight=mass * gravity, largest=self._largest, tilt=self._largest_tilt)
        # Anti-windup by tracking: the integral moves to where it just saturates; PX4's gain, after Rundqwist (1990).
        error = error - 2.0 / proportional * (demanded_acceleration - force / mass)
        integral = memory.velocity_integral + period * gains.velocity_integral * proportional * error
        return force, np.clip(integral, -gravity, gravity)

    def _desired_rates(self, motion: Measured, force: Array, target: Target) -> Array:
        """Return the body rates (3,) [rad/s] that the attitude loop demands."""
        k = self.gains.bandwidths
        limit = np.radians(LARGEST_BODY_RATES)
        error = prioritised_error(motion.attitude, attitude_for(force, target.yaw), YAW_WEIGHT)
        heading = motion.attitude[2] * target.yaw_rate  # a rotation about world z, in body axes
        return np.clip(np.array([k.attitude, k.attitude, k.yaw]) * error + heading, -limit, limit)


def desired_velocity(gain: float, largest: float, position: Array, target: Target) -> Array:
    """(3,) velocity to fly [m/s]: the target's, plus `gain` [1/s] times the position error, up to `largest` [m/s]."""
    velocity = target.velocity + gain * (target.position - position)
    horizontal = math.hypot(velocity[0], velocity[1])
    velocity[:2] *= min(1.0, largest / max(horizontal, 1e-9))
    velocity[2] = np.clip(velocity[2], -largest, largest)
    return velocity


def force_within(force: Array, *, weight: float, largest: float, tilt: float) -> Array:
    """Limit a demanded force (3,) [N], world, to a tilt [rad] and to the thrust: height before horizontal motion.

    What climbing leaves to the sides never takes more than half of the thrust above the weight.
    """
    upright = limit_force(force, least=LEAST_THRUST_SHARE * weight, tilt=tilt)
    horizontal = math.hypot(upright[0], upright[1])
    climbing = min(0.5 * (weight + largest), largest)
    spared = min(horizontal, HORIZONTAL_MARGIN * largest, math.sqrt(largest**2 - climbing**2))
    upward = min(upright[2], math.sqrt(largest**2 - spared**2))
    allowed = min(math.sqrt(largest**2 - upward**2), upward * math.tan(tilt))
    if horizontal <= allowed:
        share = 1.0
    else:
        share = allowed / horizontal
    return np.array([share * upright[0], share * upright[1], upward])


@register(
    title="PID",
    description="cascaded PID, as autopilots fly it",
    place=6,
)
@dataclass(frozen=True, kw_only=True)
class PID(Tuned):
    """Cascaded PID as autopilots fly it."""

    type: Annotated[Literal["pid"], doc("the controller, by its name in `quadsim list`")] = "pid"
    velocity: Annotated[Positive, doc("[m/s] largest velocity commanded")] = 12.0
    moment: Annotated[
        bool,
        doc(
            "whether thrust and torques balance the vehicle's rotor_moment, inflow_moment, rate_damping and inflow, in "
            "still air, at the measured velocity and the desired rates"
        ),
    ] = False

    def law(self, vehicle: Vehicle, period: float, shapes: Sequence[Shape] = ()) -> CascadedPID:
        """See `quadsim.mpc.tables.controller.ControllerTable.law`."""
        return CascadedPID(vehicle, period, self)
