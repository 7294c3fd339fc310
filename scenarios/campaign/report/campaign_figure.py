"""A campaign -> its figure."""

from __future__ import annotations

import itertools
import textwrap
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import pyarrow as pa

from quadsim.report.figures.canvas import new_figure
from quadsim.report.palette import BOUND, COURSE_COLOUR, LINES
from scenarios.campaign.report.campaign_curves import convergence_range, drivers, histograms, present
from scenarios.campaign.report.campaign_text import verdict_sentence
from scenarios.campaign.results.table import Summary
from scenarios.campaign.results.verdicts import VERDICTS
from scenarios.campaign.statistics import scatters
from scenarios.campaign.statistics.inference import ALPHA
from scenarios.campaign.statistics.wording import label, side_by_side

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_TRIANGLES: Final = {"down": "v", "up": "^", "left": "<", "right": ">"}
_MOST_DRIVERS: Final = 10
_MOST_SCATTERS: Final = 3
_LINE: Final = 150  # characters of a line below all panels
_TICK_ROOM: Final = 60  # characters that have room below a panel
_TICKS: Final = 6
_FEW: Final = 50  # flights of a verdict that are drawn larger, so as to be seen among the others


def draw_campaign(name: str, table: pa.Table, summary: Summary) -> Figure:
    """How the estimate settles, worst margins, and the parameters that matter."""
    drawn = scatters.margins(table)
    parameters = _strongest(scatters.clouds(table, drawn), summary) if drawn is not None else []
    rows = 3 if len(parameters) > 1 else 2
    figure = new_figure(f"{name}: {verdict_sentence(summary)}", 9.6, 3.4 * rows)
    panels = figure.subplots(rows, 2).ravel()
    _draw_convergence(panels[0], summary)
    _draw_margins(panels[1], table)
    _draw_drivers(panels[2], summary)
    if drawn is None or not parameters:
        _note(panels[3], "no margins, or nothing drawn")
    for axes in panels[3 + max(len(parameters), 1) :]:
        axes.set_axis_off()
    if drawn is not None and parameters:
        for axes, cloud in zip(panels[3:], parameters, strict=False):
            _draw_scatter(axes, table, cloud, drawn)
        curve = f"Curve: {scatters.COURSE}. " if any(cloud.course is not None for cloud in parameters) else ""
        note = textwrap.fill(curve + scatters.clipping(drawn, parameters), _LINE)
        figure.supxlabel(note, x=0.01, ha="left", fontsize=8.0, color="#5b6067")
    return figure


def _strongest(found: list[scatters.Cloud], summary: Summary) -> list[scatters.Cloud]:
    """The parameters that correlate most with the outcome, or the first ones where none of them can."""
    rank = {name: i for i, name in enumerate(drivers(summary))}
    return sorted(found, key=lambda cloud: rank.get(cloud.name, len(rank)))[:_MOST_SCATTERS]


def _draw_convergence(axes: Axes, summary: Summary) -> None:
    from matplotlib.ticker import LogLocator, NullFormatter

    axes.set_title("share of failed flights, in its interval", loc="left", fontsize=9.5)
    if not summary["convergence"]["flights"]:
        _note(axes, "all flights are incomplete" if summary["flights"] else "no flights")
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
    axes.set(ylim=convergence_range(summary, ["failure"]), xlabel="flights", ylabel="failed [%]")


def _draw_margins(axes: Axes, table: pa.Table) -> None:
    from matplotlib.ticker import MaxNLocator

    axes.set_title("worst margin; 0: end of what is allowed", loc="left", fontsize=9.5)
    drawn = next((histogram for histogram in histograms(table) if histogram.name == "worst_margin"), None)
    if drawn is None:
        _note(axes, "no margins that differ")
        return
    below = np.zeros(drawn.edges.size - 1)
    for verdict in present(table):
        counts = drawn.counts[verdict]
        looks: Any = {"align": "edge", "color": VERDICTS[verdict].colour, "label": verdict}
        axes.bar(drawn.edges[:-1], counts, np.diff(drawn.edges), below, **looks)
        below += counts
    if drawn.edges[0] <= 0.0 <= drawn.edges[-1]:
        axes.axvline(0.0, color=BOUND, linestyle="--", linewidth=1.1)
    axes.set_ylim(0.0, 1.08 * below.max())
    axes.xaxis.set_major_locator(MaxNLocator(_TICKS, steps=(1, 2, 2.5, 5, 10)))
    axes.yaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set(xlabel=drawn.label.replace("worst_margin", "worst margin"), ylabel="flights")
    axes.legend(fontsize=8.0)


def _draw_drivers(axes: Axes, summary: Summary) -> None:
    """Rank correlations as bars, and the measure of any dependence as diamonds over them."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    axes.set_title("which parameters matter", loc="left", fontsize=9.5)
    strongest = dict(itertools.islice(drivers(summary).items(), _MOST_DRIVERS))
    if not strongest:
        _note(axes, "nothing to correlate")
        return
    keys: list[Artist] = []
    for text, outcome, colour, offset in (
        ("worst margin", "worst_margin", LINES[0], -0.2),
        ("failure", "failed", LINES[1], 0.2),
    ):
        found = {row: each[outcome] for row, each in enumerate(strongest.values()) if each[outcome]}
        if found:
            keys.append(Patch(color=colour, label=text))
        for row, one in found.items():
            axes.barh(row + offset, one["rho"], 0.38, color=colour, alpha=1.0 if one["p_holm"] < ALPHA else 0.35)
            inside = colour if one["p_xi_holm"] < ALPHA else "white"
            looks: Any = {"markeredgecolor": "#1c1e21", "markersize": 4.0, "markeredgewidth": 0.7, "zorder": 3}
            axes.plot(one["xi"], row + offset, "D", color=inside, **looks)
    diamond = Line2D([], [], marker="D", color="#1c1e21", linestyle="none", markersize=4.0, label="xi: any dependence")
    keys += [Patch(color="#c9ccd1", label="rank correlation"), diamond]
    axes.axvline(0.0, color="#5b6067", linewidth=0.8)
    axes.set(xlim=(-1.04, 1.04), ylim=(len(strongest) - 0.4, -0.6))
    axes.set_yticks(range(len(strongest)), [label(name, found["unit"]) for name, found in strongest.items()])
    axes.grid(axis="y", visible=False)
    axes.set_xlabel("pale, hollow: not beyond chance (5 %, Holm over all tests)")
    axes.legend(handles=keys, fontsize=8.0)


def _draw_scatter(axes: Axes, table: pa.Table, cloud: scatters.Cloud, drawn: scatters.Margins) -> None:
    from matplotlib.ticker import MaxNLocator

    axes.set_title(f"worst margin over {cloud.name}", loc="left", fontsize=9.5)
    shown, beyond = scatters.shown_flights(table), scatters.edges(cloud, drawn)
    for verdict in present(table):
        looks, rows = VERDICTS[verdict], shown[verdict]
        size = 2.6 if len(rows) > _FEW else 4.5
        for edge, marker in {"": looks.marker, **_TRIANGLES}.items():
            of = rows[beyond[rows] == edge]
            axes.plot(
                cloud.x[of],
                drawn.y[of],
                marker,
                color=looks.colour,
                markersize=size + 2.0 if edge else size,
                alpha=0.65,
                markeredgewidth=0.9 if marker == "x" else 0.0,
                rasterized=True,
            )
    axes.axhline(0.0, color=BOUND, linestyle="--", linewidth=1.1)
    if cloud.course is not None:
        axes.plot(cloud.course.x, cloud.course.y, color=COURSE_COLOUR, linewidth=2.0)
    axes.xaxis.set_major_locator(MaxNLocator(_TICKS, steps=(1, 2, 2.5, 5, 10)))
    if cloud.names:
        axes.set_xticks(range(len(cloud.names)), side_by_side(cloud.names, _TICK_ROOM))
    axes.set(ylim=drawn.ends, ylabel="worst margin", xlabel=cloud.label)


def _note(axes: Axes, what: str) -> None:
    """An empty panel, and why it is so."""
    axes.text(0.5, 0.5, what, transform=axes.transAxes, ha="center", va="center", color="#5b6067")
    axes.set(xticks=[], yticks=[])
