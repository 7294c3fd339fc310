"""Control authority at hover: what thrust and torque the rotors have in reserve, and how fast they respond.

Torques at a thrust of m g are the extremes of a linear programme in the squared rotor speeds v, each within its limits:
row i of the allocation matrix times v is torque i.  Divided by the inertia, they are angular accelerations.
`rules.py` designs a controller from these numbers; `vehicle_report.py` and `shortfalls.py` show them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.optimize import linprog

from quadsim.sim.airframe import munk_moment
from quadsim.sim.effects.wind import SEA_LEVEL_DENSITY
from quadsim.vehicle import N_ROTORS, Vehicle

FORCE_AXES: Final = ("x", "y", "z")


@dataclass(frozen=True, kw_only=True)
class TorqueRange:
    """Torques available about one body axis at hover."""

    axis: str  # x, y or z
    lowest: float  # torque [N m]
    highest: float  # torque [N m]
    lowest_pure: float  # the same with no torque about the other two axes [N m]
    highest_pure: float  # the same with no torque about the other two axes [N m]
    lowest_acceleration: float  # what `lowest` gives from rest [rad/s^2]
    highest_acceleration: float  # what `highest` gives from rest [rad/s^2]


@dataclass(frozen=True, kw_only=True)
class Authority:
    """Figures at hover on which a controller's design is based."""

    thrust_to_weight: float  # all rotors at their highest speed, over the weight [-]
    hover_share: float  # where hover lies between the lowest speed, 0, and the highest, 1 [-]
    steady_tilt: float
    """Largest tilt at which the rotors still carry the weight, cos(tilt) = 1 / thrust_to_weight [rad]."""
    climb: float  # largest upward acceleration from hover, level [m/s^2]
    sink: float  # largest downward acceleration from hover, level [m/s^2]
    turning: tuple[float, float, float]
    """(3,) angular acceleration about body x, y, z available in both directions, without torque about the other axes,
    while thrust carries the weight [rad/s^2]."""
    lag: float  # the longer time constant of a rotor's speed [s]; 0 where the vehicle gives none
    munk: float  # growth rate of a tilt by Munk's moment over the level air speed [1/m]; 0 without body drag


def control_authority(vehicle: Vehicle) -> Authority:
    """Return what a vehicle has in reserve at hover."""
    hover = vehicle.thrusts(vehicle.hover_speeds)
    lowest = vehicle.thrusts(np.full(N_ROTORS, vehicle.speed_min))
    highest = vehicle.thrusts(np.full(N_ROTORS, vehicle.speed_max))
    ratio = float((highest / hover).min())
    return Authority(
        thrust_to_weight=ratio,
        hover_share=(vehicle.hover_speed - vehicle.speed_min) / (vehicle.speed_max - vehicle.speed_min),
        steady_tilt=math.acos(min(1.0, 1.0 / ratio)),
        climb=(ratio - 1.0) * vehicle.gravity,
        sink=(1.0 - float((lowest / hover).max())) * vehicle.gravity,
        turning=_turning(vehicle),
        lag=max(vehicle.rotor_rise or 0.0, vehicle.rotor_fall or 0.0),
        munk=_munk(vehicle),
    )


def _turning(vehicle: Vehicle) -> tuple[float, float, float]:
    """Return the angular accelerations [rad/s^2] about x, y, z that are available in both directions."""
    accelerations = []
    for torque, inertia in zip(torque_ranges(vehicle), vehicle.inertia, strict=True):
        both_ways = min(-torque.lowest_pure, torque.highest_pure)
        accelerations.append(both_ways / inertia)
    x, y, z = accelerations
    return x, y, z


def _munk(vehicle: Vehicle) -> float:
    """Return the larger p / v of roll and pitch [1/m], p the rate at which the air makes a tilt grow.

    At level speed v, an inflow moment k, the vehicle's or that of its body, increases a small tilt by the torque
    k v^2 tilt: J tilt'' = k v^2 tilt, which grows as exp(p t), p = v sqrt(k / J).
    """
    inflow = vehicle.inflow_moment
    if inflow is None and vehicle.body_drag is not None:
        inflow = munk_moment(vehicle.body_drag, SEA_LEVEL_DENSITY)
    about_x, about_y = inflow or (0.0, 0.0)
    ixx, iyy, _ = vehicle.inertia
    return math.sqrt(max(0.0, about_x / ixx, about_y / iyy))


def torque_ranges(vehicle: Vehicle) -> tuple[TorqueRange, ...]:
    """Return the largest torques of each sign about x, y, z, with thrust at the weight and every rotor in its range.

    A linear programme in the rotors' thrusts over their coefficients, the squared speeds v_i = w_i^2 unless the vehicle
    has a map of thrust: the torque about an axis is a row of the allocation matrix times v, the thrust is its first row
    times v, and v_i lies between those of the speed limits.
    """
    ranges = []
    for axis, name in enumerate(FORCE_AXES):
        low, high = _extremes(vehicle, 1 + axis, pure=False)
        low_pure, high_pure = _extremes(vehicle, 1 + axis, pure=True)
        ranges.append(
            TorqueRange(
                axis=name,
                lowest=low,
                highest=high,
                lowest_pure=low_pure,
                highest_pure=high_pure,
                lowest_acceleration=low / vehicle.inertia[axis],
                highest_acceleration=high / vehicle.inertia[axis],
            )
        )
    return tuple(ranges)


def _extremes(vehicle: Vehicle, row: int, *, pure: bool) -> tuple[float, float]:
    """Return the smallest and largest torque [N m] of a row of the allocation matrix; `pure`: the others are zero."""
    linear, quadratic = vehicle.square_law
    lowest = linear * vehicle.speed_min + quadratic * vehicle.speed_min**2
    highest = linear * vehicle.speed_max + quadratic * vehicle.speed_max**2
    matrix = highest * vehicle.allocation  # in v / highest, so that the programme is well scaled
    units = np.abs(matrix).max(axis=1)
    held_rows = [0]  # thrust
    if pure:
        held_rows += [other for other in (1, 2, 3) if other != row]
    held_values = np.zeros(len(held_rows))
    held_values[0] = vehicle.mass * vehicle.gravity / units[0]
    extremes = []
    for sign in (1.0, -1.0):
        solution = linprog(
            sign * matrix[row] / units[row],
            A_eq=matrix[held_rows] / units[held_rows, None],
            b_eq=held_values,
            bounds=[(least, 1.0) for least in lowest / highest],
            method="highs",
        )
        assert solution.success, "hover itself is feasible"
        extremes.append(float(sign * solution.fun * units[row]))
    return extremes[0], extremes[1]
