"""Geometric tracking control on SE(3)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from mpc.answer import ActuatorBounds
from mpc.baselines.allocation import allocate, make_allocation
from mpc.baselines.bandwidths import SEPARATION, YAW_SHARE, lag_to_allow_for
from mpc.baselines.law import FeedbackLaw
from mpc.baselines.limits import require_positive, require_within
from mpc.baselines.preview import target_of
from mpc.baselines.tracking import Gains, Integrals, geometric_wrench, integrate, motion_of
from quadsim.controller import Command, Moment, Phase
from quadsim.errors import ParameterError
from quadsim.state import Array
from quadsim.vehicle import Vehicle


@dataclass(frozen=True, kw_only=True)
class GeometricSettings:
    """What a geometric controller is made from; `geometric_settings` derives it from a vehicle and a period.

    Attributes:
        period: tau_s [s].
        k_x: gain of the position error [1/s^2], k_x / m of Lee et al. (2010).
        k_v: gain of the velocity error [1/s], k_v / m there.
        k_R: gain of the roll and pitch error [1/s^2], J^-1 k_R there.
        k_Omega: gain of the roll and pitch rate error [1/s], J^-1 k_Omega there.
        yaw_share: how fast the heading is corrected over how fast roll and pitch are: its k_Omega has this factor, its
            k_R the square; reaction torques are weak.
        k_i: gain of the integral of e_v + c_1 e_x [1/s^2]; 0 for none, as in Lee et al. (2010).
        k_I: gain of the integral of e_Omega + c_2 e_R [1/s^2]; 0 for none.
        c_1: weight of the position error in the first integral [1/s].
        c_2: weight of the attitude error in the second [1/s].
        sigma: largest acceleration of the first integral, each axis [m/s^2].
        sigma_R: largest angular acceleration of the second, each axis [rad/s^2].
        tilt_max: largest tilt of the wanted force [deg]; Lee et al. (2010) know none.
        horizon: N, samples of preview; they tell the reference's velocity and acceleration.
        bounds: what commands are held to; None for the speeds that the rotors hold.
    """

    period: float
    k_x: float
    k_v: float
    k_R: float
    k_Omega: float
    yaw_share: float = YAW_SHARE
    k_i: float = 0.0
    k_I: float = 0.0
    c_1: float = 1.0
    c_2: float = 1.0
    sigma: float = 5.0
    sigma_R: float = 5.0
    tilt_max: float = 45.0
    horizon: int = 10
    bounds: ActuatorBounds | None = None

    def __post_init__(self) -> None:
        for name in ("period", "k_x", "k_v", "k_R", "k_Omega", "c_1", "c_2", "sigma", "sigma_R"):
            require_positive(name, getattr(self, name))
        for name in ("k_i", "k_I"):
            if not 0.0 <= getattr(self, name) < math.inf:
                raise ParameterError("controller", name, getattr(self, name), "at least 0 and finite")
        require_within("yaw_share", self.yaw_share, 0.05, 1.0)
        require_within("tilt_max", self.tilt_max, 0.1, 80.0)


def geometric_settings(
    vehicle: Vehicle, *, period: float, lag: float | None = None, integral: bool = False, **others: object
) -> GeometricSettings:
    """Settings whose gains follow from the period and the lag to allow for.

    Since the law feeds forward how the wanted attitude turns, its linearisation has the polynomial
    (s^2 + k_Omega s + k_R)(s^2 + k_v s + k_x), and about k_Omega + k_v for the gain from a rate error to angular
    acceleration: that sum is 1 / (2 (period / 2 + lag)), as in `bandwidths`.  The outer pair is four times slower than
    the inner one (the cascade's separation of 2, twice), and both have the damping 1 / sqrt(2): k_R = k_Omega^2 / 2.

    Args:
        vehicle: the modelled vehicle.
        period: tau_s [s].
        lag: of rotors and computation [s]; `lag_to_allow_for` where absent.
        integral: whether the integrals of Goodarzi et al. (2013) act, a quarter as fast as what they stand behind.
        others: fields of `GeometricSettings`.
    """
    require_positive("period", period)
    allowed = lag_to_allow_for(vehicle, period) if lag is None else lag
    k_Omega = 1.0 / (2.0 * (0.5 * period + allowed)) / (1.0 + SEPARATION**-2)
    k_v = k_Omega / SEPARATION**2
    values: dict[str, object] = {
        "k_x": k_v**2 / SEPARATION,
        "k_v": k_v,
        "k_R": k_Omega**2 / SEPARATION,
        "k_Omega": k_Omega,
        "c_1": k_v / SEPARATION,
        "c_2": k_Omega / SEPARATION,
        "k_i": 0.25 * k_v**2 / SEPARATION if integral else 0.0,
        "k_I": 0.05 * k_Omega**2 / SEPARATION if integral else 0.0,
        **others,
    }
    return GeometricSettings(period=period, **values)  # type: ignore[arg-type]


class GeometricController(FeedbackLaw):
    """Thrust along the body axis and a moment from errors on SE(3); see `mpc.baselines.tracking`.

    Args:
        vehicle: the modelled vehicle.
        settings: see there.
    """

    name: Final = "geometric"

    def __init__(self, vehicle: Vehicle, settings: GeometricSettings) -> None:
        super().__init__(vehicle, settings)
        self.settings = settings
        self.vehicle = vehicle
        self.gains = Gains(
            k_x=settings.k_x,
            k_v=settings.k_v,
            k_R=settings.k_R * np.array([1.0, 1.0, settings.yaw_share**2]),
            k_Omega=settings.k_Omega * np.array([1.0, 1.0, settings.yaw_share]),
            k_i=settings.k_i,
            k_I=settings.k_I,
            c_1=settings.c_1,
            c_2=settings.c_2,
            sigma=settings.sigma,
            sigma_R=settings.sigma_R,
            tilt_max=math.radians(settings.tilt_max),
        )
        self._allocation = make_allocation(vehicle)

    def reset(self, speeds: Array) -> None:
        """Start anew after the command u(-1) (4,) [rad/s]."""
        super().reset(speeds)
        self._integrals = Integrals(translation=np.zeros(3), rotation=np.zeros(3))

    def _command(self, now: Moment, state: Array, reference: Array, before: Array) -> Command:
        """The law's wrench as rotor speeds; the integrals rest while bounds keep it from being given."""
        motion, target = motion_of(state), target_of(reference, self._operator)
        wrench, wanted = geometric_wrench(self.gains, self.vehicle, motion, target, self._integrals)
        lower, upper = self.bounds.reach(before)
        speeds = allocate(self._allocation, wrench, lower, upper)
        given = np.allclose(self._allocation.M @ speeds**2, wrench, rtol=0.0, atol=1e-6 * self._allocation.scale.max())
        if given and now.phase is Phase.FLYING:
            self._integrals = integrate(self.gains, self._integrals, motion, target, wanted, self.settings.period)
        return self._held_for_a_period(speeds)
