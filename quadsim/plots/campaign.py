"""A campaign -> the plots of its page."""

from __future__ import annotations

import html
from dataclasses import replace
from typing import TYPE_CHECKING, Final

import numpy as np
import pyarrow as pa

from quadsim.campaign.columns import numbers
from quadsim.campaign.comparison import Comparison
from quadsim.campaign.curves import (
    Cloud,
    Driver,
    Histogram,
    Margins,
    clouds,
    convergence_range,
    converging,
    drivers,
    histograms,
    margins,
    present,
    shown_flights,
)
from quadsim.campaign.estimates import Summary
from quadsim.campaign.verdicts import VERDICTS
from quadsim.palette import BOUND, LINES, REFERENCE
from quadsim.plots.panels import BOTTOM, TOP, Plot, finished, panels, place

if TYPE_CHECKING:
    from plotly.graph_objects import Figure

OUTCOMES: Final = {"with the worst margin": LINES[0], "with failure": LINES[1]}
_LOG_TICKS: Final = [float(digit * 10**power) for power in range(7) for digit in (1, 2, 5)]
_HEIGHT: Final = 230
"""Of a row of panels whose horizontal axes have each a scale of its own [pixels]."""


def campaign_plots(table: pa.Table, summary: Summary) -> dict[str, Plot]:
    """The plots of a campaign that its flights have something for.

    Args:
        table: `flights.parquet`.
        summary: its estimates.

    Returns:
        Any of `convergence`, `metrics`, `drivers` and `scatter`.
    """
    found = {}
    if table.num_rows:
        found["convergence"] = _convergence(summary)
    if drawn := histograms(table):
        found["metrics"] = _histograms(drawn, _verdict_keys(table))
    if told := drivers(summary):
        found["drivers"] = _drivers(told)
    drawn_margins, parameters = margins(table), clouds(table)
    if drawn_margins is not None and parameters:
        found["scatter"] = _scatter(table, parameters, drawn_margins)
    return found


def comparison_margins_plot(comparison: Comparison) -> Plot | None:
    """The worst margins of all pairs, one campaign against the other; None where too few pairs have both."""
    from plotly.graph_objects import Figure, Scatter

    shown = comparison.shown_margins
    if shown is None:
        return None
    figure = Figure()
    a, b = (html.escape(name) for name in comparison.names)
    ends = [shown.lowest, shown.highest]
    line = {"color": REFERENCE, "width": 1.2, "dash": "dash"}
    figure.add_trace(Scatter(x=ends, y=ends, mode="lines", line=line, hoverinfo="skip"))
    for kind, colour in shown.colours.items():
        of = shown.kind == kind
        figure.add_trace(
            Scatter(
                x=shown.margins[of, 0].astype(np.float32),
                y=shown.margins[of, 1].astype(np.float32),
                customdata=shown.flights[of],
                mode="markers",
                name=html.escape(kind),
                marker={"color": colour, "size": 5.5, "opacity": 0.75},
                hovertemplate=f"flight %{{customdata}}<br>{a}: %{{x:.3g}}<br>{b}: %{{y:.3g}}"
                "<extra>%{fullData.name}</extra>",
            )
        )
    figure.update_xaxes(title={"text": f"worst margin, {a}", "standoff": 6}, range=ends)
    figure.update_yaxes(title={"text": f"worst margin, {b}"}, range=ends)
    figure.update_layout(margin={"l": 60, "r": 12, "t": 12, "b": BOTTOM}, hovermode="closest")
    plot = finished(figure, "margins", "Worst margin, flight by flight", height=480, timed=False)
    keys = tuple((kind, colour) for kind, colour in shown.colours.items() if (shown.kind == kind).any())
    return replace(plot, key_colours=keys)


def _convergence(summary: Summary) -> Plot:
    """The shares of failures and violations over the first n flights, in their intervals."""
    from plotly.graph_objects import Scatter

    events = converging(summary)
    figure = panels(list(events.values()), shared=False)
    curves = summary["convergence"]
    n = np.asarray(curves["flights"], float)
    around = np.concatenate([n, n[::-1]])
    ends = convergence_range(summary, list(events))
    for panel, event in enumerate(events):
        share, lower, upper = (100.0 * np.asarray(curves[event][key]) for key in ("share", "lower", "upper"))
        band = np.concatenate([upper, lower[::-1]])
        filled = {"fill": "toself", "fillcolor": _faded(LINES[0], 0.22), "line": {"width": 0}}
        figure.add_trace(Scatter(x=around, y=band, mode="lines", hoverinfo="skip", **filled), **place(panel))
        figure.add_trace(
            Scatter(
                x=n,
                y=share,
                customdata=np.stack([lower, upper], axis=1),
                mode="lines+markers" if n.size < 3 else "lines",
                line={"color": LINES[0], "width": 2.0},
                hovertemplate="%{x} flights: %{y:.3g} % (%{customdata[0]:.3g} to %{customdata[1]:.3g} %)"
                "<extra></extra>",
            ),
            **place(panel),
        )
    if len(events) == 1:
        figure.update_xaxes(domain=[0.0, 1.0])
        figure.update_annotations(x=0.5)
    figure.update_yaxes(range=list(ends))
    last = float(np.log10(n[-1])) or 0.3
    figure.update_xaxes(
        type="log",
        tickvals=_LOG_TICKS,
        tickformat="~g",
        range=[0.0, 1.02 * last],
        title={"text": "flights", "standoff": 6},
    )
    figure.update_annotations(font={"size": 13})
    figure.update_layout(margin={"l": 52, "r": 12, "t": TOP, "b": BOTTOM}, hovermode="closest")
    return finished(figure, "convergence", "How the estimate settles", height=330, timed=False)


def _histograms(drawn: list[Histogram], keys: tuple[tuple[str, str], ...]) -> Plot:
    from plotly.graph_objects import Bar

    figure = panels([html.escape(histogram.label) for histogram in drawn], shared=False)
    for panel, histogram in enumerate(drawn):
        edges = histogram.edges
        for verdict, _ in keys:
            figure.add_trace(
                Bar(
                    x=(0.5 * (edges[:-1] + edges[1:])).astype(np.float32),
                    y=histogram.counts[verdict].astype(np.float32),
                    width=float(edges[1] - edges[0]),
                    name=verdict,
                    marker={"color": VERDICTS[verdict].colour, "line": {"width": 0}},
                    hovertemplate="%{x:.4g}: %{y} %{fullData.name}<extra></extra>",
                ),
                **place(panel),
            )
        highest = np.sum(list(histogram.counts.values()), axis=0).max()
        if highest < 6:
            figure.update_yaxes(dtick=1 if highest < 4 else 2, **place(panel))
        if histogram.name == "worst_margin" and edges[0] <= 0.0 <= edges[-1]:
            figure.add_vline(0.0, line={"color": BOUND, "width": 1.4, "dash": "dash"}, **place(panel))
    figure.update_layout(barmode="stack", bargap=0)
    plot = _paneled(figure, "metrics", "How flights are distributed", len(drawn))
    return replace(plot, key_colours=keys)


def _drivers(told: list[Driver]) -> Plot:
    from plotly.graph_objects import Bar, Figure

    names = [html.escape(driver.label) for driver in told]
    figure = Figure()
    for outcome, colour in OUTCOMES.items():
        of_margin = outcome == "with the worst margin"
        values = [driver.with_margin if of_margin else driver.with_failure for driver in told]
        sure = [driver.margin_is_sure if of_margin else driver.failure_is_sure for driver in told]
        if all(value is None for value in values):
            continue
        figure.add_trace(
            Bar(
                x=values,
                y=names,
                orientation="h",
                name=outcome,
                marker={"color": colour, "opacity": [1.0 if one else 0.35 for one in sure]},
                hovertemplate="%{y}, %{fullData.name}: %{x:.3f}<extra></extra>",
            )
        )
    figure.update_xaxes(range=[-1.0, 1.0], title={"text": "rank correlation", "standoff": 6}, zeroline=True)
    figure.update_yaxes(automargin=True, autorange="reversed")
    figure.update_layout(margin={"l": 12, "r": 12, "t": 6, "b": BOTTOM}, bargap=0.35, barmode="group")
    plot = finished(figure, "drivers", "What goes with it", height=70 + 36 * len(told), timed=False)
    return replace(plot, key_colours=tuple((trace.name, OUTCOMES[trace.name]) for trace in figure.data))


def _scatter(table: pa.Table, parameters: list[Cloud], drawn: Margins) -> Plot:
    from plotly.graph_objects import Scatter

    keys = _verdict_keys(table)
    figure = panels([html.escape(cloud.label) for cloud in parameters], shared=False)
    shown = shown_flights(table)
    numbered = numbers(table, "flight").astype(np.int32)
    for panel, cloud in enumerate(parameters):
        for verdict, colour in keys:
            rows = shown[verdict]
            figure.add_trace(
                Scatter(
                    x=cloud.x[rows].astype(np.float32),
                    y=drawn.y[rows].astype(np.float32),
                    customdata=numbered[rows],
                    mode="markers",
                    name=verdict,
                    marker={"color": colour, "size": 4.5, "opacity": 0.7, "symbol": VERDICTS[verdict].symbol},
                    hovertemplate="flight %{customdata}: %{fullData.name}<br>"
                    + (
                        "margin %{y:.3g}"
                        if cloud.names
                        else f"{html.escape(cloud.label)} %{{x:.4g}}, margin %{{y:.3g}}"
                    )
                    + "<extra></extra>",
                ),
                **place(panel),
            )
        if cloud.names:
            ticks = {"tickvals": list(range(len(cloud.names))), "ticktext": [html.escape(name) for name in cloud.names]}
            figure.update_xaxes(**ticks, **place(panel))
        figure.add_hline(0.0, line={"color": BOUND, "width": 1.2, "dash": "dash"}, **place(panel))
    high = max(1.0, float(np.nanmax(drawn.y)))
    figure.update_yaxes(range=[drawn.foot - 0.05 * (high - drawn.foot), high + 0.04 * (high - drawn.foot)])
    figure.update_layout(hovermode="closest")
    plot = _paneled(figure, "scatter", "Worst margin over each drawn parameter", len(parameters))
    return replace(plot, key_colours=keys)


def _verdict_keys(table: pa.Table) -> tuple[tuple[str, str], ...]:
    return tuple((verdict, VERDICTS[verdict].colour) for verdict in present(table))


def _paneled(figure: Figure, key: str, title: str, count: int) -> Plot:
    figure.update_annotations(font={"size": 13})
    figure.update_layout(margin={"l": 52, "r": 12, "t": TOP, "b": 30})
    return finished(figure, key, title, height=-(-count // 2) * _HEIGHT + TOP + 30, timed=False)


def _faded(colour: str, opacity: float) -> str:
    """A colour of the palette as rgba, which plotly asks for to fill an area."""
    red, green, blue = (int(colour[i : i + 2], 16) for i in (1, 3, 5))
    return f"rgba({red},{green},{blue},{opacity})"
