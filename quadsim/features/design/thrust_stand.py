"""A thrust stand's table as numbers of a vehicle file: thrust b w^2, torque d w^2, by least squares.

With the throttle u in place of the speed, thrust = a1 u + a2 u^2: the vehicle's `thrust_of_throttle`.  With the
coefficients of a propeller of diameter D, thrust = CT rho n^2 D^4 and torque = CP rho n^2 D^5 / (2 pi), n = w / (2 pi).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import tomlkit

from quadsim.errors import FileError, InputError
from quadsim.features.design.stand_table import StandTable, read_stand
from quadsim.plausibility import AIR_DENSITY
from quadsim.state import Array
from quadsim.ties import TIE_SHARE, first_smallest
from quadsim.vehicle import N_ROTORS

_WORST: Final = 0.1  # RMS of what is left, over the largest value, at most
_FULL: Final = 0.95  # throttle above which the fastest row is at full throttle
_FLAT: Final = 0.2  # a top row whose slope is below this share of the mean slope up to it is saturated
_STRONGEST: Final = 1.5  # thrust of one rotor over the vehicle's weight from which it may be that of four
_MAPS: Final = ("thrust_coefficient", "thrust_of_speed", "thrust_of_throttle")
"""Parameters of which a vehicle file has one."""
_PARAMETER_UNITS: Final = {
    "thrust_coefficient": "N s^2/rad^2",
    "thrust_of_throttle": "N",
    "drag_to_thrust": "m",
    "speed_max": "rad/s",
}


@dataclass(frozen=True, kw_only=True)
class StandFit:
    """Numbers of one rotor by its stand."""

    columns: dict[str, Array]  # by quantity, in SI units, the rows that were fitted
    fitted: Array  # thrust of each row [N]
    thrust_error: float  # RMS over the largest thrust [-]
    thrust_coefficient: float | None = None  # [N s^2/rad^2]; None where the speed is not measured
    thrust_of_throttle: tuple[float, float] | None = None  # a1 and a2 [N]; None where the speed is measured
    drag_to_thrust: float | None = None  # [m]
    torque_error: float | None = None  # RMS over the largest torque [-]
    speed_max: float | None = None  # the fastest row's [rad/s]
    notes: tuple[str, ...] = ()  # what was left out, or taken, for a reader


def fit_stand(path: Path, *, rotors: int = 1, diameter: float | None = None) -> StandFit:
    """Fit the table of a thrust stand.

    Args:
        path: CSV table; see `quadsim.features.design.stand_table`.
        rotors: how many rotors its thrust and torque are of.
        diameter: of the propeller [m], for a table of coefficients.

    Raises:
        FileError: it is no such table, or does not follow the law; the message names the column.
    """
    table = read_stand(path)
    columns = _of_one_rotor(path, table, rotors, diameter)
    kept, notes = _rising(columns, table)
    rows = {name: column[kept] for name, column in columns.items()}
    numbers = table.numbers[kept]
    thrust = rows["thrust"]
    notes = (*table.notes, *notes)
    if "speed" in rows:
        load = np.square(rows["speed"])
        coefficient = float(load @ thrust / (load @ load))
        fitted = coefficient * load
        error = _error(path, "thrust", thrust, fitted, "b w^2", numbers)
        found: dict[str, Any] = {
            "thrust_coefficient": coefficient,
            "speed_max": float(columns["speed"].max()),
        }
    else:
        u = rows["throttle"]
        highest = float(columns["throttle"].max())
        if highest < _FULL:
            raise FileError(path, f"throttle must reach {_FULL:.0%} where no speed is measured; got {highest:.0%}")
        (a1, a2), *_ = np.linalg.lstsq(np.stack([u, u**2], axis=1), thrust, rcond=None)
        fitted = a1 * u + a2 * u**2
        error = _error(path, "thrust", thrust, fitted, "a1 u + a2 u^2", numbers)
        found = {"thrust_of_throttle": (float(a1), float(a2))}
    torque = rows.get("torque")
    if torque is not None:
        ratio = float(fitted @ torque / (fitted @ fitted))
        found["drag_to_thrust"] = ratio
        found["torque_error"] = _error(path, "torque", torque, ratio * fitted, "d w^2", numbers)
    return StandFit(columns=rows, fitted=fitted, thrust_error=error, notes=notes, **found)


def stand_vehicle_text(
    stand: Path, start: str, *, rotors: int | None = None, diameter: float | None = None
) -> tuple[str, dict[str, Any]]:
    """Return a vehicle file's text with the numbers of a stand in it, the fit above them, and the numbers alone.

    Args:
        stand: CSV table.
        start: text of the vehicle file whose other numbers stay.
        rotors: how many rotors the table is of, 1 or 4; None for one, unless that is stronger than any vehicle's.
        diameter: as in `fit_stand`.

    Raises:
        FileError: as of `fit_stand`.
        InputError: `rotors` must be stated.
    """
    document = tomlkit.parse(start)
    tables: Mapping[str, Any] = document.unwrap()
    fit = fit_stand(stand, rotors=rotors or 1, diameter=diameter)
    if rotors is None:
        _require_of_one(fit, float(tables["mass"]["value"]) * float(tables["gravity"]["value"]))
    numbers = _numbers(fit)
    sources = _sources(fit, f"thrust stand {stand.name}, {len(fit.fitted)} rows")
    replaced = [name for name in _MAPS if name in document and name not in numbers]
    for name in replaced:
        document.pop(name)
    for name, value in numbers.items():
        table: Any = document.get(name)
        if table is None:
            table = document[name] = tomlkit.table()
            table["unit"] = _PARAMETER_UNITS[name]
        if isinstance(value, tuple):
            table["value"] = [_rounded(one) for one in value]
        else:
            table["value"] = _rounded(value)
        table["source"] = sources[name]
    head = "".join(f"# {line}\n" for line in _fit_lines(fit, stand.name, replaced))
    data = {**numbers, "thrust_error": fit.thrust_error, "torque_error": fit.torque_error, "notes": list(fit.notes)}
    return f"{head}\n{tomlkit.dumps(document)}", data


def _of_one_rotor(path: Path, table: StandTable, rotors: int, diameter: float | None) -> dict[str, Array]:
    """Return the columns with thrust and torque of one rotor, from coefficients where these are given."""
    columns = dict(table.columns)
    if "thrust" not in columns:
        if diameter is None:
            raise FileError(path, "has a propeller's coefficients: --diameter, in m, must be given with them")
        turns = columns["speed"] / math.tau
        columns["thrust"] = columns["CT"] * AIR_DENSITY * turns**2 * diameter**4
        if "CP" in columns:
            columns["torque"] = columns["CP"] * AIR_DENSITY * turns**2 * diameter**5 / math.tau
    for name in ("thrust", "torque"):
        if name in columns:
            columns[name] = columns[name] / rotors
    return {name: columns[name] for name in ("speed", "throttle", "thrust", "torque") if name in columns}


def _rising(columns: Mapping[str, Array], table: StandTable) -> tuple[Array, tuple[str, ...]]:
    """Return which rows to fit, those below saturation, and a note of the rows that are left out."""
    by = "speed" if "speed" in columns else "throttle"
    x = columns[by]
    thrust = columns["thrust"]
    order = np.argsort(x, kind="stable")
    kept = np.ones(len(x), bool)
    for above, below in zip(order[:0:-1], order[-2::-1], strict=True):
        rise = float(x[above] - x[below])
        if rise <= TIE_SHARE * float(x[above]) or x[below] <= 0.0:
            break
        slope = float(thrust[above] - thrust[below]) / rise
        if slope >= (_FLAT - TIE_SHARE) * float(thrust[below] / x[below]):
            break
        kept[above] = False
    left_out = table.numbers[~kept]
    if not left_out.size:
        return kept, ()
    rows = ", ".join(str(number) for number in left_out)
    return kept, (f"left out as saturated, thrust no longer rises with the {by}: row {rows}",)


def _require_of_one(fit: StandFit, weight: float) -> None:
    """Ask how many rotors a table is of, where one of them would be stronger than those of vehicles are."""
    strongest = float(fit.columns["thrust"].max()) / weight
    if strongest < _STRONGEST - TIE_SHARE:
        return
    each = N_ROTORS * strongest
    together = strongest
    raise InputError(
        f"--rotors must be stated, 1 or {N_ROTORS}, the rotors that the stand's table is of: the vehicle would lift "
        f"{each:.1f} times its weight with a table of one, {together:.1f} times with a table of {N_ROTORS}"
    )


def _numbers(fit: StandFit) -> dict[str, Any]:
    """Return the parameters that a fit gives, by name."""
    found = {
        "thrust_coefficient": fit.thrust_coefficient,
        "thrust_of_throttle": fit.thrust_of_throttle,
        "drag_to_thrust": fit.drag_to_thrust,
        "speed_max": fit.speed_max,
    }
    return {name: value for name, value in found.items() if value is not None}


def _sources(fit: StandFit, of: str) -> dict[str, str]:
    """Return the origin of each parameter."""
    if fit.thrust_of_throttle is None:
        law = "b w^2"
    else:
        law = "a1 u + a2 u^2"
    thrust = f"{of}: {law}, to {fit.thrust_error:.1%} of the largest thrust (RMS)"
    sources = {"thrust_coefficient": thrust, "thrust_of_throttle": thrust}
    if fit.torque_error is not None:
        sources["drag_to_thrust"] = f"{of}: d w^2, to {fit.torque_error:.1%} of the largest torque (RMS)"
    throttle = fit.columns.get("throttle")
    fastest = "the fastest row"
    if throttle is not None and throttle.max() < _FULL:
        fastest = f"only {throttle.max():.0%} throttle: it turns faster"
    sources["speed_max"] = f"{of}: {fastest}"
    return sources


def _fit_lines(fit: StandFit, name: str, replaced: list[str]) -> list[str]:
    """Return the fit as lines of text: what was fitted, what was left out or replaced, and each row."""
    law = "thrust = b w^2, w the speed"
    if fit.thrust_of_throttle is not None:
        a1, a2 = fit.thrust_of_throttle
        law = f"thrust = {a1:.4g} u + {a2:.4g} u^2 N, u the throttle"
    lines = [
        f"Fit to {name}: {len(fit.fitted)} rows of one rotor, to {fit.thrust_error:.1%} of the largest thrust (RMS)",
        law,
        *fit.notes,
    ]
    if replaced:
        lines.append(f"replaces {' and '.join(replaced)} of the file")
    if "speed" in fit.columns:
        by, unit = ("speed", "rad/s")
    else:
        by, unit = ("throttle", "-")
    lines.append(f"{f'{by} ({unit})':>14} {'thrust (N)':>12} {'fitted (N)':>12} {'error':>8}")
    thrust = fit.columns["thrust"]
    largest = float(thrust.max())
    for x, measured, fitted in zip(fit.columns[by], thrust, fit.fitted, strict=True):
        lines.append(f"{x:14.4g} {measured:12.4g} {fitted:12.4g} {(fitted - measured) / largest:8.1%}")
    return lines


def _rounded(value: float) -> float:
    """Return a number with the four digits that a stand shows."""
    return float(f"{value:.4g}")


def _error(path: Path, name: str, measured: Array, fitted: Array, law: str, numbers: Array) -> float:
    """RMS of what is left of a column over its largest value."""
    error = float(np.sqrt(np.square(measured - fitted).mean()) / measured.max())
    if error > _WORST:
        worst = first_smallest(-np.abs(measured - fitted), TIE_SHARE * float(measured.max()))
        pair = f"{measured[worst]:.4g} measured and {fitted[worst]:.4g} fitted"
        what = f"{name} does not follow {law}: {error:.0%} of the largest is left (RMS), at most {_WORST:.0%} may be"
        raise FileError(path, f"{what}; worst is row {numbers[worst]}, {pair}. Tare the stand, look for another unit")
    return error
