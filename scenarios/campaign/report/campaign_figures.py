"""A campaign -> its figures."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Final

import numpy as np
import pyarrow as pa

from quadsim.report.curves import BOUND, LINES, REFERENCE
from quadsim.report.figure import Band, Bound, Figure, Panel, Series
from quadsim.state import Array
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
from scenarios.campaign.results.verdicts import VERDICTS
from scenarios.campaign.statistics.comparison import Comparison
from scenarios.campaign.statistics.estimates import drivers
from scenarios.campaign.statistics.inference import ALPHA
from scenarios.campaign.statistics.wording import label, side_by_side

MAIN_METRICS: Final = (
    "worst_margin",
    *(f"rmse.{name}" for name in ("x", "y", "z", "yaw")),
    "peak_tilt",
    "total_variation",
    "fallback_periods",
)
"""What a reader of a campaign looks for first."""
_BINS: Final = 40
_MOST_DRIVERS, _MOST_SCATTERS = 10, 3  # in the overview
_MOST_POINTS: Final = 18_000
"""Points that all scatters of a page may have together: a page of 10 000 flights stays near 6 MB and quick to draw."""
_MOST_PAIRS: Final = 4000  # that are drawn of a comparison
_TICK_ROOM: Final = 46  # characters that have room below a panel
_GAP: Final = 0.06  # from the axis' end to what is drawn at the edge, as a share of the axis
_LOWEST_MARGIN: Final = -2.0
"""Margins below this are drawn at the foot, so that a lost flight does not flatten all others."""
_LEAST_DEPTH: Final = 0.25  # share of the height above 0 that is shown below it, however far from it the margins are
_FENCE: Final = 5.0  # quartile ranges beyond the quartiles up to which values are drawn where they are


def overview(table: pa.Table, summary: Summary, title: str) -> Figure:
    """How the estimate settles, worst margins, and the parameters that matter."""
    strongest = list(drivers(summary))
    clouds = {panel.x_label.partition(" [")[0]: panel for panel in scatters(table)}
    ranked = sorted(clouds, key=lambda name: strongest.index(name) if name in strongest else len(strongest))
    panels = [
        *convergence(summary, ("failure",)),
        *(panel for panel in histograms(table) if panel.x_label.startswith("worst_margin")),
        *dependence(summary, _MOST_DRIVERS),
        *(clouds[name] for name in ranked[:_MOST_SCATTERS]),
    ]
    return Figure(key="campaign", title=title, panels=tuple(replace(panel, height=1.4) for panel in panels))


def convergence(summary: Summary, events: Sequence[str] = ("failure", "violation")) -> list[Panel]:
    """The share of an event over the first n flights in its interval; two events that are the same are one panel."""
    curves = summary["convergence"]
    if not curves["flights"]:
        return []
    if len(events) == 2 and curves[events[0]] == curves[events[1]]:
        events = events[:1]
    n, panels = np.asarray(curves["flights"], float), []
    settled = n >= 0.1 * n[-1]
    for event in events:
        share, lower, upper = (100.0 * np.asarray(curves[event][key], float) for key in ("share", "lower", "upper"))
        low, high = float(lower[settled].min()), float(upper[settled].max())
        room = 0.08 * (high - low)
        curve = Series(x=n, y=share, colour=LINES[0], width=2.0)
        panels.append(
            Panel(
                title=f"share with {event}, in its 95 % interval",
                x_label="flights",
                y_label="share [%]",
                series=(curve if n.size > 2 else replace(curve, style="points", width=4.0),),
                bands=(Band(x=n, low=lower, high=upper, colour=LINES[0]),),
                x_log=True,
                y_range=(max(low - room, -0.02 * (high - low)), min(high + room, 100.0 + 0.25 * room)),
            )
        )
    return panels


def histograms(table: pa.Table) -> list[Panel]:
    """How the main metrics that differ between flights are distributed, by verdict."""
    panels = []
    for name in MAIN_METRICS:
        values = numbers(table, name)
        finite = values[np.isfinite(values)]
        if finite.size < 2 or np.ptp(finite) == 0.0:
            continue
        least = _lowest_shown(finite) if name == "worst_margin" else -np.inf
        edges = _edges(finite, least, whole=pa.types.is_integer(table.schema.field(name).type))
        inside, below = np.clip(values, edges[0], edges[-1]), np.zeros(edges.size - 1)
        bars = []
        for verdict, rows in verdicts(table).items():
            if not rows.any():
                continue
            counts = np.histogram(inside[rows & np.isfinite(values)], edges)[0].astype(float)
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
    for what, outcome, colour, offset in (
        ("worst margin", "worst_margin", LINES[0], -0.15),
        ("failure", "failed", LINES[1], 0.15),
    ):
        found = {row + offset: each[outcome] for row, each in enumerate(strongest.values()) if each[outcome]}
        for key, p, marker in (("rho", "p_holm", "circle"), ("xi", "p_xi_holm", "diamond")):
            for sure in (True, False):
                rows = [row for row, each in found.items() if (each[p] < ALPHA) is sure]
                x, y = np.array([found[row][key] for row in rows], float), np.array(rows, float)
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
    margins = numbers(table, "worst_margin")
    margins = np.where(np.isfinite(margins), margins, np.nan)
    if np.isnan(margins).all():
        return []
    low, high = _margin_ends(margins)
    heights = np.where(np.isnan(margins), -np.inf, margins)
    shown, flights, panels = _shown_flights(table), numbers(table, "flight"), []
    for name in draw_names(table):
        names: tuple[str, ...] = ()
        if is_number(table, DRAW + name):
            values = numbers(table, DRAW + name)
        else:
            listed = texts(table, DRAW + name)
            names = tuple(sorted(set(listed)))
            spread = np.random.default_rng(0).uniform(-0.3, 0.3, listed.size)  # the same every time
            values = np.array([names.index(each) for each in listed], float) + spread
        x, beyond_x = _clip(values, *_robust_ends(values), "left", "right")
        y, beyond_y = _clip(heights, low, high, "down", "up")
        beyond = np.where(beyond_y == "", beyond_x, beyond_y)
        points = []
        for verdict, rows in shown.items():
            look, edges = VERDICTS[verdict], beyond[rows]
            size = 2.8 if rows.size > 50 else 4.5  # few are seen among the others
            for edge in ("", "down", "up", "left", "right"):
                there = rows[edges == edge]
                if there.size:
                    marker = f"triangle-{edge}" if edge else look.symbol
                    points.append(
                        Series(x=x[there], y=y[there], flights=flights[there], colour=look.colour, label=verdict,
                               style="points", marker=marker, width=size + 2.0 if edge else size, opacity=0.65)
                    )  # fmt: skip
        room = 0.6 * _GAP * ((high - low) or 1.0)
        panels.append(
            Panel(
                title="",
                x_label=label(name, unit_of(table, DRAW + name)),
                y_label="worst margin",
                series=tuple(points),
                bounds=(Bound(value=0.0),),
                x_names=tuple(side_by_side(names, _TICK_ROOM)) if names else (),
                y_range=(float(y.min()) - room, float(y.max()) + room),
            )
        )
    return panels


def paired_margins(comparison: Comparison) -> Iterator[Figure]:
    """The worst margins of all pairs, one campaign against the other; nothing where too few pairs have both."""
    both = np.flatnonzero(np.isfinite(comparison.margins).all(axis=1))
    if both.size < 2:
        return
    low, high = _margin_ends(comparison.margins[both].ravel())
    rows = both[np.unique(np.linspace(0.0, both.size - 1.0, min(both.size, _MOST_PAIRS)).astype(int))]
    x, beyond_x = _clip(comparison.margins[rows, 0], low, high, "left", "right")
    y, beyond_y = _clip(comparison.margins[rows, 1], low, high, "down", "up")
    beyond = np.where(beyond_y == "", beyond_x, beyond_y)
    room = 0.6 * _GAP * ((high - low) or 1.0)
    ends = float(min(x.min(), y.min())) - room, float(max(x.max(), y.max())) + room
    series = [Series(x=np.array(ends), y=np.array(ends), colour=REFERENCE, dashed=True)]
    a, b = comparison.names
    kinds = {
        **{"none failed": (False, False, LINES[0]), f"{a} alone failed": (True, False, LINES[2])},
        **{f"{b} alone failed": (False, True, LINES[1]), "both failed": (True, True, BOUND)},
    }
    for kind, (in_a, in_b, colour) in kinds.items():
        for edge in ("", "down", "up", "left", "right"):
            there = (comparison.failed[rows] == (in_a, in_b)).all(axis=1) & (beyond == edge)
            if there.any():
                marker = f"triangle-{edge}" if edge else "circle"
                series.append(
                    Series(x=x[there], y=y[there], flights=comparison.numbers[rows][there], colour=colour, label=kind,
                           style="points", marker=marker, width=5.0 if edge else 3.7, opacity=0.75)
                )  # fmt: skip
    panel = Panel(title="a point per pair", x_label=f"worst margin, {a}", y_label=f"worst margin, {b}",
                  series=tuple(series), x_range=ends, y_range=ends, height=2.2)  # fmt: skip
    yield Figure(key="margins", title="worst margin, flight by flight", panels=(panel,), columns=1)


def _robust_ends(values: Array) -> tuple[float, float]:
    """The smallest and the largest of some values, some of them finite, without those far out."""
    finite = values[np.isfinite(values)]
    low, high = _fences(finite)
    inside = finite[(finite >= low) & (finite <= high)]
    return float(inside.min()), float(inside.max())


def _lowest_shown(values: Array) -> float:
    """The lowest of such margins that may be shown where it is: `_LOWEST_MARGIN`, but where most are lower still."""
    finite = values[np.isfinite(values)]
    return _LOWEST_MARGIN if np.median(finite) > _LOWEST_MARGIN else float(np.percentile(finite, 5))


def _fences(finite: Array) -> tuple[float, float]:
    """Five quartile ranges beyond the quartiles."""
    p5, q1, q3, p95 = np.percentile(finite, [5, 25, 75, 95])
    reach = _FENCE * ((q3 - q1) or (p95 - p5)) or np.inf
    return q1 - reach, q3 + reach


def _margin_ends(values: Array) -> tuple[float, float]:
    """The ends between which worst margins are drawn where they are; 0, the end of what is allowed, is among them."""
    finite = values[np.isfinite(values)]
    fence, above = _fences(finite)
    high = max(0.0, float(finite[finite <= above].max()))
    below = max(min(fence, -_LEAST_DEPTH * high), _lowest_shown(finite))
    return min(0.0, float(finite[finite >= below].min())), high


def _clip(values: Array, low: float, high: float, below: str, above: str) -> tuple[Array, np.ndarray]:
    """Values (K,) with those beyond the ends a little outside, and on which side each is; empty inside."""
    side = np.where(values < low, below, np.where(values > high, above, ""))
    gap = _GAP * ((high - low) or 1.0)
    return np.select([side == below, side == above], [low - gap, high + gap], values), side


def _shown_flights(table: pa.Table) -> dict[str, Rows]:
    """Rows of the flights that scatters show, by verdict: all, or at most a quarter of what a page bears of each."""
    limit = min(max(_MOST_POINTS // max(len(draw_names(table)), 1), 400), 2000)
    rows = {verdict: np.flatnonzero(found) for verdict, found in verdicts(table).items()}
    if table.num_rows <= limit:
        return rows
    return {
        verdict: found[np.unique(np.linspace(0.0, found.size - 1.0, limit // 4).astype(int))] if found.size else found
        for verdict, found in rows.items()
    }


def _edges(values: Array, least: float, *, whole: bool) -> Array:
    """Bins of one width over the values, without the few that are far out; 0 is an edge where it is among them."""
    low, high = _robust_ends(values)
    low = max(low, least)
    bins = min(_BINS, max(8, int(2.0 * np.sqrt(values.size))))
    if whole:
        width = max(1.0, np.ceil((high - low + 1.0) / bins))
        return np.arange(np.floor(low) - 0.5, high + width, width)
    width = (high - low) / bins
    first, last = np.floor(low / width), np.ceil(high / width)
    return np.asarray(width * np.arange(first, last + 1.0), float)
