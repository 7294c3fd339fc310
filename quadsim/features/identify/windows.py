"""Rates of change and means of a log's motion over short windows, from which the checks compare its columns.

Over a window of 2 h steps of a period T about sample k, the rate of a signal y is (y_{k+h} - y_{k-h}) / (2 h T).
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import uniform_filter1d
from scipy.spatial.transform import Rotation

from quadsim.rotation import conjugate, multiply
from quadsim.state import Array


def half_window(period: float, window: float) -> int:
    """Samples on each side of the middle of a window [s], at least one."""
    return max(1, round(0.5 * window / period))


def rate_over_window(values: Array, period: float, window: float) -> Array:
    """Rate of change (N, n) over a window [s] about each sample; near the ends, that of the nearest whole window."""
    half = half_window(period, window)
    change = values[2 * half :] - values[: -2 * half]
    return _padded(change / (2 * half * period), half)


def mean_over_window(values: Array, period: float, window: float) -> Array:
    """Mean (N, n) over a window [s] about each sample, as `rate_over_window` of their integral; so at the ends."""
    half = half_window(period, window)
    steps = 0.5 * (values[1:] + values[:-1])
    inner = uniform_filter1d(steps, 2 * half, axis=0)  # of steps k - half .. k + half - 1
    return _padded(inner[half : len(inner) - half + 1], half)


def turn_rate(quaternion: Array, period: float, window: float) -> Array:
    """Body rates (N, 3) [rad/s] by which attitudes (N, 4) turn over a window [s] about each sample."""
    half = half_window(period, window)
    attitude = Rotation.from_quat(quaternion, scalar_first=True)
    turn = attitude[: -2 * half].inv() * attitude[2 * half :]
    return _padded(turn.as_rotvec() / (2 * half * period), half)


def body_z(quaternion: Array) -> Array:
    """Thrust axis (N, 3) in the world of attitudes (N, 4), body to world."""
    attitude = Rotation.from_quat(quaternion, scalar_first=True)
    return np.asarray(attitude.apply([0.0, 0.0, 1.0]))


def load_factor(acceleration: Array, quaternion: Array, gravity: float) -> Array:
    """Specific force (N,) along the thrust axis over gravity: 1 in hover; acceleration (N, 3) in the world [m/s^2]."""
    specific_force = acceleration + np.array([0.0, 0.0, gravity])
    along_thrust = (specific_force * body_z(quaternion)).sum(axis=1)
    return np.asarray(along_thrust / gravity)


def to_world(quaternion: Array, vectors: Array) -> Array:
    """Body vectors (N, 3) in the world."""
    pure = np.concatenate([np.zeros((len(vectors), 1)), vectors], axis=1)
    turned = multiply(multiply(quaternion, pure), conjugate(quaternion))
    return np.asarray(turned)[:, 1:]


def _padded(inner: Array, half: int) -> Array:
    return np.pad(inner, ((half, half), (0, 0)), mode="edge")
