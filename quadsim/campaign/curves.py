"""A campaign -> what is drawn of it, on a page and on paper alike."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import pyarrow as pa

from quadsim.campaign.columns import draw_names, is_number, numbers, texts, verdicts
from quadsim.campaign.estimates import Summary
from quadsim.campaign.table import DRAW, unit_of
from quadsim.campaign.verdicts import VERDICTS
from quadsim.campaign.wording import count_of
from quadsim.state import Array

Rows = np.ndarray[Any, np.dtype[np.intp]]

MAIN_METRICS: Final = (
    "worst_margin",
    *(f"rmse.{name}" for name in ("x", "y", "z", "yaw")),
    "peak_tilt",
    "total_variation",
    "fallback_periods",
)
"""What a reader of a campaign asks for first."""
LOWEST_MARGIN: Final = -2.0
"""Margins below this are drawn at it, so that a lost flight does not flatten all others."""
ALPHA: Final = 0.05
"""Level of the tests."""
_MOST_POINTS: Final = 18_000
"""Points that all scatters of a page may have together: a page of 10 000 flights stays near 6 MB and quick to draw."""
_BINS: Final = 40
_FENCE: Final = 5.0
"""Quartile ranges beyond the quartiles up to which a histogram shows values where they are."""


@dataclass(frozen=True, kw_only=True)
class Margins:
    """The worst margins as they are drawn.

    Attributes:
        y: (K,) heights; `foot` where a flight has no margin, or one below `lowest`.
        true: (K,) the margins, NaN where there is none.
        lowest: margins below this are drawn at the foot.
        foot: height of what is too low, or is not there.
        at_foot: how many flights are drawn there.
    """

    y: Array
    true: Array
    lowest: float
    foot: float
    at_foot: int


@dataclass(frozen=True, kw_only=True)
class Cloud:
    """A drawn parameter of every flight, as horizontal positions.

    Attributes:
        name: the parameter.
        label: its name, with its unit where it has one.
        x: (K,) its values; whole numbers, spread a little, where it is drawn from names.
        names: what stands at 0, 1, ...; empty where it is a number.
    """

    name: str
    label: str
    x: Array
    names: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class Histogram:
    """How a metric is distributed, by verdict.

    Attributes:
        name: the metric.
        label: its name, with its unit and what is not shown in its place.
        edges: (B + 1,) ends of the bins.
        counts: flights in each bin, (B,), by verdict.
    """

    name: str
    label: str
    edges: Array
    counts: dict[str, Array]


@dataclass(frozen=True, kw_only=True)
class Driver:
    """How a drawn number goes with an outcome: rank correlations, None where there is none to tell."""

    name: str
    label: str
    with_margin: float | None
    with_failure: float | None
    margin_is_sure: bool
    failure_is_sure: bool

    @property
    def strength(self) -> float:
        """What drivers are ordered by: the correlation with the margin, or else with failure."""
        return abs(self.with_failure or 0.0) if self.with_margin is None else abs(self.with_margin)


def margins(table: pa.Table) -> Margins | None:
    """The worst margins as they are drawn; None where no flight has any, as without a required constraint."""
    true = numbers(table, "worst_margin")
    true = np.where(np.isfinite(true), true, np.nan)
    if np.isnan(true).all():
        return None
    least = lowest_shown(true)
    low = np.isnan(true) | (true < least)
    lowest = min(0.0, float(np.min(true[~low]))) if not low.all() else 0.0
    foot = lowest - 0.15 if low.any() else lowest
    return Margins(y=np.where(low, foot, true), true=true, lowest=least, foot=foot, at_foot=int(low.sum()))


def lowest_shown(values: Array) -> float:
    """The lowest of such margins that is shown where it is: `LOWEST_MARGIN`, but where most are lower still.

    Args:
        values: some of them finite.
    """
    finite = values[np.isfinite(values)]
    return LOWEST_MARGIN if np.median(finite) > LOWEST_MARGIN else float(np.percentile(finite, 5))


def clouds(table: pa.Table) -> list[Cloud]:
    """Every drawn parameter, in order."""
    found = []
    for name in draw_names(table):
        column = DRAW + name
        told = label(name, unit_of(table, column))
        if is_number(table, column):
            found.append(Cloud(name=name, label=told, x=numbers(table, column), names=()))
            continue
        values = texts(table, column)
        names = tuple(sorted(set(values)))
        spread = np.random.default_rng(0).uniform(-0.3, 0.3, values.size)  # as every time
        x = np.array([names.index(value) for value in values], float) + spread
        found.append(Cloud(name=name, label=told, x=x, names=names))
    return found


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
    return f"Drawn are {', '.join(parts)}, evenly spread by number; all others are drawn in full."


def histograms(table: pa.Table) -> list[Histogram]:
    """The main metrics that differ between flights."""
    by_verdict = verdicts(table)
    found = []
    for name in MAIN_METRICS:
        values = numbers(table, name)
        finite = values[np.isfinite(values)]
        if finite.size < 2 or np.ptp(finite) == 0.0:
            continue
        least = lowest_shown(finite) if name == "worst_margin" else -np.inf
        edges = _edges(finite, least, whole=pa.types.is_integer(table.schema.field(name).type))
        inside = np.clip(values, edges[0], edges[-1])
        counts = {
            v: np.histogram(inside[of & np.isfinite(values)], edges)[0].astype(float) for v, of in by_verdict.items()
        }
        beyond = int(np.count_nonzero((finite < edges[0]) | (finite > edges[-1])))
        told = f"; {beyond} beyond, in the end bars" if beyond else ""
        found.append(Histogram(name=name, label=label(name, unit_of(table, name)) + told, edges=edges, counts=counts))
    return found


def drivers(summary: Summary) -> list[Driver]:
    """The drawn numbers that go with an outcome at all, the strongest first."""
    found = []
    for name, parameter in summary["parameters"].items():
        margin, failed = parameter.get("worst_margin"), parameter.get("failed")
        if margin is None and failed is None:
            continue
        found.append(
            Driver(
                name=name,
                label=label(name, parameter["unit"]),
                with_margin=None if margin is None else margin["rho"],
                with_failure=None if failed is None else failed["rho"],
                margin_is_sure=margin is not None and margin["p_holm"] < ALPHA,
                failure_is_sure=failed is not None and failed["p_holm"] < ALPHA,
            )
        )
    return sorted(found, key=lambda driver: -driver.strength)


def converging(summary: Summary) -> dict[str, str]:
    """The events whose shares are drawn over n, with the headings of their panels; two that are the same are one."""
    curves = summary["convergence"]
    if curves["failure"] == curves["violation"]:
        return {"failure": "failed flights, the same as violations [%]"}
    return {"failure": "failed flights [%]", "violation": "violations [%]"}


def convergence_range(summary: Summary, events: Sequence[str]) -> tuple[float, float]:
    """Ends of the axis of shares [%]: what the intervals of the last nine tenths of all flights ask for."""
    curves = summary["convergence"]
    n = np.asarray(curves["flights"], float)
    settled = n >= 0.1 * n[-1]
    highest = max(float(np.max(np.asarray(curves[event]["upper"])[settled])) for event in events)
    lowest = min(float(np.min(np.asarray(curves[event]["lower"])[settled])) for event in events)
    room = 0.08 * (highest - lowest)
    return 100.0 * max(lowest - room, -0.02 * (highest - lowest)), 100.0 * min(highest + room, 1.0 + 0.25 * room)


def label(name: str, unit: str) -> str:
    """A name with its unit, where it has one."""
    return name if unit == "-" else f"{name} [{unit}]"


def present(table: pa.Table) -> list[str]:
    """The verdicts that occur."""
    found = verdicts(table)
    return [verdict for verdict in VERDICTS if found[verdict].any()]


def _evenly(rows: Rows, most: int) -> Rows:
    if rows.size <= most:
        return rows
    places = np.round(np.linspace(0.0, rows.size - 1.0, most)).astype(int)
    return np.asarray(rows[places])


def _edges(values: Array, least: float, *, whole: bool) -> Array:
    """Bins of one width over the values, without the few that are far out; 0 is an edge where it is among them."""
    q1, q3 = np.percentile(values, [25, 75])
    reach = _FENCE * (q3 - q1) or np.inf
    low, high = max(values.min(), q1 - reach, least), min(values.max(), q3 + reach)
    bins = min(_BINS, max(8, int(2.0 * np.sqrt(values.size))))
    if whole:
        width = max(1.0, np.ceil((high - low + 1.0) / bins))
        return np.arange(np.floor(low) - 0.5, high + width, width)
    width = (high - low) / bins
    first, last = np.floor(low / width), np.ceil(high / width)
    return np.asarray(width * np.arange(first, last + 1.0), float)
