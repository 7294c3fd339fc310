"""A campaign's directory while it grows: nothing that was flown is lost, or there twice, whatever is killed.

Rows are appended as files of their own below `parts/`, each written beside its place, forced to the disk and moved
there in one step.  Only one process appends, and holds a lock while it does.  When all is flown the parts become
`flights.parquet` and `timing.parquet`, and go.
"""

from __future__ import annotations

import contextlib
import fcntl
import io
import os
import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from quadsim.campaign.stored import read_flights, require_columns
from quadsim.campaign.table import Row, make_table, read_table, split_times
from quadsim.errors import FileError, OutputError

FLIGHTS_FILE: Final = "flights.parquet"
TIMES_FILE: Final = "timing.parquet"
PARTS_DIR: Final = "parts"
_LOCK_FILE: Final = ".lock"
_PART: Final = "part-*.parquet"


@contextlib.contextmanager
def locked(directory: Path) -> Iterator[None]:
    """Hold a campaign's directory for oneself; whoever dies lets go of it.

    Raises:
        OutputError: another process holds it, or it cannot be written.
    """
    try:
        handle = os.open(directory / _LOCK_FILE, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
    except OSError as error:
        raise OutputError(directory, error.strerror or str(error)) from error
    try:
        _hold(handle, directory)
        yield
    finally:
        os.close(handle)


def _hold(handle: int, directory: Path) -> None:
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise OutputError(directory, "another campaign is being flown there") from error
    except OSError as error:  # of a file system that knows no locks
        raise OutputError(directory, f"cannot be held for one campaign alone ({error.strerror})") from error


class Store:
    """The rows of a campaign on disk.

    Args:
        directory: of the campaign; it is there already.
        schema: see `quadsim.campaign.table.make_schema`.
    """

    def __init__(self, directory: Path, schema: pa.Schema) -> None:
        self._directory, self._schema = directory, schema
        self._parts = directory / PARTS_DIR

    def table(self) -> pa.Table:
        """All flights that are there, each once, sorted; what a killed process left half written is swept away.

        Raises:
            FileError: a file is damaged or of another campaign.
        """
        for leftover in self._parts.glob(".*.partial"):
            leftover.unlink(missing_ok=True)
        tables = [self._read(path) for path in sorted(self._parts.glob(_PART))]
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

    def append(self, rows: Sequence[Row]) -> None:
        """Add rows in one step.

        Raises:
            OutputError: they cannot be written; what was there is still there.
        """
        if not rows:
            return
        first = min(row["flight"] for row in rows)
        path = self._parts / f"part-{first:09d}.parquet"
        try:
            self._parts.mkdir(exist_ok=True)
            _write_durably(make_table(rows, self._schema), path)
        except OSError as error:
            raise OutputError(path, error.strerror or str(error)) from error

    def close(self, flights: int) -> pa.Table:
        """Put everything into its final two tables, and take the parts away.

        Args:
            flights: how many count; those beyond are left out.

        Returns:
            `flights.parquet`.

        Raises:
            OutputError: they cannot be written; the parts are still there.
        """
        whole = self.table()
        table, times = split_times(whole.filter(pc.less(whole["flight"], flights)))
        try:
            _write_durably(times, self._directory / TIMES_FILE)
            _write_durably(table, self._directory / FLIGHTS_FILE)
        except OSError as error:
            raise OutputError(self._directory, error.strerror or str(error)) from error
        shutil.rmtree(self._parts, ignore_errors=True)
        return table

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
        columns = [
            table[name]
            if name in table.column_names
            else times[name]
            if name in times.column_names
            else pa.nulls(table.num_rows, kind)
            for name, kind in zip(self._schema.names, self._schema.types, strict=True)
        ]
        return pa.Table.from_arrays(columns, schema=self._schema)


def _write_durably(table: pa.Table, path: Path) -> None:
    """A file that is there whole or not at all, even after a loss of power."""
    partial = path.with_name(f".{path.name}.partial")
    buffer = io.BytesIO()
    pq.write_table(table, buffer, compression="zstd")
    try:
        with partial.open("wb") as file:
            file.write(buffer.getbuffer())
            file.flush()
            os.fsync(file.fileno())
        partial.replace(path)
    except OSError:
        partial.unlink(missing_ok=True)
        raise
    directory = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(directory)
    finally:
        os.close(directory)
