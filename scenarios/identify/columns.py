"""Tables as logs: CSV, Parquet, and quadsim's own `flight.parquet`, their columns by the names that are in use."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.csv

from quadsim.errors import FileError, InputError, ParameterError
from quadsim.flight.parquet import FLIGHT_FILE, PLANT_FILE, read_parquet
from quadsim.rotation import euler_to_body_rates, euler_to_quaternion
from quadsim.state import Array
from scenarios.identify.series import SampledSeries

TABLE_SUFFIXES: Final = (".csv", ".parquet")
RPM: Final = math.tau / 60.0  # [rad/s]
NO_ERPM: Final = 65535  # of 16 bits: no value, but a gap
SPELLINGS: Final[dict[str, tuple[str, ...]]] = {
    "position": ("x y z", "px py pz", "pos_x pos_y pos_z"),
    "velocity": ("vx vy vz", "vel_x vel_y vel_z"),
    "force": ("ax ay az", "acc_x acc_y acc_z", "accel_x accel_y accel_z"),
    "attitude": ("qw qx qy qz", "q_w q_x q_y q_z"),
    "euler": ("roll pitch yaw",),
    "rates": ("wx wy wz", "p q r", "gyro_x gyro_y gyro_z", "body_rate_x body_rate_y body_rate_z"),
    "commands": ("u1 u2 u3 u4",),
    "throttle": ("throttle1 throttle2 throttle3 throttle4",),
    "speeds": ("w1 w2 w3 w4",),
    "rpm": ("rpm1 rpm2 rpm3 rpm4", "m1_rpm m2_rpm m3_rpm m4_rpm"),
    "erpm": ("erpm1 erpm2 erpm3 erpm4", "m1_erpm m2_erpm m3_erpm m4_erpm"),
    "voltage": ("voltage", "vbat"),
}
"""Columns of each quantity, by the names that are read."""
TIME_COLUMNS: Final = {
    "t": 1.0,
    **dict.fromkeys(("t_s", "time_s"), 1.0),
    **dict.fromkeys(("t_ms", "time_ms", "timestamp_ms"), 1e-3),
    **dict.fromkeys(("t_us", "time_us", "timestamp_us"), 1e-6),
}
"""Columns of time, with their units [s]."""
TIMES_OF_ANY_UNIT: Final = ("time", "timestamp")
"""Columns of time in s, ms or us: their step tells which, as a log has 10 to 1000 samples per second."""
KNOWN: Final = {
    *TIME_COLUMNS,
    *TIMES_OF_ANY_UNIT,
    *" ".join(way for ways in SPELLINGS.values() for way in ways).split(),
}
"""Every column that is read."""
RANGES: Final = {
    "throttle": (0.0, 1.0, "throttle1..4 must be shares of full throttle, 0 to 1"),
    "commands": (0.0, math.inf, "u1..4 must be rotor speeds in rad/s, 0 or above"),
    "speeds": (0.0, math.inf, "rotor speeds must be 0 or above, whichever way a rotor turns"),
    "euler": (-math.pi, math.pi, "roll and pitch must be in rad"),
}
"""Least and largest value of a quantity, and the rule."""
NEEDED_COLUMNS: Final = {
    "velocity": ("velocity", "position", "force"),
    "attitude": ("attitude", "euler"),
    "body rates": ("rates", "euler_rates"),
    "rotor commands or speeds": ("commands", "throttle", "speeds", "rpm", "erpm"),
}
"""What a log needs: one of each."""


def read_columns(path: Path, *, poles: int | None = None) -> dict[str, SampledSeries]:
    """Read the series of a table by field of `scenarios.identify.record.Record`; arguments and errors as there."""
    table = _read_csv(path) if path.suffix.lower() == ".csv" else read_parquet(path)
    listed = [name.partition("[")[0].strip().lower() for name in table.column_names]
    if twice := sorted({name for name in listed if name in KNOWN and listed.count(name) > 1}):
        raise FileError(path, f"has two columns of one name: {_listed(twice)}; a name is what stands before its unit")
    columns = dict(zip(listed, table.columns, strict=True))
    spellings = SPELLINGS
    if b"speeds_before" in (table.schema.metadata or {}):  # quadsim's own
        spellings = {**SPELLINGS, "euler_rates": ("roll_rate pitch_rate yaw_rate",)}
    fields = {field: spelt for field, ways in spellings.items() if (spelt := _spelling(ways, columns))}
    for what, needed in NEEDED_COLUMNS.items():
        if not {*needed} & {*fields}:
            ways = " or ".join(spellings[field][0].replace(" ", ",") for field in needed if field in spellings)
            raise FileError(path, f"lacks {what}: columns {ways}; it has {_listed(columns)}")
    t = _time(path, columns)
    values = {
        field: np.stack([_numbers(path, name, columns[name]) for name in names], axis=1)
        for field, names in fields.items()
    }
    series = {field: SampledSeries(t=t, values=rows) for field, rows in _in_our_units(path.name, values, poles).items()}
    plant = path.parent / PLANT_FILE
    if path.name == FLIGHT_FILE and plant.is_file() and "voltage" in (battery := read_parquet(plant)).column_names:
        clock, volts = (np.asarray(battery.column(name), float) for name in ("t", "voltage"))
        series["voltage"] = SampledSeries(t=t, values=np.interp(t, clock, volts)[:, None])
    return series


def _read_csv(path: Path) -> pa.Table:
    try:
        with path.open("rb") as file:
            header = file.readline()
            file.seek(0)
            separator = max(",", ";", "\t", key=lambda mark: header.count(mark.encode()))
            options = pa.csv.ParseOptions(delimiter=separator)
            threads = pa.csv.ReadOptions(use_threads=False)
            return pa.csv.read_csv(file, parse_options=options, read_options=threads)
    except (OSError, pa.ArrowException) as error:
        raise FileError(path, f"is not a readable CSV table ({error})") from error


def _listed(columns: Iterable[str]) -> str:
    return ", ".join([*columns][:40])


def _spelling(ways: tuple[str, ...], columns: Mapping[str, Any]) -> list[str] | None:
    """The first spelling of which every column is there."""
    return next((way.split() for way in ways if {*way.split()} <= {*columns}), None)


def _numbers(path: Path, name: str, column: pa.ChunkedArray) -> Array:
    try:
        return np.array(column.cast(pa.float64()).to_numpy(), float)  # a copy, null as NaN
    except (pa.ArrowException, ValueError) as error:
        raise FileError(path, f"column {name} must be numbers ({str(error)[:80]})") from error


def _time(path: Path, columns: Mapping[str, pa.ChunkedArray]) -> Array:
    """The time [s] of each row."""
    name = next((name for name in (*TIME_COLUMNS, *TIMES_OF_ANY_UNIT) if name in columns), None)
    if name is None:
        allowed = ", ".join((*TIME_COLUMNS, *TIMES_OF_ANY_UNIT))
        raise FileError(path, f"lacks a column of time: one of {allowed}; it has {_listed(columns)}")
    t = _numbers(path, name, columns[name])
    step = float(np.median(np.abs(np.diff(t)))) if t.size > 1 else 1.0
    return t * TIME_COLUMNS.get(name, 1.0 if step < 0.5 else 1e-3 if step < 200.0 else 1e-6)


def _in_our_units(name: str, values: dict[str, Array], poles: int | None) -> dict[str, Array]:
    """The fields of a record, converted where the table has them otherwise."""
    euler, erpm, rpm = values.pop("euler", None), values.pop("erpm", None), values.pop("rpm", None)
    euler_rates = values.pop("euler_rates", None)
    if "attitude" in values:
        euler = None
    if euler is not None:
        values["attitude"] = euler_to_quaternion(euler)
    if "rates" not in values and euler is not None and euler_rates is not None:
        values["rates"] = euler_to_body_rates(euler, euler_rates)
    if erpm is not None and "speeds" not in values:
        if poles is None:
            raise InputError(f"{name}: erpm is an electrical speed: give the poles (magnets) of each motor, e.g. 14")
        if poles < 2 or poles % 2:
            raise ParameterError("", "poles", poles, "an even number of magnets, 2 or more")
        values["speeds"] = np.where(erpm == NO_ERPM, np.nan, erpm) / (poles / 2.0) * RPM
    elif poles is not None:
        raise InputError(f"{name}: poles turn eRPM into speeds, and there is no erpm1..4; leave poles out")
    elif rpm is not None and "speeds" not in values:
        values["speeds"] = rpm * RPM
    for field, (low, high, rule) in RANGES.items():
        rows = values.get(field, euler[:, :2] if field == "euler" and euler is not None else None)
        if rows is not None and not (low <= np.nanmin(rows, initial=low) and np.nanmax(rows, initial=low) <= high):
            raise InputError(f"{name}: {rule}; got {np.nanmin(rows):.4g} to {np.nanmax(rows):.4g}")
    return values
