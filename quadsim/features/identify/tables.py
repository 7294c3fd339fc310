"""Tables as logs: CSV, Parquet, and quadsim's own `flight.parquet`, their columns by the names that are in use."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np
import pyarrow as pa
import pyarrow.csv

from quadsim.errors import FileError
from quadsim.features.identify.quantities import MAPPED, LoggedColumns, NamedQuantity, listed, logged_as
from quadsim.features.identify.series import Column
from quadsim.flight.parquet import FLIGHT_FILE, PLANT_FILE, read_parquet
from quadsim.rotation import euler_to_body_rates
from quadsim.state import Array

_NAMES: Final = (
    *(logged_as("position", way) for way in ("x y z", "px py pz", "pos_x pos_y pos_z")),
    *(logged_as("velocity", way) for way in ("vx vy vz", "vel_x vel_y vel_z")),
    *(logged_as("specific_force", way) for way in ("ax ay az", "acc_x acc_y acc_z", "accel_x accel_y accel_z")),
    *(logged_as("attitude", way) for way in ("qw qx qy qz", "q_w q_x q_y q_z")),
    logged_as("euler", "roll pitch yaw"),
    *(logged_as("rates", way) for way in ("wx wy wz", "p q r", "gyro_x gyro_y gyro_z")),
    logged_as("rates", "body_rate_x body_rate_y body_rate_z"),
    logged_as("commands", "u1 u2 u3 u4"),
    logged_as("throttle", "throttle1 throttle2 throttle3 throttle4"),
    logged_as("speeds", "w1 w2 w3 w4"),
    *(logged_as("speeds", way, unit="rpm") for way in ("rpm1 rpm2 rpm3 rpm4", "m1_rpm m2_rpm m3_rpm m4_rpm")),
    *(logged_as("erpm", way) for way in ("erpm1 erpm2 erpm3 erpm4", "m1_erpm m2_erpm m3_erpm m4_erpm")),
    *(logged_as("voltage", way) for way in ("voltage", "vbat")),
)
_TIMES: Final = (
    *(logged_as("t", name) for name in ("t", "t_s", "time_s")),
    *(logged_as("t", name, unit="ms") for name in ("t_ms", "time_ms", "timestamp_ms")),
    *(logged_as("t", name, unit="us") for name in ("t_us", "time_us", "timestamp_us")),
    replace(logged_as("t", "t_us", unit="us"), columns=("time (us)",)),  # as blackbox_decode writes it
)
_TIMES_OF_ANY_UNIT: Final = ("time", "timestamp")
"""Columns of time in s, ms or us: their step tells which, as a log has 10 to 1000 samples per second."""
_KNOWN: Final = {*_TIMES_OF_ANY_UNIT, *(column for one in (*_NAMES, *_TIMES) for column in one.columns)}


def read_columns(path: Path, given: Sequence[NamedQuantity]) -> LoggedColumns:
    """Read a table's columns: those that a map names, and those with a name that is in use.

    A name is what stands before its unit in brackets, in any case; a map may also name a column in full.

    Raises:
        FileError: it is no table, has no column of time or two of one name, or a column is not of numbers.
    """
    if path.suffix.lower() == ".csv":
        table = _read_csv(path)
    else:
        table = read_parquet(path)
    short = [name.partition("[")[0].strip().lower() for name in table.column_names]
    if twice := sorted({name for name in short if name in _KNOWN and short.count(name) > 1}):
        raise FileError(path, f"has two columns of one name: {listed(twice)}; a name is what stands before its unit")
    found = dict(zip(short, table.columns, strict=True))
    found |= {name.strip(): column for name, column in zip(table.column_names, table.columns, strict=True)}
    used = _KNOWN | {column for one in given for column in one.columns}
    t = _time(path, found, given)
    columns = {}
    for name, column in found.items():
        columns[name] = Column(t, _numbers(path, name, column) if name in used else t)
    if b"speeds_before" in (table.schema.metadata or {}):  # quadsim's own
        angles, rates = (
            np.stack([_numbers(path, name, found[name]) for name in names.split()], axis=1)
            for names in ("roll pitch yaw", "roll_rate pitch_rate yaw_rate")
        )
        turning = euler_to_body_rates(angles, rates).T
        columns |= {name: Column(t, rate) for name, rate in zip(("wx", "wy", "wz"), turning, strict=True)}
    plant = path.parent / PLANT_FILE
    if path.name == FLIGHT_FILE and plant.is_file() and "voltage" in (battery := read_parquet(plant)).column_names:
        clock, volts = (np.asarray(battery.column(name), float) for name in ("t", "voltage"))
        columns["voltage"] = Column(t, np.interp(t, clock, volts))
    return LoggedColumns(columns=columns, quantities=_NAMES)


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


def _numbers(path: Path, name: str, column: pa.ChunkedArray) -> Array:
    try:
        return np.array(column.cast(pa.float64()).to_numpy(), float)  # a copy, null as NaN
    except (pa.ArrowException, ValueError) as error:
        raise FileError(path, f"column {name} must be numbers ({str(error)[:80]})") from error


def _time(path: Path, columns: Mapping[str, pa.ChunkedArray], given: Sequence[NamedQuantity]) -> Array:
    """The time [s] of each row."""
    times = [*(one for one in given if one.quantity == "t"), *_TIMES]
    if one := next((one for one in times if one.columns[0] in columns), None):
        return np.asarray(_numbers(path, one.columns[0], columns[one.columns[0]]) * one.scale)
    name = next((name for name in _TIMES_OF_ANY_UNIT if name in columns), None)
    if name is None:
        allowed = ", ".join((*(one.columns[0] for one in _TIMES), *_TIMES_OF_ANY_UNIT))
        raise FileError(path, f"lacks a column of time: one of {allowed}; it has {listed(columns)}{MAPPED}")
    t = _numbers(path, name, columns[name])
    if t.size > 1:
        step = float(np.median(np.abs(np.diff(t))))
    else:
        step = 1.0
    return t * (1.0 if step < 0.5 else 1e-3 if step < 200.0 else 1e-6)
