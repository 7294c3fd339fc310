"""A campaign's tables as others may have left them: read, and held against the columns that they are to have."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np
import pyarrow as pa

from quadsim.campaign.columns import numbers
from quadsim.campaign.table import DRAW, TIMING, read_table
from quadsim.errors import FileError

_NEEDED: Final = ("flight", "seed", "status", "verdict", "failed", "violated", "crashed", "worst_margin")
"""Columns that no version left out; `flight` to `violated` have a value in every row."""
_FILLED: Final = _NEEDED[:6]
LARGEST: Final = 1e100
"""Magnitude of the largest number that a flight has; sums of squares of larger ones are infinite."""


def read_flights(path: Path, schema: pa.Schema) -> pa.Table:
    """`flights.parquet` of a campaign.

    Args:
        path: of the table.
        schema: of the campaign, `quadsim.campaign.table.make_schema`; a table of an older version may have fewer.

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
