"""Tables as logs: CSV, Parquet, and quadsim's own `flight.parquet`, their columns by the names that are in use.

A reader like those of the autopilots' formats: it gives `record` columns by name, all on the clock of the table's rows.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np
import pyarrow as pa
import pyarrow.csv

from quadsim.errors import FileError
from quadsim.features.identify.quantities import (
    MAP_ADVICE,
    LoggedColumns,
    NamedQuantity,
    listed,
    logged_as,
    usual_names,
)
from quadsim.features.identify.series import Column
from quadsim.flight.parquet import FLIGHT_FILE, PLANT_FILE, read_parquet
from quadsim.rotation import euler_to_body_rates
from quadsim.state import Array

_NAMES: Final = (
    *usual_names("position", "x y z", "px py pz", "pos_x pos_y pos_z"),
    *usual_names("velocity", "vx vy vz", "vel_x vel_y vel_z"),
    *usual_names("specific_force", "ax ay az", "acc_x acc_y acc_z", "accel_x accel_y accel_z"),
    *usual_names("attitude", "qw qx qy qz", "q_w q_x q_y q_z"),
    *usual_names("euler", "roll pitch yaw"),
    *usual_names("rates", "wx wy wz", "p q r", "gyro_x gyro_y gyro_z", "body_rate_x body_rate_y body_rate_z"),
    *usual_names("commands", "u1 u2 u3 u4"),
    *usual_names("throttle", "throttle1 throttle2 throttle3 throttle4"),
    *usual_names("speeds", "w1 w2 w3 w4"),
    *usual_names("speeds", "rpm1 rpm2 rpm3 rpm4", "m1_rpm m2_rpm m3_rpm m4_rpm", unit="rpm"),
    *usual_names("erpm", "erpm1 erpm2 erpm3 erpm4", "m1_erpm m2_erpm m3_erpm m4_erpm"),
    *usual_names("voltage", "voltage", "vbat"),
)
_TIMES: Final = (
    *usual_names("t", "t", "t_s", "time_s"),
    *usual_names("t", "t_ms", "time_ms", "timestamp_ms", unit="ms"),
    *usual_names("t", "t_us", "time_us", "timestamp_us", unit="us"),
    replace(logged_as("t", "t_us", unit="us"), columns=("time (us)",)),  # as blackbox_decode writes it
)
_TIMES_OF_ANY_UNIT: Final = ("time", "timestamp")
"""Columns of time in s, ms or us: their step shows which, as a log has 10 to 1000 samples per second."""


def _names_of(quantities: Iterable[NamedQuantity]) -> set[str]:
    return {column for named in quantities for column in named.columns}


_NAMES_IN_USE: Final = {*_TIMES_OF_ANY_UNIT, *_names_of(_NAMES), *_names_of(_TIMES)}
_WRITTEN_BY_QUADSIM: Final = b"speeds_before"  # in the metadata of its tables


def read_columns(path: Path, column_map: Sequence[NamedQuantity]) -> LoggedColumns:
    """Read a table's columns: those that a map names, and those with a name that is in use.

    A name is what stands before its unit in brackets, in any case; a map may also name a column in full.

    Raises:
        FileError: it is no table, has no column of time or two of one name, or a column is not of numbers.
    """
    if path.suffix.lower() == ".csv":
        table = _read_csv(path)
    else:
        table = read_parquet(path)
    names = [name.partition("[")[0].strip().lower() for name in table.column_names]
    twice = sorted({name for name in names if name in _NAMES_IN_USE and names.count(name) > 1})
    if twice:
        raise FileError(path, f"has two columns of one name: {listed(twice)}; a name is what stands before its unit")
    logged = dict(zip(names, table.columns, strict=True))
    for full_name, column in zip(table.column_names, table.columns, strict=True):
        logged[full_name.strip()] = column
    used = _NAMES_IN_USE | _names_of(column_map)
    t = _time(path, logged, column_map)
    columns = {}
    for name, column in logged.items():
        values = t  # of a column that nobody reads
        if name in used:
            values = _numbers(path, name, column)
        columns[name] = Column(t, values)
    if _WRITTEN_BY_QUADSIM in (table.schema.metadata or {}):
        columns |= _body_rates(path, t, logged)
    if path.name == FLIGHT_FILE:
        columns |= _voltage(path.parent / PLANT_FILE, t)
    return LoggedColumns(columns=columns, quantities=_NAMES)


def _body_rates(path: Path, t: Array, logged: Mapping[str, pa.ChunkedArray]) -> dict[str, Column]:
    """Body rates from the Euler angles and rates of quadsim's own table."""

    def stacked(names: str) -> Array:
        return np.stack([_numbers(path, name, logged[name]) for name in names.split()], axis=1)

    rates = euler_to_body_rates(stacked("roll pitch yaw"), stacked("roll_rate pitch_rate yaw_rate"))
    return {name: Column(t, rate) for name, rate in zip(("wx", "wy", "wz"), rates.T, strict=True)}


def _voltage(plant: Path, t: Array) -> dict[str, Column]:
    """The battery's voltage from the table of the plant that lies beside a flight's, where it has any."""
    if not plant.is_file():
        return {}
    table = read_parquet(plant)
    if "voltage" not in table.column_names:
        return {}
    plant_t = np.asarray(table.column("t"), float)
    volts = np.asarray(table.column("voltage"), float)
    return {"voltage": Column(t, np.interp(t, plant_t, volts))}


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


def _time(path: Path, columns: Mapping[str, pa.ChunkedArray], column_map: Sequence[NamedQuantity]) -> Array:
    """The time [s] of each row."""
    mapped = [named for named in column_map if named.quantity == "t"]
    for named in (*mapped, *_TIMES):
        (name,) = named.columns
        if name in columns:
            return np.asarray(_numbers(path, name, columns[name]) * named.scale)
    for name in _TIMES_OF_ANY_UNIT:
        if name in columns:
            t = _numbers(path, name, columns[name])
            return t * _unit_of_time(t)
    names = [named.columns[0] for named in _TIMES]
    allowed = ", ".join([*names, *_TIMES_OF_ANY_UNIT])
    raise FileError(path, f"lacks a column of time: one of {allowed}; it has {listed(columns)}{MAP_ADVICE}")


def _unit_of_time(t: Array) -> float:
    """The unit of times [s], by their usual step: s, ms or us."""
    if t.size < 2:
        return 1e-3
    step = float(np.median(np.abs(np.diff(t))))
    if step < 0.5:
        return 1.0
    if step < 200.0:
        return 1e-3
    return 1e-6
