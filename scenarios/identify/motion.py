"""Slopes of a log's motion over short windows, against which its columns are checked."""

from __future__ import annotations

import numpy as np

from quadsim.state import Array


def slope(values: Array, period: float, window: float) -> Array:
    """Rate of change (N, n) of values over a window [s] about each sample; the ends keep their neighbours'."""
    half = max(1, round(0.5 * window / period))
    rate = (values[2 * half :] - values[: -2 * half]) / (2 * half * period)
    return np.concatenate([np.repeat(rate[:1], half, axis=0), rate, np.repeat(rate[-1:], half, axis=0)])


def body_z(quaternion: Array) -> Array:
    """Thrust axis (N, 3) in the world of attitudes (N, 4), body to world."""
    w, x, y, z = quaternion.T
    return np.stack([2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)], axis=1)
