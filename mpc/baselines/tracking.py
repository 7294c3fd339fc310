"""The control law of Lee, Leok, McClamroch (2010) with the integrals of Goodarzi, Lee, Lee (2013)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from mpc.baselines.attitude import attitude_error, limit_force, rate_error, unit_derivatives, vee
from mpc.baselines.preview import Target, wrapped
from quadsim.state import EULER, EULER_RATE, INDEX, POSITION, VELOCITY, Array, body_to_world, euler_to_body_rates
from quadsim.vehicle import Vehicle

LEAST_LIFT: Final = 0.2  # share of the weight below which the wanted force does not fall; ours


@dataclass(frozen=True, kw_only=True)
class Gains:
    """Gains per unit of mass and inertia: the papers' k_x is m k_x here, and their k_R is J k_R."""

    k_x: float  # of the position error [1/s^2]
    k_v: float  # of the velocity error [1/s]
    k_R: Array  # (3,) of the attitude error, about body x, y, z [1/s^2]
    k_Omega: Array  # (3,) of the rate error [1/s]
    k_i: float  # of the integral of e_v + c_1 e_x [1/s^2]; 0 for none
    k_I: float  # of the integral of e_Omega + c_2 e_R [1/s^2]; 0 for none
    c_1: float  # [1/s]
    c_2: float  # [1/s]
    sigma: float  # largest magnitude of the acceleration of the position integral, each axis [m/s^2]
    sigma_R: float  # the same of the angular acceleration [rad/s^2]
    tilt_max: float  # largest tilt of the wanted force [rad]


@dataclass(frozen=True, kw_only=True)
class Motion:
    """A measured state in the law's terms."""

    position: Array  # x (3,), world [m]
    velocity: Array  # v (3,), world [m/s]
    attitude: Array  # R (3, 3), body to world
    rates: Array  # Omega (3,), body [rad/s]
    yaw: float  # [rad]


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


def motion_of(state: Array) -> Motion:
    """A state (12,) in the law's terms."""
    euler = state[list(EULER)]
    return Motion(
        position=state[list(POSITION)],
        velocity=state[list(VELOCITY)],
        attitude=body_to_world(euler),
        rates=euler_to_body_rates(euler, state[list(EULER_RATE)]),
        yaw=float(state[INDEX["yaw"]]),
    )


def geometric_wrench(
    gains: Gains, vehicle: Vehicle, motion: Motion, target: Target, integrals: Integrals
) -> tuple[Array, Wanted]:
    """[f, M_x, M_y, M_z] (4,) [N, N m], and the attitude that the moment turns to.

    f = A . R e_3 with A = m (-k_x e_x - k_v e_v + g e_3 + x_d'') less the integral, and
    M = -J (k_R e_R + k_Omega e_Omega) + Omega x J Omega - J (hat(Omega) R' R_c Omega_c - R' R_c Omega_c').

    Where the limits of tilt or of lift hold A, the attitude that it asks for counts as one at rest.
    """
    m, J = vehicle.mass, np.array(vehicle.inertia)
    R, Omega = motion.attitude, motion.rates
    e_x, e_v = motion.position - target.position, motion.velocity - target.velocity
    weight = np.array([0.0, 0.0, vehicle.gravity])
    asked = m * (-gains.k_x * e_x - gains.k_v * e_v - integrals.translation + weight + target.acceleration)
    A = limit_force(asked, least=LEAST_LIFT * m * vehicle.gravity, tilt=gains.tilt_max)
    if np.array_equal(A, asked):
        A1, A2 = _force_derivatives(gains, vehicle, motion, target, A, e_v)
    else:
        A1 = A2 = np.zeros(3)
    wanted = _wanted(A, A1, A2, motion.yaw, target)
    R_rel = R.T @ wanted.attitude
    e_R, e_Omega = attitude_error(R, wanted.attitude), rate_error(R, Omega, wanted.attitude, wanted.rates)
    ahead = np.cross(Omega, R_rel @ wanted.rates) - R_rel @ wanted.acceleration
    moment = np.cross(Omega, J * Omega) - J * (gains.k_R * e_R + gains.k_Omega * e_Omega + integrals.rotation + ahead)
    return np.concatenate([[A @ R[:, 2]], moment]), wanted


def integrate(
    gains: Gains, integrals: Integrals, motion: Motion, target: Target, wanted: Wanted, period: float
) -> Integrals:
    """The integrals one period on: of e_v + c_1 e_x and of e_Omega + c_2 e_R, saturated."""
    e_x, e_v = motion.position - target.position, motion.velocity - target.velocity
    e_R = attitude_error(motion.attitude, wanted.attitude)
    e_Omega = rate_error(motion.attitude, motion.rates, wanted.attitude, wanted.rates)
    translation = integrals.translation + period * gains.k_i * (e_v + gains.c_1 * e_x)
    rotation = integrals.rotation + period * gains.k_I * (e_Omega + gains.c_2 * e_R)
    return Integrals(
        translation=np.clip(translation, -gains.sigma, gains.sigma),
        rotation=np.clip(rotation, -gains.sigma_R, gains.sigma_R),
    )


def _force_derivatives(
    gains: Gains, vehicle: Vehicle, motion: Motion, target: Target, A: Array, e_v: Array
) -> tuple[Array, Array]:
    """A' and A'' (3,), by the equations of motion under the law's own thrust; the target's jerk counts as zero."""
    m, R, Omega = vehicle.mass, motion.attitude, motion.rates
    up, up1 = R[:, 2], R @ np.array([Omega[1], -Omega[0], 0.0])  # R e_3 and its derivative, R hat(Omega) e_3
    f = max(float(A @ up), 0.0)
    e_a = f / m * up - np.array([0.0, 0.0, vehicle.gravity]) - target.acceleration
    A1 = -m * (gains.k_x * e_v + gains.k_v * e_a)
    f1 = float(A1 @ up + A @ up1)
    e_j = f1 / m * up + f / m * up1
    return A1, -m * (gains.k_x * e_a + gains.k_v * e_j)


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
