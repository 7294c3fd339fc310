"""Control allocation: thrust and torques to rotor speeds within bounds.  Yaw is sacrificed first.

The wrench is linear in the squared speeds s = w^2: wrench = M s (Sec. 2.2).  A wrench that the bounds do not allow is
approximated (`allocate`).  The autopilot allocates in each of its steps, `quadsim/core/quadsim_inner.c`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from quadsim.core.mirror import Struct, core_library, fill
from quadsim.core.structs import InnerStruct
from quadsim.state import Array, read_only
from quadsim.vehicle import N_ROTORS, Vehicle


@dataclass(frozen=True, kw_only=True)
class Allocation:
    """A vehicle's map between squared rotor speeds [rad^2/s^2] and the wrench [U, tau_x, tau_y, tau_z] [N, N m].

    Where thrust is a map of the speed, s = linear w + quadratic w^2 takes the place of the squared speed w^2.
    """

    linear: Array  # (4,) 0 where there is no such map [rad/s]
    quadratic: Array  # (4,) 1 where there is no such map [-]
    M: Array  # (4, 4), wrench = M s
    inverse: Array  # (4, 4), s = inverse wrench
    scale: Array  # (4,) wrench of one rotor at hover speed, the unit of each error

    def wrench(self, speeds: Array) -> Array:
        """Return the wrench (4,) of rotor speeds (4,) [rad/s]; a negative one pulls."""
        return np.asarray(self.M @ (self.linear * speeds + self.quadratic * speeds * np.abs(speeds)))


def make_allocation(vehicle: Vehicle) -> Allocation:
    """Return the allocation of a vehicle."""
    M = vehicle.allocation
    scale = np.asarray(np.abs(M).max(axis=1) * vehicle.hover_speed**2, np.float64)
    linear, quadratic = vehicle.square_law
    return Allocation(
        linear=read_only(linear),
        quadratic=read_only(quadratic),
        M=read_only(M),
        inverse=read_only(np.asarray(np.linalg.inv(M), np.float64)),
        scale=read_only(scale),
    )


def thrust_to_command(largest: float, weight: float, share: float) -> float:
    """Return the largest collective thrust [N] that a controller commands; the rest is for torques.

    It is a share of the `largest` that the rotors give [N], but at least half way from the weight [N] to it: a vehicle
    of low thrust to weight still climbs.  All of it, if the rotors cannot carry the weight.
    """
    return min(largest, max(share * largest, 0.5 * (weight + largest)))


def allocation_struct(allocation: Allocation, lower: Array, upper: Array) -> Struct:
    """Return what the core takes for an allocation within `lower` and `upper` (4,) [rad/s], which are finite."""
    struct = InnerStruct()
    fill(struct.effect, allocation.M)
    fill(struct.inverse, allocation.inverse)
    struct.linear[:] = allocation.linear
    struct.quadratic[:] = allocation.quadratic
    struct.scale[:] = allocation.scale
    struct.least[:] = lower
    struct.most[:] = upper
    return struct


def allocate(allocation: Allocation, wrench: Array, lower: Array, upper: Array) -> Array:
    """Return the rotor speeds (4,) within `lower` and `upper` (4,) [rad/s] whose wrench is closest to the one demanded.

    The wrench (4,) is thrust [N] along body z and torques [N m] about the body axes; the bounds are finite.  One that
    they do not allow is approximated in two stages:

    1. thrust, roll and pitch torque exactly, yaw torque as closely as possible: the speeds that give the first three
       form a line, and the yaw torque varies along it (the last stage of PX4's mixers);
    2. where no point of that line is within the bounds, weighted least squares of the error, with roll and pitch above
       thrust above yaw, and thrust first clipped to its range (Smeur, Höppener, De Wagter, "Prioritized control
       allocation for quadrotors subject to saturation", 2017, after Härkegård, "Efficient active set algorithms for
       solving constrained least squares problems in aircraft control allocation", 2002).

    The core computes it; stage 2 is the best of all choices of rotors at their lower or upper bound.
    """
    demanded = np.ascontiguousarray(wrench, np.float64)
    speeds = np.empty(N_ROTORS)
    struct = allocation_struct(allocation, lower, upper)
    core_library().quadsim_allocate(struct, demanded.ctypes.data, speeds.ctypes.data)
    return speeds
