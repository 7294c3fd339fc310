"""A reference's velocity and acceleration now, from its next samples."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from quadsim.errors import ParameterError
from quadsim.state import Array, read_only

SMALLEST_PREVIEW: Final = 3  # samples that a parabola needs


@dataclass(frozen=True, kw_only=True)
class Target:
    """What a baseline is to follow at t_k, world frame."""

    position: Array  # (3,) [m]
    velocity: Array  # (3,) [m/s]
    acceleration: Array  # (3,) [m/s^2]
    yaw: float  # [rad]
    yaw_rate: float  # [rad/s]
    yaw_acceleration: float  # [rad/s^2]


def differentiator(samples: int, period: float) -> Array:
    """(3, N): value, first and second derivative at t_k of samples at t_{k+1} .. t_{k+N}.

    Those of the least-squares parabola through the samples (Savitzky and Golay, 1964), which N = 3 makes the ordinary
    differences.  Where the reference's velocity jumps, as a filtered step's does, the second derivative is a smooth
    hump of the jump's area over the N samples, not a spike.

    Raises:
        ParameterError: there are too few samples, or the period is not positive.
    """
    if samples < SMALLEST_PREVIEW:
        raise ParameterError("controller", "horizon", samples, f"at least {SMALLEST_PREVIEW}, to tell an acceleration")
    if not 0.0 < period < math.inf:
        raise ParameterError("controller", "period", period, "positive and finite")
    t = period * np.arange(1, samples + 1)
    fit = np.linalg.pinv(np.vander(t, 3, increasing=True))
    return read_only(fit * np.array([[1.0], [1.0], [2.0]]))


def target_of(reference: Array, operator: Array) -> Target:
    """What to follow, from the preview (N, 4) of x, y, z [m], yaw [rad] and its `differentiator` (3, N)."""
    value, rate, acceleration = operator @ reference
    return Target(
        position=value[:3],
        velocity=rate[:3],
        acceleration=acceleration[:3],
        yaw=float(value[3]),
        yaw_rate=float(rate[3]),
        yaw_acceleration=float(acceleration[3]),
    )


def wrapped(angle: float) -> float:
    """The same heading as an angle in [-pi, pi) [rad]."""
    return (angle + math.pi) % (2.0 * math.pi) - math.pi
