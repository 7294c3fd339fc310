"""The flights of a campaign as points: the worst margin over each drawn parameter.

Few flights far out would squash all others into a line.  They are drawn at the edge, as triangles that point to where
they are; a caption has how many they are and how far out.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import pyarrow as pa

from quadsim.state import Array
from scenarios.campaign.results.columns import Edges, Rows, draw_names, is_number, numbers, texts, verdicts
from scenarios.campaign.results.events import Flags
from scenarios.campaign.results.table import DRAW, unit_of
from scenarios.campaign.statistics.dependence import Trend, trend
from scenarios.campaign.statistics.outliers import margin_ends, robust_ends
from scenarios.campaign.statistics.wording import count_of, label

COURSE: Final = "half of the flights are above"  # what a curve through the flights of a scatter tells
_GAP: Final = 0.06  # from the axis' end to what is drawn at the edge, as a share of the axis
_MOST_POINTS: Final = 18_000
"""Points that all scatters of a page may have together: a page of 10 000 flights stays near 6 MB and quick to draw."""


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
    """A drawn parameter of every flight, as horizontal positions."""

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
    """Every drawn parameter, in order, with the course of the worst margin over it."""
    found = []
    for name in draw_names(table):
        column = DRAW + name
        text = label(name, unit_of(table, column))
        if not is_number(table, column):
            found.append(_levels(name, text, texts(table, column)))
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
    if not parts:
        return ""
    return f"Drawn are {', '.join(parts)}, evenly spread by number; all others are shown in full."


def clipping(drawn: Margins, parameters: list[Cloud]) -> str:
    """Which flights are drawn at the edges, how many, and how far out they are; empty where there are none."""
    parts = [*_beyond_margins(drawn), *(part for cloud in parameters for part in _beyond(cloud))]
    if not parts:
        return ""
    return f"Triangles at the edges stand for flights beyond the axes: {'; '.join(parts)}."


def _beyond_margins(drawn: Margins) -> Iterator[str]:
    none = int(np.isnan(drawn.true).sum())
    below, above = (drawn.edge == "down") & ~np.isnan(drawn.true), drawn.edge == "up"
    if below.any():
        yield _told(below, "with a margin below", drawn.shown[0], "down to", float(drawn.true[below].min()))
    if none:
        yield f"{count_of(none, 'flight')} without a margin, at the foot"
    if above.any():
        yield _told(above, "with a margin above", drawn.shown[1], "up to", float(drawn.true[above].max()))


def _beyond(cloud: Cloud) -> Iterator[str]:
    left, right = cloud.edge == "left", cloud.edge == "right"
    if left.any():
        least = float(cloud.true[~left].min())
        yield _told(left, f"with {cloud.name} below", least, "down to", float(cloud.true[left].min()))
    if right.any():
        most = float(cloud.true[~right].max())
        yield _told(right, f"with {cloud.name} above", most, "up to", float(cloud.true[right].max()))


def _told(beyond: Flags, how: str, limit: float, as_far: str, extreme: float) -> str:
    return f"{count_of(int(beyond.sum()), 'flight')} {how} {limit:.3g}, {as_far} {extreme:.3g}"


def _levels(name: str, text: str, values: np.ndarray[Any, np.dtype[np.object_]]) -> Cloud:
    names = tuple(sorted(set(values)))
    spread = np.random.default_rng(0).uniform(-0.3, 0.3, values.size)  # as every time
    x = np.array([names.index(value) for value in values], float) + spread
    return Cloud(name=name, label=text, x=x, edge=np.full(x.size, ""), true=x, names=names, course=None)


def _evenly(rows: Rows, most: int) -> Rows:
    if rows.size <= most:
        return rows
    places = np.round(np.linspace(0.0, rows.size - 1.0, most)).astype(int)
    return np.asarray(rows[places])
