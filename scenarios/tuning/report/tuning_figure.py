"""A tuning -> its figure."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import pyarrow as pa

from quadsim.report.figures.canvas import new_figure
from quadsim.report.palette import LINES, REFERENCE
from scenarios.campaign.statistics.wording import label
from scenarios.tuning.report import tuning_curves as curves
from scenarios.tuning.report.tuning_tables import verdict_sentence

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_LINE: Final = 96  # characters of a line of the title


def draw_tuning(summary: curves.Summary, tables: Sequence[pa.Table]) -> Figure:
    """The candidates, what matters, and the fresh flights pair by pair."""
    title = textwrap.fill(f"{summary['tuning']}: {verdict_sentence(summary)}", _LINE)
    figure = new_figure(title, 9.6, 4.0)
    first, second, third = figure.subplots(1, 3, width_ratios=(1.25, 1.0, 1.0))
    _draw_candidates(first, summary)
    _draw_importance(second, summary)
    _draw_pairs(third, summary, tables)
    return figure


def _draw_candidates(axes: Axes, summary: curves.Summary) -> None:
    drawn = curves.candidates(summary)
    axes.set_title("candidates, on the draws of the search", loc="left", fontsize=9.5)
    for each in drawn:
        marked = each.kind in ("start", "best")
        size, marker, order = (60.0, "*", 3) if marked else (14.0, "o", 2)
        looks: Any = {"s": size, "marker": marker, "zorder": order, "linewidth": 0.0}
        axes.scatter(each.x, each.y, color=curves.KINDS[each.kind], label=each.kind, **looks)
    if len(summary["objectives"]) == 2 and summary["front"]:
        axes.plot(*curves.front(summary), color=LINES[0], linewidth=1.0, zorder=1)
    if drawn:
        axes.set(xlim=curves.ends(drawn, "x"), ylim=curves.ends(drawn, "y"))
        axes.legend(fontsize=7.0, loc="upper right")
    across, up = curves.axis_labels(summary)
    axes.set(xlabel=across, ylabel=up)


def _draw_importance(axes: Axes, summary: curves.Summary) -> None:
    axes.set_title("what matters (PED-ANOVA) [%]", loc="left", fontsize=9.5)
    names = [entry["name"] for entry in summary["search"]]
    shown = {name: shares for name, shares in summary["importance"].items() if shares}
    if not shown:
        axes.set_axis_off()
        axes.text(0.5, 0.5, "too few candidates", ha="center", va="center", transform=axes.transAxes)
        return
    height = 0.8 / len(shown)
    for i, (objective, shares) in enumerate(shown.items()):
        rows = np.arange(len(names)) + (i + 0.5) * height - 0.4
        axes.barh(rows, [100.0 * shares.get(name, 0.0) for name in names], height, color=LINES[i], label=objective)
    axes.set_yticks(range(len(names)), names)
    axes.invert_yaxis()
    axes.legend(fontsize=7.0)


def _draw_pairs(axes: Axes, summary: curves.Summary, tables: Sequence[pa.Table]) -> None:
    objective = summary["objectives"][0]
    axes.set_title(label(f"{objective['name']}, fresh draws", objective["unit"]), loc="left", fontsize=9.5)
    if len(tables) < 2:
        axes.set_axis_off()
        axes.text(0.5, 0.5, "the start is the answer", ha="center", va="center", transform=axes.transAxes)
        return
    start, best = curves.pairs(summary, tables, 0)
    axes.scatter(start, best, s=8.0, color=LINES[0], linewidth=0.0, alpha=0.7)
    both = np.concatenate([start, best])
    if both.size:
        axes.plot([both.min(), both.max()], [both.min(), both.max()], color=REFERENCE, linestyle="--", linewidth=1.0)
    axes.set(xlabel="start", ylabel="best")
