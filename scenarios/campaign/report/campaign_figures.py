"""A campaign -> its figures."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import replace
from typing import Final

import numpy as np
import pyarrow as pa

from quadsim.report.figure import Bound, Figure, Panel, Series
from quadsim.report.palette import BOUND, LINES, REFERENCE
from quadsim.state import Array
from scenarios.campaign.results.events import VERDICTS
from scenarios.campaign.results.table import (
    DRAW,
    Rows,
    Summary,
    draw_names,
    is_number,
    numbers,
    texts,
    unit_of,
    verdicts,
)
from scenarios.campaign.statistics.comparison import Comparison
from scenarios.campaign.statistics.estimates import drivers
from scenarios.campaign.statistics.inference import ALPHA
from scenarios.campaign.statistics.wording import label

MAIN_METRICS: Final = (
    "worst_margin",
    *(f"rmse.{name}" for name in ("x", "y", "z", "yaw")),
    *("peak_tilt", "total_variation", "fallback_periods"),
)
"""What a reader of a campaign looks for first."""
_BINS: Final = 40
_MOST_DRIVERS, _MOST_SCATTERS = 10, 3  # in the overview
_MOST_POINTS: Final = 9000  # of one verdict in all scatters of a page, which has a few MB then
_MOST_PAIRS: Final = 4000  # that are drawn of a comparison
_GAP: Final = 0.06  # from the axis' end to what is drawn at the edge, as a share of the axis
_FENCE: Final = 5.0  # quartile ranges beyond the quartiles up to which values are drawn where they are


def overview(table: pa.Table, summary: Summary, title: str) -> Figure:
    """Worst margins, and the parameters that matter."""
    strongest = list(drivers(summary))
    clouds = {panel.x_label.partition(" [")[0]: panel for panel in scatters(table)}
    ranked = sorted(clouds, key=lambda name: strongest.index(name) if name in strongest else len(strongest))
    panels = [
        *(panel for panel in histograms(table) if panel.x_label.startswith("worst_margin")),
        *dependence(summary, _MOST_DRIVERS),
        *(clouds[name] for name in ranked[:_MOST_SCATTERS]),
    ]
    return Figure(key="campaign", title=title, panels=tuple(replace(panel, height=1.4) for panel in panels))


def histograms(table: pa.Table) -> list[Panel]:
    """How the main metrics that differ between flights are distributed, by verdict."""
    panels = []
    for name in MAIN_METRICS:
        values = numbers(table, name)
        finite = values[np.isfinite(values)]
        if finite.size < 2 or np.ptp(finite) == 0.0:
            continue
        low, high = _ends(finite)
        width = (high - low or 1.0) / min(_BINS, max(8, int(2.0 * np.sqrt(finite.size))))
        edges = width * np.arange(np.floor(low / width), np.ceil(high / width) + 1.0)  # 0 is one, where it is inside
        inside, below, bars = np.clip(values, edges[0], edges[-1]), np.zeros(edges.size - 1), []
        for verdict, rows in verdicts(table).items():
            counts = np.histogram(inside[rows & np.isfinite(values)], edges)[0].astype(float)
            if counts.any():
                middles, colour = 0.5 * (edges[:-1] + edges[1:]), VERDICTS[verdict].colour
                bars.append(Series(x=middles, y=counts, base=below, colour=colour, label=verdict, style="bars"))
            below = below + counts
        beyond = int(np.count_nonzero((finite < edges[0]) | (finite > edges[-1])))
        zero = (Bound(value=0.0, vertical=True),) if name == "worst_margin" and edges[0] <= 0.0 <= edges[-1] else ()
        x_label = label(name, unit_of(table, name)) + (f"; {beyond} beyond, in the end bars" if beyond else "")
        panels.append(Panel(title="", x_label=x_label, y_label="flights", series=tuple(bars), bounds=zero, whole=True))
    return panels


def dependence(summary: Summary, most: int | None = None) -> list[Panel]:
    """Rank correlation and Chatterjee's xi of each varied parameter, hollow where not beyond chance."""
    strongest = dict(itertools.islice(drivers(summary).items(), most))
    if not strongest:
        return []
    series = [Series(x=np.zeros(2), y=np.array([-0.5, len(strongest) - 0.5]), colour=REFERENCE, width=0.8)]
    outcomes = (("worst margin", "worst_margin", LINES[0], -0.15), ("failure", "failed", LINES[1], 0.15))
    measures = (("rho", "p_holm", "circle"), ("xi", "p_xi_holm", "diamond"))
    for (what, outcome, colour, offset), (key, p, marker), sure in itertools.product(outcomes, measures, (True, False)):
        points = [
            (found[outcome][key], row + offset)
            for row, found in enumerate(strongest.values())
            if found[outcome] and (found[outcome][p] < ALPHA) is sure
        ]
        x, y = np.array(points, float).reshape(-1, 2).T
        symbol = marker if sure else f"{marker}-open"
        series.append(Series(x=x, y=y, colour=colour, label=what, style="points", marker=symbol, width=6.0))
    names = tuple(label(name, found["unit"]) for name, found in strongest.items())
    return [
        Panel(
            title="circles: rank correlation; diamonds: xi; hollow: not beyond chance",
            x_label="rank correlation, or xi",
            series=tuple(series),
            x_range=(-1.04, 1.04),
            y_range=(len(names) - 0.5, -0.5),
            y_names=names,
            legend=True,
            height=max(1.0, 0.17 * len(names)),
        )
    ]


def scatters(table: pa.Table) -> list[Panel]:
    """The worst margin of each flight over each varied parameter; triangles are beyond the axes, or have no margin."""
    margins, names = numbers(table, "worst_margin"), draw_names(table)
    if not np.isfinite(margins).any():
        return []
    low, high = _margin_ends(margins)
    y, beyond_y = _clip(np.where(np.isfinite(margins), margins, -np.inf), low, high, "down", "up")
    room, panels = 0.6 * _GAP * ((high - low) or 1.0), []
    for name in names:
        kinds: tuple[str, ...] = ()
        if is_number(table, DRAW + name):
            values = numbers(table, DRAW + name)
        else:
            listed = texts(table, DRAW + name)
            kinds = tuple(sorted(set(listed)))
            spread = np.random.default_rng(0).uniform(-0.3, 0.3, listed.size)  # the same every time
            values = np.array([kinds.index(each) for each in listed], float) + spread
        x, beyond_x = _clip(values, *_ends(values[np.isfinite(values)]), "left", "right")
        beyond, points = np.where(beyond_y == "", beyond_x, beyond_y), list[Series]()
        for verdict, found in verdicts(table).items():
            rows, (_, colour, symbol) = np.flatnonzero(found), VERDICTS[verdict]
            shown = _thinned(rows, _MOST_POINTS // len(names))
            points += _points(x, y, beyond, numbers(table, "flight"), rows=shown, look=(colour, verdict, symbol))
        panels.append(
            Panel(
                title="",
                x_label=label(name, unit_of(table, DRAW + name)),
                y_label="worst margin",
                series=tuple(points),
                bounds=(Bound(value=0.0),),
                x_names=kinds,
                y_range=(float(y.min()) - room, float(y.max()) + room),
            )
        )
    return panels


def paired_margins(comparison: Comparison) -> Iterator[Figure]:
    """The worst margins of all pairs, one campaign against the other; nothing where too few pairs have both."""
    both = np.flatnonzero(np.isfinite(comparison.margins).all(axis=1))
    if both.size < 2:
        return
    low, high = _margin_ends(comparison.margins[both])
    x, beyond_x = _clip(comparison.margins[:, 0], low, high, "left", "right")
    y, beyond_y = _clip(comparison.margins[:, 1], low, high, "down", "up")
    room = 1.6 * _GAP * ((high - low) or 1.0)
    ends = low - room, high + room
    series = [Series(x=np.array(ends), y=np.array(ends), colour=REFERENCE, dashed=True)]
    a, b = comparison.names
    kinds = {
        **{"none failed": (False, False, LINES[0]), f"{a} alone failed": (True, False, LINES[2])},
        **{f"{b} alone failed": (False, True, LINES[1]), "both failed": (True, True, BOUND)},
    }
    rows, beyond = _thinned(both, _MOST_PAIRS), np.where(beyond_y == "", beyond_x, beyond_y)
    for kind, (in_a, in_b, colour) in kinds.items():
        there = rows[(comparison.failed[rows] == (in_a, in_b)).all(axis=1)]
        series += _points(x, y, beyond, comparison.numbers, rows=there, look=(colour, kind, "circle"))
    panel = Panel(title="a point per pair", x_label=f"worst margin, {a}", y_label=f"worst margin, {b}",
                  series=tuple(series), x_range=ends, y_range=ends, height=2.2)  # fmt: skip
    yield Figure(key="margins", title="worst margin, flight by flight", panels=(panel,), columns=1)


def _points(
    x: Array, y: Array, beyond: np.ndarray, flights: Array, *, rows: Rows, look: tuple[str, str, str]
) -> Iterator[Series]:
    """Some flights as points of one colour, label and marker; those beyond the axes as triangles."""
    colour, name, marker = look
    for edge in ("", "down", "up", "left", "right"):
        there = rows[beyond[rows] == edge]
        if there.size:
            marked = (f"triangle-{edge}", 5.0) if edge else (marker, 3.5)
            yield Series(x=x[there], y=y[there], flights=flights[there], colour=colour, label=name, style="points",
                         marker=marked[0], width=marked[1], opacity=0.7)  # fmt: skip


def _thinned(rows: Rows, most: int) -> Rows:
    """At most so many of some rows, evenly spread."""
    return rows[np.unique(np.linspace(0.0, rows.size - 1.0, min(rows.size, most)).astype(int))]


def _ends(finite: Array) -> tuple[float, float]:
    """The smallest and the largest of some values, without those far out."""
    q1, q3 = np.percentile(finite, [25, 75])
    reach = _FENCE * (q3 - q1) or np.inf
    inside = finite[(finite >= q1 - reach) & (finite <= q3 + reach)]
    return float(inside.min()), float(inside.max())


def _margin_ends(margins: Array) -> tuple[float, float]:
    """The ends between which worst margins are drawn where they are; 0, the end of what is allowed, is among them."""
    low, high = _ends(margins[np.isfinite(margins)])
    return min(0.0, low), max(0.0, high)


def _clip(values: Array, low: float, high: float, below: str, above: str) -> tuple[Array, np.ndarray]:
    """Values (K,) with those beyond the ends a little outside, and on which side each is; empty inside."""
    side = np.where(values < low, below, np.where(values > high, above, ""))
    gap = _GAP * ((high - low) or 1.0)
    return np.select([side == below, side == above], [low - gap, high + gap], values), side
