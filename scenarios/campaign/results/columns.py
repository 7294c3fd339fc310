"""A campaign's table -> arrays, one value per flight."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
import pyarrow as pa

from quadsim.state import Array
from scenarios.campaign.results.events import Flags
from scenarios.campaign.results.table import DRAW, MARGIN, SATISFIED, TIME_VIOLATED
from scenarios.campaign.results.verdicts import VERDICTS

Texts = np.ndarray[Any, np.dtype[np.object_]]
_NO_METRIC: Final = ("flight", "seed", DRAW, MARGIN, TIME_VIOLATED, SATISFIED)
Rows = np.ndarray[Any, np.dtype[np.intp]]
Edges = np.ndarray[Any, np.dtype[np.str_]]


def numbers(table: pa.Table, name: str) -> Array:
    """(K,) a column of numbers or of truth values; NaN where a flight has none, or where there is no such column."""
    if name not in table.column_names:
        return np.full(table.num_rows, np.nan)
    return np.array(table[name].cast(pa.float64()).to_numpy(), float)


def flags(table: pa.Table, name: str, *, absent: bool) -> Flags:
    """(K,) a column of truth values, with `absent` where a flight has none."""
    return np.array(table[name].fill_null(absent).to_pylist(), bool)


def texts(table: pa.Table, name: str) -> Texts:
    """(K,) a column as text, `-` where a flight has none; truth values as `true` and `false`."""
    words = {None: "-", True: "true", False: "false"} if pa.types.is_boolean(table[name].type) else {None: "-"}
    values = table[name].to_pylist()
    return np.array([str(words.get(value, value) if _hashable(value) else value) for value in values], object)


def verdicts(table: pa.Table) -> dict[str, Flags]:
    """(K,) which flights have each verdict."""
    found = texts(table, "verdict")
    return {verdict: np.asarray(found == verdict, bool) for verdict in VERDICTS}


def draw_names(table: pa.Table) -> list[str]:
    """The drawn parameters, in order."""
    return [name.removeprefix(DRAW) for name in table.column_names if name.startswith(DRAW)]


def constraint_names(table: pa.Table) -> list[str]:
    """The constraints of the scenario, in order."""
    return [name.removeprefix(SATISFIED) for name in table.column_names if name.startswith(SATISFIED)]


def metric_names(table: pa.Table) -> list[str]:
    """The columns that measure a flight by a number, `worst_margin` included."""
    return [
        field.name
        for field in table.schema
        if (pa.types.is_integer(field.type) or pa.types.is_floating(field.type))
        and not field.name.startswith(_NO_METRIC)
    ]


def is_number(table: pa.Table, name: str) -> bool:
    """Whether a column holds numbers, rather than texts or truth values."""
    kind = table.schema.field(name).type
    return bool(pa.types.is_integer(kind) or pa.types.is_floating(kind))


def _hashable(value: object) -> bool:
    return not isinstance(value, list | dict)
