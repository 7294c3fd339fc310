"""The flights of a campaign as points: the worst margin over each varied parameter.

Few flights far out would squash all others into a line.  They are drawn at the edge, as triangles that point to where
they are; a caption has how many they are and how far out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import pyarrow as pa

from quadsim.report.palette import BOUND, LINES
from quadsim.state import Array
from scenarios.campaign.results.events import Flags
from scenarios.campaign.results.table import Edges, Rows, numbers
from scenarios.campaign.statistics.wording import count_of

LOWEST_MARGIN: Final = -2.0
"""Margins below this are drawn at the foot, so that a lost flight does not flatten all others."""
_LEAST_DEPTH: Final = 0.25  # share of the height above 0 that is shown below it, however far from it the margins are
_FENCE: Final = 5.0  # quartile ranges beyond the quartiles up to which values are drawn where they are
_GAP: Final = 0.06  # from the axis' end to what is drawn at the edge, as a share of the axis
_MOST_PAIRS: Final = 4000  # that are drawn of a comparison


def robust_ends(values: Array) -> tuple[float, float]:
    """The smallest and the largest of some values, some of them finite, without those far out."""
    finite = values[np.isfinite(values)]
    low, high = _fences(finite)
    inside = finite[(finite >= low) & (finite <= high)]
    return float(inside.min()), float(inside.max())


def lowest_shown(values: Array) -> float:
    """The lowest of such margins that may be shown where it is: `LOWEST_MARGIN`, but where most are lower still."""
    finite = values[np.isfinite(values)]
    return LOWEST_MARGIN if np.median(finite) > LOWEST_MARGIN else float(np.percentile(finite, 5))


def _fences(finite: Array) -> tuple[float, float]:
    """Five quartile ranges beyond the quartiles."""
    p5, q1, q3, p95 = np.percentile(finite, [5, 25, 75, 95])
    reach = _FENCE * ((q3 - q1) or (p95 - p5)) or np.inf
    return q1 - reach, q3 + reach


def margin_ends(values: Array) -> tuple[float, float]:
    """The ends between which worst margins are drawn where they are; 0, the end of what is allowed, is among them."""
    finite = values[np.isfinite(values)]
    fence, above = _fences(finite)
    high = max(0.0, float(finite[finite <= above].max()))
    below = max(min(fence, -_LEAST_DEPTH * high), lowest_shown(finite))
    return min(0.0, float(finite[finite >= below].min())), high


def _count_beyond(
    values: Array, beyond: Flags, side: str, limit: float, *, of: str = "a margin", thing: str = "flight"
) -> list[str]:
    """How many have a value too far to one side to be drawn there, and how far out these are; nothing of none."""
    if not beyond.any():
        return []
    as_far, extreme = ("down to", np.min) if side == "below" else ("up to", np.max)
    count = count_of(int(beyond.sum()), thing)
    return [f"{count} with {of} {side} {limit:.3g}, {as_far} {extreme(values[beyond]):.3g}"]


def _evenly(rows: Rows, most: int) -> Rows:
    if rows.size <= most:
        return rows
    return np.asarray(rows[np.round(np.linspace(0.0, rows.size - 1.0, most)).astype(int)])


@dataclass(frozen=True, kw_only=True)
class ShownMargins:
    """Worst margins of pairs of flights, of a first and a second campaign, as they are drawn."""

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
    rows, every = _evenly(there, _MOST_PAIRS), pairs[there]
    kinds = ("none failed", f"{names[0]} alone failed", f"{names[1]} alone failed", "both failed")
    low, high = margin_ends(every.ravel())
    true = pairs[rows]
    gap = _GAP * ((high - low) or 1.0)
    drawn = np.where(true < low, low - gap, np.where(true > high, high + gap, true))
    first, second = true.T  # the second campaign's is the vertical one
    sides = [second < low, second > high, first < low, first > high]
    least, most = every.min(axis=1), every.max(axis=1)
    beyond = [
        *_count_beyond(least, least < low, "below", low, thing="pair"),
        *_count_beyond(most, most > high, "above", high, thing="pair"),
    ]
    return ShownMargins(
        flights=numbers(a, "flight")[rows].astype(np.int32),
        margins=drawn,
        true=true,
        edge=np.select(sides, ["down", "up", "left", "right"], default=""),
        beyond=f"Triangles at the edges mark pairs beyond the axes: {'; '.join(beyond)}." if beyond else "",
        kind=np.array(kinds, object)[failed[0][rows] + 2 * failed[1][rows].astype(int)],
        colours=dict(zip(kinds, (LINES[0], LINES[2], LINES[1], BOUND), strict=True)),
        lowest=float(drawn.min()) - 0.6 * gap,
        highest=float(drawn.max()) + 0.6 * gap,
        left_out=there.size - rows.size,
    )
