"""Samples of a log, each quantity on its own clock: what every reader returns, before `record` puts them on one."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quadsim.state import Array


class Column(NamedTuple):
    """M samples of one number, as a log has them, or of the n numbers of a quantity."""

    t: Array  # (M,) [s]
    values: Array  # (M,) or (M, n), NaN where there is none


def latest_samples(column: Column, t: Array) -> Array:
    """The latest sample at each of some times (N,); before the first, that one."""
    latest = np.searchsorted(column.t, t, side="right") - 1
    rows = np.clip(latest, 0, len(column.t) - 1)
    return np.asarray(column.values[rows])


def interpolated(t: NDArray[Any], known_t: NDArray[Any], rows: Array) -> Array:
    """Rows (N, n) at some times (N,), linear between rows (M, n) at known times (M,)."""
    columns = [np.interp(t, known_t, column) for column in rows.T]
    return np.stack(columns, axis=1)


def on_one_clock(t: Array, table: Mapping[str, Array]) -> dict[str, Column]:
    """Columns with the times (M,) [s] of their samples, in order; one that repeats a time is left out."""
    times, rows = np.unique(t, return_index=True)
    columns = {}
    for name, values in table.items():
        columns[name] = Column(times, np.asarray(values, float)[rows])
    return columns
