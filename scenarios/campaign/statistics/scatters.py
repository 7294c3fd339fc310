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
from scenarios.campaign.results.table import DRAW, Edges, Rows, draw_names, is_number, numbers, texts, unit_of, verdicts
from scenarios.campaign.statistics.dependence import Trend, trend
from scenarios.campaign.statistics.wording import count_of, label

LOWEST_MARGIN: Final = -2.0
"""Margins below this are drawn at the foot, so that a lost flight does not flatten all others."""
_LEAST_DEPTH: Final = 0.25  # share of the height above 0 that is shown below it, however far from it the margins are
_FENCE: Final = 5.0  # quartile ranges beyond the quartiles up to which values are drawn where they are
COURSE: Final = "half of the flights are above"  # the meaning of a curve through the flights of a scatter
_GAP: Final = 0.06  # from the axis' end to what is drawn at the edge, as a share of the axis
_MOST_POINTS: Final = 18_000
"""Points that all scatters of a page may have together: a page of 10 000 flights stays near 6 MB and quick to draw."""
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


@dataclass(frozen=True, kw_only=True)
class Margins:
    """The worst margins as they are drawn."""

    # (K,) heights; at the foot where a flight has no margin, or one below the axis, at the top of one above it
    y: Array
    true: Array  # (K,) the margins, NaN where there is none
    edge: Edges  # (K,) `down`, `up`, or empty where a flight is drawn where it is
    shown: tuple[float, float]  # the ends between which margins are drawn where they are
    ends: tuple[float, float]  # of the axis, with what is drawn at its edges


@dataclass(frozen=True, kw_only=True)
class Cloud:
    """A varied parameter of every flight, as horizontal positions."""

    name: str  # the parameter
    label: str  # its name, with its unit where it has one
    x: Array  # (K,) its values; whole numbers, spread a little, where it is drawn from names
    edge: Edges  # (K,) `left`, `right`, or empty where a flight is drawn where it is
    true: Array  # (K,) its values; as `x` where it is drawn from names
    names: tuple[str, ...]  # what stands at 0, 1, ...; empty where it is a number
    course: Trend | None  # of the worst margin over it; None where there are too few flights, and of names


def margins(table: pa.Table) -> Margins | None:
    """The worst margins as they are drawn; None where no flight has any, as without a required constraint."""
    true = numbers(table, "worst_margin")
    true = np.where(np.isfinite(true), true, np.nan)
    if np.isnan(true).all():
        return None
    low, high = margin_ends(true)
    edge = np.where(np.isnan(true) | (true < low), "down", np.where(true > high, "up", ""))
    gap = _GAP * ((high - low) or 1.0)
    foot, top = low - gap * (edge == "down").any(), high + gap * (edge == "up").any()
    y = np.select([edge == "down", edge == "up"], [foot, top], true)
    return Margins(y=y, true=true, edge=edge, shown=(low, high), ends=(foot - 0.6 * gap, top + 0.6 * gap))


def clouds(table: pa.Table, drawn: Margins) -> list[Cloud]:
    """Every varied parameter, in order, with the course of the worst margin over it."""
    found = []
    for name in draw_names(table):
        column = DRAW + name
        text = label(name, unit_of(table, column))
        if not is_number(table, column):
            values = texts(table, column)
            names = tuple(sorted(set(values)))
            spread = np.random.default_rng(0).uniform(-0.3, 0.3, values.size)  # as every time
            x = np.array([names.index(value) for value in values], float) + spread
            unclipped = np.full(x.size, "")
            found.append(Cloud(name=name, label=text, x=x, edge=unclipped, true=x, names=names, course=None))
            continue
        true = numbers(table, column)
        low, high = robust_ends(true)
        gap = _GAP * (high - low)
        edge = np.where(true < low, "left", np.where(true > high, "right", ""))
        x = np.select([edge == "left", edge == "right"], [low - gap, high + gap], true)
        course = trend(x, drawn.y) if np.isfinite(x).all() else None
        found.append(Cloud(name=name, label=text, x=x, edge=edge, true=true, names=(), course=course))
    return found


def edges(cloud: Cloud, drawn: Margins) -> Edges:
    """(K,) where a point lies beyond the axes: `down`, `up`, `left`, `right`, or empty where it does not."""
    return np.where(drawn.edge == "", cloud.edge, drawn.edge)


def shown_flights(table: pa.Table) -> dict[str, Rows]:
    """Rows of the flights that scatters show, by verdict: all, or at most a quarter of what a page bears of each."""
    limit = min(max(_MOST_POINTS // max(len(draw_names(table)), 1), 400), 2000)
    rows = {verdict: np.flatnonzero(found) for verdict, found in verdicts(table).items()}
    if table.num_rows <= limit:
        return rows
    return {verdict: _evenly(found, limit // 4) for verdict, found in rows.items()}


def thinning(table: pa.Table) -> str:
    """What the scatters leave out, as a sentence; empty where they show all."""
    shown = shown_flights(table)
    parts = [
        f"{shown[verdict].size} of {count_of(int(found.sum()), f'{verdict} flight')}"
        for verdict, found in verdicts(table).items()
        if shown[verdict].size < found.sum()
    ]
    return f"Drawn are {', '.join(parts)}, evenly spread by number; all others are shown in full." if parts else ""


def clipping(drawn: Margins, parameters: list[Cloud]) -> str:
    """Which flights are drawn at the edges, how many, and how far out they are; empty where there are none."""
    none, (low, high) = np.isnan(drawn.true), drawn.shown
    parts = _count_beyond(drawn.true, (drawn.edge == "down") & ~none, "below", low)
    if none.any():
        parts.append(f"{count_of(int(none.sum()), 'flight')} without a margin, at the foot")
    parts += _count_beyond(drawn.true, drawn.edge == "up", "above", high)
    for cloud in parameters:
        for edge, side, end in (("left", "below", np.min), ("right", "above", np.max)):
            beyond = cloud.edge == edge
            parts += _count_beyond(cloud.true, beyond, side, end(cloud.true[~beyond]), of=cloud.name)
    return f"Triangles at the edges mark flights beyond the axes: {'; '.join(parts)}." if parts else ""


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
