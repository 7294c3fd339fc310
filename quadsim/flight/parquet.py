"""A flight log's Parquet files.

Three tables, as in the file contract: what happened once per control period (`flight.parquet`), what a clock measured
(`timing.parquet`, the only one that differs between two equal flights), and the plant between commands
(`plant.parquet`).  A fourth, `horizon.parquet`, keeps the predicted positions of every period for pictures.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from quadsim.errors import FileError
from quadsim.flight.log import (
    BODY_RATES,
    QUATERNION,
    RESIDUALS,
    SQP_RESIDUAL,
    WIND,
    WRENCH,
    ControlLog,
    FlightLog,
    PlantLog,
    TimingLog,
)
from quadsim.state import REFERENCE_NAMES, REFERENCE_UNITS, STATE_NAMES, STATE_UNITS, Array
from quadsim.vehicle import N_ROTORS

FLIGHT_FILE: Final = "flight.parquet"
TIMING_FILE: Final = "timing.parquet"
PLANT_FILE: Final = "plant.parquet"
HORIZON_FILE: Final = "horizon.parquet"
_TRUE: Final = "true_"  # how the columns of the true state begin, which are there where the measured one differs
_REFERENCES: Final = tuple(f"ref_{name}" for name in REFERENCE_NAMES)
_COMMANDED: Final = tuple(f"u{i}" for i in range(1, N_ROTORS + 1))
_TURNING: Final = tuple(f"w{i}" for i in range(1, N_ROTORS + 1))
_SPEED_UNITS: Final = ("rad/s",) * N_ROTORS
_TIMES: Final = {"t": "s", "solve_ms": "ms", "step_ms": "ms"}
_COUNTS: Final = ("iterations", "active", "fallback")
_NUMBERS: Final = {"slack": "rad", **dict.fromkeys(RESIDUALS, "-"), "delay": "s"}
"""Columns of one number in each period, with their units; those of counts have none."""

_Column = tuple[str, str, Any]


def _columns(rows: Array, names: Iterable[str], units: Iterable[str]) -> Iterator[_Column]:
    return zip(names, units, rows.T, strict=True)


def _state_columns(state: Array, prefix: str = "") -> Iterator[_Column]:
    return _columns(state, (prefix + name for name in STATE_NAMES), STATE_UNITS)


def _optional(*groups: tuple[Array | None, Mapping[str, str]]) -> Iterator[_Column]:
    """The columns of those groups that are there, each with its names and units."""
    for rows, units in groups:
        if rows is not None:
            yield from _columns(rows, units, units.values())


def _table(columns: Sequence[_Column], metadata: Mapping[str, str]) -> pa.Table:
    arrays, schema = [], []
    for name, unit, values in columns:
        array = values if isinstance(values, pa.Array) else pa.array(values, from_pandas=name in RESIDUALS)
        arrays.append(array)
        nullable = name in RESIDUALS or name in SQP_RESIDUAL
        schema.append(pa.field(name, array.type, nullable=nullable, metadata={"unit": unit}))
    return pa.Table.from_arrays(arrays, schema=pa.schema(schema, metadata=dict(metadata)))


def _flight_table(log: ControlLog, metadata: Mapping[str, str]) -> pa.Table:
    columns: list[_Column] = [
        ("t", "s", log.t),
        *_state_columns(log.state),
        *_columns(log.reference, _REFERENCES, REFERENCE_UNITS),
        *_columns(log.speeds, _COMMANDED, _SPEED_UNITS),
        ("status", "-", pa.array(log.status, pa.string())),
        ("answered_by", "-", pa.array(log.answered_by, pa.string())),
        ("phase", "-", pa.array(log.phase, pa.string())),
        *((name, "-", getattr(log, name)) for name in _COUNTS),
        *((name, unit, getattr(log, name)) for name, unit in _NUMBERS.items()),
        *([] if log.measured_perfectly else _state_columns(log.truth, _TRUE)),
        *_optional((log.attitude, QUATERNION), (log.body_rates, BODY_RATES)),
        *((name, unit, pa.array(rows, from_pandas=True)) for name, unit, rows in _optional((log.sqp, SQP_RESIDUAL))),
    ]
    before = ",".join(repr(float(speed)) for speed in log.speeds_before)
    return _table(columns, {**metadata, "speeds_before": before})


def _plant_table(log: PlantLog, metadata: Mapping[str, str]) -> pa.Table:
    columns = [("t", "s", log.t), *_state_columns(log.state), *_columns(log.speeds, _TURNING, _SPEED_UNITS)]
    columns += _optional(
        (log.wrench, WRENCH), (log.wind, WIND), (log.attitude, QUATERNION), (log.body_rates, BODY_RATES)
    )
    return _table(columns, metadata)


def _horizon_table(t: Array, predicted: np.ndarray[Any, np.dtype[np.float32]], metadata: Mapping[str, str]) -> pa.Table:
    horizon = predicted.shape[1]
    lists = (pa.FixedSizeListArray.from_arrays(predicted[:, :, i].ravel(), horizon) for i in range(3))
    return _table(
        [("t", "s", t), *((f"predicted_{axis}", "m", a) for axis, a in zip("xyz", lists, strict=True))], metadata
    )


def log_tables(log: FlightLog, *, plant_stride: int = 1, metadata: Mapping[str, str]) -> dict[str, pa.Table]:
    """A flight's tables `flight`, `timing`, `plant`, and `horizon` where positions were predicted; see `write_log`."""
    tables = {
        "flight": _flight_table(log.control, metadata),
        "timing": _table([(name, unit, getattr(log.timing, name)) for name, unit in _TIMES.items()], metadata),
        "plant": _plant_table(log.plant.every(plant_stride), metadata),
    }
    if log.predicted is not None:
        tables["horizon"] = _horizon_table(log.control.t, log.predicted, metadata)
    return tables


def write_log(directory: Path, log: FlightLog, *, plant_stride: int, metadata: Mapping[str, str]) -> None:
    """Write a flight's Parquet files into an existing directory.

    Every `plant_stride`-th physics step is a row of `plant.parquet`; `metadata`, texts without clock times, is stored
    in each file's schema.
    """
    for name, table in log_tables(log, plant_stride=plant_stride, metadata=metadata).items():
        _write(table, directory / f"{name}.parquet")


def _write(table: pa.Table, path: Path) -> None:
    with path.open("wb") as file:  # Arrow by itself takes no path that is no Unicode
        pq.write_table(table, file, compression="zstd")


def read_parquet(path: Path) -> pa.Table:
    """A Parquet file, read by the calling thread alone.

    Arrow's own threads may still hold the file when Python ends, and a thread that takes Python's lock then aborts the
    process (https://github.com/apache/arrow/issues/34314).

    Raises:
        FileError: it is missing, no file, or damaged.
    """
    if not path.is_file():  # reading a pipe would not end
        raise FileError(path, "is not a readable Parquet file (it is missing or no file)")
    try:
        with path.open("rb") as file:  # Arrow by itself takes no path that is no Unicode
            return pq.ParquetFile(file, pre_buffer=False).read(use_threads=False)
    except (OSError, ValueError, pa.ArrowException) as error:
        raise FileError(path, f"is not a readable Parquet file ({error})") from error


def _stack(table: pa.Table, names: Sequence[str]) -> Array:
    return np.stack([_numbers(table, name) for name in names], axis=1)


def _stack_if_there(table: pa.Table, names: Sequence[str]) -> Array | None:
    return _stack(table, names) if set(names) <= set(table.column_names) else None


def _numbers(table: pa.Table, name: str, kind: type = np.float64) -> np.ndarray[Any, Any]:
    column = table.column(name)
    if column.null_count and name not in RESIDUALS and name not in SQP_RESIDUAL:
        raise ValueError(f"{name} has gaps")
    return np.asarray(column.to_numpy(), dtype=kind)


def _texts(table: pa.Table, name: str) -> tuple[str, ...]:
    texts = tuple(table.column(name).to_pylist())
    if not all(isinstance(text, str) for text in texts):
        raise ValueError(f"{name} is not text throughout")
    return texts


def read_log(directory: Path, *, reason: str | None = None) -> FlightLog:
    """Read a flight back from its run directory, the plant's rows at the log rate; its summary has the `reason`.

    Raises:
        FileError: a file is missing or damaged.
    """
    flight, timing, plant = (read_parquet(directory / name) for name in (FLIGHT_FILE, TIMING_FILE, PLANT_FILE))
    try:
        before = np.array([float(text) for text in (flight.schema.metadata or {})[b"speeds_before"].split(b",")])
        state = _stack(flight, STATE_NAMES)
        truth = _stack_if_there(flight, [_TRUE + name for name in STATE_NAMES])
        control = ControlLog(
            t=_numbers(flight, "t"),
            state=state,
            truth=state if truth is None else truth,
            reference=_stack(flight, _REFERENCES),
            speeds=_stack(flight, _COMMANDED),
            speeds_before=before,
            status=_texts(flight, "status"),
            answered_by=_texts(flight, "answered_by"),
            phase=_texts(flight, "phase"),
            **{name: _numbers(flight, name, np.int64) for name in _COUNTS},
            **{name: _numbers(flight, name) for name in _NUMBERS},
            attitude=_stack_if_there(flight, list(QUATERNION)),
            body_rates=_stack_if_there(flight, list(BODY_RATES)),
            sqp=_stack_if_there(flight, list(SQP_RESIDUAL)),
        )
        plant_log = PlantLog(
            t=_numbers(plant, "t"),
            state=_stack(plant, STATE_NAMES),
            speeds=_stack(plant, _TURNING),
            wrench=_stack_if_there(plant, list(WRENCH)),
            wind=_stack_if_there(plant, list(WIND)),
            attitude=_stack_if_there(plant, list(QUATERNION)),
            body_rates=_stack_if_there(plant, list(BODY_RATES)),
        )
        timing_log = TimingLog(**{name: _numbers(timing, name) for name in _TIMES})
        predicted = _read_predicted(directory)
        _require_whole(control, timing_log, plant_log, predicted)
    except FileError:
        raise
    except (AttributeError, ArithmeticError, KeyError, TypeError, ValueError, pa.ArrowException) as error:
        raise FileError(directory, f"lacks or misstates a column of the flight log ({error})") from error
    return FlightLog(control=control, timing=timing_log, plant=plant_log, predicted=predicted, reason=reason)


def _require_whole(
    control: ControlLog, timing: TimingLog, plant: PlantLog, predicted: np.ndarray[Any, np.dtype[np.float32]] | None
) -> None:
    """Refuse tables that are not of one flight."""
    rows = {control.t.size, timing.t.size, *(() if predicted is None else (len(predicted),))}
    if len(rows) > 1 or not plant.t.size:
        raise ValueError("its tables have not as many rows as one another, or none")
    for t in (control.t, plant.t):
        if not np.isfinite(t).all() or (np.diff(t) <= 0.0).any():
            raise ValueError("t does not increase")


def _read_predicted(directory: Path) -> np.ndarray[Any, np.dtype[np.float32]] | None:
    path = directory / HORIZON_FILE
    if not path.exists():
        return None
    table = read_parquet(path)
    columns = [table.column(f"predicted_{axis}").combine_chunks() for axis in "xyz"]
    shape = (table.num_rows, columns[0].type.list_size)  # also right for a flight of no period
    return np.stack([column.flatten().to_numpy().reshape(shape) for column in columns], axis=-1)
