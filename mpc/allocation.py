"""From thrust and torques to rotor speeds within bounds: yaw is limited first.

Squared speeds s = w^2 make the wrench linear, wrench = M s (Sec. 2.2).  A wrench outside what the bounds leave is met
in two stages:

1. thrust, roll and pitch torque exactly, yaw torque as near as it then can be: the speeds that keep the first three are
   a line, and yaw is where on it (the last stage of PX4's mixers);
2. where no point of that line is within the bounds, the least weighted squares of what is missed, roll and pitch above
   thrust above yaw, thrust wanted beyond its reach counting as wanted at its end (Smeur, Höppener, De Wagter,
   "Prioritized control allocation for quadrotors subject to saturation", 2017, after Härkegård, "Efficient active set
   algorithms for solving constrained least squares problems in aircraft control allocation", 2002).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from quadsim.state import Array, read_only
from quadsim.vehicle import Vehicle

WEIGHTS: Final = (30.0, 1000.0, 1000.0, 1.0)
"""Weights of thrust, roll, pitch and yaw in stage 2: squared, about a thousandfold from one to the next."""
LARGEST_SPEED: Final = 1e4  # in place of no upper bound [rad/s]; no rotor reaches it


@dataclass(frozen=True, kw_only=True)
class Allocation:
    """A vehicle's map between squared rotor speeds [rad^2/s^2] and the wrench [U, tau_x, tau_y, tau_z] [N, N m]."""

    M: Array  # (4, 4), wrench = M s
    inverse: Array  # (4, 4), s = inverse wrench
    scale: Array  # (4,) wrench that one rotor at hover speed gives, what is missed being counted in these units


def make_allocation(vehicle: Vehicle) -> Allocation:
    """The allocation of a vehicle."""
    M = vehicle.allocation
    scale = np.asarray(np.abs(M).max(axis=1) * vehicle.hover_speed**2, np.float64)
    return Allocation(
        M=read_only(M), inverse=read_only(np.asarray(np.linalg.inv(M), np.float64)), scale=read_only(scale)
    )


def allocate(allocation: Allocation, wrench: Array, lower: Array, upper: Array) -> Array:
    """Rotor speeds (4,) within `lower` and `upper` (4,) [rad/s] that give a wrench, or what comes nearest to it.

    The wrench (4,) is thrust [N] along body z and torques [N m] about the body axes; upper speeds may be infinite.
    """
    low, high = lower**2, np.minimum(upper, LARGEST_SPEED) ** 2
    squares = allocation.inverse @ wrench
    if not ((low <= squares) & (squares <= high)).all():
        given = _less_yaw(squares, allocation.inverse[:, 3], low, high)
        squares = _nearest(allocation, wrench, low, high) if given is None else given
    return np.asarray(np.clip(np.sqrt(np.maximum(squares, 0.0)), lower, upper))


def _less_yaw(squares: Array, yaw: Array, low: Array, high: Array) -> Array | None:
    """The point nearest to `squares` of the line along `yaw`, (4,) squares per N m, within the bounds; None without."""
    room = 1e-9 * max(float(high.max()), 1.0)  # a corner of the bounds is a point of theirs, whatever the rounding
    ends = np.sort(np.stack([(low - room - squares) / yaw, (high + room - squares) / yaw]), axis=0)
    first, last = ends[0].max(), ends[1].min()
    return squares + np.clip(0.0, first, last) * yaw if first <= last else None


def _nearest(allocation: Allocation, wrench: Array, low: Array, high: Array) -> Array:
    from scipy.optimize import lsq_linear  # not for those who only read settings

    unit = max(float(high.max()), 1.0)  # of the squares, so that the solver's numbers are about 1
    weights = np.array(WEIGHTS) / allocation.scale
    wrench = wrench.copy()  # thrust beyond all reach would drown the torques in its squares
    wrench[0] = np.clip(wrench[0], allocation.M[0] @ low, allocation.M[0] @ high)
    wide = np.maximum(high, low + 1e-9 * unit)  # the solver wants room between bounds
    found = lsq_linear(
        weights[:, None] * allocation.M * unit, weights * wrench, (low / unit, wide / unit), method="bvls", tol=1e-14
    )
    return np.asarray(found.x * unit)
