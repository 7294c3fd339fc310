"""Which columns of a log are which quantity, in which unit, sign and frame: by a format's own names, or by a map.

`to_series` gives sign * (logged - zero) * scale, in our units and frames, which `record` samples on one clock.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from quadsim.assets import read_toml
from quadsim.errors import FileError, InputError, ParameterError
from quadsim.features.identify.series import Column
from quadsim.plausibility import LARGEST_SAMPLES
from quadsim.rotation import euler_to_quaternion
from quadsim.state import Array

RPM: Final = math.tau / 60.0  # [rad/s]
NO_ERPM: Final = 65535  # of 16 bits: no value, but a gap
HALF_TURN: Final = np.array([1.0, -1.0, -1.0])  # about x: NED to north, west, up; FRD to x forward, y left, z up
_MOST_LISTED: Final = 40  # names in a message
_DEGREE: Final = math.pi / 180.0
STANDARD_GRAVITY: Final = 9.80665  # [m/s^2]
# Zero and scale of units: (logged - zero) * scale in ours.
_LENGTHS: Final = {"m": (0.0, 1.0), "cm": (0.0, 0.01), "mm": (0.0, 1e-3)}
_VELOCITIES: Final = {"m/s": (0.0, 1.0), "cm/s": (0.0, 0.01), "mm/s": (0.0, 1e-3), "km/h": (0.0, 1 / 3.6)}
_ROTOR_SPEEDS: Final = {"rad/s": (0.0, 1.0), "rpm": (0.0, RPM)}
_ANGLES: Final = {"rad": (0.0, 1.0), "deg": (0.0, _DEGREE)}
# Frames with z up, which are ours, and with z down.
_WORLDS: Final = ("ENU", "NED")
_BODIES: Final = ("FLU", "FRD")
_WORLDS_AND_BODIES: Final = ("ENU/FLU", "NED/FRD")


class Quantity(NamedTuple):
    """What a quantity may be logged as."""

    size: int  # columns
    units: Mapping[str, tuple[float, float]]  # zero and scale of each: (logged - zero) * scale in ours
    frames: tuple[str, str] | None = None  # with z up, which is ours, and with z down


LOGGED: Final = {
    "t": Quantity(1, {"s": (0.0, 1.0), "ms": (0.0, 1e-3), "us": (0.0, 1e-6), "ns": (0.0, 1e-9)}),
    "position": Quantity(3, _LENGTHS, _WORLDS),
    "velocity": Quantity(3, _VELOCITIES, _WORLDS),
    "specific_force": Quantity(
        3,
        {"m/s^2": (0.0, 1.0), "g": (0.0, STANDARD_GRAVITY), "g/2048": (0.0, STANDARD_GRAVITY / 2048)},
        _BODIES,
    ),
    "attitude": Quantity(4, {"-": (0.0, 1.0)}, _WORLDS_AND_BODIES),
    "euler": Quantity(3, _ANGLES, _WORLDS_AND_BODIES),
    "rates": Quantity(3, {"rad/s": (0.0, 1.0), "deg/s": (0.0, _DEGREE)}, _BODIES),
    "commands": Quantity(4, _ROTOR_SPEEDS),
    "throttle": Quantity(4, {"-": (0.0, 1.0), "%": (0.0, 0.01), "us": (1000.0, 1e-3), "16 bit": (0.0, 1 / 65535)}),
    "speeds": Quantity(4, _ROTOR_SPEEDS),
    "erpm": Quantity(4, {"rpm": (0.0, 1.0), "100 rpm": (0.0, 100.0)}),
    "voltage": Quantity(1, {"V": (0.0, 1.0), "mV": (0.0, 1e-3), "cV": (0.0, 0.01)}),
}
"""Every quantity, its usual unit first."""
MAP_ADVICE: Final = f"; --columns MAP.toml says which columns of a log are which of {', '.join(LOGGED)}"
"""What a message about missing columns ends with."""
_NEEDED: Final = {
    "velocity": ("velocity", "position", "specific_force"),
    "attitude": ("attitude", "euler", "specific_force"),
    "body rates": ("rates",),
    "rotor commands or speeds": ("commands", "throttle", "speeds", "erpm"),
}
"""What a log needs: one of each."""
THROTTLE_EXCESS: Final = 0.02
"""A throttle may be so far beyond its ends, as mixers and rounding make it; it is taken for the end."""
RANGES: Final = {
    "throttle": (-THROTTLE_EXCESS, 1.0 + THROTTLE_EXCESS, "throttle1..4 must be shares of full throttle, 0 to 1"),
    "commands": (0.0, math.inf, "u1..4 must be rotor speeds in rad/s, 0 or above"),
    "speeds": (0.0, math.inf, "rotor speeds must be 0 or above, whichever way a rotor turns"),
    "euler": (-math.pi, math.pi, "roll and pitch must be in rad"),
}
"""Least and largest value of a quantity, and the rule."""


@dataclass(frozen=True, kw_only=True)
class NamedQuantity:
    """A quantity as some columns have it: sign * (logged - zero) * scale, in our units."""

    quantity: str
    columns: tuple[str, ...]
    zero: float | Array = 0.0
    scale: float | Array = 1.0
    sign: tuple[float, ...] = ()  # empty for all 1
    down: bool = False  # whether its frame has z down: NED, FRD


@dataclass(frozen=True, kw_only=True)
class LoggedColumns:
    """What a log has, and how its format names the quantities."""

    columns: Mapping[str, Column]
    quantities: Sequence[NamedQuantity]  # of a quantity that it names twice, the best first
    advice: str = ""  # how its autopilot logs more
    notes: tuple[str, ...] = ()  # what was found in reading it


def logged_as(
    quantity: str, columns: str, *, each: str = "", unit: str = "", down: bool = False, **numbers: Any
) -> NamedQuantity:
    """A quantity by its columns: by their names, or one name with {} for each of some words, else for 0, 1, ..."""
    size, units, _ = LOGGED[quantity]
    if "{}" in columns:
        words = each.split() or [str(i) for i in range(size)]
        names = [columns.format(word) for word in words]
    else:
        names = columns.split()
    zero, scale = units[unit or next(iter(units))]
    factors = {"zero": zero, "scale": scale, **numbers}
    return NamedQuantity(quantity=quantity, columns=tuple(names), down=down, **factors)


def usual_names(quantity: str, *ways: str, unit: str = "") -> tuple[NamedQuantity, ...]:
    """A quantity by each of several ways to name its columns."""
    return tuple(logged_as(quantity, way, unit=unit) for way in ways)


def read_map(path: Path) -> tuple[NamedQuantity, ...]:
    """Read a map of columns: a TOML file with a table for each quantity that it names.

        [rates]
        columns = ["gyroADC[0]", "gyroADC[1]", "gyroADC[2]"]
        unit = "deg/s"
        sign = [1, -1, -1]
        frame = "FLU"

    Raises:
        FileError: it is not TOML, or a table of it is not as it should be; the message names the field.
    """
    return tuple(_named_in(path, quantity, table) for quantity, table in read_toml(path).items())


def _named_in(path: Path, quantity: str, table: Any) -> NamedQuantity:
    if quantity not in LOGGED:
        raise FileError(path, f"has no table {quantity!r}; there are {', '.join(LOGGED)}")
    size, units, frames = LOGGED[quantity]
    defaults: dict[str, Any] = {"columns": [], "unit": next(iter(units)), "sign": [1] * size}
    if frames:
        defaults["frame"] = frames[0]
    fields = ", ".join(defaults)
    if not isinstance(table, dict):
        raise FileError(path, f"{quantity} must be a table; got {table!r:.80}; its fields are {fields}")
    unknown = sorted({*table} - {*defaults})
    if unknown:
        raise FileError(path, f"{quantity} has no {unknown[0]!r}; its fields are {fields}")
    entry = defaults | table
    for field, rule in _broken_rules(LOGGED[quantity], entry):
        raise FileError(path, f"{quantity}.{field} must be {rule}; got {entry[field]!r:.80}")
    zero, scale = units[entry["unit"]]
    return NamedQuantity(
        quantity=quantity,
        columns=tuple(entry["columns"]),
        zero=zero,
        scale=scale,
        sign=tuple(map(float, entry["sign"])),
        down=frames is not None and entry["frame"] == frames[1],
    )


def _broken_rules(quantity: Quantity, entry: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """The fields of a map's table that are not as they should be, and what they should be."""
    size, units, frames = quantity
    names = entry["columns"]
    if not _has_size(names, size) or not all(isinstance(name, str) for name in names):
        yield "columns", f"a list of {size} name{'s' * (size > 1)}"
    if entry["unit"] not in [*units]:
        yield "unit", f"one of {', '.join(map(repr, units))}"
    signs = entry["sign"]
    if not _has_size(signs, size) or not all(sign in (1, -1) for sign in signs):
        yield "sign", f"a list of {size} of 1 and -1"
    if frames and entry["frame"] not in frames:
        yield "frame", f"one of {', '.join(map(repr, frames))}"


def _has_size(values: Any, size: int) -> bool:
    return isinstance(values, list) and len(values) == size


def to_series(
    path: Path, log: LoggedColumns, column_map: Sequence[NamedQuantity] = (), poles: int | None = None
) -> dict[str, Column]:
    """Return the series of a log by field of `quadsim.features.identify.record.Record`, in our units and frames.

    Args:
        path: of the log, for messages.
        log: what it has.
        column_map: the map of its user, which comes before its own names.
        poles: magnets of each motor, where the log has electrical speeds.

    Raises:
        FileError: a column is missing; the message names what is allowed.
        InputError: a sample or a unit cannot be meant, or poles are missing.
    """
    named = _named_quantities(path, log, column_map)
    for quantity in named.values():
        _check_samples(path.name, log.columns, quantity)
    series = {}
    for name, quantity in named.items():
        if name != "t":
            series[name] = _series(log.columns, quantity)
    _set_speeds(path.name, series, poles)
    _check_ranges(path.name, series)
    if "throttle" in series:
        throttle = series["throttle"]
        series["throttle"] = throttle._replace(values=np.clip(throttle.values, 0.0, 1.0))
    euler = series.pop("euler", None)
    if euler is not None and "attitude" not in series:
        series["attitude"] = Column(t=euler.t, values=euler_to_quaternion(euler.values))
        named["attitude"] = named["euler"]
    for name, column in series.items():
        if name in named and named[name].down:
            turn = HALF_TURN
            if name == "attitude":
                turn = np.append(1.0, HALF_TURN)
            series[name] = column._replace(values=column.values * turn)
    return series


def _named_quantities(path: Path, log: LoggedColumns, column_map: Sequence[NamedQuantity]) -> dict[str, NamedQuantity]:
    """The quantities of which a log has the columns, by the map first; refuse a log that lacks one that is needed."""
    for quantity in column_map:
        missing = [column for column in quantity.columns if column not in log.columns]
        if missing:
            what = f"{quantity.quantity}.columns names {', '.join(map(repr, missing))}"
            raise FileError(path, f"lacks what the map's {what}; it has {listed(log.columns)}")
    named: dict[str, NamedQuantity] = {}
    for quantity in (*column_map, *log.quantities):
        if {*quantity.columns} <= {*log.columns}:
            named.setdefault(quantity.quantity, quantity)
    for what, alternatives in _NEEDED.items():
        if not {*alternatives} & {*named}:
            raise FileError(path, _lacks(what, alternatives, log))
    return named


def _lacks(what: str, alternatives: Sequence[str], log: LoggedColumns) -> str:
    """That a log lacks all alternatives of something, with the columns that would be one."""
    ways = {}
    for quantity in reversed(log.quantities):  # the best, which stands first, is kept
        if quantity.quantity in alternatives:
            ways[quantity.quantity] = ",".join(quantity.columns)
    if not ways:
        ways = {name: f"[{name}] of the map" for name in alternatives}
    columns = " or ".join(ways[name] for name in alternatives if name in ways)
    more = "".join(f"; {text}" for text in (log.advice, *log.notes) if text)
    return f"lacks {what}: columns {columns}; it has {listed(log.columns)}{more}{MAP_ADVICE}"


def _set_speeds(name: str, series: dict[str, Column], poles: int | None) -> None:
    """Put rotor speeds in the place of electrical ones, and leave out those of controllers without telemetry."""
    erpm = series.pop("erpm", None)
    if erpm is not None:
        if "speeds" not in series:
            series["speeds"] = Column(t=erpm.t, values=_speeds(name, erpm.values, poles))
    elif poles is not None:
        raise InputError(f"{name}: poles turn eRPM into speeds, and there is no erpm1..4; leave poles out")
    has_commands = "commands" in series or "throttle" in series
    if has_commands and "speeds" in series and not np.nanmax(series["speeds"].values, initial=0):
        del series["speeds"]  # speed controllers without telemetry report zeros


def _check_ranges(name: str, series: Mapping[str, Column]) -> None:
    """Refuse a quantity beyond the values that it may have; of Euler angles, roll and pitch where they are used."""
    for quantity, (low, high, rule) in RANGES.items():
        if quantity not in series:
            continue
        rows = series[quantity].values
        if quantity == "euler":
            if "attitude" in series:
                continue
            rows = rows[:, :2]
        least = np.nanmin(rows, initial=0.0)
        most = np.nanmax(rows, initial=0.0)
        if not (low <= least and most <= high):
            raise InputError(f"{name}: {rule}; got {np.nanmin(rows):.4g} to {np.nanmax(rows):.4g}")


def _check_samples(name: str, columns: Mapping[str, Column], named: NamedQuantity) -> None:
    """Refuse a quantity with a finite sample that no vehicle has, in whatever unit: by its column, time and value."""
    largest = LARGEST_SAMPLES.get(named.quantity, math.inf)
    size = len(named.columns)
    zeros = np.broadcast_to(named.zero, size)
    scales = np.broadcast_to(named.scale, size)
    for column, zero, scale in zip(named.columns, zeros, scales, strict=True):
        t, logged = columns[column]
        beyond = np.isfinite(logged) & (np.abs(logged - zero) > largest / scale)
        if beyond.any():
            row = int(np.argmax(beyond))
            unit = next(iter(LOGGED[named.quantity].units))
            raise InputError(
                f"{name}: {column} is {logged[row]:.4g} at t = {t[row]:.6g} s; {named.quantity} must be within "
                f"+-{largest:g} {unit}: correct the sample or its unit, or leave it empty"
            )


def listed(columns: Iterable[str]) -> str:
    """Names of columns; where there are many, of those with a dot the topics alone."""
    names = [*columns]
    if len(names) > _MOST_LISTED:
        topics = dict.fromkeys(name.partition(".")[0] for name in names)
        names = [*topics][:_MOST_LISTED]
    return ", ".join(names) or "none"


def _series(columns: Mapping[str, Column], named: NamedQuantity) -> Column:
    """The columns on the clock of the first of them."""
    t = columns[named.columns[0]].t
    logged = []
    for name in named.columns:
        column = columns[name]
        if column.t is t:
            logged.append(column.values)
        else:
            logged.append(np.interp(t, column.t, column.values))
    values = (np.stack(logged, axis=1) - named.zero) * named.scale
    if np.any(named.zero):  # a motor that is stopped has a shorter pulse
        values = np.maximum(values, 0.0)
    if named.sign:
        values = values * named.sign
    return Column(t=t, values=values)


def _speeds(name: str, erpm: Array, poles: int | None) -> Array:
    if poles is None:
        raise InputError(f"{name}: erpm is an electrical speed: give the poles (magnets) of each motor, e.g. 14")
    if poles < 2 or poles % 2:
        raise ParameterError("", "poles", poles, "an even number of magnets, 2 or more")
    return np.where(erpm == NO_ERPM, np.nan, erpm) / (poles / 2.0) * RPM
