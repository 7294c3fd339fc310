"""A thrust stand's table as numbers of a vehicle file: thrust b w^2, torque d w^2, by least squares.

Where a linear term makes the difference, thrust = a1 w + a2 w^2: the vehicle's `thrust_of_speed`.  With the throttle u
in place of the speed, thrust = a1 u + a2 u^2: its `thrust_of_throttle`; where the curve begins at a throttle u0, or has
begun without any, thrust = a1 v + a2 v^2 with v = (u - u0) / (1 - u0): `throttle_offset`, which a line of speed over
throttle gives, too.  With the coefficients of a propeller of diameter D, thrust = CT rho n^2 D^4 and torque =
CP rho n^2 D^5 / (2 pi), n = w / (2 pi).
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import tomlkit
from scipy.optimize import nnls

from quadsim.errors import FileError, InputError, ParameterError
from quadsim.features.design.stand_table import StandTable, read_stand
from quadsim.plausibility import AIR_DENSITY
from quadsim.state import Array
from quadsim.ties import TIE_SHARE, first_smallest
from quadsim.vehicle import N_ROTORS, VEHICLE_UNITS, Vehicle

_WORST: Final = 0.1  # RMS of what is left, over the largest value, at most
_FULL: Final = 0.95  # throttle above which the fastest row is at full throttle
_FLAT: Final = 0.2  # a top row whose slope is below this share of the mean slope up to it is saturated
_LOWEST: Final = 0.2  # throttle of the first row above which a table does not show where its curve begins
_SLOWEST: Final = 0.5  # speed of the first row, over the largest, above which it does not show a linear term
_SMALL: Final = 0.005  # what a map without offset, or without a linear term, may leave (RMS, of the largest value)
_BETTER: Final = 0.5  # share of it that one with them leaves at most, to be taken
_REST: Final = 0.02  # thrust over the largest that a rotor at rest may show
_OFFSETS: Final = np.round(np.arange(-0.5, 0.501, 0.005), 3)
"""Throttles at which a curve may begin."""
_STRONGEST: Final = 1.5  # thrust of one rotor over the vehicle's weight from which it may be that of four
_MAPS: Final = ("thrust_coefficient", "thrust_of_speed", "thrust_of_throttle")
"""Parameters of which a vehicle file has one."""
_PARAMETER_UNITS: Final = {
    "thrust_coefficient": "N s^2/rad^2",
    "thrust_of_speed": "N s/rad, N s^2/rad^2",
    "thrust_of_throttle": "N",
    "throttle_offset": "-",
    "drag_to_thrust": "m",
    "speed_max": "rad/s",
}


@dataclass(frozen=True, kw_only=True)
class StandFit:
    """Numbers of one rotor by its stand."""

    columns: dict[str, Array]  # by quantity, in SI units, the rows that were fitted
    fitted: Array  # thrust of each row [N]
    thrust_error: float  # RMS over the largest thrust [-]
    law: str  # of the thrust, as text
    thrust_coefficient: float | None = None  # [N s^2/rad^2]; None where another of these three is given
    thrust_of_speed: tuple[float, float] | None = None  # a1 [N s/rad] and a2 [N s^2/rad^2]
    thrust_of_throttle: tuple[float, float] | None = None  # a1 and a2 [N]
    throttle_offset: float | None = None  # u0 [-]; None where the table does not show it
    drag_to_thrust: float | None = None  # [m]
    torque_error: float | None = None  # RMS over the largest torque [-]
    speed_max: float | None = None  # the fastest row's [rad/s]
    notes: tuple[str, ...] = ()  # what was left out, or taken, for a reader


@dataclass(frozen=True, kw_only=True)
class _Curve:
    """Thrust over speed or throttle."""

    parameters: dict[str, Any]  # of the vehicle file, by name
    law: str  # as text
    fitted: Array  # thrust of each row [N]


def fit_stand(path: Path, *, rotors: int = 1, diameter: float | None = None, speed_min: float = 0.0) -> StandFit:
    """Fit the table of a thrust stand.

    Args:
        path: CSV table; see `quadsim.features.design.stand_table`.
        rotors: how many rotors its thrust and torque are of.
        diameter: of the propeller [m], for a table of coefficients.
        speed_min: lowest speed at which a rotor turns in flight [rad/s], from which on its thrust must rise.

    Raises:
        FileError: it is no such table, or does not follow the law; the message names the column.
    """
    table = read_stand(path)
    columns = _of_one_rotor(path, table, rotors, diameter)
    kept, notes = _rising(columns, table)
    rows = {name: column[kept] for name, column in columns.items()}
    numbers = table.numbers[kept]
    thrust = rows["thrust"]
    found: dict[str, Any] = {}
    if "speed" in rows:
        _require_rest(path, rows["speed"], thrust, numbers)
        curve = _of_speed(rows["speed"], thrust, speed_min)
        found["speed_max"] = float(columns["speed"].max())
        found["throttle_offset"] = _offset_of_speed(columns)
    else:
        highest = float(columns["throttle"].max())
        if highest < _FULL:
            raise FileError(path, f"throttle must reach {_FULL:.0%} where no speed is measured; got {highest:.0%}")
        curve = _of_throttle(rows["throttle"], thrust)
    found |= curve.parameters
    error = _error(path, "thrust", thrust, curve.fitted, curve.law, numbers)
    torque = rows.get("torque")
    if torque is not None:
        ratio = float(curve.fitted @ torque / (curve.fitted @ curve.fitted))
        found["drag_to_thrust"] = ratio
        found["torque_error"] = _error(path, "torque", torque, ratio * curve.fitted, "d w^2", numbers)
    return StandFit(
        columns=rows,
        fitted=curve.fitted,
        thrust_error=error,
        law=curve.law,
        notes=(*table.notes, *notes),
        **found,
    )


def _require_rest(path: Path, speed: Array, thrust: Array, numbers: Array) -> None:
    """Refuse thrust of a rotor at rest."""
    most = _REST * float(thrust.max())
    resting = np.flatnonzero((speed <= 0.0) & (thrust > most * (1.0 + TIE_SHARE)))
    if resting.size:
        first = resting[0]
        rule = f"thrust must be at most {most:.3g} N at speed 0, {_REST:.0%} of the largest; got {thrust[first]:.4g} N"
        raise FileError(path, f"row {numbers[first]}: {rule}. Tare the stand, or leave out rows without a speed")


def _of_speed(speed: Array, thrust: Array, speed_min: float) -> _Curve:
    """Return b w^2; or a1 w + a2 w^2, where that leaves much less and is not negative from `speed_min` on."""
    load = np.square(speed)
    coefficient = float(load @ thrust / (load @ load))
    square = _Curve(parameters={"thrust_coefficient": coefficient}, law="b w^2", fitted=coefficient * load)
    a1, a2 = _two_terms(speed, thrust)
    mapped = _Curve(
        parameters={"thrust_of_speed": (a1, a2)}, law="a1 w + a2 w^2", fitted=np.maximum(a1 * speed + a2 * load, 0.0)
    )
    shown = float(speed.min()) <= (_SLOWEST + TIE_SHARE) * float(speed.max())
    rises = a2 > 0.0 and a1 + a2 * speed_min >= 0.0
    if shown and rises and _is_better(mapped.fitted, square.fitted, thrust):
        return mapped
    return square


def _of_throttle(throttle: Array, thrust: Array) -> _Curve:
    """Return a1 u + a2 u^2; or the same of v, where an offset leaves much less."""
    plain = _from(0.0, throttle, thrust)
    if float(throttle.min()) > _LOWEST + TIE_SHARE:
        return plain
    curves = [_from(float(offset), throttle, thrust) for offset in _OFFSETS]
    errors = [_rms(curve.fitted, thrust) for curve in curves]
    best = curves[first_smallest(errors, TIE_SHARE * float(thrust.max()))]
    if _is_better(best.fitted, plain.fitted, thrust):
        return best
    return plain


def _from(offset: float, throttle: Array, thrust: Array) -> _Curve:
    """Return the curve a1 v + a2 v^2, v = (u - u0) / (1 - u0), that begins at a throttle and never falls."""
    v = np.clip((throttle - offset) / (1.0 - offset), 0.0, 1.0)
    a1, a2 = _two_terms(v, thrust)
    if a1 < 0.0 or a1 + 2.0 * a2 <= 0.0:  # of slopes s0 at v = 0 and s1 at v = 1 that are not negative
        (start, end), _ = nnls(np.stack([v - 0.5 * v**2, 0.5 * v**2], axis=1), thrust)
        a1 = float(start)
        a2 = 0.5 * float(end - start)
    law = "a1 u + a2 u^2"
    if offset:
        law = "a1 v + a2 v^2"
    parameters = {"thrust_of_throttle": (a1, a2), "throttle_offset": offset}
    return _Curve(parameters=parameters, law=law, fitted=a1 * v + a2 * v**2)


def _two_terms(x: Array, y: Array) -> tuple[float, float]:
    """Return a1 and a2 of y = a1 x + a2 x^2, by least squares."""
    (a1, a2), *_ = np.linalg.lstsq(np.stack([x, x**2], axis=1), y, rcond=None)
    return float(a1), float(a2)


def _offset_of_speed(columns: Mapping[str, Array]) -> float | None:
    """Return u0 of the line w = (u - u0) / (1 - u0) w_max; 0 where w_max u is as good, None where no row shows it."""
    throttle = columns.get("throttle")
    if throttle is None:
        return None
    turning = columns["speed"] > 0.0
    u = throttle[turning]
    if float(u.min()) > _LOWEST + TIE_SHARE or float(u.max()) < _FULL:
        return None
    share = columns["speed"][turning] / float(columns["speed"].max())
    rest = 1.0 - u
    slope = float(rest @ (1.0 - share) / (rest @ rest))
    offset = round(1.0 - 1.0 / slope, 3)
    line = 1.0 - slope * rest
    if abs(offset) <= float(_OFFSETS.max()) and _is_better(line, u, share):
        return offset
    return 0.0


def _rms(fitted: Array, measured: Array) -> float:
    return float(np.sqrt(np.square(measured - fitted).mean()))


def _is_better(fitted: Array, plain: Array, measured: Array) -> bool:
    """Return whether a fit with one number more than the plain one leaves so much less that it is taken."""
    left = _rms(plain, measured)
    return left > _SMALL * float(measured.max()) and _rms(fitted, measured) <= _BETTER * left


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
        FileError: as of `fit_stand`, or no vehicle can have the thrust.
        InputError: `rotors` must be stated.
    """
    document = tomlkit.parse(start)
    tables: Mapping[str, Any] = document.unwrap()
    slowest = float(tables["speed_min"]["value"])
    fit = fit_stand(stand, rotors=rotors or 1, diameter=diameter, speed_min=slowest)
    if rotors is None:
        _require_of_one(fit, float(tables["mass"]["value"]), float(tables["gravity"]["value"]))
    numbers = _numbers(fit)
    if not fit.throttle_offset and "throttle_offset" not in document:
        numbers.pop("throttle_offset", None)
    rows = _rows_text(fit, rotors or 1)
    sources = _sources(fit, f"thrust stand {stand.name}, {rows}")
    replaced = [name for name in _MAPS if name in document and name not in numbers]
    added = [name for name in numbers if name not in document]
    document = tomlkit.parse(_with_tables(start, added, replaced))
    for name in replaced:
        document.pop(name, None)
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
    doubts = _doubts(stand, document.unwrap())
    head = "".join(f"# {line}\n" for line in (*_fit_lines(fit, f"{stand.name}: {rows}", replaced), *doubts))
    notes = [*fit.notes, *doubts]
    data = {**numbers, "thrust_error": fit.thrust_error, "torque_error": fit.torque_error, "notes": notes}
    return f"{head}\n{tomlkit.dumps(document)}", data


def _with_tables(text: str, added: Iterable[str], replaced: Iterable[str]) -> str:
    """Return a vehicle file's text whose comments stay above the tables that they explain.

    Tables that are replaced become comments; comments that hold an added table become that table, to be filled in.
    """
    document = tomlkit.parse(text)
    for name in replaced:
        stated = _stated(name, document[name])
        commented = "".join(f"# {line}" for line in stated.splitlines(keepends=True))
        text = text.replace(stated, commented)
    for name in added:
        commented_table = rf"^# \[{name}\]\n(?:# (?:value|unit|source) = .*\n)+"
        empty_table = f'[{name}]\nvalue = 0\nunit = "{_PARAMETER_UNITS[name]}"\nsource = ""\n'
        text = re.sub(commented_table, empty_table, text, count=1, flags=re.MULTILINE)
    return text


def _stated(name: str, table: Any) -> str:
    """Return the text of a table up to its last value, without the comments below, which are the next table's."""
    text = f"[{name}]\n{table.as_string()}"
    below = ""
    for key, item in reversed(table.value.body):
        if key is not None:
            break
        below = item.as_string() + below
    return text.removesuffix(below)


def _doubts(path: Path, tables: Mapping[str, Any]) -> tuple[str, ...]:
    """Return why a file's numbers do not make a vehicle yet; nothing if they do.

    Raises:
        FileError: it is the thrust, whatever the others are.
    """
    values = {name: table["value"] for name, table in tables.items() if name in VEHICLE_UNITS}
    try:
        Vehicle(name=str(tables["name"]), **values)
    except ParameterError as error:
        lifts = "hover" in error.rule
        if error.name in _MAPS and not lifts:
            raise FileError(path, str(error)) from None
        return (f"not yet a vehicle, other numbers than the stand's must suit it: {error}",)
    return ()


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


def _rows_text(fit: StandFit, rotors: int) -> str:
    """Return how many rows were fitted, and of how many rotors."""
    rows = len(fit.fitted)
    if rotors == 1:
        return f"{rows} rows of one rotor"
    return f"{rows} rows of {rotors} rotors together, divided by {rotors}"


def _require_of_one(fit: StandFit, mass: float, gravity: float) -> None:
    """Ask how many rotors a table is of, where one of them would be stronger than those of vehicles are."""
    strongest = float(fit.columns["thrust"].max()) / (mass * gravity)
    if strongest < _STRONGEST - TIE_SHARE:
        return
    each = N_ROTORS * strongest
    together = strongest
    raise InputError(
        f"--rotors must be stated, 1 or {N_ROTORS}, the rotors that the stand's table is of: a vehicle of "
        f"{mass:.4g} kg would lift {each:.1f} times its weight with a table of one, {together:.1f} times with one of "
        f"{N_ROTORS}"
    )


def _numbers(fit: StandFit) -> dict[str, Any]:
    """Return the parameters that a fit gives, by name."""
    found = {
        "thrust_coefficient": fit.thrust_coefficient,
        "thrust_of_speed": fit.thrust_of_speed,
        "thrust_of_throttle": fit.thrust_of_throttle,
        "throttle_offset": fit.throttle_offset,
        "drag_to_thrust": fit.drag_to_thrust,
        "speed_max": fit.speed_max,
    }
    return {name: value for name, value in found.items() if value is not None}


def _sources(fit: StandFit, of: str) -> dict[str, str]:
    """Return the origin of each parameter."""
    thrust = f"{of}: {fit.law}, to {fit.thrust_error:.1%} of the largest thrust (RMS)"
    sources = dict.fromkeys(_MAPS, thrust)
    if fit.thrust_of_throttle is None:
        sources["throttle_offset"] = f"{of}: where the line of speed over throttle meets 0"
    else:
        sources["throttle_offset"] = f"{of}: where the curve of thrust over throttle begins"
    if fit.torque_error is not None:
        sources["drag_to_thrust"] = f"{of}: d w^2, to {fit.torque_error:.1%} of the largest torque (RMS)"
    throttle = fit.columns.get("throttle")
    fastest = "the fastest row"
    if throttle is not None and throttle.max() < _FULL:
        fastest = f"only {throttle.max():.0%} throttle: it turns faster"
    sources["speed_max"] = f"{of}: {fastest}"
    return sources


def _fit_lines(fit: StandFit, rows: str, replaced: list[str]) -> list[str]:
    """Return the fit as lines of text: what was fitted, what was left out or replaced, and each row."""
    lines = [
        f"Fit to {rows}, to {fit.thrust_error:.1%} of the largest thrust (RMS)",
        *_law_lines(fit),
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


def _law_lines(fit: StandFit) -> Iterator[str]:
    """Yield the law of the thrust with its numbers, and that of the throttle."""
    u = "u"
    if fit.throttle_offset:
        u = "v"
    if fit.thrust_of_throttle is not None:
        a1, a2 = fit.thrust_of_throttle
        yield f"thrust = {a1:.4g} {u} + {a2:.4g} {u}^2 N, u the throttle"
    elif fit.thrust_of_speed is not None:
        a1, a2 = fit.thrust_of_speed
        yield f"thrust = {a1:.4g} w + {a2:.4g} w^2 N, w the speed"
    else:
        yield "thrust = b w^2, w the speed"
    if fit.throttle_offset:
        line = f"v = (u {-fit.throttle_offset:+.4g}) / {1.0 - fit.throttle_offset:.4g}"
        if fit.thrust_of_throttle is None:
            line = f"speed = v {fit.speed_max:.4g} rad/s, u the throttle, {line}"
        yield line


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
