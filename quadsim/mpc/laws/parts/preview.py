"""The derivatives of a reference now, from its next samples.

A polynomial is fitted to the samples by least squares; its value and derivatives now are linear in them, with
coefficients that are computed once (`differentiator`).  Baselines and the geometric controller take their target so.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Final

import numpy as np

from quadsim.errors import ParameterError
from quadsim.mpc.problem.rigidbody import zero
from quadsim.state import Array, read_only

SMALLEST_PREVIEW: Final = 3  # a parabola needs three samples
PREVIEW_DEGREE: Final = 4  # degree of the polynomial through a preview for jerk and snap
MOTION_DEGREE: Final = 5  # degree of the one through the next samples of a motion, which are exact
MOTION_SAMPLES: Final = 7


@dataclass(frozen=True, kw_only=True)
class Target:
    """The target of a baseline at t_k, world frame."""

    position: Array  # (3,) [m]
    velocity: Array  # (3,) [m/s]
    acceleration: Array  # (3,) [m/s^2]
    yaw: float  # [rad]
    yaw_rate: float  # [rad/s]
    yaw_acceleration: float  # [rad/s^2]
    jerk: Array = field(default_factory=zero)  # (3,) [m/s^3]
    snap: Array = field(default_factory=zero)  # (3,) [m/s^4]
    heading: Array | None = None
    """(3, 3) rows: the desired direction of body x, of any length but zero, and its first two derivatives; None to use
    yaw."""


@lru_cache(maxsize=32)
def differentiator(samples: int, period: float, *, degree: int = 2, first: float = 1.0) -> Array:
    """(degree + 1, N): value and derivatives at t_k of samples at t_{k + first} .. t_{k + first + N - 1}.

    The least-squares polynomial through the samples (Savitzky and Golay, 1964); N = degree + 1 gives ordinary
    differences.  Where the reference's velocity jumps, as a filtered step's does, the second derivative of a parabola
    spreads the jump over the N samples as a smooth hump instead of a spike.

    Raises:
        ParameterError: too few samples, or a period that is not positive.
    """
    if samples < degree + 1:
        derivative = {SMALLEST_PREVIEW: "an acceleration", PREVIEW_DEGREE + 1: "a snap"}.get(degree + 1, "derivatives")
        raise ParameterError("controller", "horizon", samples, f"at least {degree + 1}, for {derivative}")
    if not 0.0 < period < math.inf:
        raise ParameterError("controller", "period", period, "positive and finite")
    t = period * (first + np.arange(samples))
    fit = np.linalg.pinv(np.vander(t, degree + 1, increasing=True))
    factorials = [float(math.factorial(order)) for order in range(degree + 1)]
    return read_only(fit * np.array(factorials)[:, None])


def target_of(reference: Array, operator: Array) -> Target:
    """Return the target from a preview (N, 4) of x, y, z [m], yaw [rad] and its `differentiator` (degree + 1, N)."""
    value, rate, acceleration, *higher = operator @ reference
    derivatives = {}
    for name, row in zip(("jerk", "snap"), higher, strict=False):
        derivatives[name] = row[:3]
    return Target(
        position=value[:3],
        velocity=rate[:3],
        acceleration=acceleration[:3],
        yaw=float(value[3]),
        yaw_rate=float(rate[3]),
        yaw_acceleration=float(acceleration[3]),
        **derivatives,
    )
