"""Cascaded PID, as autopilots fly it: one loop in the other, position P, velocity PID, attitude P, rate PID, mixer.

The structure is PX4's (PositionControl, AttitudeControl, RateControl); ArduPilot's differs in names.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Final, Literal

import numpy as np
from annotated_types import doc

from mpc.allocation import allocate, make_allocation
from mpc.answer import ActuatorBounds
from mpc.baselines.attitude import LEAST_LIFT, Measured, attitude_for, limit_force, motion_of, prioritised_error
from mpc.baselines.bandwidths import Bandwidths, bandwidths, lag_to_allow_for
from mpc.baselines.law import FeedbackLaw, Tuned
from mpc.baselines.preview import Target, target_of
from mpc.handover import within
from mpc.obstacles import Shape
from quadsim.controller import Command, Controller, Phase, StepInputs
from quadsim.fields import Positive
from quadsim.state import Array
from quadsim.vehicle import Vehicle

HORIZONTAL_MARGIN: Final = 0.3  # share of the largest thrust that climbing leaves to the sides: PX4's MPC_THR_XY_MARG
LARGEST_THRUST: Final = 0.85
"""Share of all rotors' highest thrust that is demanded: PX4's mixer takes back up to 15 % of it for yaw."""


@dataclass(frozen=True, kw_only=True)
class PIDSettings:
    """What a cascade is made from; `pid_settings` derives it from a vehicle and a period."""

    period: float  # tau_s [s]
    bandwidths: Bandwidths  # proportional gains of the loops [1/s]
    velocity_integral: float = 0.4  # integral over proportional gain of the velocity loop [1/s]; 0 for none
    rate_integral: float = 0.5  # the same of the rate loop [1/s]
    velocity_derivative: float = 0.1  # share of the measured acceleration that is taken back
    rate_derivative: float = 0.05  # share of the measured angular acceleration; late by a period, less than 1
    yaw_weight: float = 0.4  # share of the heading error corrected while turning the thrust; PX4's MC_YAW_WEIGHT
    tilt_max: float = 45.0  # largest tilt commanded [deg]; PX4's MPC_TILTMAX_AIR
    velocity_max: float = 12.0  # largest commanded, horizontal and vertical [m/s]; PX4's MPC_XY_VEL_MAX
    rate_max: tuple[float, float, float] = (220.0, 220.0, 200.0)  # body rates commanded [deg/s]; PX4's MC_ROLLRATE_MAX
    horizon: int = 10  # N, samples of preview; they give the reference's velocity and acceleration
    bounds: ActuatorBounds | None = None  # what commands are held to; None for the speeds that the rotors hold


def pid_settings(vehicle: Vehicle, *, period: float, lag: float | None = None, **others: object) -> PIDSettings:
    """Settings whose gains follow from the period and the lag to allow for [s]; `others` are fields of theirs."""
    allowed = lag_to_allow_for(vehicle, period) if lag is None else lag
    speeds = bandwidths(period=period, lag=allowed)
    values: dict[str, object] = {
        "velocity_integral": 0.25 * speeds.position,
        "rate_integral": 0.5 * speeds.position,
        **others,
    }
    return PIDSettings(period=period, bandwidths=speeds, **values)  # type: ignore[arg-type]


@dataclass(frozen=True, kw_only=True)
class Memory:
    """What the loops remember from one period to the next."""

    velocity_integral: Array  # (3,) world [m/s^2]
    rate_integral: Array  # (3,) body [rad/s^2]
    velocity: Array | None = None  # (3,) measured before, world [m/s]; None in the first period
    rates: Array | None = None  # (3,) measured before, body [rad/s]; None in the first period


class CascadedPID(FeedbackLaw):
    """Position P, velocity PID, attitude P by quaternions, rate PID, mixer, all normalised by mass and inertia."""

    name: Final = "pid"

    def __init__(self, vehicle: Vehicle, settings: PIDSettings) -> None:
        self.settings, self._vehicle, self._inertia = settings, vehicle, np.array(vehicle.inertia)
        super().__init__(vehicle, settings.period, settings.horizon, settings.bounds)
        self.allocation = make_allocation(vehicle)
        highest = float(self.bounds.u_max.min())
        self._largest = LARGEST_THRUST * 4.0 * vehicle.thrust_coefficient * highest**2  # thrust to command [N]

    def reset(self, speeds: Array) -> None:
        """Restart after the command u(-1) (4,) [rad/s]."""
        super().reset(speeds)
        self._memory = Memory(velocity_integral=np.zeros(3), rate_integral=np.zeros(3))

    def adopt(self, previous: object) -> None:
        """Go on from the integrals of the PID before."""
        law = within(previous, CascadedPID)
        if law is not None:
            self._memory = law._memory

    def _command(self, now: StepInputs, state: Array, reference: Array, before: Array) -> Command:
        """One period of all loops, integrals at rest until the vehicle flies."""
        target, reach = target_of(reference, self._operator), self.bounds.reach(before)
        speeds, after = self.fly(self._memory, state, target, *reach)
        if now.phase is not Phase.FLYING:
            memory = self._memory
            after = replace(after, velocity_integral=memory.velocity_integral, rate_integral=memory.rate_integral)
        self._memory = after
        return self._held_for_a_period(speeds)

    def fly(self, memory: Memory, state: Array, target: Target, lower: Array, upper: Array) -> tuple[Array, Memory]:
        """One period of all loops, from a state (12,) and speeds (4,) within reach [rad/s].

        Returns:
            (4,) rotor speeds [rad/s], and what to remember.
        """
        motion, k, inertia, period = motion_of(state), self.settings.bandwidths, self._inertia, self.settings.period
        force, velocity_integral = self._velocity_loop(memory, motion, target)
        turning = np.zeros(3) if memory.rates is None else (motion.rates - memory.rates) / period
        error = self._desired_rates(motion, force, target) - motion.rates
        proportional = np.array([k.rate, k.rate, k.yaw_rate])
        acceleration = proportional * error + memory.rate_integral - self.settings.rate_derivative * turning
        wrench = np.concatenate([[np.linalg.norm(force)], inertia * acceleration])
        speeds = allocate(self.allocation, wrench, lower, upper)
        # What the mixer could not give stops an integral from asking for more of it.
        missed = acceleration - (self.allocation.M @ np.square(speeds))[1:] / inertia
        windup = missed * error > 1e-9 * (1.0 + np.abs(acceleration)) * np.abs(error)
        summed = np.where(windup, 0.0, error)
        return speeds, Memory(
            velocity_integral=velocity_integral,
            rate_integral=memory.rate_integral + period * self.settings.rate_integral * proportional * summed,
            velocity=motion.velocity,
            rates=motion.rates,
        )

    def _velocity_loop(self, memory: Memory, motion: Measured, target: Target) -> tuple[Array, Array]:
        """The force (3,) to command [N], world, and the velocity integral (3,) [m/s^2] of the next period."""
        settings, mass, gravity = self.settings, self._vehicle.mass, self._vehicle.gravity
        period, proportional = settings.period, settings.bandwidths.velocity
        error = desired_velocity(settings, motion.position, target) - motion.velocity
        measured = np.zeros(3) if memory.velocity is None else (motion.velocity - memory.velocity) / period
        demanded_acceleration = (
            target.acceleration
            + proportional * error
            + memory.velocity_integral
            - settings.velocity_derivative * measured
            + np.array([0.0, 0.0, gravity])
        )
        tilt = math.radians(settings.tilt_max)
        force = force_within(mass * demanded_acceleration, weight=mass * gravity, largest=self._largest, tilt=tilt)
        # Tracking anti-windup: the integral is drawn to where it just saturates; PX4's gain, after Rundqwist (1990).
        error = error - 2.0 / proportional * (demanded_acceleration - force / mass)
        integral = memory.velocity_integral + period * settings.velocity_integral * proportional * error
        return force, np.clip(integral, -gravity, gravity)

    def _desired_rates(self, motion: Measured, force: Array, target: Target) -> Array:
        """(3,) body rates to turn at [rad/s], by the attitude loop."""
        k, limit = self.settings.bandwidths, np.radians(self.settings.rate_max)
        error = prioritised_error(motion.attitude, attitude_for(force, target.yaw), self.settings.yaw_weight)
        heading = motion.attitude[2] * target.yaw_rate  # a turn about world z, seen from the body
        return np.clip(np.array([k.attitude, k.attitude, k.yaw]) * error + heading, -limit, limit)


def desired_velocity(settings: PIDSettings, position: Array, target: Target) -> Array:
    """(3,) velocity to fly at [m/s]: the target's, and a share of the position error per second, within limits."""
    velocity = target.velocity + settings.bandwidths.position * (target.position - position)
    horizontal = math.hypot(velocity[0], velocity[1])
    velocity[:2] *= min(1.0, settings.velocity_max / max(horizontal, 1e-9))
    velocity[2] = np.clip(velocity[2], -settings.velocity_max, settings.velocity_max)
    return velocity


def force_within(force: Array, *, weight: float, largest: float, tilt: float) -> Array:
    """A wanted force (3,) [N], world, as a vehicle can give it within a tilt [rad]: height before horizontal motion."""
    upright = limit_force(force, least=LEAST_LIFT * weight, tilt=tilt)
    horizontal = math.hypot(upright[0], upright[1])
    spared = min(horizontal, HORIZONTAL_MARGIN * largest)
    upward = min(upright[2], math.sqrt(largest**2 - spared**2))
    allowed = min(math.sqrt(largest**2 - upward**2), upward * math.tan(tilt))
    share = 1.0 if horizontal <= allowed else allowed / horizontal
    return np.array([share * upright[0], share * upright[1], upward])


@dataclass(frozen=True, kw_only=True)
class PID(Tuned):
    """Cascaded PID as autopilots fly it."""

    type: Annotated[Literal["pid"], doc("the control law, by its name in `quadsim list`")] = "pid"
    velocity: Annotated[Positive, doc("[m/s] largest velocity commanded")] = 12.0

    def build(self, vehicle: Vehicle, period: float, shapes: Sequence[Shape] = ()) -> Controller:
        """See `mpc.bounded.ControllerTable.build`."""
        shared = self.shared(vehicle, period)
        return CascadedPID(vehicle, pid_settings(vehicle, lag=self.lag, velocity_max=self.velocity, **shared))
