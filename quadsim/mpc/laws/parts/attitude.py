"""Attitudes as rotation matrices: the attitude for a force and a heading, and its error."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from quadsim.core.mirror import core_library
from quadsim.mpc.problem.rigidbody import rotation
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
    if attitude is None:
        matrix = body_to_world(euler)
    else:
        matrix = rotation(attitude)
    if rates is None:
        rates = euler_to_body_rates(euler, state[list(EULER_RATE)])
    return Measured(
        position=state[list(POSITION)],
        velocity=state[list(VELOCITY)],
        attitude=matrix,
        rates=rates,
        yaw=float(euler[2]),
    )


def hat(vector: Array) -> Array:
    """The skew matrix (3, 3) of the cross product: `hat(a) @ b` is a x b."""
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def limit_force(force: Array, *, least: float, tilt: float) -> Array:
    """Limit a force (3,) [N], world, to at least `least` [N] upwards and at most `tilt` [rad] from the vertical.

    The limit changes the vertical part only if it is too small; the horizontal part keeps its direction.
    """
    force = np.ascontiguousarray(force, np.float64)
    limited = np.empty(3)
    core_library().quadsim_geometric_limit(force.ctypes.data, least, math.tan(tilt), limited.ctypes.data)
    return limited


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
        x = -thrust[1] / (2.0 * w)
        y = thrust[0] / (2.0 * w)
        cross = hat(np.array([-thrust[1], thrust[0], 0.0]))
        tilting = np.eye(3) + cross + cross @ cross / (1.0 + cosine)
    else:  # upside down: all axes are equally short, so roll is chosen
        w = 0.0
        x = 1.0
        y = 0.0
        tilting = np.diag([1.0, -1.0, -1.0])
    tilted = attitude @ tilting
    turn = math.atan2(desired[:, 0] @ tilted[:, 1], desired[:, 0] @ tilted[:, 0])
    half = 0.5 * yaw_weight * turn
    c = math.cos(half)
    s = math.sin(half)
    return 2.0 * np.array([x * c + y * s, y * c - x * s, w * s / yaw_weight])
