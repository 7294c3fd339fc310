"""The worst margins of flights in pairs, as they are drawn."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import pyarrow as pa

from quadsim.report.palette import BOUND, LINES
from quadsim.state import Array
from scenarios.campaign.results.columns import Edges, Rows, numbers
from scenarios.campaign.results.events import Flags
from scenarios.campaign.statistics.outliers import margin_ends
from scenarios.campaign.statistics.wording import count_of

_MOST_POINTS: Final = 4000


@dataclass(frozen=True, kw_only=True)
class ShownMargins:
    """Worst margins of pairs as they are drawn."""

    flights: Rows  # (P,) their numbers
    margins: Array  # (P, 2) of the first and the second campaign; what is beyond the axes is at their edge
    true: Array  # (P, 2) the margins themselves
    edge: Edges  # (P,) `down`, `up`, `left` or `right` where a pair is beyond the axes; else empty
    beyond: str  # which pairs are drawn at the edges, and how far out they are, as a sentence; empty of none
    kind: np.ndarray[Any, np.dtype[np.object_]]  # (P,) which of the two failed, in words
    colours: dict[str, str]  # colour of each kind
    lowest: float  # low end of both axes
    highest: float  # high end of both axes
    left_out: int  # pairs that are not drawn, as there are too many


def paired_margins(a: pa.Table, b: pa.Table, failed: tuple[Flags, ...], names: Sequence[str]) -> ShownMargins | None:
    """The worst margins of all pairs, and which of both (K,) failed, as drawn; None of fewer than two with margins."""
    pairs = np.stack([numbers(a, "worst_margin"), numbers(b, "worst_margin")], axis=1)
    there = np.flatnonzero(np.isfinite(pairs).all(axis=1))
    if there.size < 2:
        return None
    rows = there
    if rows.size > _MOST_POINTS:
        rows = there[np.round(np.linspace(0.0, there.size - 1.0, _MOST_POINTS)).astype(int)]
    kinds = ("none failed", f"{names[0]} alone failed", f"{names[1]} alone failed", "both failed")
    low, high = margin_ends(pairs[there].ravel())
    true = pairs[rows]
    gap = 0.06 * ((high - low) or 1.0)
    drawn = np.where(true < low, low - gap, np.where(true > high, high + gap, true))
    return ShownMargins(
        flights=numbers(a, "flight")[rows].astype(np.int32),
        margins=drawn,
        true=true,
        edge=_edges(true, low, high),
        beyond=_beyond(pairs[there], low, high),
        kind=np.array(kinds, object)[failed[0][rows] + 2 * failed[1][rows].astype(int)],
        colours=dict(zip(kinds, (LINES[0], LINES[2], LINES[1], BOUND), strict=True)),
        lowest=float(drawn.min()) - 0.6 * gap,
        highest=float(drawn.max()) + 0.6 * gap,
        left_out=there.size - rows.size,
    )


def _edges(true: Array, low: float, high: float) -> Edges:
    """Where each pair lies beyond the axes; the second campaign's is the vertical one."""
    first, second = true.T
    return np.select(
        [second < low, second > high, first < low, first > high], ["down", "up", "left", "right"], default=""
    )


def _beyond(true: Array, low: float, high: float) -> str:
    below, above = (true < low).any(axis=1), (true > high).any(axis=1)
    parts = [
        f"{count_of(int(beyond.sum()), 'pair')} with a margin {how} {limit:.3g}, {as_far} {extreme:.3g}"
        for beyond, how, limit, as_far, extreme in (
            (below, "below", low, "down to", float(true.min())),
            (above, "above", high, "up to", float(true.max())),
        )
        if beyond.any()
    ]
    return f"Triangles at the edges stand for pairs beyond the axes: {'; '.join(parts)}." if parts else ""
