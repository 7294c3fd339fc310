"""A campaign -> its figure."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
import pyarrow as pa

from quadsim.campaign.curves import (
    clouds,
    convergence_range,
    drivers,
    histograms,
    margins,
    present,
    shown_flights,
)
from quadsim.campaign.estimates import Summary
from quadsim.campaign.sentences import verdict_sentence
from quadsim.campaign.verdicts import VERDICTS
from quadsim.figures.canvas import new_figure, write_drawings
from quadsim.palette import BOUND, LINES

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_MOST_DRIVERS: Final = 10
_FEW: Final = 50
"""Flights of a verdict that are drawn larger, so as to be seen among the others."""


def write_campaign_figure(name: str, table: pa.Table, summary: Summary, directory: Path) -> list[Path]:
    """Draw how the estimate settles, the worst margins, what goes with them, and the strongest of that.

    Args:
        name: the campaign's.
        table: `flights.parquet`.
        summary: its estimates.
        directory: where `campaign.png` and `campaign.svg` go; made when it is not there.

    Returns:
        The two files.

    Raises:
        OutputError: the directory cannot be written.
    """
    return write_drawings({"campaign": lambda: _draw(name, table, summary)}, directory)


def _draw(name: str, table: pa.Table, summary: Summary) -> Figure:
    figure = new_figure(f"{name}: {verdict_sentence(summary)}", 9.6, 6.6)
    ((settling, distribution), (ranks, strongest)) = figure.subplots(2, 2)
    _draw_convergence(settling, summary)
    _draw_margins(distribution, table)
    _draw_drivers(ranks, summary)
    _draw_strongest(strongest, table, summary)
    return figure


def _draw_convergence(axes: Axes, summary: Summary) -> None:
    from matplotlib.ticker import LogLocator, NullFormatter

    axes.set_title("share of failed flights, in its interval", loc="left", fontsize=9.5)
    if not summary["flights"]:
        _say(axes, "no flights")
        return
    curves = summary["convergence"]
    n = curves["flights"]
    share, lower, upper = (100.0 * np.asarray(curves["failure"][key]) for key in ("share", "lower", "upper"))
    axes.fill_between(n, lower, upper, color=LINES[0], alpha=0.22, linewidth=0.0)
    axes.plot(n, share, color=LINES[0], marker="o" if len(n) < 3 else None, markersize=3.0)
    axes.set_xscale("log")
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if n[-1] < 1000 else (1.0,)))
    axes.xaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_ylim(*convergence_range(summary, ["failure"]))
    axes.set_xlabel("flights")
    axes.set_ylabel("failed [%]")


def _draw_margins(axes: Axes, table: pa.Table) -> None:
    from matplotlib.ticker import MaxNLocator

    axes.set_title("worst margin; 0: end of what is allowed", loc="left", fontsize=9.5)
    drawn = next((histogram for histogram in histograms(table) if histogram.name == "worst_margin"), None)
    if drawn is None:
        _say(axes, "no margins that differ")
        return
    below = np.zeros(drawn.edges.size - 1)
    for verdict in present(table):
        counts = drawn.counts[verdict]
        axes.bar(
            drawn.edges[:-1],
            counts,
            np.diff(drawn.edges),
            below,
            align="edge",
            color=VERDICTS[verdict].colour,
            label=verdict,
        )
        below += counts
    if drawn.edges[0] <= 0.0 <= drawn.edges[-1]:
        axes.axvline(0.0, color=BOUND, linestyle="--", linewidth=1.1)
    axes.set_ylim(0.0, 1.08 * below.max())
    axes.yaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_xlabel(drawn.label.replace("worst_margin", "worst margin"))
    axes.set_ylabel("flights")
    axes.legend(fontsize=8.0)


def _draw_drivers(axes: Axes, summary: Summary) -> None:
    from matplotlib.patches import Patch

    axes.set_title("rank correlation with the drawn numbers", loc="left", fontsize=9.5)
    told = drivers(summary)[:_MOST_DRIVERS][::-1]
    if not told:
        _say(axes, "nothing to correlate")
        return
    rows = np.arange(len(told))
    outcomes = (
        ("worst margin", LINES[0], 0.2, [(driver.with_margin, driver.margin_is_sure) for driver in told]),
        ("failure", LINES[1], -0.2, [(driver.with_failure, driver.failure_is_sure) for driver in told]),
    )
    keys: list[Artist] = []
    for outcome, colour, offset, values in outcomes:
        if all(value is None for value, _ in values):
            continue
        keys.append(Patch(color=colour, label=outcome))
        bars = axes.barh(rows + offset, [value or 0.0 for value, _ in values], 0.38, color=colour)
        for bar, (_, sure) in zip(bars, values, strict=True):
            bar.set_alpha(1.0 if sure else 0.35)
    axes.axvline(0.0, color="#5b6067", linewidth=0.8)
    axes.set_xlim(-1.0, 1.0)
    axes.set_yticks(rows, [driver.label for driver in told])
    axes.grid(axis="y", visible=False)
    axes.set_xlabel("pale: not beyond chance (5 %, Holm)")
    axes.legend(handles=keys, fontsize=8.0)


def _draw_strongest(axes: Axes, table: pa.Table, summary: Summary) -> None:
    drawn, told = margins(table), drivers(summary)
    parameters = {cloud.name: cloud for cloud in clouds(table)}
    if drawn is None or not parameters:
        _say(axes, "no margins, or nothing drawn")
        return
    cloud = parameters[told[0].name] if told else next(iter(parameters.values()))
    axes.set_title(f"worst margin over {cloud.name}", loc="left", fontsize=9.5)
    shown = shown_flights(table)
    for verdict in present(table):
        rows = shown[verdict]
        axes.plot(
            cloud.x[rows],
            drawn.y[rows],
            VERDICTS[verdict].marker,
            color=VERDICTS[verdict].colour,
            markersize=2.6 if len(rows) > _FEW else 4.5,
            alpha=0.65,
            markeredgewidth=0.9 if verdict == "lost" else 0.0,
            rasterized=True,
        )
    axes.axhline(0.0, color=BOUND, linestyle="--", linewidth=1.1)
    if cloud.names:
        axes.set_xticks(range(len(cloud.names)), cloud.names)
    axes.set_xlabel(cloud.label)
    axes.set_ylabel("worst margin")


def _say(axes: Axes, what: str) -> None:
    """An empty panel, and why it is so."""
    axes.text(0.5, 0.5, what, transform=axes.transAxes, ha="center", va="center", color="#5b6067")
    axes.set_xticks([])
    axes.set_yticks([])
