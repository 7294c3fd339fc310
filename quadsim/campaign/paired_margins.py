"""The worst margins of flights in pairs, as they are drawn."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import pyarrow as pa

from quadsim.campaign.columns import numbers
from quadsim.campaign.curves import Rows, lowest_shown
from quadsim.campaign.events import Flags
from quadsim.palette import BOUND, LINES
from quadsim.state import Array

_MOST_POINTS: Final = 4000


@dataclass(frozen=True, kw_only=True)
class ShownMargins:
    """Worst margins of pairs as they are drawn.

    Attributes:
        flights: (P,) their numbers.
        margins: (P, 2) of the first and the second campaign; what is below `least` is at it.
        least: the lowest margin shown where it is.
        kind: (P,) which of the two failed, in words.
        colours: colour of each kind.
        lowest: low end of both axes.
        highest: high end of both axes.
        left_out: pairs that are not drawn, as there are too many.
    """

    flights: Rows
    margins: Array
    least: float
    kind: np.ndarray[Any, np.dtype[np.object_]]
    colours: dict[str, str]
    lowest: float
    highest: float
    left_out: int


def paired_margins(a: pa.Table, b: pa.Table, failed: tuple[Flags, ...], names: Sequence[str]) -> ShownMargins | None:
    """The worst margins of all pairs as they are drawn; None where fewer than two pairs have margins.

    Args:
        a: flights of the first campaign, in pairs with those of the second.
        b: of the second.
        failed: (K,) which flights failed, of each.
        names: of both.
    """
    pairs = np.stack([numbers(a, "worst_margin"), numbers(b, "worst_margin")], axis=1)
    there = np.flatnonzero(np.isfinite(pairs).all(axis=1))
    if there.size < 2:
        return None
    rows = there
    if rows.size > _MOST_POINTS:
        rows = there[np.round(np.linspace(0.0, there.size - 1.0, _MOST_POINTS)).astype(int)]
    kinds = ("none failed", f"{names[0]} alone failed", f"{names[1]} alone failed", "both failed")
    least = lowest_shown(pairs[there].ravel())
    drawn = np.maximum(pairs[rows], least)
    low, high = float(drawn.min()), max(1.0, float(drawn.max()))
    room = 0.04 * (high - low)
    return ShownMargins(
        flights=numbers(a, "flight")[rows].astype(np.int32),
        margins=drawn,
        least=least,
        kind=np.array(kinds, object)[failed[0][rows] + 2 * failed[1][rows].astype(int)],
        colours=dict(zip(kinds, (LINES[0], LINES[2], LINES[1], BOUND), strict=True)),
        lowest=low - room,
        highest=high + room,
        left_out=there.size - rows.size,
    )
