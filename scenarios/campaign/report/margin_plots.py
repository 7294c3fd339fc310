"""The worst margins of a campaign's flights as points: over what was drawn, and against another campaign's."""

from __future__ import annotations

import html
from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import pyarrow as pa

from quadsim.report.palette import BOUND, COURSE_COLOUR, REFERENCE
from quadsim.report.plots.panels import BOTTOM, Plot, finished, finished_panels, panels, place
from quadsim.state import Array
from scenarios.campaign.report.campaign_curves import present
from scenarios.campaign.results.columns import Rows, numbers
from scenarios.campaign.results.verdicts import VERDICTS
from scenarios.campaign.statistics.comparison import Comparison
from scenarios.campaign.statistics.scatters import COURSE, Cloud, Margins, edges, shown_flights
from scenarios.campaign.statistics.wording import side_by_side

if TYPE_CHECKING:
    from plotly.graph_objects import Scatter

_EDGE_SIZE: Final = 8
_TICK_ROOM: Final = 46  # characters that have room below a panel of a narrow page


def verdict_keys(table: pa.Table) -> tuple[tuple[str, str], ...]:
    """The verdicts that occur, with their colours."""
    return tuple((verdict, VERDICTS[verdict].colour) for verdict in present(table))


def scatter_plot(table: pa.Table, parameters: list[Cloud], drawn: Margins) -> Plot:
    """The worst margin over each drawn parameter, with its course."""
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
            figure.add_trace(_course(cloud.course.x, cloud.course.y), **place(panel))
        if cloud.names:
            parts = [html.escape(name).replace("\n", "<br>") for name in side_by_side(cloud.names, _TICK_ROOM)]
            figure.update_xaxes(tickvals=list(range(len(parts))), ticktext=parts, **place(panel))
    figure.update_yaxes(range=list(drawn.ends))
    figure.update_layout(hovermode="closest")
    plot = finished_panels(figure, "scatter", "Worst margin over each drawn parameter", len(parameters))
    curved = any(cloud.course is not None for cloud in parameters)
    return replace(plot, key_colours=(*keys, (COURSE, COURSE_COLOUR)) if curved else keys)


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


def _course(x: Array, y: Array) -> Scatter:
    from plotly.graph_objects import Scatter

    return Scatter(
        x=x.astype(np.float32),
        y=y.astype(np.float32),
        mode="lines",
        name=COURSE,
        line={"color": COURSE_COLOUR, "width": 2.5},
        hovertemplate=f"{COURSE} %{{y:.3g}}<extra></extra>",
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
    plot = finished(figure, "margins", "Worst margin, flight by flight", height=480, timed=False)
    keys = tuple((kind, colour) for kind, colour in shown.colours.items() if (shown.kind == kind).any())
    return replace(plot, key_colours=keys)
