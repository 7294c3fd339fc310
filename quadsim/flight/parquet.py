"""A flight log's Parquet files.

Three tables: control periods (`flight.parquet`), clock times (`timing.parquet`, the only one that differs between two
equal flights), and the plant between commands (`plant.parquet`). A fourth, `horizon.parquet`, keeps the predicted
positions of every period for figures and films.
"""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from quadsim.errors import FileError
from quadsim.flight.log import (
    COLUMNS,
    COUNT,
    TEXT,
    Columns,
    ControlLog,
    FlightLog,
    PlantLog,
    PredictedPositions,
    TimingLog,
    columns_of,
)
from quadsim.input_limits import LARGEST_TABLE, LARGEST_TEXTS, MOST_COLUMNS, MOST_ROWS
from quadsim.state import Array

FORMAT: Final = 2
"""Version of the files of runs and campaigns; to be raised when a file of an earlier version would be misread."""
FLIGHT_FILE: Final = "flight.parquet"
TIMING_FILE: Final = "timing.parquet"
PLANT_FILE: Final = "plant.parquet"
HORIZON_FILE: Final = "horizon.parquet"


class _Column(NamedTuple):
    """A column of a table that is to be written."""

    name: str
    unit: str
    gaps: bool  # whether some rows may lack a value
    values: pa.Array


def _columns(log: ControlLog | TimingLog | PlantLog, *, without: str = "") -> Iterator[_Column]:
    """The columns of a log's fields, but for fields that are None and the one named `without`."""
    for field_name, stated in columns_of(type(log)).items():
        rows = getattr(log, field_name)
        if rows is None or field_name == without:
            continue
        if len(stated.units) == 1:
            by_column = [rows]
        else:
            by_column = rows.T
        arrow_type = None  # that of the values
        if stated.kind == TEXT:
            arrow_type = pa.string()
        for (name, unit), entries in zip(stated.units.items(), by_column, strict=True):
            values = pa.array(entries, arrow_type, from_pandas=stated.gaps)
            yield _Column(name=name, unit=unit, gaps=stated.gaps, values=values)


def _logged(log: ControlLog) -> Iterator[_Column]:
    """The columns that the controller logged."""
    for name, (unit, values) in log.logged.items():
        array = pa.array(values, from_pandas=True)
        yield _Column(name=name, unit=unit, gaps=array.null_count > 0, values=array)


def _table(columns: Iterable[_Column], metadata: Mapping[str, str]) -> pa.Table:
    """Return a table of the columns; its schema has their units and gaps, the `metadata`, and the format."""
    arrays = []
    fields = []
    for column in columns:
        arrays.append(column.values)
        fields.append(pa.field(column.name, column.values.type, nullable=column.gaps, metadata={"unit": column.unit}))
    schema = pa.schema(fields, metadata={**metadata, "format": str(FORMAT)})
    return pa.Table.from_arrays(arrays, schema=schema)


def require_format(stated: object, path: Path, again: str) -> None:
    """Refuse a file of another version of quadsim.

    Args:
        stated: the format that the file states; None if it states none.
        path: of the file.
        again: the command that makes the file anew.

    Raises:
        FileError: the format is not `FORMAT`.
    """
    if str(stated) == str(FORMAT):
        return
    difference = f"format {str(stated)[:20]!r}, this one has {FORMAT}"
    if stated is None:
        difference = f"an unnumbered format, this one has {FORMAT}"
    raise FileError(path, f"was made by another version of quadsim ({difference}); fly it again: {again}")


def format_of(table: pa.Table) -> str | None:
    """The format that a table states; None if it states none."""
    stated: bytes | None = (table.schema.metadata or {}).get(b"format")
    if stated is None:
        return None
    return stated.decode("utf-8", "replace")


def log_tables(log: FlightLog, *, plant_stride: int = 1, metadata: Mapping[str, str]) -> dict[str, pa.Table]:
    """A flight's tables `flight`, `timing`, `plant`, and `horizon` if positions were predicted; see `write_log`."""
    control = log.control
    left_out = ""
    if control.measured_perfectly:
        left_out = "truth"  # it equals the measured state, which is written
    speeds_before = ",".join(repr(float(speed)) for speed in control.speeds_before)
    flight_columns = [*_columns(control, without=left_out), *_logged(control)]
    tables = {
        "flight": _table(flight_columns, {**metadata, "speeds_before": speeds_before}),
        "timing": _table(_columns(log.timing), metadata),
        "plant": _table(_columns(log.plant.every(plant_stride)), metadata),
    }
    if log.predicted is not None:
        tables["horizon"] = _table(_predicted_columns(control.t, log.predicted), metadata)
    return tables


def _predicted_columns(t: Array, predicted: PredictedPositions) -> Iterator[_Column]:
    """The columns of the positions (K, N, 3) [m] that were predicted at times (K,) [s]; each row has N per axis."""
    yield _Column(name="t", unit="s", gaps=False, values=pa.array(t))
    horizon = predicted.shape[1]
    for i, axis in enumerate("xyz"):
        positions = pa.FixedSizeListArray.from_arrays(predicted[:, :, i].ravel(), horizon)
        yield _Column(name=f"predicted_{axis}", unit="m", gaps=False, values=positions)


def write_log(directory: Path, log: FlightLog, *, plant_stride: int, metadata: Mapping[str, str]) -> None:
    """Write a flight's Parquet files into an existing directory.

    Every `plant_stride`-th physics step is a row of `plant.parquet`. `metadata`, texts without clock times, is stored
    in each file's schema.
    """
    for name, table in log_tables(log, plant_stride=plant_stride, metadata=metadata).items():
        with (directory / f"{name}.parquet").open("wb") as file:  # Arrow takes no path that is not Unicode
            pq.write_table(table, file, compression="zstd")


def read_parquet(path: Path) -> pa.Table:
    """Read a Parquet file in the calling thread.

    Arrow's own threads may still hold the file when Python exits; a thread that then takes Python's lock aborts the
    process (https://github.com/apache/arrow/issues/34314).

    Raises:
        FileError: it is missing, not a file, damaged, or too large.
    """
    if not path.is_file():  # reading a pipe would block
        raise FileError(path, "is not a readable Parquet file (missing, or not a file)")
    try:
        with path.open("rb") as file:  # Arrow takes no path that is not Unicode
            return _read_bounded(path, pq.ParquetFile(file, pre_buffer=False))
    except FileError:
        raise
    except (OSError, ValueError, pa.ArrowException) as error:
        raise FileError(path, f"is not a readable Parquet file ({error})") from error


def _read_bounded(path: Path, file: pq.ParquetFile) -> pa.Table:
    """Read a table that fits in memory.

    A file of a few bytes may hold any number of equal values.  Its numbers are therefore counted before they are read.
    A text that the file stores once may occur in each row: only a table that fits even then is read as a whole, another
    one in batches, until it is too large.
    """
    rows = file.metadata.num_rows
    columns = file.metadata.num_columns
    if rows > MOST_ROWS or columns > MOST_COLUMNS:
        raise FileError(path, f"must have at most {MOST_ROWS} rows and {MOST_COLUMNS} columns; got {rows}, {columns}")
    largest = f"{LARGEST_TABLE} bytes of numbers and {LARGEST_TEXTS} of texts"
    too_large = FileError(path, f"must be of at most {largest} in memory; it has more")
    numbers, texts = _sizes(file.metadata)
    if numbers > LARGEST_TABLE:
        raise too_large
    if rows * texts <= LARGEST_TEXTS:
        return file.read(use_threads=False)
    table = _read_in_batches(file, texts, numbers + LARGEST_TEXTS)
    if table is None:
        raise too_large
    return table


def _sizes(metadata: pq.FileMetaData) -> tuple[int, int]:
    """Return the bytes of all numbers of a file in memory, and of its texts as the file stores them."""
    numbers = 0
    texts = 0
    for i in range(metadata.num_row_groups):
        group = metadata.row_group(i)
        for j in range(metadata.num_columns):
            chunk = group.column(j)
            numbers += 8 * chunk.num_values  # the widest number has 8 bytes
            if chunk.physical_type.endswith("BYTE_ARRAY"):
                texts += chunk.total_uncompressed_size
    return numbers, texts


def _read_in_batches(file: pq.ParquetFile, texts: int, most: int) -> pa.Table | None:
    """Read a table in batches that fit even with every text in each row; return None if the table does not fit.

    Args:
        file: of the table.
        texts: bytes of its texts in the file, at least 1.
        most: bytes that the table may have in memory.
    """
    batch_bytes = LARGEST_TEXTS // 16
    rows_per_batch = max(1, batch_bytes // texts)
    batches = []
    remaining = most
    for batch in file.iter_batches(rows_per_batch, use_threads=False):
        batches.append(batch)
        remaining -= batch.nbytes
        if remaining < 0:
            return None
    return pa.Table.from_batches(batches, file.schema_arrow)


def _fields(table: pa.Table, log: type[Any], *, optional: str = "") -> dict[str, Any]:
    """Return the fields of a log, by name, as its table has them.

    A field that is optional in the log, and the one named `optional`, is None if the table lacks its columns.
    """
    values: dict[str, Any] = {}
    for name, stated in columns_of(log).items():
        may_be_absent = stated.optional or name == optional
        is_complete = set(stated.units) <= set(table.column_names)
        if may_be_absent and not is_complete:
            values[name] = None
            continue
        columns = [_values(table, column, stated) for column in stated.units]
        if len(columns) == 1:
            values[name] = columns[0]
        else:
            values[name] = np.stack(columns, axis=1)
    return values


def _values(table: pa.Table, name: str, stated: Columns) -> Any:
    """Return a column's values: a tuple of texts, or an array of numbers, NaN where one is missing.

    Raises:
        ValueError: it is not what its field states.
    """
    column = table.column(name)
    if stated.kind == TEXT:
        texts = tuple(column.to_pylist())
        if not all(isinstance(text, str) for text in texts):
            raise ValueError(f"{name} is not text throughout")
        return texts
    if column.null_count and not stated.gaps:
        raise ValueError(f"{name} has gaps")
    if stated.kind == COUNT:
        return np.asarray(column.to_numpy(), dtype=np.int64)
    return np.asarray(column.to_numpy(), dtype=np.float64)


def read_log(directory: Path, *, reason: str | None = None) -> FlightLog:
    """Read a flight back from its run directory, the plant's rows at the log rate.

    Args:
        directory: of the run.
        reason: why the flight ended early, as its summary states it.

    Raises:
        FileError: a file is missing or damaged.
    """
    tables = {name: read_parquet(directory / name) for name in (FLIGHT_FILE, TIMING_FILE, PLANT_FILE)}
    again = f"quadsim run {shlex.quote(str(directory / 'scenario.toml'))}"
    for name, table in tables.items():
        require_format(format_of(table), directory / name, again)
    try:
        log = FlightLog(
            control=_read_control(tables[FLIGHT_FILE]),
            timing=TimingLog(**_fields(tables[TIMING_FILE], TimingLog)),
            plant=PlantLog(**_fields(tables[PLANT_FILE], PlantLog)),
            predicted=_read_predicted(directory / HORIZON_FILE),
            reason=reason,
        )
        _require_consistent(log)
    except FileError:
        raise
    except (AttributeError, ArithmeticError, KeyError, TypeError, ValueError, pa.ArrowException) as error:
        raise FileError(directory, f"lacks or misstates a column of the flight log ({error})") from error
    return log


def _read_control(table: pa.Table) -> ControlLog:
    """Return the control periods of `flight.parquet`."""
    before = (table.schema.metadata or {})[b"speeds_before"]
    speeds_before = np.array([float(text) for text in before.split(b",")])
    values = _fields(table, ControlLog, optional="truth")
    if values["truth"] is None:
        values["truth"] = values["state"]
    logged = {}
    for field in table.schema:
        if field.name not in COLUMNS:
            unit = field.metadata[b"unit"].decode()
            logged[field.name] = (unit, np.asarray(table.column(field.name), np.float64))
    return ControlLog(**values, logged=logged, speeds_before=speeds_before)


def _require_consistent(log: FlightLog) -> None:
    """Refuse tables that are empty or differ in length, and times that do not increase.

    Raises:
        ValueError: saying which of these it is.
    """
    lengths = {log.control.t.size, log.timing.t.size}
    if log.predicted is not None:
        lengths.add(len(log.predicted))
    if len(lengths) > 1 or not log.plant.t.size:
        raise ValueError("its tables are empty or differ in length")
    for t in (log.control.t, log.plant.t):
        if not np.isfinite(t).all() or (np.diff(t) <= 0.0).any():
            raise ValueError("t does not increase")


def _read_predicted(path: Path) -> PredictedPositions | None:
    """Return the predicted positions (K, N, 3) [m]; None if the flight has none."""
    if not path.exists():
        return None
    table = read_parquet(path)
    columns = [table.column(f"predicted_{axis}").combine_chunks() for axis in "xyz"]
    shape = (table.num_rows, columns[0].type.list_size)  # also valid for a flight without periods
    by_axis = [column.flatten().to_numpy().reshape(shape) for column in columns]
    return np.stack(by_axis, axis=-1)
