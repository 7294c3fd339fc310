"""The table of a thrust stand as it is sold: its columns by quantity, in SI units.

A column's name says its quantity, and its unit stands in brackets: `Thrust (gf)`, `Torque (N·m)`, `ESC signal (µs)`,
`Average RPM`.  Cells are separated by commas, semicolons (then with decimal points or commas), tabs or blanks.  A
propeller's table has `CT` and `CP` in place of thrust and torque, by speed.  `thrust_stand.py` fits a rotor to it.
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
        "N": 1.0,
        "mN": 1e-3,
        "g": _GRAM,
        "gf": _GRAM,
        "kg": 1e3 * _GRAM,
        "kgf": 1e3 * _GRAM,
        "lbf": _POUND,
        "ozf": _POUND / 16.0,
    },
    "torque": {"N m": 1.0, "N cm": 0.01, "N mm": 1e-3, "mN m": 1e-3, "ozf in": _POUND / 16.0 * _INCH},
    "CT": {"-": 1.0},
    "CP": {"-": 1.0},
}
"""Quantities of a column, and their units; a pulse in microseconds becomes milliseconds, counted from `_IDLE`."""
_NAMES: Final[dict[str, str]] = {
    "speed": "speed",
    "rpm": "speed",
    "averagerpm": "speed",
    "motorspeed": "speed",
    "rotationspeed": "speed",
    "motoropticalspeed": "speed",
    "motorelectricalspeed": "speed",
    "rotorspeed": "speed",
    "throttle": "throttle",
    "escsignal": "throttle",
    "esc": "throttle",
    "pwm": "throttle",
    "thrust": "thrust",
    "torque": "torque",
    "ct": "CT",
    "cp": "CP",
}
"""Quantity of a column by its name in lower case, without blanks."""
_SPELLED: Final = {
    "Nm": "N m",
    "Ncm": "N cm",
    "Nmm": "N mm",
    "mNm": "mN m",
    "oz in": "ozf in",
    "oz": "ozf",
    "lb": "lbf",
}
"""Units as `_UNITS` spells them, by other spellings."""
_HEADING: Final = re.compile(r"\s*([^\[(]*?)\s*(?:[\[(]\s*(.*?)\s*[\])])?\s*")
"""A column's name, and its unit in brackets if it has one."""
_IDLE: Final = 1.0  # [ms] pulse of no throttle; that of full throttle takes twice as long
_LARGEST: Final = 1_000_000  # [bytes]
_FEWEST: Final = 3  # rows
_TARE: Final = 0.02  # how far below zero a column may be, over its largest value
_AGREE: Final = 0.05  # difference of two columns of one quantity that is not mentioned, over the largest value


@dataclass(frozen=True, kw_only=True)
class StandTable:
    """The rows of a stand, in the order of the file."""

    columns: dict[str, Array]  # by quantity, in SI units; throttle as a share, 0 to 1
    numbers: Array  # of the rows in the file, from 1, that of the header included
    notes: tuple[str, ...]  # which of several columns of one quantity was taken, a sentence each


def read_stand(path: Path) -> StandTable:
    """Read the table of a thrust stand, or a propeller's coefficients.

    Raises:
        FileError: it is no such table; the message names the column, the row and what is allowed.
    """
    head, lines, numbers = _cells(path)
    columns = {}
    notes: list[str] = []
    for quantity, factors in _places(path, head).items():
        candidates = {}
        for place, factor in factors.items():
            candidates[place] = _column(path, quantity, place, factor, lines, numbers)
        chosen = _chosen(candidates, head)
        columns[quantity] = candidates[chosen]
        notes += _notes_on_choice(quantity, chosen, candidates, head)
    _require_rotor(path, columns, head)
    if len(lines) < _FEWEST or not min(float(column.max()) for column in columns.values()):
        raise FileError(path, f"needs {_FEWEST} rows or more with the rotor turning; got {len(lines)}")
    _check_throttle(path, columns.get("throttle"))
    return StandTable(columns=columns, numbers=np.array(numbers), notes=tuple(notes))


def _require_rotor(path: Path, columns: dict[str, Array], head: list[str]) -> None:
    """Refuse a table that has neither thrust by speed or throttle, nor a propeller's CT by speed."""
    if "thrust" in columns and ("speed" in columns or "throttle" in columns):
        return
    if "CT" in columns and "speed" in columns:
        return
    there = ", ".join(cell.strip() for cell in head) or "nothing"
    raise FileError(
        path, f"needs thrust [N] and rpm, speed [rad/s] or throttle, or a propeller's CT and rpm; it has {there}"
    )


def _cells(path: Path) -> tuple[list[str], list[list[str]], list[int]]:
    """Return the header, the rows that are not blank, and these rows' numbers in the file."""
    text = _text(path)
    first = next((line for line in text.splitlines() if line.strip()), "")
    delimiter = next((mark for mark in (";", "\t", ",") if mark in first), None)
    if delimiter is None:  # columns of blanks, as propeller tables have
        rows = [line.split() for line in text.splitlines()]
    else:
        rows = list(csv.reader(io.StringIO(text), delimiter=delimiter))
    head: list[str] | None = None
    lines = []
    numbers = []
    for number, row in enumerate(rows, start=1):
        if delimiter == ";" and number > 1:  # a decimal comma
            row = [cell.replace(",", ".") for cell in row]
        if not any(cell.strip() for cell in row):
            continue
        if head is None:
            head = row
        else:
            lines.append(row)
            numbers.append(number)
    return head or [], lines, numbers


def _text(path: Path) -> str:
    """Return the text of a file that is not too large."""
    try:
        size = path.stat().st_size
        if size > _LARGEST:
            raise FileError(path, f"must be of {_LARGEST} or fewer bytes; got {size}")
        return path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise FileError(path, f"cannot be read ({error})") from error


def _places(path: Path, head: list[str]) -> dict[str, dict[int, float]]:
    """Return the places of the columns of each quantity, and for each the factor of its unit to SI."""
    places: dict[str, dict[int, float]] = {}
    for place, cell in enumerate(head):
        match = _HEADING.fullmatch(cell)
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
            allowed = ", ".join(f"{quantity} [{known}]" for known in _UNITS[quantity])
            raise FileError(path, f"column {cell.strip()!r} must state its unit, one of {allowed}")
        places.setdefault(quantity, {})[place] = _UNITS[quantity][unit]
    return places


def _unit(stated: str | None) -> str | None:
    """Return a unit as `_UNITS` spells it, or as it is stated."""
    if stated is None:
        return None
    unit = re.sub(r"\s*[*·⋅.\- ]\s*", " ", stated.strip()) or "-"  # N·m, N*m, N-m
    unit = unit.replace("µ", "u").replace("μ", "u")  # the micro sign and the Greek letter
    if unit.lower() in {"rpm", "rad/s"}:
        return unit.lower()
    return _SPELLED.get(unit, unit)


def _column(path: Path, quantity: str, place: int, factor: float, lines: list[list[str]], numbers: list[int]) -> Array:
    """Return a column in SI units; a torque's sign is that of its cell's mounting, and is dropped."""
    cells = []
    values = []
    for number, row in zip(numbers, lines, strict=True):
        cell = ""
        if place < len(row):
            cell = row[place].strip()
        cells.append(cell)
        bare = cell
        if quantity == "throttle":
            bare = cell.removesuffix("%").strip()
        try:
            value = float(bare)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise FileError(path, f"row {number}: {quantity} must be a number; got {cell!r:.40}")
        if bare != cell and factor == 1.0:  # cells such as 50% under a header without a unit
            value *= 0.01
        values.append(value * factor)
    column = np.array(values)
    if quantity == "throttle" and factor == _UNITS["throttle"]["us"]:
        return column - _IDLE
    if quantity == "torque":
        return np.abs(column)
    if not values:
        return column
    lowest = int(column.argmin())
    if column[lowest] < -_TARE * abs(float(column.max())):
        raise FileError(
            path, f"row {numbers[lowest]}: {quantity} must be 0 or above but for a tare; got {cells[lowest]!r:.40}"
        )
    return column


def _chosen(candidates: dict[int, Array], head: list[str]) -> int:
    """Return the place of the column to take of those of one quantity.

    It is the first of those with the most rows above zero, an optical one before others.
    """
    turning = {place: int(np.count_nonzero(column > 0.0)) for place, column in candidates.items()}
    most = max(turning.values())
    full = [place for place, rows in turning.items() if rows == most]
    for place in full:
        if "optical" in head[place].lower():
            return place
    return full[0]


def _notes_on_choice(quantity: str, chosen: int, candidates: dict[int, Array], head: list[str]) -> list[str]:
    """Return a sentence for each column of a quantity that was not taken, with its difference if that is large."""
    taken = candidates[chosen]
    largest = float(np.abs(taken).max(initial=0.0))
    notes = []
    for place, column in candidates.items():
        if place == chosen:
            continue
        note = f"{quantity} is taken from {head[chosen].strip()!r}, not from {head[place].strip()!r}"
        difference = float(np.abs(column - taken).max(initial=0.0))
        if not column.any():
            note += ", which is 0 throughout"
        elif largest > 0.0 and difference > (_AGREE + TIE_SHARE) * largest:
            note += f", which differs by up to {difference / largest:.0%} of the largest"
        notes.append(note)
    return notes


def _check_throttle(path: Path, throttle: Array | None) -> None:
    """Refuse a throttle that is no share of the full one."""
    if throttle is None:
        return
    for value in (float(throttle.max()), float(throttle.min())):
        if not -TIE_SHARE <= value <= 1.0 + TIE_SHARE:
            raise FileError(
                path, f"throttle must be a share, 0 to 1, throttle [%], or [us] from 1000 to 2000; got {value:g}"
            )
