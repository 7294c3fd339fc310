"""Samples of a log on their own clock."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from quadsim.state import Array


class Column(NamedTuple):
    """M samples of one number, as a log has them, or of the n numbers of a quantity."""

    t: Array  # (M,) [s]
    values: Array  # (M,) or (M, n), NaN where there is none


def held(column: Column, t: Array) -> Array:
    """The latest sample at each of some times (N,); before the first, that one."""
    return np.asarray(column.values[np.clip(np.searchsorted(column.t, t, side="right") - 1, 0, len(column.t) - 1)])


def on_one_clock(t: Array, table: Mapping[str, Array]) -> dict[str, Column]:
    """Columns with the times (M,) [s] of their samples, in order; one that repeats a time is left out."""
    times, rows = np.unique(t, return_index=True)
    return {name: Column(times, np.asarray(of, float)[rows]) for name, of in table.items()}
