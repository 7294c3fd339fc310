"""The table of a thrust stand as it is sold: its columns by quantity, in SI units.

A column's name says its quantity, and its unit stands in brackets: `Thrust (gf)`, `Torque (N·m)`, `ESC signal (µs)`,
`Average RPM`.  Cells are separated by commas, semicolons (then with decimal points or commas), tabs or blanks.  A
propeller's table has `CT` and `CP` in place of thrust and torque, by speed.
"""

from __future__ import annotations

import csv
import io
import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from quadsim.errors import FileError
from quadsim.state import Array
from quadsim.ties import TIE_SHARE

_GRAM: Final = 9.80665e-3  # [N]
_POUND: Final = 4.4482216152605  # [N]
_INCH: Final = 0.0254  # [m]
_RPM: Final = math.tau / 60.0  # [rad/s]
_UNITS: Final[dict[str, dict[str, float]]] = {
    "speed": {"rad/s": 1.0, "rpm": _RPM},
    "throttle": {"-": 1.0, "%": 0.01, "us": 1e-3},
    "thrust": {
        **{"N": 1.0, "mN": 1e-3, "g": _GRAM, "gf": _GRAM, "kg": 1e3 * _GRAM, "kgf": 1e3 * _GRAM},
        **{"lbf": _POUND, "ozf": _POUND / 16.0},
    },
    "torque": {"N m": 1.0, "N cm": 0.01, "N mm": 1e-3, "mN m": 1e-3, "ozf in": _POUND / 16.0 * _INCH},
    "CT": {"-": 1.0},
    "CP": {"-": 1.0},
}
"""Quantities of a column, and their units; a pulse in microseconds becomes milliseconds, counted from `_IDLE`."""
_NAMES: Final[dict[str, str]] = {
    **{"speed": "speed", "rpm": "speed", "averagerpm": "speed", "motorspeed": "speed", "rotationspeed": "speed"},
    **{"motoropticalspeed": "speed", "motorelectricalspeed": "speed", "rotorspeed": "speed"},
    **{"throttle": "throttle", "escsignal": "throttle", "esc": "throttle", "pwm": "throttle"},
    **{"thrust": "thrust", "torque": "torque", "ct": "CT", "cp": "CP"},
}
"""Quantity of a column by its name in lower case, without blanks."""
_NAME: Final = re.compile(r"\s*([^\[(]*?)\s*(?:[\[(]\s*(.*?)\s*[\])])?\s*")
_IDLE: Final = 1.0  # [ms] pulse of no throttle; that of full throttle takes twice as long
_LARGEST: Final = 1_000_000  # [bytes]
_FEWEST: Final = 3  # rows
_TARE: Final = 0.02  # a column may lie so much of its largest value below zero
_AGREE: Final = 0.05  # two columns of speed may differ by this share of the largest


@dataclass(frozen=True, kw_only=True)
class StandTable:
    """The rows of a stand, in the order of the file."""

    columns: dict[str, Array]  # by quantity, in SI units; throttle as a share, 0 to 1
    numbers: Array  # of the rows in the file, from 1, that of the header included
    notes: tuple[str, ...]  # what was taken of several columns, for a reader


def read_stand(path: Path) -> StandTable:
    """Read the table of a thrust stand, or a propeller's coefficients.

    Raises:
        FileError: it is no such table; the message names the column, the row and what is allowed.
    """
    head, lines, numbers = _cells(path)
    places = _places(path, head)
    columns = {}
    notes: list[str] = []
    for quantity, found in places.items():
        read = {place: _column(path, quantity, place, scale, lines, numbers) for place, scale in found.items()}
        place = _chosen(quantity, read, head, notes)
        columns[quantity] = read[place]
    by = {"speed", "throttle"} & {*columns}
    lifts = "thrust" in columns and by
    coefficients = "CT" in columns and "speed" in columns
    if not lifts and not coefficients:
        there = ", ".join(cell.strip() for cell in head) or "nothing"
        raise FileError(
            path, f"needs thrust [N] and rpm, speed [rad/s] or throttle, or a propeller's CT and rpm; it has {there}"
        )
    if len(lines) < _FEWEST or not min(float(columns[name].max()) for name in columns):
        raise FileError(path, f"needs {_FEWEST} rows or more with the rotor turning; got {len(lines)}")
    _check_throttle(path, columns.get("throttle"))
    return StandTable(columns=columns, numbers=np.array(numbers), notes=tuple(notes))


def _cells(path: Path) -> tuple[list[str], list[list[str]], list[int]]:
    """Return the header, the rows that are not blank, and these rows' numbers in the file."""
    try:
        size = path.stat().st_size
        if size > _LARGEST:
            raise FileError(path, f"must be of {_LARGEST} or fewer bytes; got {size}")
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise FileError(path, f"cannot be read ({error})") from error
    first = next((line for line in text.splitlines() if line.strip()), "")
    delimiter = next((mark for mark in (";", "\t", ",") if mark in first), None)
    if delimiter is None:  # columns of blanks, as propeller tables have
        rows = [line.split() for line in text.splitlines()]
    else:
        rows = list(csv.reader(io.StringIO(text), delimiter=delimiter))
    if delimiter == ";":
        rows = rows[:1] + [[cell.replace(",", ".") for cell in row] for row in rows[1:]]
    filled = [(number, row) for number, row in enumerate(rows, start=1) if any(cell.strip() for cell in row)]
    if not filled:
        return [], [], []
    (_, head), *rest = filled
    return head, [row for _, row in rest], [number for number, _ in rest]


def _places(path: Path, head: list[str]) -> dict[str, dict[int, float]]:
    """Return the columns of each quantity: their places, with the factor of their unit."""
    places: dict[str, dict[int, float]] = {}
    for place, cell in enumerate(head):
        match = _NAME.fullmatch(cell)
        if match is None:
            continue
        name = re.sub(r"[\s_]+", "", match[1]).lower()
        quantity = _NAMES.get(name)
        if quantity is None:
            continue
        unit = _unit(match[2])
        if unit is None and quantity in {"throttle", "CT", "CP"}:
            unit = "-"
        if unit is None and name.endswith("rpm"):
            unit = "rpm"
        if unit not in _UNITS[quantity]:
            allowed = ", ".join(f"{quantity} [{one}]" for one in _UNITS[quantity])
            raise FileError(path, f"column {cell.strip()!r} must state its unit, one of {allowed}")
        places.setdefault(quantity, {})[place] = _UNITS[quantity][unit]
    return places


def _unit(stated: str | None) -> str | None:
    """Return a unit as `_UNITS` spells it, or as it is stated."""
    if stated is None:
        return None
    unit = re.sub(r"\s*[*·⋅.\- ]\s*", " ", stated.strip()) or "-"  # N·m, N*m, N-m
    unit = unit.replace("µ", "u").replace("μ", "u")  # the micro sign and the Greek letter
    spelled = {"Nm": "N m", "Ncm": "N cm", "Nmm": "N mm", "mNm": "mN m", "oz in": "ozf in", "oz": "ozf", "lb": "lbf"}
    if unit.lower() in {"rpm", "rad/s"}:
        return unit.lower()
    return spelled.get(unit, unit)


def _column(path: Path, quantity: str, place: int, scale: float, lines: list[list[str]], numbers: list[int]) -> Array:
    """Return a column in SI units; a torque's sign is that of its cell's mounting, and is dropped."""
    values = []
    for number, row in zip(numbers, lines, strict=True):
        cell = row[place].strip() if place < len(row) else ""
        if quantity == "throttle":
            bare = cell.removesuffix("%").strip()
        else:
            bare = cell
        try:
            value = float(bare)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise FileError(path, f"row {number}: {quantity} must be a number; got {cell!r:.40}")
        if bare != cell and scale == 1.0:  # cells such as 50% under a header without a unit
            value *= 0.01
        values.append(value * scale)
    column = np.array(values)
    if quantity == "throttle" and scale == _UNITS["throttle"]["us"]:
        return column - _IDLE
    if quantity == "torque":
        return np.abs(column)
    lowest = int(column.argmin()) if len(column) else 0
    if len(column) and column[lowest] < -_TARE * abs(float(column.max())):
        cell = lines[lowest][place].strip()
        raise FileError(path, f"row {numbers[lowest]}: {quantity} must be 0 or above but for a tare; got {cell!r:.40}")
    return column


def _chosen(quantity: str, read: dict[int, Array], head: list[str], notes: list[str]) -> int:
    """Return the place of the column to take of those of one quantity: the first that shows every turning row."""
    names = {place: head[place].strip() for place in read}
    shown = {place: int(np.count_nonzero(column > 0.0)) for place, column in read.items()}
    most = max(shown.values())
    full = [place for place, count in shown.items() if count == most]
    optical = [place for place in full if "optical" in names[place].lower()]
    chosen = (optical or full)[0]
    for place, column in read.items():
        if place == chosen:
            continue
        apart = float(np.abs(column - read[chosen]).max(initial=0.0))
        largest = float(np.abs(read[chosen]).max(initial=0.0))
        note = f"{quantity} is taken from {names[chosen]!r}, not from {names[place]!r}"
        if not column.any():
            note += ", which is 0 throughout"
        elif largest > 0.0 and apart > (_AGREE + TIE_SHARE) * largest:
            note += f", which differs by up to {apart / largest:.0%} of the largest"
        notes.append(note)
    return chosen


def _check_throttle(path: Path, throttle: Array | None) -> None:
    """Refuse a throttle that is no share of the full one."""
    if throttle is None:
        return
    for value in (float(throttle.max()), float(throttle.min())):
        if not -TIE_SHARE <= value <= 1.0 + TIE_SHARE:
            raise FileError(
                path, f"throttle must be a share, 0 to 1, throttle [%], or [us] from 1000 to 2000; got {value:g}"
            )
