"""A reference's derivatives now, from its next samples."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Final

import numpy as np

from mpc.nonlinear.model import zero
from mpc.nonlinear.rigidbody import rotation
from quadsim.errors import ParameterError
from quadsim.motion import Motion
from quadsim.state import Array, read_only

SMALLEST_PREVIEW: Final = 3  # samples that a parabola needs
PREVIEW_DEGREE: Final = 4  # of the polynomial through a preview that gives jerk and snap
MOTION_DEGREE: Final = 5  # of the one through a motion's next samples, which are exact
MOTION_SAMPLES: Final = 7


@dataclass(frozen=True, kw_only=True)
class Target:
    """What a baseline is to follow at t_k, world frame."""

    position: Array  # (3,) [m]
    velocity: Array  # (3,) [m/s]
    acceleration: Array  # (3,) [m/s^2]
    yaw: float  # [rad]
    yaw_rate: float  # [rad/s]
    yaw_acceleration: float  # [rad/s^2]
    jerk: Array = field(default_factory=zero)  # (3,) [m/s^3]
    snap: Array = field(default_factory=zero)  # (3,) [m/s^4]
    heading: Array | None = None
    """(3, 3) rows: the direction near which body x is wanted, any length but zero, its rate of change and that of this;
    None where yaw gives it."""


@lru_cache(maxsize=32)
def differentiator(samples: int, period: float, *, degree: int = 2, first: int = 1) -> Array:
    """(degree + 1, N): value and derivatives at t_k of samples at t_{k + first} .. t_{k + first + N - 1}.

    Those of the least-squares polynomial through the samples (Savitzky and Golay, 1964), which N = degree + 1 makes the
    ordinary differences.  Where the reference's velocity jumps, as a filtered step's does, the second derivative of a
    parabola is a smooth hump of the jump's area over the N samples, not a spike.

    Raises:
        ParameterError: there are too few samples, or the period is not positive.
    """
    if samples < degree + 1:
        derivative = {SMALLEST_PREVIEW: "an acceleration", PREVIEW_DEGREE + 1: "a snap"}.get(degree + 1, "derivatives")
        raise ParameterError("controller", "horizon", samples, f"at least {degree + 1}, for {derivative}")
    if not 0.0 < period < math.inf:
        raise ParameterError("controller", "period", period, "positive and finite")
    t = period * np.arange(first, first + samples)
    fit = np.linalg.pinv(np.vander(t, degree + 1, increasing=True))
    return read_only(fit * np.array([[float(math.factorial(order))] for order in range(degree + 1)]))


def target_of(reference: Array, operator: Array) -> Target:
    """What to follow, from the preview (N, 4) of x, y, z [m], yaw [rad] and its `differentiator` (degree + 1, N)."""
    value, rate, acceleration, *higher = operator @ reference
    return Target(
        position=value[:3],
        velocity=rate[:3],
        acceleration=acceleration[:3],
        yaw=float(value[3]),
        yaw_rate=float(rate[3]),
        yaw_acceleration=float(acceleration[3]),
        **{name: each[:3] for name, each in zip(("jerk", "snap"), higher, strict=False)},
    )


def target_of_motion(motion: Motion, yaw: Array, period: float) -> Target:
    """What to follow, from the present and next samples of a motion and the yaw (3,), its rate and acceleration.

    All derivatives are those of the positions and attitudes, whatever velocities a course states of itself: they agree
    with what the vehicle has to fly.  Near the course's end fewer samples give fewer derivatives.
    """
    samples = min(len(motion), MOTION_SAMPLES)
    degree = min(MOTION_DEGREE, samples - 1)
    operator = differentiator(samples, period, degree=degree, first=0)
    derivatives = np.zeros((MOTION_DEGREE, 3))  # position to snap
    orders = min(degree + 1, MOTION_DEGREE)
    derivatives[:orders] = operator[:orders] @ motion.position[:samples]
    heading = np.zeros((3, 3))
    heading[: min(degree + 1, 3)] = operator[:3] @ rotation(motion.attitude[:samples])[:, :, 0]
    position, velocity, acceleration, jerk, snap = derivatives
    return Target(
        position=position,
        velocity=velocity,
        acceleration=acceleration,
        jerk=jerk,
        snap=snap,
        yaw=float(yaw[0]),
        yaw_rate=float(yaw[1]),
        yaw_acceleration=float(yaw[2]),
        heading=heading,
    )


def wrapped(angle: float) -> float:
    """The same heading as an angle in [-pi, pi) [rad]."""
    return (angle + math.pi) % (2.0 * math.pi) - math.pi
