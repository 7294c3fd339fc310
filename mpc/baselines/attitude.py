"""Attitudes as rotation matrices: the attitude for a force and a heading, its derivatives, and attitude errors."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from mpc.nonlinear.rigidbody import rotation
from quadsim.rotation import body_to_world, euler_to_body_rates
from quadsim.state import EULER, EULER_RATE, POSITION, VELOCITY, Array

LEAST_THRUST_SHARE: Final = 0.2
"""Least thrust as a share of the weight, so that torques keep their authority.  Our addition."""


@dataclass(frozen=True, kw_only=True)
class Measured:
    """A measured state with its attitude as a rotation matrix."""

    position: Array  # x (3,), world [m]
    velocity: Array  # v (3,), world [m/s]
    attitude: Array  # R (3, 3), body to world
    rates: Array  # Omega (3,), body [rad/s]
    yaw: float  # [rad]


def motion_of(state: Array, attitude: Array | None = None, rates: Array | None = None) -> Measured:
    """Return the motion of a state (12,), with the attitude (4,) wxyz and body rates (3,) [rad/s] if given."""
    euler = state[list(EULER)]
    return Measured(
        position=state[list(POSITION)],
        velocity=state[list(VELOCITY)],
        attitude=body_to_world(euler) if attitude is None else rotation(attitude),
        rates=euler_to_body_rates(euler, state[list(EULER_RATE)]) if rates is None else rates,
        yaw=float(euler[2]),
    )


def hat(vector: Array) -> Array:
    """The skew matrix (3, 3) of the cross product: `hat(a) @ b` is a x b."""
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def vee(matrix: Array) -> Array:
    """(3,) inverse of `hat`, applied to the skew part of a matrix (3, 3)."""
    skew = 0.5 * (matrix - matrix.T)
    return np.array([skew[2, 1], skew[0, 2], skew[1, 0]])


def limit_force(force: Array, *, least: float, tilt: float) -> Array:
    """Limit a force (3,) [N], world, to at least `least` [N] upwards and at most `tilt` [rad] from the vertical.

    The limit changes the vertical part only if it is too small; the horizontal part keeps its direction.
    """
    upward = max(float(force[2]), least)
    horizontal = math.hypot(force[0], force[1])
    allowed = upward * math.tan(tilt)
    share = 1.0 if horizontal <= allowed else allowed / horizontal
    return np.array([share * force[0], share * force[1], upward])


def attitude_for(force: Array, yaw: float) -> Array:
    """(3, 3) body to world with body z along `force` (3,), which points upward, and Euler yaw `yaw` [rad].

    Body x is y_C x z normalised, y_C = (-sin yaw, cos yaw, 0): PX4's construction.
    """
    z = force / np.linalg.norm(force)
    x = np.cross([-math.sin(yaw), math.cos(yaw), 0.0], z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)


def prioritised_error(attitude: Array, desired: Array, yaw_weight: float) -> Array:
    """Attitude error (3,) about the body axes [rad for small errors], heading reduced; attitudes (3, 3) body to world.

    2 sgn(q_0) times the vector part of the error quaternion q = q_tilt q_yaw: the shortest rotation of body z to its
    desired direction, then the remaining rotation about it, of which only the share `yaw_weight`, in (0, 1], is
    demanded.  Brescianini, Hehn, D'Andrea, "Nonlinear quadrocopter attitude control", ETH Zurich, 2013; PX4's
    AttitudeControl.  The yaw part is divided by the weight, so that small errors about all three axes have the same
    scale.
    """
    thrust = attitude.T @ desired[:, 2]  # desired direction of body z, in body axes
    cosine = float(np.clip(thrust[2], -1.0, 1.0))
    if cosine > -1.0 + 1e-9:
        w = math.sqrt(0.5 * (1.0 + cosine))
        x, y = -thrust[1] / (2.0 * w), thrust[0] / (2.0 * w)
        cross = hat(np.array([-thrust[1], thrust[0], 0.0]))
        tilting = np.eye(3) + cross + cross @ cross / (1.0 + cosine)
    else:  # upside down: all axes are equally short, so roll is chosen
        w, x, y = 0.0, 1.0, 0.0
        tilting = np.diag([1.0, -1.0, -1.0])
    tilted = attitude @ tilting
    turn = math.atan2(desired[:, 0] @ tilted[:, 1], desired[:, 0] @ tilted[:, 0])
    half = 0.5 * yaw_weight * turn
    c, s = math.cos(half), math.sin(half)
    return 2.0 * np.array([x * c + y * s, y * c - x * s, w * s / yaw_weight])


def quaternion_of(rotation: Array) -> Array:
    """(4,) unit quaternion q, wxyz, of a matrix (3, 3): the longest column of 4 q q'."""
    (a, b, c), (d, e, f), (g, h, i) = rotation
    outer = np.array(
        [
            [1.0 + a + e + i, h - f, c - g, d - b],
            [h - f, 1.0 + a - e - i, b + d, c + g],
            [c - g, b + d, 1.0 - a + e - i, f + h],
            [d - b, c + g, f + h, 1.0 - a - e + i],
        ]
    )
    column = outer[np.argmax(np.diag(outer))]
    return np.asarray(column / np.linalg.norm(column))


def attitude_error(attitude: Array, desired: Array) -> Array:
    """e_R = (R_d' R - R' R_d)^vee / 2 (3,).  Lee, Leok, McClamroch (2010)."""
    return vee(desired.T @ attitude)


def rate_error(attitude: Array, rates: Array, desired: Array, desired_rates: Array) -> Array:
    """e_Omega = Omega - R' R_d Omega_d (3,) [rad/s].  Lee, Leok, McClamroch (2010)."""
    return np.asarray(rates - attitude.T @ desired @ desired_rates)


def unit_derivatives(v: Array, v1: Array, v2: Array) -> tuple[Array, Array, Array]:
    """The direction v / |v| of v (3,) != 0 and its first two derivatives (3,), from those of v."""
    length = np.linalg.norm(v)
    u = v / length
    along = u @ v1
    u1 = (v1 - along * u) / length
    u2 = (v2 - (u1 @ v1 + u @ v2) * u - 2.0 * along * u1) / length
    return u, u1, u2


@dataclass(frozen=True, kw_only=True)
class DesiredAttitude:
    """The commanded attitude R_c (3, 3), Omega_c (3,) [rad/s] and its derivative (3,) [rad/s^2], in its own axes."""

    attitude: Array
    rates: Array
    acceleration: Array


def desired_attitude(force: Sequence[Array], momentum: Sequence[Array], drag: Array, heading: Array) -> DesiredAttitude:
    """R_c = [b_1c, b_2c, b_3c], with b_1c as close to the heading as the force allows.

    Rotors and drag together give `force`, f b_3c - R_c diag(d) R_c' p = A. Perpendicular to b_3c, b_1c . (A + d_x p) =
    0 and b_2c . (A + d_y p) = 0; along it, f = b_3c . (A + d_z p). Faessler et al.  (2018), Eqs.  (12) to (16), with
    body x rather than body y close to a given direction.  Without drag, b_3c lies along A.

    Args:
        force: A and its first two derivatives, (3,) each [N].
        momentum: p, mass times the velocity that causes drag, and its first two derivatives, (3,) each.
        drag: d (3,), body axes [1/s].
        heading: (3, 3) rows: the direction h and its first two derivatives.
    """
    h, h1, h2 = heading
    beta = unit_derivatives(*_with_drag(force, momentum, drag[1]))
    b2, b21, b22 = unit_derivatives(*_cross(beta, (h, h1, h2)))
    if drag[0] == drag[1]:
        b3, b31, b32 = beta
        b1, b11, b12 = _cross((b2, b21, b22), beta)
    else:
        alpha = unit_derivatives(*_with_drag(force, momentum, drag[0]))
        b1, b11, b12 = unit_derivatives(*_cross((b2, b21, b22), alpha))
        b3, b31, b32 = _cross((b1, b11, b12), (b2, b21, b22))
    R_c = np.stack([b1, b2, b3], axis=1)
    Omega_c = vee(R_c.T @ np.stack([b11, b21, b31], axis=1))
    acceleration_c = vee(R_c.T @ np.stack([b12, b22, b32], axis=1))  # of hat(Omega_c)^2 + hat(Omega_c'), skew
    return DesiredAttitude(attitude=R_c, rates=Omega_c, acceleration=acceleration_c)


def _with_drag(force: Sequence[Array], momentum: Sequence[Array], drag: float) -> Sequence[Array]:
    return force if drag == 0.0 else [A + drag * p for A, p in zip(force, momentum, strict=True)]


def _cross(a: Sequence[Array], b: Sequence[Array]) -> tuple[Array, Array, Array]:
    """The cross product of two vectors and its first two derivatives, from those of the vectors."""
    (a0, a1, a2), (b0, b1, b2) = a, b
    first = np.cross(a1, b0) + np.cross(a0, b1)
    return np.cross(a0, b0), first, np.cross(a2, b0) + 2.0 * np.cross(a1, b1) + np.cross(a0, b2)
