"""A tuning -> the plots of its page."""

from __future__ import annotations

import html
from collections.abc import Sequence

import numpy as np
import pyarrow as pa

from quadsim.report.palette import LINES, REFERENCE
from quadsim.report.plots.panels import BOTTOM, Plot, finished, finished_panels, panels, place
from scenarios.campaign.statistics.wording import label
from scenarios.tuning.report import tuning_curves as curves


def tuning_plots(summary: curves.Summary, tables: Sequence[pa.Table]) -> dict[str, Plot]:
    """The plots that there is something for: any of `candidates`, `importance` and `pairs`."""
    found = {}
    if curves.candidates(summary):
        found["candidates"] = _candidates(summary)
    if any(summary["importance"].values()):
        found["importance"] = _importance(summary)
    if len(tables) == 2 and curves.pairs(summary, tables, 0)[0].size:
        found["pairs"] = _pairs(summary, tables)
    return found


def _candidates(summary: curves.Summary) -> Plot:
    """The Pareto front of two objectives, or one objective over the candidates' numbers."""
    from plotly.graph_objects import Figure, Scatter

    figure, drawn = Figure(), curves.candidates(summary)
    across, up = (html.escape(text) for text in curves.axis_labels(summary))
    if len(summary["objectives"]) == 2 and summary["front"]:
        x, y = curves.front(summary)
        line = {"color": LINES[0], "width": 1.2}
        figure.add_trace(Scatter(x=x, y=y, mode="lines", line=line, hoverinfo="skip"))
    for each in drawn:
        marked = each.kind in ("start", "best")
        figure.add_trace(
            Scatter(
                x=each.x,
                y=each.y,
                customdata=each.numbers,
                mode="markers",
                name=each.kind,
                marker={
                    "color": curves.KINDS[each.kind],
                    "size": 13 if marked else 6,
                    "symbol": "star" if marked else "circle",
                },
                hovertemplate=f"candidate %{{customdata}}: %{{fullData.name}}<br>{up} %{{y:.4g}}"
                + (f"<br>{across} %{{x:.4g}}" if len(summary["objectives"]) == 2 else "")
                + "<extra></extra>",
            )
        )
    figure.update_xaxes(title={"text": across, "standoff": 6}, range=list(curves.ends(drawn, "x")))
    figure.update_yaxes(title={"text": up}, range=list(curves.ends(drawn, "y")))
    figure.update_layout(margin={"l": 64, "r": 12, "t": 12, "b": BOTTOM}, hovermode="closest")
    title = "Pareto front" if len(summary["objectives"]) == 2 else "Candidates"
    keys = tuple((each.kind, curves.KINDS[each.kind]) for each in drawn)
    return finished(figure, "candidates", title, height=430, timed=False, keys=keys)


def _importance(summary: curves.Summary) -> Plot:
    from plotly.graph_objects import Bar, Figure

    figure = Figure()
    names = [entry["name"] for entry in summary["search"]]
    shown = {name: shares for name, shares in summary["importance"].items() if shares}
    for i, (objective, shares) in enumerate(shown.items()):
        figure.add_trace(
            Bar(
                x=[100.0 * shares.get(name, 0.0) for name in names],
                y=names,
                orientation="h",
                name=objective,
                marker={"color": LINES[i]},
                hovertemplate="%{y}: %{x:.0f} % of %{fullData.name}<extra></extra>",
            )
        )
    figure.update_xaxes(title={"text": "share [%]", "standoff": 6}, rangemode="tozero")
    figure.update_yaxes(automargin=True, autorange="reversed")
    figure.update_layout(margin={"l": 12, "r": 12, "t": 6, "b": BOTTOM}, hovermode="closest")
    keys, height = tuple((name, LINES[i]) for i, name in enumerate(shown)), 90 + 34 * len(names)
    return finished(figure, "importance", "What matters", height=height, timed=False, keys=keys)


def _pairs(summary: curves.Summary, tables: Sequence[pa.Table]) -> Plot:
    """Each objective of the fresh flights, best over start."""
    from plotly.graph_objects import Scatter

    objectives = summary["objectives"]
    figure = panels([html.escape(label(each["name"], each["unit"])) for each in objectives], shared=False)
    for i in range(len(objectives)):
        start, best = curves.pairs(summary, tables, i)
        both = np.concatenate([start, best])
        ends = [float(both.min()), float(both.max())]
        line = {"color": REFERENCE, "width": 1.2, "dash": "dash"}
        figure.add_trace(Scatter(x=ends, y=ends, mode="lines", line=line, hoverinfo="skip"), **place(i))
        figure.add_trace(
            Scatter(
                x=start.astype(np.float32),
                y=best.astype(np.float32),
                mode="markers",
                marker={"color": LINES[0], "size": 5, "opacity": 0.7},
                hovertemplate="start %{x:.4g}, best %{y:.4g}<extra></extra>",
            ),
            **place(i),
        )
    if len(objectives) == 1:
        figure.update_xaxes(domain=[0.0, 1.0])
        figure.update_annotations(x=0.5)
    figure.update_layout(hovermode="closest")
    return finished_panels(figure, "pairs", "Fresh flights, pair by pair", len(objectives))
