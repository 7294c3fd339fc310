"""Ties: which of several computed numbers gives its name, where rounding alone tells them apart.

Processors round linear algebra differently.  Numbers that are equal by symmetry differ in their last digits, and the
smallest of them is another one on another machine.  All that are within a window of the smallest are therefore tied,
and the first of them counts: the first by declaration, the first instant, or the flight with the smallest number.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from quadsim.state import Indices

TIE_SHARE: Final = 1e-3
"""Window of ties, as a share of half the band of a limit, or of another scale: rounding moves shares by 1e-5 at most,
except in flights that diverge."""


def tied(values: ArrayLike, window: float = TIE_SHARE) -> Indices:
    """Return the indices of all values (K,) within `window` of the smallest, in order; NaN counts as the smallest.

    Raises:
        ValueError: there is no value, or the window is negative.

    Examples:
        >>> tied([0.2, 0.1000001, 0.3, 0.1]).tolist()
        [1, 3]
    """
    numbers = np.asarray(values, float)
    if not numbers.size or not window >= 0.0:
        raise ValueError(f"ties need a value and a window of at least 0; got {numbers.size} values, window {window!r}")
    missing = np.isnan(numbers)
    if missing.any():
        return np.flatnonzero(missing)
    return np.flatnonzero(numbers <= numbers.min() + window)


def first_smallest(values: ArrayLike, window: float = TIE_SHARE) -> int:
    """Return the index of the first of all values (K,) within `window` of the smallest; see `tied`."""
    return int(tied(values, window)[0])


def in_order(values: ArrayLike, window: float = TIE_SHARE) -> Indices:
    """Return the indices of values (K,) from the smallest to the largest, tied ones in order.

    Those within `window` of the smallest come first, then those within it of the smallest of the rest, and so on.

    Examples:
        >>> in_order([0.2, 0.1000001, 0.3, 0.1]).tolist()
        [1, 3, 0, 2]
    """
    numbers = np.asarray(values, float)
    by_size = np.argsort(numbers, kind="stable")
    groups: list[Indices] = []
    start = 0
    while start < by_size.size:
        reach = numbers[by_size[start]] + window
        stop = max(int(np.searchsorted(numbers[by_size], reach, side="right")), start + 1)
        groups.append(np.sort(by_size[start:stop]))
        start = stop
    if groups:
        return np.concatenate(groups)
    return by_size
