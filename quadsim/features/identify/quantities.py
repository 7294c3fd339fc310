"""Which columns of a log are which quantity, in which unit, sign and frame: by a format's own names, or by a map.

A map is a TOML file with a table for each quantity that it names:

    [rates]
    columns = ["gyroADC[0]", "gyroADC[1]", "gyroADC[2]"]
    unit = "deg/s"
    sign = [1, -1, -1]
    frame = "FLU"
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
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
_LISTED: Final = 40  # names in a message
_DEGREE: Final = math.pi / 180.0
_LENGTHS: Final = {"m": (0.0, 1.0), "cm": (0.0, 0.01), "mm": (0.0, 1e-3)}
_SPEEDS: Final = {"rad/s": (0.0, 1.0), "rpm": (0.0, RPM)}
_WORLDS = ("ENU", "NED")
_BODIES = ("FLU", "FRD")
_BOTH = ("ENU/FLU", "NED/FRD")


class Quantity(NamedTuple):
    """What a quantity may be logged as."""

    size: int  # columns
    units: Mapping[str, tuple[float, float]]  # zero and scale of each: (logged - zero) * scale in ours
    frames: tuple[str, str] | None = None  # with z up, which is ours, and with z down


LOGGED: Final = {
    "t": Quantity(1, {"s": (0.0, 1.0), "ms": (0.0, 1e-3), "us": (0.0, 1e-6), "ns": (0.0, 1e-9)}),
    "position": Quantity(3, _LENGTHS, _WORLDS),
    "velocity": Quantity(3, {f"{unit}/s": of for unit, of in _LENGTHS.items()} | {"km/h": (0.0, 1 / 3.6)}, _WORLDS),
    "specific_force": Quantity(
        3, {"m/s^2": (0.0, 1.0), "g": (0.0, 9.80665), "g/2048": (0.0, 9.80665 / 2048)}, _BODIES
    ),
    "attitude": Quantity(4, {"-": (0.0, 1.0)}, _BOTH),
    "euler": Quantity(3, {"rad": (0.0, 1.0), "deg": (0.0, _DEGREE)}, _BOTH),
    "rates": Quantity(3, {"rad/s": (0.0, 1.0), "deg/s": (0.0, _DEGREE)}, _BODIES),
    "commands": Quantity(4, _SPEEDS),
    "throttle": Quantity(
        4, {"-": (0.0, 1.0), "%": (0.0, 0.01), "us": (1000.0, 1e-3), "16 bit": (0.0, 1 / 65535)}
    ),
    "speeds": Quantity(4, _SPEEDS),
    "erpm": Quantity(4, {"rpm": (0.0, 1.0), "100 rpm": (0.0, 100.0)}),
    "voltage": Quantity(1, {"V": (0.0, 1.0), "mV": (0.0, 1e-3), "cV": (0.0, 0.01)}),
}  # fmt: skip
"""Every quantity, its usual unit first."""
MAPPED: Final = f"; --columns MAP.toml says which columns of a log are which of {', '.join(LOGGED)}"
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
        names = [columns.format(i) for i in each.split() or range(size)]
    else:
        names = columns.split()
    zero, scale = units[unit or next(iter(units))]
    known = {"zero": zero, "scale": scale, **numbers}
    return NamedQuantity(quantity=quantity, columns=tuple(names), down=down, **known)


def read_map(path: Path) -> tuple[NamedQuantity, ...]:
    """Read a map of columns.

    Raises:
        FileError: it is not TOML, or a table of it is not as it should be; the message names the field.
    """
    return tuple(_named_in(path, quantity, table) for quantity, table in read_toml(path).items())


def _named_in(path: Path, quantity: str, table: Any) -> NamedQuantity:
    if quantity not in LOGGED:
        raise FileError(path, f"has no table {quantity!r}; there are {', '.join(LOGGED)}")
    size, units, frames = LOGGED[quantity]
    usual: dict[str, Any] = {"columns": [], "unit": next(iter(units)), "sign": [1] * size}
    usual |= {"frame": frames[0]} if frames else {}
    if not isinstance(table, dict) or (odd := {*table} - {*usual}):
        if isinstance(table, dict):
            what = f"has no {sorted(odd)[0]!r}"
        else:
            what = f"must be a table; got {table!r:.80}"
        raise FileError(path, f"{quantity} {what}; its fields are {', '.join(usual)}")
    of = usual | table
    sizes = {field: len(of[field]) if isinstance(of[field], list) else 0 for field in ("columns", "sign")}
    are_names = sizes["columns"] == size and all(isinstance(column, str) for column in of["columns"])
    are_signs = sizes["sign"] == size and all(sign in (1, -1) for sign in of["sign"])
    rules = {
        "columns": (are_names, f"a list of {size} name{'s' * (size > 1)}"),
        "unit": (of["unit"] in [*units], f"one of {', '.join(map(repr, units))}"),
        "sign": (are_signs, f"a list of {size} of 1 and -1"),
    }
    rules |= {"frame": (of["frame"] in frames, f"one of {', '.join(map(repr, frames))}")} if frames else {}
    for field, (right, rule) in rules.items():
        if not right:
            raise FileError(path, f"{quantity}.{field} must be {rule}; got {of[field]!r:.80}")
    zero, scale = units[of["unit"]]
    return NamedQuantity(
        quantity=quantity, columns=tuple(of["columns"]), zero=zero, scale=scale, sign=tuple(map(float, of["sign"])),
        down=frames is not None and of["frame"] == frames[1],
    )  # fmt: skip


def to_series(
    path: Path, log: LoggedColumns, given: Sequence[NamedQuantity] = (), poles: int | None = None
) -> dict[str, Column]:
    """Return the series of a log by field of `quadsim.features.identify.record.Record`, in our units and frames.

    Args:
        path: of the log, for messages.
        log: what it has.
        given: the map of its user, which comes before its own names.
        poles: magnets of each motor, where the log has electrical speeds.

    Raises:
        FileError: a column is missing; the message names what is allowed.
        InputError: a sample or a unit cannot be meant, or poles are missing.
    """
    for one in given:
        if missing := [column for column in one.columns if column not in log.columns]:
            what = f"{one.quantity}.columns names {', '.join(map(repr, missing))}"
            raise FileError(path, f"lacks what the map's {what}; it has {listed(log.columns)}")
    known: dict[str, NamedQuantity] = {}
    for one in (*given, *log.quantities):
        if {*one.columns} <= {*log.columns}:
            known.setdefault(one.quantity, one)
    for what, needed in _NEEDED.items():
        if not {*needed} & {*known}:
            ways = {one.quantity: ",".join(one.columns) for one in reversed(log.quantities) if one.quantity in needed}
            ways = ways or {quantity: f"[{quantity}] of the map" for quantity in needed}
            columns = " or ".join(ways[quantity] for quantity in needed if quantity in ways)
            more = "".join(f"; {text}" for text in (log.advice, *log.notes) if text)
            raise FileError(path, f"lacks {what}: columns {columns}; it has {listed(log.columns)}{more}{MAPPED}")
    name = path.name
    for one in known.values():
        _check_samples(name, log.columns, one)
    series = {quantity: _series(log.columns, one) for quantity, one in known.items() if quantity != "t"}
    if (erpm := series.pop("erpm", None)) is not None:
        if "speeds" not in series:
            series["speeds"] = Column(t=erpm.t, values=_speeds(name, erpm.values, poles))
    elif poles is not None:
        raise InputError(f"{name}: poles turn eRPM into speeds, and there is no erpm1..4; leave poles out")
    if (
        {"commands", "throttle"} & {*series}
        and "speeds" in series
        and not np.nanmax(series["speeds"].values, initial=0)
    ):
        del series["speeds"]  # speed controllers without telemetry report zeros
    for quantity, (low, high, rule) in RANGES.items():
        if quantity in series and not (quantity == "euler" and "attitude" in series):
            rows = series[quantity].values[:, : 2 if quantity == "euler" else None]
            if not (low <= np.nanmin(rows, initial=0.0) and np.nanmax(rows, initial=0.0) <= high):
                raise InputError(f"{name}: {rule}; got {np.nanmin(rows):.4g} to {np.nanmax(rows):.4g}")
    if "throttle" in series:
        series["throttle"] = series["throttle"]._replace(values=np.clip(series["throttle"].values, 0.0, 1.0))
    if (euler := series.pop("euler", None)) is not None and "attitude" not in series:
        series["attitude"] = Column(t=euler.t, values=euler_to_quaternion(euler.values))
        known["attitude"] = known["euler"]
    for quantity in {*series} & {*known}:
        if known[quantity].down:
            if quantity == "attitude":
                turn = np.append(1.0, HALF_TURN)
            else:
                turn = HALF_TURN
            series[quantity] = Column(t=series[quantity].t, values=series[quantity].values * turn)
    return series


def _check_samples(name: str, columns: Mapping[str, Column], one: NamedQuantity) -> None:
    """Refuse a quantity with a finite sample that no vehicle has, in whatever unit: by its column, time and value."""
    largest = LARGEST_SAMPLES.get(one.quantity, math.inf)
    size = len(one.columns)
    zeros = np.broadcast_to(one.zero, size)
    scales = np.broadcast_to(one.scale, size)
    for column, zero, scale in zip(one.columns, zeros, scales, strict=True):
        t, logged = columns[column]
        beyond = np.isfinite(logged) & (np.abs(logged - zero) > largest / scale)
        if beyond.any():
            row = int(np.argmax(beyond))
            unit = next(iter(LOGGED[one.quantity].units))
            raise InputError(
                f"{name}: {column} is {logged[row]:.4g} at t = {t[row]:.6g} s; {one.quantity} must be within "
                f"+-{largest:g} {unit}: correct the sample or its unit, or leave it empty"
            )


def listed(columns: Iterable[str]) -> str:
    """Names of columns; where there are many, of those with a dot the topics alone."""
    names = [*columns]
    if len(names) > _LISTED:
        names = [*dict.fromkeys(name.partition(".")[0] for name in names)][:_LISTED]
    return ", ".join(names) or "none"


def _series(columns: Mapping[str, Column], one: NamedQuantity) -> Column:
    """The columns on the clock of the first of them."""
    t = columns[one.columns[0]].t
    rows = []
    for c in (columns[name] for name in one.columns):
        rows.append(c.values if c.t is t else np.interp(t, c.t, c.values))
    values = (np.stack(rows, axis=1) - one.zero) * one.scale
    # a motor that is stopped has a shorter pulse
    if np.any(one.zero):
        values = np.maximum(values, 0.0)
    return Column(t=t, values=values * one.sign if one.sign else values)


def _speeds(name: str, erpm: Array, poles: int | None) -> Array:
    if poles is None:
        raise InputError(f"{name}: erpm is an electrical speed: give the poles (magnets) of each motor, e.g. 14")
    if poles < 2 or poles % 2:
        raise ParameterError("", "poles", poles, "an even number of magnets, 2 or more")
    return np.where(erpm == NO_ERPM, np.nan, erpm) / (poles / 2.0) * RPM
