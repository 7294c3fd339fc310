"""Figures as zoomable plots of pages that work offline, by plotly."""

from __future__ import annotations

import html
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from quadsim.palette import COLOUR
from quadsim.report.figure import Figure, Panel, Scene, Series
from quadsim.state import Array

if TYPE_CHECKING:
    from plotly.graph_objects import Figure as Canvas

# of a row of panels, and above and below them all [px]
_ROW = 210
_TOP = 34
_BOTTOM = 46
# between rows of panels, and where each has a label [px]
_GAP = 56
_LABELLED_GAP = 76
_SCENE: Final = 560  # [px]
_LEAST_SHARE: Final = 0.4  # of the longest axis of a scene: how long the others are at least
_MOST_POINTS: Final = 3000
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
    json = str(canvas.to_json()).replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")
    return Plot(key=key, title=title, height=height, timed=timed, json=json, labels=dict(labels), note=note)


def to_plot(figure: Figure, *, labelled: bool = True, note: str = "") -> Plot:
    """A figure for a page, which explains its labels unless toggles of the page do."""
    from plotly.subplots import make_subplots

    count = len(figure.panels)
    columns = min(figure.columns, len(figure.panels))
    rows = -(-count // columns)
    heights = [max(panel.height for panel in figure.panels[i : i + columns]) for i in range(0, count, columns)]
    timed = figure.end is not None
    canvas = make_subplots(
        rows=rows,
        cols=columns,
        subplot_titles=[html.escape(panel.heading) for panel in figure.panels],
        horizontal_spacing=0.08 if columns > 1 else 0.0,
        vertical_spacing=(_GAP if timed else _LABELLED_GAP) / (_ROW * sum(heights)),
        row_heights=heights,
        specs=[[{} if columns * row + column < count else None for column in range(columns)] for row in range(rows)],
    )
    groups = {series.group for panel in figure.panels for series in panel.series}
    points = min(_MOST_POINTS, max(200, _POINTS_OF_ALL_RUNS // max(len(groups), 1)))
    for i, panel in enumerate(figure.panels):
        place = {"row": i // columns + 1, "col": i % columns + 1}
        _draw_panel(canvas, panel, place, points)
        if panel.equal:
            canvas.update_yaxes(scaleanchor=f"x{i + 1}" if i else "x", **place)
        if figure.end is not None and not panel.x_label:
            canvas.update_xaxes(matches="x" if i else None, range=[-0.01 * figure.end, figure.end or 1.0], **place)
            if i >= count - columns:
                canvas.update_xaxes(title={"text": "time [s]", "standoff": 6}, **place)
    canvas.update_xaxes(nticks=None if timed else 6)
    if rows > 1:
        canvas.update_xaxes(tickangle=0)  # a turned label runs into the next row
    canvas.update_annotations(font={"size": 13})
    hover = "x unified" if timed else "closest"
    margin = {"l": 56, "r": 12, "t": _TOP, "b": _BOTTOM}
    canvas.update_layout(margin=margin, hovermode=hover, dragmode="zoom", barmode="overlay", bargap=0)
    height = int(_ROW * sum(heights)) + _TOP + _BOTTOM
    labels = figure.labels if labelled else {}
    return embed(canvas, figure.key, figure.title, height, timed=timed, labels=labels, note=note)


def scene_to_plot(scene: Scene) -> Plot:
    """Paths and solids in space for a page."""
    from plotly.graph_objects import Figure as Canvas
    from plotly.graph_objects import Mesh3d, Scatter3d

    canvas = Canvas()
    for points, name in scene.solids:
        x, y, z = points.T.astype(np.float32)
        look: dict[str, Any] = {
            "color": COLOUR.obstacle,
            "opacity": 0.6,
            "name": html.escape(name),
            "hoverinfo": "name",
        }
        canvas.add_trace(Mesh3d(x=x, y=y, z=z, alphahull=0, **look))
    for path, label, colour, group, dashed in scene.paths:
        x, y, z = path[:: max(1, len(path) // _MOST_POINTS)].T.astype(np.float32)
        line = {"color": colour, "width": 3 if dashed else 5, "dash": "dash" if dashed else "solid"}
        canvas.add_trace(Scatter3d(x=x, y=y, z=z, mode="lines", line=line, name=html.escape(label), legendgroup=group))
    drawn = np.concatenate([points for points, *_ in (*scene.solids, *scene.paths)])
    drawn = drawn[np.isfinite(drawn).all(axis=1)]
    low = drawn.min(axis=0)
    high = drawn.max(axis=0)
    middle = 0.5 * (low + high)
    half = 0.55 * (high - low)
    half = np.maximum(half, max(_LEAST_SHARE * half.max(), 1e-3))  # equal scales, and room beside a straight path
    axes = {
        f"{name}axis": {"title": {"text": f"{name} [m]"}, "range": [middle[i] - half[i], middle[i] + half[i]]}
        for i, name in enumerate("xyz")
    }
    ratio = dict(zip("xyz", half / half.max(), strict=True))
    camera = {"eye": {"x": 1.2, "y": -1.7, "z": 0.8}, "center": {"x": 0.0, "y": 0.0, "z": -0.12}}
    space = {"aspectmode": "manual", "aspectratio": ratio, "camera": camera, **axes}
    canvas.update_layout(scene=space, margin=dict.fromkeys("lrtb", 0))
    return embed(canvas, scene.key, scene.title, _SCENE)


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
    thinned = np.concatenate([[0, values.size - 1], starts + segments.argmin(axis=1), starts + segments.argmax(axis=1)])
    return np.unique(np.minimum(np.concatenate([thinned, gaps]), values.size - 1))


def _draw_panel(canvas: Canvas, panel: Panel, place: dict[str, int], points: int) -> None:
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
    line = {"color": COLOUR.bound, "width": 1.4, "dash": "dash"}
    for bound in panel.bounds:
        if bound.vertical:
            canvas.add_vline(bound.value, line=line, **place)
        elif not np.isfinite([bound.start, bound.stop]).all():
            canvas.add_hline(bound.value, line=line, **place)
        else:
            x = [bound.start, bound.stop]
            y = [bound.value, bound.value]
            canvas.add_trace(Scatter(x=x, y=y, mode="lines", line=line, name="bound", hoverinfo="skip"), **place)
    for label in panel.labels:
        if label.bold:
            shown = f"<b>{html.escape(label.text)}</b>"
        else:
            shown = html.escape(label.text)
        font = {"color": label.colour} if label.colour else {}
        canvas.add_annotation(x=label.x, y=label.y, text=shown, font=font, showarrow=False, **place)
    if panel.x_label:
        canvas.update_xaxes(title={"text": html.escape(panel.x_label), "standoff": 6}, **place)
    if panel.y_label:
        canvas.update_yaxes(title={"text": html.escape(panel.y_label)}, **place)
    if panel.y_log:
        canvas.update_yaxes(type="log", dtick=1, **place)
    if panel.whole:
        highest = max((float(np.max(s.y if s.base is None else s.y + s.base)) for s in panel.series), default=0.0)
        canvas.update_yaxes(rangemode="tozero", **({"dtick": 1 if highest < 4 else 2} if highest < 6 else {}), **place)
    if panel.x_names:
        text = list(map(html.escape, panel.x_names))
        canvas.update_xaxes(tickvals=list(range(len(text))), ticktext=text, automargin=True, **place)
    if panel.fixed_range:
        canvas.update_yaxes(range=list(panel.fixed_range), **place)
    elif panel.least_range:
        canvas.update_yaxes(autorangeoptions={"include": panel.least_range}, **place)


def _draw_series(canvas: Canvas, series: Series, place: dict[str, int], points: int) -> None:
    from plotly.graph_objects import Bar, Scatter

    # plotly reads names as HTML
    shared: dict[str, Any] = {"name": html.escape(series.label), "legendgroup": series.group or None}
    shared["opacity"] = series.opacity
    if series.style == "bars":
        if series.x.size > 1:
            width = float(np.diff(series.x).min())
        else:
            width = 0.8
        shared |= {"marker": {"color": series.colour, "line": {"width": 0}}, "width": width, "base": series.base}
        hover = "%{x:.4g}: %{customdata} %{fullData.name}<extra></extra>"
        canvas.add_trace(
            Bar(x=series.x.astype(np.float32), y=series.y, customdata=series.y, hovertemplate=hover, **shared), **place
        )
        return
    if series.style != "points" or series.flights is None:
        drawn = thinned_curve(series.y, points)
    else:
        drawn = np.arange(series.y.size)
    x = series.x[drawn].astype(np.float32)
    y = series.y[drawn].astype(np.float32)
    if series.style == "points":
        shared["marker"] = {"color": series.colour, "size": 1.5 * series.width, "symbol": series.marker}
        if series.flights is not None:
            shared["customdata"] = series.flights[drawn].astype(np.int32)
            shared["hovertemplate"] = "flight %{customdata}: %{x:.4g}, %{y:.4g}<extra>%{fullData.name}</extra>"
        canvas.add_trace(Scatter(x=x, y=y, mode="markers", **shared), **place)
        return
    shape = "hv" if series.style == "steps" else "linear"
    shared["line"] = {"color": series.colour, "width": 1.25 * series.width, "shape": shape}
    shared["line"] |= {"dash": "dash"} if series.dashed else {}
    canvas.add_trace(Scatter(x=x, y=y, mode="lines", **shared), **place)
