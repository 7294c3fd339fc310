"""A campaign's table as others left it is held against its columns before it is used."""

from __future__ import annotations

import math
from pathlib import Path

import pyarrow as pa
import pytest

from quadsim.errors import FileError
from scenarios.campaign.results.store import require_columns

SCHEMA = pa.schema([("flight", pa.int64()), ("failed", pa.bool_()), ("peak", pa.float64())])


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ({"peak": [1e308, None]}, r"has a number beyond \+-1e\+100 in its column peak"),
        ({"peak": [-math.inf, 0.0]}, "in its column peak"),
        ({"peak": ["1", "2"]}, "has in its column peak string instead of double"),
        ({"failed": [None, True]}, "has gaps in its column failed"),
        ({"flight": [3, 3]}, "not numbered upwards"),
        ({"flight": [-1, 3]}, "not numbered upwards"),
        ({"extra": [1, 2]}, "has other columns"),
    ],
)
def test_what_a_table_may_not_hold_is_named(columns: dict[str, list[object]], message: str) -> None:
    right = {"flight": [0, 2], "failed": [False, True], "peak": [0.5, None]}
    require_columns(pa.table(right, schema=SCHEMA), SCHEMA, Path("t"))
    with pytest.raises(FileError, match=message):
        require_columns(pa.table({**right, **columns}), SCHEMA, Path("t"))
