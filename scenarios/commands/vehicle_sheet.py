"""`quadsim vehicle`: what its numbers amount to, of hover, thrust and torque margins and of the linear model."""

from __future__ import annotations

import itertools
import json
import math
from argparse import Namespace
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from scipy.optimize import linprog

from mpc.model import continuous_model, discretise
from quadsim.assets import vehicle_path
from quadsim.errors import ParameterError
from quadsim.report.table import Cell, Grid, format_number
from quadsim.state import INDEX, Array
from quadsim.vehicle import N_ROTORS, VEHICLE_UNITS, Vehicle, load_vehicle, vehicle_sources
from scenarios.commands import EXIT_DONE, console

AXES: Final = ("x", "y", "z")
SHEET_PERIOD: Final = 0.05  # control period of the discrete poles [s], the paper's
_RPM: Final = 60.0 / (2.0 * math.pi)


@dataclass(frozen=True)
class TorqueRange:
    """The torques about one body axis that hover leaves room for."""

    axis: str  # x, y or z
    lowest: float  # torque [N m]
    highest: float  # torque [N m]
    lowest_pure: float  # the same with no torque about the other two axes [N m]
    highest_pure: float  # the same with no torque about the other two axes [N m]
    lowest_acceleration: float  # what `lowest` gives from rest [rad/s^2]
    highest_acceleration: float  # what `highest` gives from rest [rad/s^2]


@dataclass(frozen=True, kw_only=True)
class VehicleSheet:
    """Figures derived from a vehicle's numbers, all at hover."""

    weight: float  # m g [N]
    hover_speed: float  # omega_bar [rad/s]
    hover_speed_rpm: float  # the same [rpm]
    speed_range_used: float  # where hover lies between the lowest speed, 0, and the highest, 1 [-]
    thrust_to_weight: float  # all rotors at their highest speed, over the weight [-]
    climb_acceleration: float  # largest upward acceleration from hover, level [m/s^2]
    # largest tilt at which the rotors still carry the weight, cos(tilt) = 1 / thrust_to_weight [deg]
    steady_tilt: float
    torques: tuple[TorqueRange, ...]  # about x, y and z
    thrust_slope: float  # of one rotor, 2 b omega_bar [N s/rad]
    # largest entry of B_c in the rows of vz [m/s^2 per rad/s] and of the three rates [rad/s^2 per rad/s]: the modelled
    # effect of one rotor per rad/s
    input_slopes: dict[str, float]
    # lengths of the chains of integrators that the linear model falls into, longest first
    integrator_chains: tuple[int, ...]
    continuous_poles: tuple[float, ...]  # of A_c [1/s]
    discrete_poles: tuple[float, ...]  # of A at `period` [-]
    period: float  # tau_s [s]
    # of the rotors' speeds when they rise and fall, continuous [1/s], as far as the file gives them
    lag_poles: dict[str, float]
    discrete_lag_poles: dict[str, float]  # the same at `period` [-]


def vehicle(options: Namespace) -> int:
    """`quadsim vehicle`."""
    path = vehicle_path(options.vehicle)
    loaded, sources = load_vehicle(path), vehicle_sources(path)
    if options.out is not None:
        from quadsim.report.film.video import render_portrait

        if Path(options.out).suffix != ".png":
            raise ParameterError("", "--out", options.out, "a file ending in .png")
        render_portrait(loaded, Path(options.out))
    sheet = make_sheet(loaded)
    if options.json:
        print(json.dumps(sheet_to_json(loaded, sheet, sources), indent=2))
    else:
        console.print_grids(sheet_tables(loaded, sheet, sources), options.out, prose=("unit", "source"))
    return EXIT_DONE


def make_sheet(vehicle: Vehicle) -> VehicleSheet:
    """The figures of a vehicle."""
    A_c, B_c = continuous_model(vehicle)
    A, _ = discretise(A_c, B_c, SHEET_PERIOD)
    ratio = (vehicle.speed_max / vehicle.hover_speed) ** 2
    lags = {name: value for name in ("rotor_rise", "rotor_fall") if (value := getattr(vehicle, name)) is not None}
    return VehicleSheet(
        weight=vehicle.mass * vehicle.gravity,
        hover_speed=vehicle.hover_speed,
        hover_speed_rpm=_RPM * vehicle.hover_speed,
        speed_range_used=(vehicle.hover_speed - vehicle.speed_min) / (vehicle.speed_max - vehicle.speed_min),
        thrust_to_weight=ratio,
        climb_acceleration=(ratio - 1.0) * vehicle.gravity,
        steady_tilt=math.degrees(math.acos(min(1.0, 1.0 / ratio))),
        torques=torque_ranges(vehicle),
        thrust_slope=2.0 * vehicle.thrust_coefficient * vehicle.hover_speed,
        input_slopes={
            name: float(np.abs(B_c[INDEX[name]]).max()) for name in ("vz", "roll_rate", "pitch_rate", "yaw_rate")
        },
        integrator_chains=integrator_chains(A_c),
        # A_c permutes to a strictly upper triangular matrix: chains of integrators, whose poles are its diagonal.
        continuous_poles=tuple(np.diag(A_c).tolist()),
        discrete_poles=tuple(np.diag(A).tolist()),
        period=SHEET_PERIOD,
        lag_poles={name: -1.0 / value for name, value in lags.items()},
        discrete_lag_poles={name: math.exp(-SHEET_PERIOD / value) for name, value in lags.items()},
    )


def torque_ranges(vehicle: Vehicle) -> tuple[TorqueRange, ...]:
    """The largest torques of each sign about x, y, z with the thrust kept at the weight and every rotor in its range.

    A linear programme in the squared speeds v_i = w_i^2: the torque about an axis is a row of the allocation matrix
    times v, the thrust is its first row times v, and v_i lies between the squares of the speed limits.
    """
    ranges = []
    for axis, (name, inertia) in enumerate(zip(AXES, vehicle.inertia, strict=True)):
        (low, high), (low_pure, high_pure) = (_extremes(vehicle, 1 + axis, pure=pure) for pure in (False, True))
        ranges.append(TorqueRange(name, low, high, low_pure, high_pure, low / inertia, high / inertia))
    return tuple(ranges)


def integrator_chains(A_c: Array) -> tuple[int, ...]:
    """Sizes of the Jordan blocks of a nilpotent matrix (n, n), longest first: its chains of integrators.

    rank A^(k-1) - rank A^k counts the blocks of size k or more.
    """
    ranks = [np.linalg.matrix_rank(np.linalg.matrix_power(A_c, k)) for k in range(A_c.shape[0] + 1)]
    assert ranks[-1] == 0, "the hover model has poles away from zero"
    at_least = [int(before - after) for before, after in itertools.pairwise(ranks)]
    return tuple(sum(count > i for count in at_least) for i in range(at_least[0]))


def sheet_to_json(vehicle: Vehicle, sheet: VehicleSheet, sources: Mapping[str, str]) -> dict[str, Any]:
    """All of it as plain values: the vehicle, each parameter with unit and source, and what follows from them."""
    parameters = {
        name: {"value": value, "unit": unit, "source": sources[name]} for name, value, unit in _parameters(vehicle)
    }
    about = {"name": vehicle.name, "description": vehicle.description}
    return {**about, "parameters": parameters, "derived": asdict(sheet)}


def sheet_tables(vehicle: Vehicle, sheet: VehicleSheet, sources: Mapping[str, str]) -> list[Grid]:
    """All of it as tables: figures, torques, linear model, parameters."""
    return [
        _grid(f"{vehicle.name} at hover", ("", "value", "unit"), _figures(vehicle, sheet), note=vehicle.description),
        _grid(
            "torque authority at hover",
            ("axis", "torque [N m]", "acceleration [rad/s^2]", "pure torque [N m]"),
            [
                (
                    torque.axis,
                    _span(torque.lowest, torque.highest),
                    _span(torque.lowest_acceleration, torque.highest_acceleration),
                    _span(torque.lowest_pure, torque.highest_pure),
                )
                for torque in sheet.torques
            ],
            note="thrust kept at the weight, every rotor within its range; pure: no torque about the other axes",
        ),
        _grid("linear model at hover", ("", "continuous [1/s]", f"discrete, {1e3 * sheet.period:g} ms"), _poles(sheet)),
        _grid(
            "parameters",
            ("parameter", "value", "unit", "source"),
            [(name, _value(value), unit, sources[name]) for name, value, unit in _parameters(vehicle)],
            note="short names of sources are spelt out at the head of the vehicle's file",
        ),
    ]


def _parameters(vehicle: Vehicle) -> list[tuple[str, Any, str]]:
    """Name, value and unit of those that the file gives."""
    given = ((name, getattr(vehicle, name), unit) for name, unit in VEHICLE_UNITS.items())
    return [(name, value, unit) for name, value, unit in given if value is not None]


def _extremes(vehicle: Vehicle, row: int, *, pure: bool) -> tuple[float, float]:
    """Smallest and largest torque [N m] of one row of the allocation matrix; `pure`: the other torques vanish."""
    top = vehicle.speed_max**2
    matrix = top * vehicle.allocation  # in v / speed_max^2, so that the programme is well scaled
    units = np.abs(matrix).max(axis=1)
    fixed = [0, *(other for other in (1, 2, 3) if pure and other != row)]
    equal = [vehicle.mass * vehicle.gravity / units[0], *np.zeros(len(fixed) - 1)]
    found = []
    for sign in (1.0, -1.0):
        solution = linprog(
            sign * matrix[row] / units[row],
            A_eq=matrix[fixed] / units[fixed, None],
            b_eq=equal,
            bounds=(vehicle.speed_min**2 / top, 1.0),
            method="highs",
        )
        assert solution.success, "hover itself is feasible"
        found.append(float(sign * solution.fun * units[row]))
    return found[0], found[1]


def _figures(vehicle: Vehicle, sheet: VehicleSheet) -> list[tuple[str, ...]]:
    slopes = sheet.input_slopes
    return [
        ("mass", format_number(vehicle.mass), "kg"),
        ("weight", format_number(sheet.weight), "N"),
        ("hover speed", format_number(sheet.hover_speed), "rad/s"),
        ("", format_number(sheet.hover_speed_rpm), "rpm"),
        ("speed range used", f"{100.0 * sheet.speed_range_used:.1f}", "%"),
        ("thrust to weight", format_number(sheet.thrust_to_weight), "-"),
        ("largest climb acceleration", format_number(sheet.climb_acceleration), "m/s^2"),
        ("largest steady tilt", format_number(sheet.steady_tilt), "deg"),
        ("thrust of one rotor per rad/s", format_number(sheet.thrust_slope), "N s/rad"),
        ("climb per rad/s of one rotor, as modelled", format_number(slopes["vz"]), "m/s^2 per rad/s"),
        *(
            (f"{name} per rad/s of one rotor, as modelled", format_number(slopes[f"{name}_rate"]), "rad/s^2 per rad/s")
            for name in ("roll", "pitch", "yaw")
        ),
    ]


def _poles(sheet: VehicleSheet) -> list[tuple[str, ...]]:
    chains = ", ".join(str(length) for length in sheet.integrator_chains)
    body = f"rigid body: {len(sheet.continuous_poles)} poles, chains of {chains} integrators"
    lines: list[tuple[str, ...]] = [(body, "0", "1")]
    for name, pole in sheet.lag_poles.items():
        label = f"rotors that {'rise' if name == 'rotor_rise' else 'fall'}: {N_ROTORS} poles, unknown to the controller"
        lines.append((label, format_number(pole), format_number(sheet.discrete_lag_poles[name])))
    return lines


def _grid(title: str, head: tuple[str, ...], lines: list[tuple[str, ...]], note: str = "") -> Grid:
    cells = tuple(tuple(Cell(text=text) for text in line) for line in lines)
    return Grid(key=head[0], title=title, head=head, lines=cells, note=note)


def _span(low: float, high: float) -> str:
    return f"{format_number(low)} .. {format_number(high)}"


def _value(value: object) -> str:
    return ", ".join(f"{item:g}" for item in value) if isinstance(value, tuple) else f"{value:g}"
