"""Discrete gusts of the 1-cosine shape."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from annotated_types import doc

from quadsim.errors import ParameterError
from quadsim.fields import Instant, Positive, Vector
from quadsim.state import Array

Velocity = Vector  # A velocity in the world frame, z up [m/s]


@dataclass(frozen=True, kw_only=True)
class Gust:
    """One 1-cosine gust, v(t) = v_peak / 2 (1 - cos(2 pi (t - t0) / T)) for t0 <= t <= t0 + T, and zero elsewhere.

    The shape is that of 14 CFR 25.341(a)(2), v = v_peak / 2 (1 - cos(pi s / H)) over the way s = 0 .. 2 H; its rise
    to the peak is the discrete gust of MIL-F-8785C, Sec. 3.7.1.3.  Both measure the gust along the way of an aeroplane
    that flies into it at the airspeed V.  A hovering vehicle waits for the air instead: T = 2 H / V is given here.
    t0 is `at`, T `duration` and v_peak `velocity`.

    Raises:
        ParameterError: a value is not finite, the start is negative or the duration is not positive.
    """

    at: Instant
    duration: Annotated[Positive, doc("[s] from calm to calm")]
    velocity: Annotated[Velocity, doc("[m/s] in its middle, world frame")]

    def __post_init__(self) -> None:
        if not 0.0 <= self.at < math.inf:
            raise ParameterError("gust", "at", self.at, "a finite time >= 0 s")
        if not 0.0 < self.duration < math.inf:
            raise ParameterError("gust", "duration", self.duration, "a finite time > 0 s")
        check_velocity("gust", "velocity", self.velocity)


def gust_velocity(gusts: Sequence[Gust], t: Array) -> Array:
    """Sum of gusts (M, 3) at times `t` (M,) [s], world frame [m/s]."""
    velocity = np.zeros((t.size, 3))
    for gust in gusts:
        share = (t - gust.at) / gust.duration
        inside = (share > 0.0) & (share < 1.0)
        velocity[inside] += 0.5 * (1.0 - np.cos(2.0 * np.pi * share[inside, None])) * np.array(gust.velocity)
    return velocity


def check_velocity(owner: str, name: str, value: Velocity) -> None:
    """Raise a ParameterError unless a value is three finite numbers."""
    if np.shape(value) != (3,) or not np.all(np.isfinite(value)):
        raise ParameterError(owner, name, value, "three finite numbers, x, y, z in m/s")
