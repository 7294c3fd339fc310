"""A campaign -> the plots of its page."""

from __future__ import annotations

import html
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import pyarrow as pa

from quadsim.report.palette import BOUND, COURSE_COLOUR, LINES, REFERENCE
from quadsim.report.plots.panels import BOTTOM, TOP, Plot, finished, finished_panels, panels, place
from scenarios.campaign.report.campaign_curves import (
    Histogram,
    convergence_range,
    converging,
    drivers,
    histograms,
    present,
)
from scenarios.campaign.results.table import Rows, Summary, numbers
from scenarios.campaign.results.verdicts import VERDICTS
from scenarios.campaign.statistics.comparison import Comparison
from scenarios.campaign.statistics.inference import ALPHA
from scenarios.campaign.statistics.scatters import COURSE, Cloud, Margins, clouds, edges, margins, shown_flights
from scenarios.campaign.statistics.wording import label, side_by_side

if TYPE_CHECKING:
    from plotly.graph_objects import Scatter

OUTCOMES: Final = {"with the worst margin": LINES[0], "with failure": LINES[1]}
_LOG_TICKS: Final = [float(digit * 10**power) for power in range(7) for digit in (1, 2, 5)]
_EDGE_SIZE: Final = 8
_TICK_ROOM: Final = 46  # characters that have room below a panel of a narrow page


def campaign_plots(table: pa.Table, summary: Summary) -> dict[str, Plot]:
    """The plots that its flights have something for: any of `convergence`, `metrics`, `drivers` and `scatter`."""
    found = {}
    if summary["convergence"]["flights"]:
        found["convergence"] = _convergence(summary)
    if drawn := histograms(table):
        found["metrics"] = _histograms(drawn, verdict_keys(table))
    if strongest := drivers(summary):
        found["drivers"] = _drivers(strongest)
    drawn_margins = margins(table)
    if drawn_margins is not None and (parameters := clouds(table, drawn_margins)):
        found["scatter"] = scatter_plot(table, parameters, drawn_margins)
    return found


def _convergence(summary: Summary) -> Plot:
    """The shares of failures and violations over the first n flights, in their intervals."""
    from plotly.graph_objects import Scatter

    events = converging(summary)
    figure = panels(list(events.values()), shared=False)
    curves = summary["convergence"]
    n = np.asarray(curves["flights"], float)
    pale = f"rgba({','.join(str(int(LINES[0][i : i + 2], 16)) for i in (1, 3, 5))},0.22)"
    around = np.concatenate([n, n[::-1]])
    ends = convergence_range(summary, list(events))
    for panel, event in enumerate(events):
        share, lower, upper = (100.0 * np.asarray(curves[event][key]) for key in ("share", "lower", "upper"))
        band = np.concatenate([upper, lower[::-1]])
        filled = {"fill": "toself", "fillcolor": pale, "line": {"width": 0}}
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
    return finished_panels(figure, "metrics", "How flights are distributed", len(drawn), keys=keys)


def _drivers(strongest: Mapping[str, Mapping[str, Any]]) -> Plot:
    """Rank correlations as bars, and the measure of any dependence as diamonds over them."""
    from plotly.graph_objects import Bar, Figure, Scatter

    names = [html.escape(label(name, found["unit"])) for name, found in strongest.items()]
    figure = Figure()
    keys = []
    for (text, colour), outcome, offset in zip(
        OUTCOMES.items(), ("worst_margin", "failed"), (-0.19, 0.19), strict=True
    ):
        found = {row: each[outcome] for row, each in enumerate(strongest.values()) if each[outcome]}
        if not found:
            continue
        keys.append((text, colour))
        shared = {"customdata": [names[i] for i in found], "name": text, "y": [i + offset for i in found]}
        figure.add_trace(
            Bar(
                x=[one["rho"] for one in found.values()],
                orientation="h",
                width=0.36,
                marker={"color": colour, "opacity": [1.0 if one["p_holm"] < ALPHA else 0.35 for one in found.values()]},
                hovertemplate="%{customdata}, %{fullData.name}: rank correlation %{x:.3f}<extra></extra>",
                **shared,
            )
        )
        figure.add_trace(
            Scatter(
                x=[one["xi"] for one in found.values()],
                mode="markers",
                marker={
                    **{"color": colour, "size": 10, "line": {"color": "white", "width": 1}},
                    "symbol": ["diamond" if one["p_xi_holm"] < ALPHA else "diamond-open" for one in found.values()],
                },
                hovertemplate="%{customdata}, %{fullData.name}: xi %{x:.3f}<extra></extra>",
                **shared,
            )
        )
    figure.update_xaxes(
        range=[-1.04, 1.04],
        title={"text": "bars: rank correlation; diamonds: xi, of any dependence", "standoff": 6},
        zeroline=True,
    )
    ticks = {"tickmode": "array", "tickvals": list(range(len(names))), "ticktext": names}
    figure.update_yaxes(automargin=True, range=[len(names) - 0.4, -0.6], **ticks)
    figure.update_layout(margin={"l": 12, "r": 12, "t": 6, "b": BOTTOM}, barmode="overlay", hovermode="closest")
    height = 70 + 36 * len(strongest)
    return finished(figure, "drivers", "Which parameters matter", height=height, timed=False, keys=tuple(keys))


def verdict_keys(table: pa.Table) -> tuple[tuple[str, str], ...]:
    """The verdicts that occur, with their colours."""
    return tuple((verdict, VERDICTS[verdict].colour) for verdict in present(table))


def scatter_plot(table: pa.Table, parameters: list[Cloud], drawn: Margins) -> Plot:
    """The worst margin over each varied parameter, with its course."""
    from plotly.graph_objects import Scatter

    keys = verdict_keys(table)
    figure = panels([html.escape(cloud.label) for cloud in parameters], shared=False)
    shown = shown_flights(table)
    numbered = numbers(table, "flight").astype(np.int32)
    for panel, cloud in enumerate(parameters):
        for verdict, _ in keys:
            for trace in _points(cloud, drawn, numbered, shown[verdict], verdict):
                figure.add_trace(trace, **place(panel))
        figure.add_hline(0.0, line={"color": BOUND, "width": 1.2, "dash": "dash"}, **place(panel))
        if cloud.course is not None:
            figure.add_trace(
                Scatter(
                    x=cloud.course.x.astype(np.float32),
                    y=cloud.course.y.astype(np.float32),
                    mode="lines",
                    name=COURSE,
                    line={"color": COURSE_COLOUR, "width": 2.5},
                    hovertemplate=f"{COURSE} %{{y:.3g}}<extra></extra>",
                ),
                **place(panel),
            )
        if cloud.names:
            parts = [html.escape(name).replace("\n", "<br>") for name in side_by_side(cloud.names, _TICK_ROOM)]
            figure.update_xaxes(tickvals=list(range(len(parts))), ticktext=parts, **place(panel))
    figure.update_yaxes(range=list(drawn.ends))
    figure.update_layout(hovermode="closest")
    if any(cloud.course is not None for cloud in parameters):
        keys = (*keys, (COURSE, COURSE_COLOUR))
    return finished_panels(figure, "scatter", "Worst margin over each varied parameter", len(parameters), keys=keys)


def _points(
    cloud: Cloud, drawn: Margins, numbered: np.ndarray[Any, np.dtype[np.int32]], rows: Rows, verdict: str
) -> Iterator[Scatter]:
    """The flights of one verdict where they are, and those beyond the axes as triangles at their edge."""
    from plotly.graph_objects import Scatter

    looks = VERDICTS[verdict]
    beyond = edges(cloud, drawn)
    inside, outside = rows[beyond[rows] == ""], rows[beyond[rows] != ""]
    over = "" if cloud.names else f"{html.escape(cloud.label)} %{{x:.4g}}, "
    yield Scatter(
        x=cloud.x[inside].astype(np.float32),
        y=drawn.y[inside].astype(np.float32),
        customdata=numbered[inside],
        mode="markers",
        name=verdict,
        marker={"color": looks.colour, "size": 4.5, "opacity": 0.7, "symbol": looks.symbol},
        hovertemplate=f"flight %{{customdata}}: %{{fullData.name}}<br>{over}margin %{{y:.3g}}<extra></extra>",
    )
    if outside.size:
        over = "" if cloud.names else f"{html.escape(cloud.label)} %{{customdata[1]:.4g}}, "
        margins = ["none" if np.isnan(margin) else f"{margin:.3g}" for margin in drawn.true[outside]]
        yield Scatter(
            x=cloud.x[outside].astype(np.float32),
            y=drawn.y[outside].astype(np.float32),
            customdata=np.stack([numbered, cloud.true], axis=1)[outside].astype(np.float32),
            text=margins,
            mode="markers",
            name=verdict,
            marker={
                **{"color": looks.colour, "size": _EDGE_SIZE, "opacity": 0.7},
                "symbol": [f"triangle-{edge}" for edge in beyond[outside]],
            },
            hovertemplate=f"flight %{{customdata[0]}}: %{{fullData.name}}<br>{over}margin %{{text}}<extra></extra>",
        )


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
                customdata=np.column_stack([shown.flights, shown.true])[of].astype(np.float32),
                mode="markers",
                name=html.escape(kind),
                marker={
                    **{"color": colour, "opacity": 0.75},
                    "size": [_EDGE_SIZE if edge else 5.5 for edge in shown.edge[of]],
                    "symbol": [f"triangle-{edge}" if edge else "circle" for edge in shown.edge[of]],
                },
                hovertemplate=f"flight %{{customdata[0]}}<br>{a}: %{{customdata[1]:.3g}}<br>{b}: %{{customdata[2]:.3g}}"
                "<extra>%{fullData.name}</extra>",
            )
        )
    figure.update_xaxes(title={"text": f"worst margin, {a}", "standoff": 6}, range=ends)
    figure.update_yaxes(title={"text": f"worst margin, {b}"}, range=ends)
    figure.update_layout(margin={"l": 60, "r": 12, "t": 12, "b": BOTTOM}, hovermode="closest")
    keys = tuple((kind, colour) for kind, colour in shown.colours.items() if (shown.kind == kind).any())
    return finished(figure, "margins", "Worst margin, flight by flight", height=480, timed=False, keys=keys)
