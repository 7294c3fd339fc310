"""Control allocation: thrust and torques to rotor speeds within bounds.  Yaw is sacrificed first.

The wrench is linear in the squared speeds s = w^2: wrench = M s (Sec. 2.2).  A wrench that the bounds do not allow is
approximated in two stages:

1. thrust, roll and pitch torque exactly, yaw torque as closely as possible: the speeds that give the first three form
   a line, and the yaw torque varies along it (the last stage of PX4's mixers);
2. where no point of that line is within the bounds, weighted least squares of the error, with roll and pitch above
   thrust above yaw, and thrust first clipped to its range (Smeur, Höppener, De Wagter, "Prioritized control allocation
   for quadrotors subject to saturation", 2017, after Härkegård, "Efficient active set algorithms for solving
   constrained least squares problems in aircraft control allocation", 2002).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from quadsim.state import Array, read_only
from quadsim.vehicle import Vehicle

WEIGHTS: Final = (30.0, 1000.0, 1000.0, 1.0)
"""Weights of thrust, roll, pitch and yaw in stage 2.  Squared, they differ by a factor of about 1000."""


@dataclass(frozen=True, kw_only=True)
class Allocation:
    """A vehicle's map between squared rotor speeds [rad^2/s^2] and the wrench [U, tau_x, tau_y, tau_z] [N, N m]."""

    M: Array  # (4, 4), wrench = M s
    inverse: Array  # (4, 4), s = inverse wrench
    scale: Array  # (4,) wrench of one rotor at hover speed, the unit of each error


def make_allocation(vehicle: Vehicle) -> Allocation:
    """Return the allocation of a vehicle."""
    M = vehicle.allocation
    scale = np.asarray(np.abs(M).max(axis=1) * vehicle.hover_speed**2, np.float64)
    return Allocation(
        M=read_only(M), inverse=read_only(np.asarray(np.linalg.inv(M), np.float64)), scale=read_only(scale)
    )


def thrust_to_command(largest: float, weight: float, share: float) -> float:
    """Return the largest collective thrust [N] that a law commands; the rest is for torques.

    It is a share of the `largest` that the rotors give [N], but at least half way from the weight [N] to it: a vehicle
    of low thrust to weight still climbs.  All of it, if the rotors cannot carry the weight.
    """
    return min(largest, max(share * largest, 0.5 * (weight + largest)))


def allocate(allocation: Allocation, wrench: Array, lower: Array, upper: Array) -> Array:
    """Return the rotor speeds (4,) within `lower` and `upper` (4,) [rad/s] whose wrench is closest to the one demanded.

    The wrench (4,) is thrust [N] along body z and torques [N m] about the body axes; the bounds are finite.
    """
    low, high = lower**2, upper**2
    squares = allocation.inverse @ wrench
    if not ((low <= squares) & (squares <= high)).all():
        squares_less_yaw = _less_yaw(squares, allocation.inverse[:, 3], low, high)
        squares = _nearest(allocation, wrench, low, high) if squares_less_yaw is None else squares_less_yaw
    return np.asarray(np.clip(np.sqrt(np.maximum(squares, 0.0)), lower, upper))


def _less_yaw(squares: Array, yaw: Array, low: Array, high: Array) -> Array | None:
    """Return the point of the line along `yaw` closest to `squares` and within the bounds; None if there is none."""
    rounding = 1e-9 * max(float(high.max()), 1.0)  # rounding must not exclude a corner of the bounds
    ends = np.sort(np.stack([(low - rounding - squares) / yaw, (high + rounding - squares) / yaw]), axis=0)
    first, last = ends[0].max(), ends[1].min()
    return squares + np.clip(0.0, first, last) * yaw if first <= last else None


def _nearest(allocation: Allocation, wrench: Array, low: Array, high: Array) -> Array:
    from scipy.optimize import lsq_linear  # slow to import, and not needed to read settings

    unit = max(float(high.max()), 1.0)  # scales the squares, so that the solver works with numbers near 1
    weights = np.array(WEIGHTS) / allocation.scale
    wrench = wrench.copy()  # a thrust out of range would dominate the torques in the squared error
    wrench[0] = np.clip(wrench[0], allocation.M[0] @ low, allocation.M[0] @ high)
    wide = np.maximum(high, low + 1e-9 * unit)  # the solver needs a gap between bounds
    fit = lsq_linear(
        weights[:, None] * allocation.M * unit, weights * wrench, (low / unit, wide / unit), method="bvls", tol=1e-14
    )
    return np.asarray(fit.x * unit)
