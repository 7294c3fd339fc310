"""Geometric tracking control on SE(3): Lee, Leok, McClamroch (2010), integrals by Goodarzi, Lee, Lee (2013)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from mpc.answer import ActuatorBounds
from mpc.baselines.allocation import allocate, make_allocation
from mpc.baselines.attitude import (
    LEAST_LIFT,
    Motion,
    attitude_error,
    limit_force,
    motion_of,
    rate_error,
    unit_derivatives,
    vee,
)
from mpc.baselines.bandwidths import SEPARATION, YAW_SHARE, lag_to_allow_for
from mpc.baselines.law import FeedbackLaw
from mpc.baselines.limits import require_positive, require_within
from mpc.baselines.preview import Target, target_of, wrapped
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
    """Settings whose gains follow from the period and the lag to allow for [s]; `others` are fields of theirs.

    Since the law feeds forward how the wanted attitude turns, its linearisation has the polynomial
    (s^2 + k_Omega s + k_R)(s^2 + k_v s + k_x), and about k_Omega + k_v for the gain from a rate error to angular
    acceleration: that sum is 1 / (2 (period / 2 + lag)), as in `bandwidths`.  The outer pair is four times slower than
    the inner one (the cascade's separation of 2, twice), and both have the damping 1 / sqrt(2): k_R = k_Omega^2 / 2.
    The integrals of Goodarzi et al. (2013) are, where they act, a quarter as fast as what they stand behind.
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


@dataclass(frozen=True, kw_only=True)
class Integrals:
    """The integral terms, within +-sigma: an acceleration, world, and an angular one, body; (3,) each."""

    translation: Array
    rotation: Array


@dataclass(frozen=True, kw_only=True)
class Wanted:
    """The computed attitude R_c (3, 3), Omega_c (3,) [rad/s] and its derivative (3,) [rad/s^2], in its own axes."""

    attitude: Array
    rates: Array
    acceleration: Array


class GeometricController(FeedbackLaw):
    """Thrust along the body axis and a moment from errors on SE(3).

    Attributes:
        k_R: (3,) gains of the attitude error about body x, y, z [1/s^2].
        k_Omega: (3,) gains of the rate error [1/s].
    """

    name: Final = "geometric"

    def __init__(self, vehicle: Vehicle, settings: GeometricSettings) -> None:
        super().__init__(vehicle, settings)
        self.settings, self._vehicle = settings, vehicle
        self.k_R = settings.k_R * np.array([1.0, 1.0, settings.yaw_share**2])
        self.k_Omega = settings.k_Omega * np.array([1.0, 1.0, settings.yaw_share])
        self._allocation = make_allocation(vehicle)

    def reset(self, speeds: Array) -> None:
        """Start anew after the command u(-1) (4,) [rad/s]."""
        super().reset(speeds)
        self._integrals = Integrals(translation=np.zeros(3), rotation=np.zeros(3))

    def _command(self, now: Moment, state: Array, reference: Array, before: Array) -> Command:
        """The law's wrench as rotor speeds; the integrals rest while bounds keep it from being given."""
        motion, target = motion_of(state), target_of(reference, self._operator)
        wrench, wanted = self.wrench(motion, target, self._integrals)
        lower, upper = self.bounds.reach(before)
        speeds = allocate(self._allocation, wrench, lower, upper)
        given = np.allclose(self._allocation.M @ speeds**2, wrench, rtol=0.0, atol=1e-6 * self._allocation.scale.max())
        if given and now.phase is Phase.FLYING:
            self._integrals = self.integrate(self._integrals, motion, target, wanted)
        return self._held_for_a_period(speeds)

    def wrench(self, motion: Motion, target: Target, integrals: Integrals) -> tuple[Array, Wanted]:
        """[f, M_x, M_y, M_z] (4,) [N, N m], and the attitude that the moment turns to.

        f = A . R e_3 with A = m (-k_x e_x - k_v e_v + g e_3 + x_d'') less the integral, and
        M = -J (k_R e_R + k_Omega e_Omega) + Omega x J Omega - J (hat(Omega) R' R_c Omega_c - R' R_c Omega_c').

        Where the limits of tilt or of lift hold A, the attitude that it asks for counts as one at rest.
        """
        settings, m, gravity = self.settings, self._vehicle.mass, self._vehicle.gravity
        J, R, Omega = np.array(self._vehicle.inertia), motion.attitude, motion.rates
        e_x, e_v = motion.position - target.position, motion.velocity - target.velocity
        weight = np.array([0.0, 0.0, gravity])
        asked = m * (-settings.k_x * e_x - settings.k_v * e_v - integrals.translation + weight + target.acceleration)
        A = limit_force(asked, least=LEAST_LIFT * m * gravity, tilt=math.radians(settings.tilt_max))
        at_rest = np.zeros(3), np.zeros(3)
        A1, A2 = self._force_derivatives(motion, target, A, e_v) if np.array_equal(A, asked) else at_rest
        wanted = _wanted(A, A1, A2, motion.yaw, target)
        R_rel = R.T @ wanted.attitude
        e_R, e_Omega = attitude_error(R, wanted.attitude), rate_error(R, Omega, wanted.attitude, wanted.rates)
        ahead = np.cross(Omega, R_rel @ wanted.rates) - R_rel @ wanted.acceleration
        moment = np.cross(Omega, J * Omega) - J * (self.k_R * e_R + self.k_Omega * e_Omega + integrals.rotation + ahead)
        return np.concatenate([[A @ R[:, 2]], moment]), wanted

    def integrate(self, integrals: Integrals, motion: Motion, target: Target, wanted: Wanted) -> Integrals:
        """The integrals one period on: of e_v + c_1 e_x and of e_Omega + c_2 e_R, saturated."""
        settings = self.settings
        e_x, e_v = motion.position - target.position, motion.velocity - target.velocity
        e_R = attitude_error(motion.attitude, wanted.attitude)
        e_Omega = rate_error(motion.attitude, motion.rates, wanted.attitude, wanted.rates)
        translation = integrals.translation + settings.period * settings.k_i * (e_v + settings.c_1 * e_x)
        rotation = integrals.rotation + settings.period * settings.k_I * (e_Omega + settings.c_2 * e_R)
        return Integrals(
            translation=np.clip(translation, -settings.sigma, settings.sigma),
            rotation=np.clip(rotation, -settings.sigma_R, settings.sigma_R),
        )

    def _force_derivatives(self, motion: Motion, target: Target, A: Array, e_v: Array) -> tuple[Array, Array]:
        """A' and A'' (3,), by the equations of motion under the law's own thrust; the target's jerk counts as zero."""
        m, R, Omega, k_x, k_v = self._vehicle.mass, motion.attitude, motion.rates, self.settings.k_x, self.settings.k_v
        up, up1 = R[:, 2], R @ np.array([Omega[1], -Omega[0], 0.0])  # R e_3 and its derivative, R hat(Omega) e_3
        f = max(float(A @ up), 0.0)
        e_a = f / m * up - np.array([0.0, 0.0, self._vehicle.gravity]) - target.acceleration
        A1 = -m * (k_x * e_v + k_v * e_a)
        f1 = float(A1 @ up + A @ up1)
        e_j = f1 / m * up + f / m * up1
        return A1, -m * (k_x * e_a + k_v * e_j)


def _wanted(A: Array, A1: Array, A2: Array, yaw: float, target: Target) -> Wanted:
    """R_c = [b_1c, b_2c, b_3c] with b_3c along A and b_1c as near to the heading as that leaves, and how it turns.

    e_R vanishes at half a turn, where it should be largest: a heading more than a quarter turn away is wanted a quarter
    turn away, and at rest.
    """
    turn = wrapped(target.yaw - yaw)
    near = abs(turn) <= 0.5 * math.pi
    heading = yaw + (turn if near else math.copysign(0.5 * math.pi, turn))
    rate, acceleration = (target.yaw_rate, target.yaw_acceleration) if near else (0.0, 0.0)
    along, across = (
        np.array([math.cos(heading), math.sin(heading), 0.0]),
        np.array([-math.sin(heading), math.cos(heading), 0.0]),
    )
    h, h1, h2 = along, rate * across, acceleration * across - rate**2 * along
    b3, b31, b32 = unit_derivatives(A, A1, A2)
    b2, b21, b22 = unit_derivatives(
        np.cross(b3, h),
        np.cross(b31, h) + np.cross(b3, h1),
        np.cross(b32, h) + 2.0 * np.cross(b31, h1) + np.cross(b3, h2),
    )
    b1 = np.cross(b2, b3)
    b11 = np.cross(b21, b3) + np.cross(b2, b31)
    b12 = np.cross(b22, b3) + 2.0 * np.cross(b21, b31) + np.cross(b2, b32)
    R_c = np.stack([b1, b2, b3], axis=1)
    Omega_c = vee(R_c.T @ np.stack([b11, b21, b31], axis=1))
    acceleration_c = vee(R_c.T @ np.stack([b12, b22, b32], axis=1))  # of hat(Omega_c)^2 + hat(Omega_c'), skew
    return Wanted(attitude=R_c, rates=Omega_c, acceleration=acceleration_c)
