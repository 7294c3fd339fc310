"""A thrust stand's table as numbers of a vehicle file: thrust b w^2, torque d w^2, by least squares.

With the throttle u in place of the speed, thrust = T (a1 u + a2 u^2), a1 + a2 = 1, T that of full throttle: b then
holds for the highest speed of the vehicle file, which no such table shows.
"""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import tomlkit

from quadsim.errors import FileError
from quadsim.state import Array
from quadsim.ties import TIE_SHARE, first_smallest

_GRAM: Final = 9.80665e-3  # [N]
_UNITS: Final[dict[str, dict[str, float]]] = {
    "speed": {"rad/s": 1.0, "rpm": math.tau / 60.0},
    "throttle": {"-": 1.0, "%": 0.01},
    "thrust": {"N": 1.0, "g": _GRAM, "kg": 1e3 * _GRAM},
    "torque": {"N m": 1.0, "N cm": 0.01, "N mm": 1e-3},
}
"""Columns of the table, and their units; `rpm` is a speed in rpm."""
_NAME: Final = re.compile(r"\s*(\w+)\s*(?:[\[(]\s*(.*?)\s*[\])])?\s*")
_LARGEST: Final = 1_000_000  # [bytes]
_FEWEST: Final = 3  # rows
_WORST: Final = 0.1  # RMS of what is left, over the largest value, at most
_FULL: Final = 0.95  # throttle above which the fastest row is at full throttle


@dataclass(frozen=True, kw_only=True)
class StandFit:
    """Numbers of one rotor by its stand."""

    rows: dict[str, Array]  # by column, in SI units
    thrust_coefficient: float  # [N s^2/rad^2]
    thrust_error: float  # RMS over the largest thrust [-]
    fitted: Array  # thrust of each row [N]
    drag_to_thrust: float | None = None  # [m]
    torque_error: float | None = None  # RMS over the largest torque [-]
    speed_max: float | None = None  # the fastest row's [rad/s]
    throttle_curve: tuple[float, float] | None = None  # a1 and a2 [-]; None where the speed is measured


def fit_stand(path: Path, speed_max: float) -> StandFit:
    """Fit the table of a thrust stand.

    Args:
        path: CSV table of one rotor.
        speed_max: speed at full throttle [rad/s], used where the table has the throttle alone.

    Raises:
        FileError: it is no such table, or does not follow the law; the message names the column.
    """
    rows = _read(path)
    thrust = rows["thrust"]
    curve = None
    if "speed" in rows:
        load = rows["speed"] ** 2
        coefficient = float(load @ thrust / (load @ load))
        fitted = coefficient * load
    else:
        u = rows["throttle"]
        if u.max() < _FULL:
            raise FileError(path, f"throttle must reach {_FULL:.0%} where no speed is measured; got {u.max():.0%}")
        (a1, a2), *_ = np.linalg.lstsq(np.stack([u, u**2], axis=1), thrust, rcond=None)
        coefficient, curve = float(a1 + a2) / speed_max**2, (float(a1 / (a1 + a2)), float(a2 / (a1 + a2)))
        fitted = a1 * u + a2 * u**2
        load = fitted / coefficient
    error = _error(path, "thrust", thrust, fitted, "b w^2" if curve is None else "a1 u + a2 u^2")
    torque = rows.get("torque")
    drag = None if torque is None else float(load @ torque / (load @ load))
    return StandFit(
        rows=rows,
        thrust_coefficient=coefficient,
        thrust_error=error,
        fitted=fitted,
        drag_to_thrust=None if drag is None else drag / coefficient,
        torque_error=None if torque is None or drag is None else _error(path, "torque", torque, drag * load, "d w^2"),
        speed_max=float(rows["speed"].max()) if "speed" in rows else None,
        throttle_curve=curve,
    )


def stand_vehicle_text(stand: Path, start: str) -> tuple[str, dict[str, Any]]:
    """Return a vehicle file's text with the numbers of a stand in it, the fit above them, and the numbers alone.

    Raises:
        FileError: as of `fit_stand`.
    """
    document = tomlkit.parse(start)
    tables: Mapping[str, Any] = document.unwrap()
    fit = fit_stand(stand, float(tables["speed_max"]["value"]))
    count, of = len(fit.fitted), f"{stand.name}, {len(fit.fitted)} rows"
    law = "b w^2" if fit.throttle_curve is None else f"for speed_max = {tables['speed_max']['value']:g} rad/s, as kept"
    sources = {"thrust_coefficient": f"thrust stand {of}: {law}, to {fit.thrust_error:.1%} of the largest thrust (RMS)"}
    numbers: dict[str, float] = {"thrust_coefficient": fit.thrust_coefficient}
    if fit.drag_to_thrust is not None and fit.torque_error is not None:
        numbers["drag_to_thrust"] = fit.drag_to_thrust
        sources["drag_to_thrust"] = f"thrust stand {of}: d w^2, to {fit.torque_error:.1%} of the largest torque (RMS)"
    if fit.speed_max is not None:
        numbers["speed_max"] = fit.speed_max
        throttle = fit.rows.get("throttle")
        full = throttle is None or throttle.max() >= _FULL
        at = "the fastest row" if full or throttle is None else f"only {throttle.max():.0%} throttle: it turns faster"
        sources["speed_max"] = f"thrust stand {of}: {at}"
    for name in ("thrust_of_speed", "thrust_of_throttle"):  # which the coefficient replaces
        document.pop(name, None)
    for name, value in numbers.items():
        table: Any = document.get(name)
        if table is None:
            table = document[name] = tomlkit.table()
            table["unit"] = {"drag_to_thrust": "m", "speed_max": "rad/s"}.get(name, "N s^2/rad^2")
        table["value"], table["source"] = float(f"{value:.4g}"), sources[name]
    lines = [f"Fit to {stand.name}: {count} rows of one rotor, {sources['thrust_coefficient'].partition(': ')[2]}"]
    if fit.throttle_curve is not None:
        lines.append(
            "thrust over that of full throttle = {:.3g} u + {:.3g} u^2, u the throttle".format(*fit.throttle_curve)
        )
    by = "speed" if "speed" in fit.rows else "throttle"
    lines.append(f"{f'{by} ({next(iter(_UNITS[by]))})':>14} {'thrust (N)':>12} {'fitted (N)':>12} {'error':>8}")
    largest = float(fit.rows["thrust"].max())
    for x, measured, fitted in zip(fit.rows[by], fit.rows["thrust"], fit.fitted, strict=True):
        lines.append(f"{x:14.4g} {measured:12.4g} {fitted:12.4g} {(fitted - measured) / largest:8.1%}")
    head = "".join(f"# {line}\n" for line in lines)
    data = {**numbers, "thrust_error": fit.thrust_error, "torque_error": fit.torque_error}
    return f"{head}\n{tomlkit.dumps(document)}", {**data, "throttle_curve": fit.throttle_curve}


def _read(path: Path) -> dict[str, Array]:
    """The columns of a table in SI units."""
    try:
        if (size := path.stat().st_size) > _LARGEST:
            raise FileError(path, f"must be of {_LARGEST} or fewer bytes; got {size}")
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise FileError(path, f"cannot be read ({error})") from error
    head, *lines = [row for row in csv.reader(io.StringIO(text)) if any(cell.strip() for cell in row)] or [[]]
    places: dict[str, tuple[int, float]] = {}
    for place, cell in enumerate(head):
        match = _NAME.fullmatch(cell)
        name, unit = (match[1].lower(), match[2]) if match else ("", None)
        name, unit = ("speed", "rpm") if name == "rpm" else (name, unit)
        if name not in _UNITS:
            continue
        unit = "-" if name == "throttle" and unit is None else unit
        if unit not in _UNITS[name]:
            allowed = " or ".join(f"{name} [{one}]" for one in _UNITS[name])
            raise FileError(path, f"column {cell.strip()!r} must state its unit: {allowed}")
        if name in places:
            raise FileError(path, f"has two columns of {name}; keep one")
        places[name] = place, _UNITS[name][unit]
    if "thrust" not in places or not {"speed", "throttle"} & {*places}:
        there = ", ".join(cell.strip() for cell in head) or "nothing"
        raise FileError(path, f"needs thrust [N] and rpm, speed [rad/s] or throttle; it has {there}")
    columns: dict[str, list[float]] = {name: [] for name in places}
    for number, row in enumerate(lines, start=2):
        for name, (place, scale) in places.items():
            cell = row[place].strip() if place < len(row) else ""
            try:
                value = float(cell) * scale
            except ValueError:
                value = math.nan
            if not math.isfinite(value) or (value < 0.0 and name != "torque"):
                raise FileError(path, f"row {number}: {name} must be a number, 0 or above; got {cell!r:.40}")
            columns[name].append(abs(value))
    if len(lines) < _FEWEST or not min(max(columns[name]) for name in columns):
        raise FileError(path, f"needs {_FEWEST} rows or more with the rotor turning; got {len(lines)}")
    if "throttle" in columns and max(columns["throttle"]) > 1.0:
        largest = max(columns["throttle"])
        raise FileError(path, f"throttle must be a share, 0 to 1, or throttle [%]; got {largest:g}")
    return {name: np.array(values) for name, values in columns.items()}


def _error(path: Path, name: str, measured: Array, fitted: Array, law: str) -> float:
    """RMS of what is left of a column over its largest value."""
    error = float(np.sqrt(np.square(measured - fitted).mean()) / measured.max())
    if error > _WORST:
        worst = first_smallest(-np.abs(measured - fitted), TIE_SHARE * float(measured.max()))
        pair = f"{measured[worst]:.4g} measured and {fitted[worst]:.4g} fitted"
        what = f"{name} does not follow {law}: {error:.0%} of the largest is left (RMS), at most {_WORST:.0%} may be"
        raise FileError(path, f"{what}; worst is row {worst + 2}, {pair}. Tare the stand, look for another unit")
    return error
