"""A campaign's directory while it grows: nothing that was flown is lost, or there twice, whatever is killed.

Rows are appended as files of their own below `parts/`.  When all is flown the parts become `flights.parquet` and
`timing.parquet`, and go.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from quadsim.campaign.stored import read_flights, require_columns
from quadsim.campaign.table import Row, make_table, read_table, split_times
from quadsim.errors import FileError
from quadsim.outputs import Growing

FLIGHTS_FILE: Final = "flights.parquet"
TIMES_FILE: Final = "timing.parquet"
PARTS_DIR: Final = "parts"
_PART: Final = "part-*.parquet"


class Store:
    """The rows of a campaign on disk.

    Args:
        files: of the campaign's directory.
        schema: see `quadsim.campaign.table.make_schema`.
    """

    def __init__(self, files: Growing, schema: pa.Schema) -> None:
        self._files, self._directory, self._schema = files, files.path, schema

    def table(self) -> pa.Table:
        """All flights that are there, each once, sorted.

        Raises:
            FileError: a file is damaged or of another campaign.
            OutputError: a part is not as it was written.
        """
        self._files.require(self._parts())
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
        columns = [
            table[name]
            if name in table.column_names
            else times[name]
            if name in times.column_names
            else pa.nulls(table.num_rows, kind)
            for name, kind in zip(self._schema.names, self._schema.types, strict=True)
        ]
        return pa.Table.from_arrays(columns, schema=self._schema)


def _encoded(table: pa.Table) -> bytes:
    buffer = io.BytesIO()
    pq.write_table(table, buffer, compression="zstd")
    return buffer.getvalue()
