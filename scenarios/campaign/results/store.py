"""A campaign's directory while it grows: nothing that was flown is lost, or there twice, whatever is killed.

Rows are appended as files of their own below `parts/`.  When all is flown the parts become `flights.parquet` and
`timing.parquet`, and go.
"""

from __future__ import annotations

import io
import time as clock
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from quadsim.errors import FileError
from quadsim.outputs import Growing
from scenarios.campaign.results.table import DRAW, TIMING, Row, make_table, numbers, read_table, split_times

_NEEDED: Final = ("flight", "seed", "status", "verdict", "failed", "violated", "crashed", "worst_margin")
"""Columns that no version left out; `flight` to `violated` have a value in every row."""
_FILLED: Final = _NEEDED[:6]
LARGEST: Final = 1e100  # magnitude of the largest number that a flight has; sums of squares of larger ones are infinite
FLIGHTS_FILE: Final = "flights.parquet"
TIMES_FILE: Final = "timing.parquet"
FLUSH_S: Final = 5.0  # how long an answer may wait in memory before it is on the disk [s]
PARTS_DIR: Final = "parts"
_PART: Final = "part-*.parquet"


def read_flights(path: Path, schema: pa.Schema) -> pa.Table:
    """`flights.parquet` of a campaign, whose schema it has; a table of an older version may have fewer columns.

    Raises:
        FileError: it cannot be read, a column is missing, not of the campaign or of another type, a number is too
            large, or flights are there twice, or in no order.
    """
    table = read_table(path)
    clock = {name for name, *_ in TIMING}
    drawn = [name for name in schema.names if name.startswith(DRAW)]
    missing = [name for name in (*_NEEDED, *drawn) if name not in table.column_names]
    if missing:
        raise FileError(path, f"lacks the column {missing[0]} of this campaign")
    require_columns(table, schema, path, without=clock)
    return table


def require_columns(table: pa.Table, schema: pa.Schema, path: Path, *, without: set[str] | None = None) -> None:
    """Refuse a table with a column that the schema does not have so, or with flights that are not numbered upwards.

    Raises:
        FileError: naming the column.
    """
    known = {field.name: field.type for field in schema if field.name not in (without or ())}
    if len(set(table.column_names)) < len(table.column_names):
        raise FileError(path, "has two columns of one name")
    for field in table.schema:
        if field.name not in known:
            raise FileError(path, "has other columns than this campaign")
        if field.type != known[field.name]:
            raise FileError(path, f"has in its column {field.name} {field.type} instead of {known[field.name]}")
        if field.name in _FILLED and table[field.name].null_count:
            raise FileError(path, f"has gaps in its column {field.name}")
    try:
        table.validate(full=True)
    except pa.ArrowException as error:
        raise FileError(path, f"is damaged ({error})") from error
    for field in table.schema:
        if pa.types.is_floating(field.type) and (np.abs(numbers(table, field.name)) > LARGEST).any():
            raise FileError(path, f"has a number beyond +-{LARGEST:g} in its column {field.name}")
    flights = table["flight"].to_numpy()
    if flights.size and (flights[0] < 0 or (np.diff(flights) <= 0).any()):
        raise FileError(path, "has flights that are not numbered upwards from 0")


class Store:
    """The rows of a campaign on disk, in the columns of `scenarios.campaign.results.table.make_schema`."""

    def __init__(self, files: Growing, schema: pa.Schema) -> None:
        self._files, self._directory, self._schema = files, files.path, schema
        self._waiting: list[Row] = []
        self._flushed = clock.perf_counter()

    def table(self) -> pa.Table:
        """All flights that are there, each once, sorted.

        Raises:
            FileError: a file is damaged or of another campaign.
        """
        tables = [self._read(self._directory / name) for name in self._parts()]
        if (self._directory / FLIGHTS_FILE).is_file():
            tables.insert(0, self._finished())
        if not tables:
            return self._schema.empty_table()
        whole = pa.concat_tables(tables)
        _, first = np.unique(whole["flight"].to_numpy(), return_index=True)
        return whole.take(first)

    def counted(self) -> int:
        """Flights of the final table that is there; 0 where there is none."""
        path = self._directory / FLIGHTS_FILE
        return read_table(path).num_rows if path.is_file() else 0

    def add(self, row: Row) -> None:
        """Add a row, which may wait in memory until `flush`, though not for long."""
        self._waiting.append(row)
        if clock.perf_counter() - self._flushed > FLUSH_S:
            self.flush()

    def flush(self) -> None:
        """Append the rows that wait."""
        self._flushed = clock.perf_counter()
        self.append(self._waiting)
        self._waiting = []  # not before: by Ctrl-C it is appended once more, to the same file

    def append(self, rows: Sequence[Row]) -> None:
        """Add rows in one step.

        Raises:
            OutputError: they cannot be written; what was there is still there.
        """
        if not rows:
            return
        first = min(row["flight"] for row in rows)
        self._files.write({f"{PARTS_DIR}/part-{first:09d}.parquet": _encoded(make_table(rows, self._schema))})

    def close(self, flights: int) -> pa.Table:
        """Put the first `count` flights into their final two tables, take the parts away, and return `flights.parquet`.

        Raises:
            OutputError: they cannot be written; the parts are still there.
        """
        whole = self.table()
        table, times = split_times(whole.filter(pc.less(whole["flight"], flights)))
        self._files.write({TIMES_FILE: _encoded(times), FLIGHTS_FILE: _encoded(table)})
        self._files.remove(self._parts())
        return table

    def _parts(self) -> list[str]:
        """The parts that are there, by their names relative to the directory."""
        return [f"{PARTS_DIR}/{path.name}" for path in sorted((self._directory / PARTS_DIR).glob(_PART))]

    def _read(self, path: Path) -> pa.Table:
        table = read_table(path)
        if table.schema != self._schema:
            raise FileError(path, "has other columns than this campaign")
        require_columns(table, self._schema, path)
        return table

    def _finished(self) -> pa.Table:
        """The final table with its clock times, where they are there."""
        table = read_flights(self._directory / FLIGHTS_FILE, self._schema)
        path = self._directory / TIMES_FILE
        times = read_table(path) if path.is_file() else table.select(["flight"])
        require_columns(times, self._schema, path)
        if not times["flight"].equals(table["flight"]):
            times = table.select(["flight"])  # the process died between the two files
        there = {name: of[name] for of in (times, table) for name in of.column_names}
        fields = zip(self._schema.names, self._schema.types, strict=True)
        columns = [there[name] if name in there else pa.nulls(table.num_rows, kind) for name, kind in fields]
        return pa.Table.from_arrays(columns, schema=self._schema)


def _encoded(table: pa.Table) -> bytes:
    buffer = io.BytesIO()
    pq.write_table(table, buffer, compression="zstd")
    return buffer.getvalue()
