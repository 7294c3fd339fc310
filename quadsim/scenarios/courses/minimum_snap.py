"""The smoothest polynomials through given points at given times.

Position has the least snap, the integral of |x''''|^2, and yaw the least integral of its second derivative squared.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Annotated, Final, Literal

import numpy as np
from annotated_types import Len, doc

from quadsim.errors import ParameterError
from quadsim.scenarios.courses.course import (
    CLOSEST,
    MOST_POINTS,
    Path,
    Point,
    Speed,
    Time,
    Travelled,
    poses_of,
    require_apart,
    require_free_yaw,
    require_one,
)
from quadsim.state import Array

if TYPE_CHECKING:
    from scipy.interpolate import BPoly

SNAP: Final = 4
ACCELERATION_ORDER: Final = 2


@dataclass(frozen=True, kw_only=True)
class MinimumSnap(Travelled):
    """The smoothest course through points, from rest at the initial position to rest at the last of them."""

    type: Annotated[Literal["minimum_snap"], doc("kind of course: least snap through points")]
    points: Annotated[tuple[Point, ...], Len(1, MOST_POINTS), doc("the points, in order")]
    times: Annotated[
        tuple[Time, ...] | None, doc("[s] after start, times at which the points are passed; either times or speed")
    ] = None
    speed: Annotated[Speed | None, doc("[m/s] average on the straight line between points; either times or speed")] = (
        None
    )

    def __post_init__(self) -> None:
        require_one(times=self.times, speed=self.speed)
        require_free_yaw(self.points, self.yaw)
        if self.times is None:
            require_apart(self.points, "or give times instead of speed")
        elif len(self.times) != len(self.points):
            rule = f"a list of {len(self.points)} times, one for each point"
            raise ParameterError("", "times", list(self.times), rule)
        elif any(after - before < CLOSEST for before, after in pairwise(self.times)):
            raise ParameterError("", "times", list(self.times), f"increasing, by {CLOSEST} s or more")

    def path(self, initial: Array, gravity: float) -> Path:
        """The polynomials through the points.

        Raises:
            ParameterError: a speed is to lead to a first point at the initial position.
        """
        poses = poses_of(self.points, initial)
        if self.times is not None:
            return minimum_snap(initial, poses, self.times)
        lengths = np.linalg.norm(np.diff(np.vstack([initial, poses])[:, :3], axis=0), axis=1)
        if lengths[0] < CLOSEST:
            rule = f"{CLOSEST} m or more from the initial position, where the course begins"
            rule += " (or give times instead of speed)"
            raise ParameterError("reference", "points.0.position", list(self.points[0].position), rule)
        return minimum_snap(initial, poses, (np.cumsum(lengths) / self.speed).tolist())


def smoothest(times: Array, values: Array, order: int) -> BPoly:
    """The curve through values (n + 1, c) at times (n + 1,) [s], from rest to rest, least in a squared derivative.

    The integral is of the derivative of an `order`, 4 for snap; the curve is a polynomial of degree 2 order - 1 between
    two points (Mellinger & Kumar 2011, Sec. IV).  The quadratic program's equality constraints are met by taking for
    unknowns the derivatives at the points, which neighbouring segments share, so that what is left of the KKT system is
    R_PP d_P = -R_PF d_F, with d_F the derivatives that are given and d_P those that are free (Richter, Bry & Roy 2013,
    Sec. 3.2).  Time is in mean segment durations, and the unknowns are scaled to a unit diagonal of R_PP.
    """
    from scipy.interpolate import BPoly

    n = times.size - 1
    unit = (times[-1] - times[0]) / (times.size - 1)
    durations = np.diff(times) / unit
    # Coefficients of one segment on s in [0, 1] from derivatives 0 .. order - 1 at s = 0 and at s = 1.
    from_ends = np.linalg.inv(np.vstack([_derivatives_at(0.0, order), _derivatives_at(1.0, order)]))
    cost = from_ends.T @ _squared_derivative(order) @ from_ends
    blocks = np.zeros((n + 1, order, n + 1, order))
    for i, duration in enumerate(durations):
        scale = np.tile(duration ** np.arange(order), 2)
        block = duration ** (1 - 2 * order) * scale[:, None] * cost * scale
        blocks[i : i + 2, :, i : i + 2, :] += block.reshape(2, order, 2, order)
    R = blocks.reshape((n + 1) * order, (n + 1) * order)

    derivatives = np.zeros((n + 1, order, values.shape[1]))
    derivatives[:, 0] = values
    stacked = derivatives.reshape((n + 1) * order, -1)  # a view
    free = np.setdiff1d(np.arange(order, n * order), order * np.arange(1, n))
    if free.size:
        R_PP = R[np.ix_(free, free)]
        gradient = R[free] @ stacked
        unit_diagonal = 1.0 / np.sqrt(np.diag(R_PP))
        R_PP = unit_diagonal[:, None] * R_PP * unit_diagonal
        stacked[free] = -unit_diagonal[:, None] * np.linalg.solve(R_PP, unit_diagonal[:, None] * gradient)
    return BPoly.from_derivatives(times, derivatives / unit ** np.arange(order)[:, None])


def minimum_snap(start: Array, poses: Array, times: Sequence[float]) -> Path:
    """Least snap of x, y, z and angular acceleration of yaw through poses (n, 4) at times (n,) [s], rest to rest."""
    knots = np.array([0.0, *times])
    through = np.vstack([start, poses])
    position = smoothest(knots, through[:, :3], SNAP)
    yaw = smoothest(knots, through[:, 3:], ACCELERATION_ORDER)
    return Path(pose=lambda t: np.hstack([position(t), yaw(t)]), duration=float(knots[-1]))


def _derivatives_at(s: float, order: int) -> Array:
    """(order, 2 order): derivatives 0 .. order - 1 at s of 1, s, s^2, ..."""
    derivatives = np.zeros((order, 2 * order))
    for k in range(order):
        for p in range(2 * order):
            derivatives[k, p] = math.perm(p, k) * s ** max(p - k, 0)
    return derivatives


def _squared_derivative(order: int) -> Array:
    """(2 order, 2 order): integral over [0, 1] of the products of the derivatives of an order of s^i and s^j."""
    slopes = np.array([math.perm(i, order) for i in range(2 * order)], float)  # 0 below the order
    degrees = np.add.outer(np.arange(2 * order), np.arange(2 * order)) - 2 * order + 1
    return np.outer(slopes, slopes) / np.maximum(degrees, 1)
