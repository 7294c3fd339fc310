"""Cascaded PID, as autopilots fly it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from mpc.answer import ActuatorBounds
from mpc.baselines.allocation import make_allocation
from mpc.baselines.bandwidths import Bandwidths, bandwidths, lag_to_allow_for
from mpc.baselines.cascade import Gains, fly_cascade, fresh_memory, make_body
from mpc.baselines.law import FeedbackLaw
from mpc.baselines.limits import require_positive, require_within
from mpc.baselines.preview import target_of
from quadsim.controller import Command, Moment, Phase
from quadsim.state import Array
from quadsim.vehicle import Vehicle


@dataclass(frozen=True, kw_only=True)
class PIDSettings:
    """What a cascade is made from; `pid_settings` derives it from a vehicle and a period.

    Attributes:
        period: tau_s [s].
        bandwidths: proportional gains of the loops [1/s].
        velocity_integral: integral over proportional gain of the velocity loop [1/s]; 0 for none.
        rate_integral: the same of the rate loop [1/s].
        velocity_derivative: share of the measured acceleration that is taken back.
        rate_derivative: share of the measured angular acceleration that is taken back; late by a period, less than 1.
        yaw_weight: share of the heading error asked for while turning the thrust; PX4's MC_YAW_WEIGHT.
        tilt_max: largest tilt commanded [deg]; PX4's MPC_TILTMAX_AIR.
        velocity_max: largest velocity commanded, horizontal and vertical [m/s]; PX4's MPC_XY_VEL_MAX.
        rate_max: largest body rates commanded, roll, pitch, yaw [deg/s]; PX4's MC_ROLLRATE_MAX and so on.
        horizon: N, samples of preview; they tell the reference's velocity and acceleration.
        bounds: what commands are held to; None for the speeds that the rotors hold.
    """

    period: float
    bandwidths: Bandwidths
    velocity_integral: float = 0.4
    rate_integral: float = 0.5
    velocity_derivative: float = 0.1
    rate_derivative: float = 0.05
    yaw_weight: float = 0.4
    tilt_max: float = 45.0
    velocity_max: float = 12.0
    rate_max: tuple[float, float, float] = (220.0, 220.0, 200.0)
    horizon: int = 10
    bounds: ActuatorBounds | None = None

    def __post_init__(self) -> None:
        require_positive("period", self.period)
        require_positive("velocity_max", self.velocity_max)
        for name in ("velocity_integral", "rate_integral"):
            require_within(name, getattr(self, name), 0.0, 1.0 / self.period)
        for name in ("velocity_derivative", "rate_derivative"):
            require_within(name, getattr(self, name), 0.0, 0.9)
        require_within("yaw_weight", self.yaw_weight, 0.05, 1.0)
        require_within("tilt_max", self.tilt_max, 0.1, 80.0)
        for rate in self.rate_max:
            require_positive("rate_max", rate)


def pid_settings(vehicle: Vehicle, *, period: float, lag: float | None = None, **others: object) -> PIDSettings:
    """Settings whose gains follow from the period, and the lag [s] to allow for; see `bandwidths`.

    Args:
        vehicle: the modelled vehicle.
        period: tau_s [s].
        lag: of rotors and computation; `lag_to_allow_for` where absent.
        others: fields of `PIDSettings`.
    """
    allowed = lag_to_allow_for(vehicle, period) if lag is None else lag
    speeds = bandwidths(period=period, lag=allowed)
    values: dict[str, object] = {
        "velocity_integral": 0.25 * speeds.position,
        "rate_integral": 0.5 * speeds.position,
        **others,
    }
    return PIDSettings(period=period, bandwidths=speeds, **values)  # type: ignore[arg-type]


class CascadedPID(FeedbackLaw):
    """Position P, velocity PID, attitude P by quaternions, rate PID, mixer; see `mpc.baselines.cascade`.

    Args:
        vehicle: the modelled vehicle.
        settings: see there.
    """

    name: Final = "pid"

    def __init__(self, vehicle: Vehicle, settings: PIDSettings) -> None:
        super().__init__(vehicle, settings)
        self.settings = settings
        self.gains = Gains(
            bandwidths=settings.bandwidths,
            velocity_integral=settings.velocity_integral,
            rate_integral=settings.rate_integral,
            velocity_derivative=settings.velocity_derivative,
            rate_derivative=settings.rate_derivative,
            yaw_weight=settings.yaw_weight,
            tilt_max=math.radians(settings.tilt_max),
            velocity_max=settings.velocity_max,
            rate_max=tuple(np.radians(settings.rate_max).tolist()),
        )
        self.body = make_body(vehicle, make_allocation(vehicle), float(self.bounds.u_max.min()))

    def reset(self, speeds: Array) -> None:
        """Start anew after the command u(-1) (4,) [rad/s]."""
        super().reset(speeds)
        self._memory = fresh_memory()

    def _command(self, now: Moment, state: Array, reference: Array, before: Array) -> Command:
        """One period of all loops, integrals at rest until the vehicle flies."""
        lower, upper = self.bounds.reach(before)
        speeds, self._memory = fly_cascade(
            self.gains,
            self.body,
            self._memory,
            state,
            target_of(reference, self._operator),
            lower=lower,
            upper=upper,
            period=self.settings.period,
            integrate=now.phase is Phase.FLYING,
        )
        return self._held_for_a_period(speeds)
