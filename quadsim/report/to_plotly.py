"""Figures as zoomable plots of pages that work offline, by plotly, which reads all texts as HTML."""

from __future__ import annotations

import html
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from quadsim.palette import COLOUR
from quadsim.report.figure import Bound, Figure, Panel, Scene, Series
from quadsim.state import Array

if TYPE_CHECKING:
    from plotly.graph_objects import Figure as Canvas

_ROW: Final = 210  # height of a row of panels [px]
_TOP: Final = 34  # above all panels [px]
_BOTTOM: Final = 46  # below them [px]
_GAP: Final = 56  # between rows of panels [px]
_LABELLED_GAP: Final = 76  # likewise, where each row has a label [px]
_SCENE_HEIGHT: Final = 560  # of a scene [px]
_LEAST_SHARE: Final = 0.4  # length of a scene's shorter axes, at least, as a share of the longest
_LARGEST_PLAIN_EXPONENT: Final = 5  # of 10 in an axis' numbers, up to which they are written out
_MOST_POINTS: Final = 3000  # of a curve, or a path
_FEWEST_POINTS: Final = 200  # of a curve, however many runs there are
_POINTS_OF_ALL_RUNS: Final = 12_000
"""Points that one quantity may have over all runs: keeps a page of two runs near 6 MB, and of ten below 8 MB."""


@dataclass(frozen=True, kw_only=True)
class Plot:
    """A figure as a page holds it."""

    key: str  # its identifier in the page
    title: str  # its heading
    height: int  # [px]
    timed: bool  # whether its horizontal axes are time, linked with those of other plots
    json: str  # plotly's JSON, safe inside a script element
    labels: dict[str, str]  # colour of each label, where the page explains them above the plot
    note: str = ""  # what a reader has to know of it


def plotly_script() -> str:
    """plotly.js itself, to stand inside a page."""
    from plotly.offline import get_plotlyjs

    return str(get_plotlyjs())


def embed(
    canvas: Canvas,
    key: str,
    title: str,
    height: int,
    *,
    timed: bool = False,
    note: str = "",
    labels: Mapping[str, str] = MappingProxyType({}),
) -> Plot:
    """A figure of plotly's for a page, without plotly's own template and legend: the page gives its colours."""
    canvas.update_layout(template="none", showlegend=False, height=height)
    for update in (canvas.update_xaxes, canvas.update_yaxes):
        update(exponentformat="power", minexponent=_LARGEST_PLAIN_EXPONENT)
    # a logarithmic axis would have a power at each of its ticks
    canvas.update_yaxes(exponentformat="none", selector={"type": "log"})
    json = str(canvas.to_json()).replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")
    return Plot(key=key, title=title, height=height, timed=timed, json=json, labels=dict(labels), note=note)


def to_plot(figure: Figure, *, labelled: bool = True, note: str = "") -> Plot:
    """A figure for a page, which explains its labels unless toggles of the page do."""
    canvas = _new_canvas(figure)
    columns = _columns(figure)
    points = _points_per_curve(figure)
    timed = figure.end is not None
    for i, panel in enumerate(figure.panels):
        place = {"row": i // columns + 1, "col": i % columns + 1}
        _draw_panel(canvas, panel, place, points)
        if panel.equal:
            canvas.update_yaxes(scaleanchor=_x_axis(i), **place)
        if figure.end is not None and not panel.x_label:
            if i > 0:
                canvas.update_xaxes(matches=_x_axis(0), **place)
            canvas.update_xaxes(range=[-0.01 * figure.end, figure.end or 1.0], **place)
            if i >= len(figure.panels) - columns:
                canvas.update_xaxes(title={"text": "time [s]", "standoff": 6}, **place)
    hover = "x unified"
    if not timed:
        hover = "closest"
        canvas.update_xaxes(nticks=6)
    if len(figure.panels) > columns:
        canvas.update_xaxes(tickangle=0)  # a turned label runs into the next row
    canvas.update_annotations(font={"size": 13})
    margin = {"l": 56, "r": 12, "t": _TOP, "b": _BOTTOM}
    canvas.update_layout(margin=margin, hovermode=hover, dragmode="zoom", barmode="overlay", bargap=0)
    height = int(_ROW * sum(figure.row_heights)) + _TOP + _BOTTOM
    labels = {}
    if labelled:
        labels = figure.labels
    return embed(canvas, figure.key, figure.title, height, timed=timed, labels=labels, note=note)


def _columns(figure: Figure) -> int:
    return min(figure.columns, len(figure.panels))


def _x_axis(i: int) -> str:
    """The name of the horizontal axis of panel `i`: x, x2, x3, ..."""
    if i == 0:
        return "x"
    return f"x{i + 1}"


def _points_per_curve(figure: Figure) -> int:
    """How many points each curve may have: the fewer, the more runs there are."""
    groups = set[str]()
    for panel in figure.panels:
        groups.update(series.group for series in panel.series)
    points = _POINTS_OF_ALL_RUNS // max(len(groups), 1)
    return min(_MOST_POINTS, max(_FEWEST_POINTS, points))


def _new_canvas(figure: Figure) -> Canvas:
    """Empty axes for each panel under its heading; places of the last row without a panel have none."""
    from plotly.subplots import make_subplots

    columns = _columns(figure)
    heights = figure.row_heights
    count = len(figure.panels)
    places: list[dict[str, Any] | None] = [{} for _ in range(count)]
    places += [None] * (columns * len(heights) - count)
    gap = _LABELLED_GAP
    if figure.end is not None:
        gap = _GAP
    horizontal_gap = 0.0
    if columns > 1:
        horizontal_gap = 0.08
    return make_subplots(
        rows=len(heights),
        cols=columns,
        subplot_titles=[html.escape(panel.heading) for panel in figure.panels],
        horizontal_spacing=horizontal_gap,
        vertical_spacing=gap / (_ROW * sum(heights)),
        row_heights=heights,
        specs=[places[first : first + columns] for first in range(0, len(places), columns)],
    )


def scene_to_plot(scene: Scene) -> Plot:
    """Paths and solids in space for a page."""
    from plotly.graph_objects import Figure as Canvas
    from plotly.graph_objects import Mesh3d, Scatter3d

    canvas = Canvas()
    drawn = []
    for points, name in scene.solids:
        drawn.append(points)
        x, y, z = points.T.astype(np.float32)
        look: dict[str, Any] = {"color": COLOUR.obstacle, "opacity": 0.6, "hoverinfo": "name"}
        canvas.add_trace(Mesh3d(x=x, y=y, z=z, alphahull=0, name=html.escape(name), **look))
    for path, label, colour, group, dashed in scene.paths:
        drawn.append(path)
        x, y, z = path[:: max(1, len(path) // _MOST_POINTS)].T.astype(np.float32)
        line = {"color": colour, "width": 5, "dash": "solid"}
        if dashed:
            line |= {"width": 3, "dash": "dash"}
        canvas.add_trace(Scatter3d(x=x, y=y, z=z, mode="lines", line=line, name=html.escape(label), legendgroup=group))
    canvas.update_layout(scene=_space(np.concatenate(drawn)), margin=dict.fromkeys("lrtb", 0))
    return embed(canvas, scene.key, scene.title, _SCENE_HEIGHT)


def _space(drawn: Array) -> dict[str, Any]:
    """Axes of one scale around points (K, 3), and the camera that sees them."""
    drawn = drawn[np.isfinite(drawn).all(axis=1)]
    low = drawn.min(axis=0)
    high = drawn.max(axis=0)
    middle = 0.5 * (low + high)
    half = 0.55 * (high - low)
    half = np.maximum(half, max(_LEAST_SHARE * half.max(), 1e-3))  # equal scales, and room beside a straight path
    space: dict[str, Any] = {
        "aspectmode": "manual",
        "aspectratio": dict(zip("xyz", half / half.max(), strict=True)),
        "camera": {"eye": {"x": 1.2, "y": -1.7, "z": 0.8}, "center": {"x": 0.0, "y": 0.0, "z": -0.12}},
    }
    for i, name in enumerate("xyz"):
        ends = [middle[i] - half[i], middle[i] + half[i]]
        axis = {"title": {"text": f"{name} [m]"}, "range": ends, "exponentformat": "none"}
        space[f"{name}axis"] = axis
    return space


def thinned_curve(values: Array, points: int) -> np.ndarray[Any, np.dtype[np.intp]]:
    """Rising indices of about `points` of the values (K,): the lowest and highest of each segment, so no peak is lost.

    The first, the last, and all gaps, where a value is not finite, are retained.
    """
    if values.size <= points:
        return np.arange(values.size)
    gaps = np.flatnonzero(~np.isfinite(values))
    values = np.nan_to_num(values, posinf=0.0, neginf=0.0)
    stride = -(-2 * values.size // points)
    rows = -(-values.size // stride)
    segments = np.pad(values, (0, rows * stride - values.size), mode="edge").reshape(rows, stride)
    starts = stride * np.arange(rows)
    lowest = starts + segments.argmin(axis=1)
    highest = starts + segments.argmax(axis=1)
    ends = [0, values.size - 1]
    indices = np.concatenate([ends, lowest, highest, gaps])
    return np.unique(np.minimum(indices, values.size - 1))


def _draw_panel(canvas: Canvas, panel: Panel, place: dict[str, int], points: int) -> None:
    """Draw a panel at a row and column, with so many points a curve."""
    from plotly.graph_objects import Scatter

    for area in panel.areas:
        x, y = area.outline.T.astype(np.float32)
        look = {"fill": "toself", "fillcolor": area.colour, "opacity": area.opacity, "line": {"width": 0}}
        canvas.add_trace(Scatter(x=x, y=y, mode="lines", name=html.escape(area.label), **look), **place)
    for band in panel.bands:
        x = np.concatenate([band.x, band.x[::-1]])
        y = np.concatenate([band.high, band.low[::-1]])
        look = {"fill": "toself", "fillcolor": band.colour, "opacity": band.opacity, "line": {"width": 0}}
        canvas.add_trace(Scatter(x=x, y=y, mode="lines", hoverinfo="skip", **look), **place)
    for series in panel.series:
        _draw_series(canvas, series, place, points)
    for bound in panel.bounds:
        _draw_bound(canvas, bound, place)
    for label in panel.labels:
        text = html.escape(label.text)
        if label.bold:
            text = f"<b>{text}</b>"
        font = {}
        if label.colour:
            font["color"] = label.colour
        canvas.add_annotation(x=label.x, y=label.y, text=text, font=font, showarrow=False, **place)
    _set_axes(canvas, panel, place)


def _draw_bound(canvas: Canvas, bound: Bound, place: dict[str, int]) -> None:
    from plotly.graph_objects import Scatter

    line = {"color": COLOUR.bound, "width": 1.4, "dash": "dash"}
    if bound.vertical:
        canvas.add_vline(bound.value, line=line, **place)
    elif not np.isfinite([bound.start, bound.stop]).all():
        canvas.add_hline(bound.value, line=line, **place)
    else:
        x = [bound.start, bound.stop]
        y = [bound.value, bound.value]
        canvas.add_trace(Scatter(x=x, y=y, mode="lines", line=line, name="bound", hoverinfo="skip"), **place)


def _set_axes(canvas: Canvas, panel: Panel, place: dict[str, int]) -> None:
    """Set a panel's labels, and kind, ticks and range of its axes."""
    if panel.x_label:
        canvas.update_xaxes(title={"text": html.escape(panel.x_label), "standoff": 6}, **place)
    if panel.y_label:
        canvas.update_yaxes(title={"text": html.escape(panel.y_label)}, **place)
    if panel.y_log:
        canvas.update_yaxes(type="log", dtick=1, **place)
    if panel.whole:
        canvas.update_yaxes(rangemode="tozero", **place)
        highest = max(map(_highest, panel.series), default=0.0)
        if highest < 4:
            canvas.update_yaxes(dtick=1, **place)
        elif highest < 6:
            canvas.update_yaxes(dtick=2, **place)
    if panel.x_names:
        names = [html.escape(name) for name in panel.x_names]
        canvas.update_xaxes(tickvals=list(range(len(names))), ticktext=names, automargin=True, **place)
    if panel.fixed_range:
        canvas.update_yaxes(range=list(panel.fixed_range), **place)
    elif panel.least_range:
        canvas.update_yaxes(autorangeoptions={"include": panel.least_range}, **place)


def _highest(series: Series) -> float:
    """The highest value of a series, of stacked bars the top."""
    if series.base is None:
        return float(np.max(series.y))
    return float(np.max(series.y + series.base))


def _draw_series(canvas: Canvas, series: Series, place: dict[str, int], points: int) -> None:
    """Draw a series at a row and column: bars and the points of flights all, other series thinned."""
    from plotly.graph_objects import Scatter

    if series.style == "bars":
        _draw_bars(canvas, series, place)
        return
    looks = _shared_looks(series)
    if series.style == "points" and series.flights is not None:
        drawn = np.arange(series.y.size)
    else:
        drawn = thinned_curve(series.y, points)
    x = series.x[drawn].astype(np.float32)
    y = series.y[drawn].astype(np.float32)
    if series.style == "points":
        looks["mode"] = "markers"
        looks["marker"] = {"color": series.colour, "size": 1.5 * series.width, "symbol": series.marker}
        if series.flights is not None:
            looks["customdata"] = series.flights[drawn].astype(np.int32)
            looks["hovertemplate"] = "flight %{customdata}: %{x:.4g}, %{y:.4g}<extra>%{fullData.name}</extra>"
    else:
        line = {"color": series.colour, "width": 1.25 * series.width, "shape": "linear"}
        if series.style == "steps":
            line["shape"] = "hv"
        if series.dashed:
            line["dash"] = "dash"
        looks["mode"] = "lines"
        looks["line"] = line
    canvas.add_trace(Scatter(x=x, y=y, **looks), **place)


def _draw_bars(canvas: Canvas, series: Series, place: dict[str, int]) -> None:
    from plotly.graph_objects import Bar

    looks = _shared_looks(series)
    looks |= {"marker": {"color": series.colour, "line": {"width": 0}}, "width": series.bar_width, "base": series.base}
    looks |= {"customdata": series.y, "hovertemplate": "%{x:.4g}: %{customdata} %{fullData.name}<extra></extra>"}
    canvas.add_trace(Bar(x=series.x.astype(np.float32), y=series.y, **looks), **place)


def _shared_looks(series: Series) -> dict[str, Any]:
    """What series of every style have."""
    return {
        "name": html.escape(series.label),
        "legendgroup": series.group or None,
        "opacity": series.opacity,
    }
