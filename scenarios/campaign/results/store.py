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
from scenarios.campaign.results.table import TIMES, Row, make_table, read_table, split_times

FLIGHTS_FILE: Final = "flights.parquet"
TIMES_FILE: Final = "timing.parquet"
FLUSH_S: Final = 5.0  # how long an answer may wait in memory before it is on the disk [s]
PARTS_DIR: Final = "parts"


def read_flights(path: Path, schema: pa.Schema) -> pa.Table:
    """A campaign's table, with or without its clock times.

    Raises:
        FileError: it cannot be read, it has other columns than the campaign, or flights are there twice, or unsorted.
    """
    table = read_table(path)
    kinds = {field.name: field.type for field in table.schema}
    if any(kinds.get(field.name) != field.type for field in schema if field.name not in TIMES):
        raise FileError(path, "has other columns than this campaign")
    flights = table["flight"].to_numpy()
    if flights.size and (flights[0] < 0 or (np.diff(flights) <= 0).any()):
        raise FileError(path, "has flights that are not numbered upwards from 0")
    return table


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
        tables = [self._schema.empty_table()]
        if (path := self._directory / FLIGHTS_FILE).is_file():
            table, times = read_flights(path, self._schema), read_table(self._directory / TIMES_FILE)
            same = times["flight"].equals(table["flight"])  # else the process died between the two files
            for name in TIMES:
                absent = pa.nulls(table.num_rows, self._schema.field(name).type)
                table = table.append_column(name, times[name] if same else absent)
            tables.append(table)
        tables += [read_flights(self._directory / name, self._schema) for name in self._parts()]
        columns = [[table[name] for name in self._schema.names] for table in tables]
        whole = pa.concat_tables(pa.Table.from_arrays(each, schema=self._schema) for each in columns)
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
        if rows:
            first = min(row["flight"] for row in rows)
            self._files.write({f"{PARTS_DIR}/part-{first:09d}.parquet": _encoded(make_table(rows, self._schema))})

    def close(self, flights: int) -> pa.Table:
        """Put the first `flights` flights into their final two tables, remove the parts, return `flights.parquet`.

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
        return sorted(f"{PARTS_DIR}/{path.name}" for path in (self._directory / PARTS_DIR).glob("part-*.parquet"))


def _encoded(table: pa.Table) -> bytes:
    buffer = io.BytesIO()
    pq.write_table(table, buffer, compression="zstd")
    return buffer.getvalue()
