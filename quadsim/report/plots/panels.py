"""What all plots of a page share: panels, bounds, and how a figure becomes text inside the page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from quadsim.report.curves import least_range
from quadsim.report.palette import BOUND

if TYPE_CHECKING:
    from plotly.graph_objects import Figure

PANEL_HEIGHT: Final = 210
TOP, BOTTOM = 34, 46
_OWN_HEIGHT: Final = 230  # of a row of panels whose horizontal axes have each a scale of its own [pixels]
_OWN_TICKS: Final = 5
Keys = tuple[tuple[str, str], ...]  # names of lines and their colours


@dataclass(frozen=True, kw_only=True)
class Plot:
    """One figure of the page."""

    key: str  # its identifier in the page
    title: str  # its heading
    height: int  # its height [pixels]
    timed: bool  # whether its horizontal axes are time, linked with those of the other plots
    json: str  # the figure as plotly's JSON, safe inside a script element
    key_colours: Keys = ()  # those of its lines, where the page shows them above it


def plotly_script() -> str:
    """plotly.js itself, to stand inside a page that must work offline."""
    from plotly.offline import get_plotlyjs

    return str(get_plotlyjs())


def panels(labels: Sequence[str], *, shared: bool = True) -> Figure:
    """An empty figure of two columns, its panels named row by row; they share their horizontal axes, or have own ones.

    The last place stays empty where the labels are odd in number.  No tick label is turned: it would run into the next
    row.
    """
    from plotly.subplots import make_subplots

    rows = -(-len(labels) // 2)
    figure = make_subplots(
        rows=rows,
        cols=2,
        subplot_titles=list(labels),
        shared_xaxes="all" if shared else False,
        horizontal_spacing=0.06,
        vertical_spacing=0.14 / max(rows - 1, 1) if shared else 0.22 / rows,
        specs=[[{}, {} if 2 * row + 1 < len(labels) else None] for row in range(rows)],
    )
    figure.update_xaxes(tickangle=0)
    return figure


def place(panel: int) -> dict[str, int]:
    """Row and column of the i-th panel, counted from 0."""
    return {"row": panel // 2 + 1, "col": panel % 2 + 1}


def draw_bound(figure: Figure, panel: int, bound: float, start: float, stop: float) -> None:
    """A bound, level from `start` to `stop` on the panel's horizontal axis."""
    from plotly.graph_objects import Scatter

    line = {"color": BOUND, "width": 1.4, "dash": "dash"}
    x, y = [start, stop], [bound, bound]
    figure.add_trace(Scatter(x=x, y=y, mode="lines", line=line, name="bound", hoverinfo="skip"), **place(panel))


def keep_least_span(figure: Figure, panel: int, unit: str) -> None:
    """Widen the vertical axis of a panel whose curves and bounds all stand still; see `quadsim.report.curves`."""
    ends = least_range([np.asarray(trace.y, float) for trace in figure.select_traces(**place(panel))], unit)
    if ends is not None:
        figure.update_yaxes(autorangeoptions={"include": ends}, **place(panel))


def finished(figure: Figure, key: str, title: str, *, height: int, timed: bool, keys: Keys = ()) -> Plot:
    """The figure without plotly's own template and legend: the page gives its colours and its toggles."""
    figure.update_layout(template="none", showlegend=False, height=height)
    text = str(figure.to_json()).replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")
    return Plot(key=key, title=title, height=height, timed=timed, json=text, key_colours=keys)


def finished_panels(figure: Figure, key: str, title: str, count: int, keys: Keys = ()) -> Plot:
    """So many panels of `panels(..., shared=False)`."""
    figure.update_annotations(font={"size": 13})
    figure.update_xaxes(nticks=_OWN_TICKS)
    figure.update_layout(margin={"l": 52, "r": 12, "t": TOP, "b": BOTTOM})
    height = -(-count // 2) * _OWN_HEIGHT + TOP + BOTTOM
    return finished(figure, key, title, height=height, timed=False, keys=keys)
