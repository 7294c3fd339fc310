"""Runs -> plots of their flights: all runs overlaid, one colour each, linked time axes."""

from __future__ import annotations

import html
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from quadsim.flight.audit import SIGNALS
from quadsim.flight.rundir import Run
from quadsim.report.comparison import distinct_courses, run_names
from quadsim.report.curves import bounds_of, break_at_wraps, reference_curve
from quadsim.report.palette import BOUND, OBSTACLE, REFERENCE, line_colour
from quadsim.report.plots.panels import (
    BOTTOM,
    PANEL_HEIGHT,
    TOP,
    Plot,
    draw_bound,
    finished,
    keep_least_span,
    panels,
    place,
)
from quadsim.report.scene import has_space, obstacles_in, region_edges
from quadsim.state import POSITION, REFERENCE_NAMES, Array
from quadsim.vehicle import N_ROTORS

if TYPE_CHECKING:
    from plotly.graph_objects import Figure

_Named = tuple[int, str]  # number and name of a run, which set its colour and toggle
_MOST_POINTS: Final = 3000
_WAYS: Final = 300  # in which the points of a solid are taken whose hull is drawn
_POINTS_OF_ALL_RUNS: Final = 12_000
"""Points that one quantity may have over all runs: keeps a page of two runs near 6 MB, and of ten below 8 MB."""


def comparison_plots(runs: Sequence[Run]) -> list[Plot]:
    """All plots of the page, for the runs that flew at least one control period; none without such a run."""
    named = enumerate(zip(run_names(runs), runs, strict=True))
    flown = [(i, name, run) for i, (name, run) in named if run.log.control.t.size]
    return list(_Plotter(flown).plots()) if flown else []


def thin(values: Array, points: int) -> np.ndarray[Any, np.dtype[np.intp]]:
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


class _Plotter:
    """Draws the plots of runs given as (number, name, run), which sets their colours and toggles."""

    def __init__(self, runs: Sequence[tuple[int, str, Run]]) -> None:
        self._runs = runs
        self._courses = distinct_courses([run for _, _, run in runs])
        self._end = max(run.end for _, _, run in runs)
        self._points = min(_MOST_POINTS, max(200, _POINTS_OF_ALL_RUNS // len(runs)))

    def plots(self) -> Iterator[Plot]:
        yield self._states("course", "Course and heading", ("x", "y", "z", "yaw"))
        if all(run.log.plant.attitude is None for _, _, run in self._runs):
            yield self._states("attitude", "Roll and pitch", ("roll", "pitch"))
        else:  # some may turn upside down
            yield self._states("attitude", "Tilt, roll and pitch", ("tilt", "roll", "pitch"))
        yield self._inputs("speeds", "Rotor speeds", "speed")
        yield self._inputs("slews", "Steps of the rotor speeds, per period", "slew")
        yield self._times()
        yield self._path()

    def _states(self, key: str, title: str, names: Sequence[str]) -> Plot:
        figure = panels([f"{name} [{SIGNALS[name].unit}]" for name in names])
        for panel, name in enumerate(names):
            signal = SIGNALS[name].plant
            assert signal is not None, name
            self._references(figure, panel, name)
            for i, label, run in self._runs:
                drawn = break_at_wraps(run.log.plant.t, signal(run.log.plant), SIGNALS[name].unit)
                self._line(figure, panel, (i, label), *drawn)
            self._bounds(figure, panel, name)
            keep_least_span(figure, panel, SIGNALS[name].unit)
        return self._timed(figure, key, title)

    def _inputs(self, key: str, title: str, name: str) -> Plot:
        figure = panels([f"rotor {i} [rad/s]" for i in range(1, N_ROTORS + 1)])
        for panel in range(N_ROTORS):
            for i, label, run in self._runs:
                values = SIGNALS[name].sampled(run.log.control)[:, panel]
                self._line(figure, panel, (i, label), run.log.control.t, values, shape="hv")
            self._bounds(figure, panel, name)
            keep_least_span(figure, panel, SIGNALS[name].unit)
        return self._timed(figure, key, title)

    def _times(self) -> Plot:
        labels = ("whole step [ms]", "optimum alone [ms]", "iterations, of whoever answered", "active constraints")
        figure = panels(labels)
        for i, label, run in self._runs:
            timing, control = run.log.timing, run.log.control
            for panel, values in enumerate((timing.step_ms, timing.solve_ms)):
                read = np.where(values > 0.0, values, np.nan)  # a clock may read 0, which has no logarithm
                self._line(figure, panel, (i, label), timing.t, read, mode="markers")
            for panel, counts in enumerate((control.iterations, control.active), start=2):
                self._line(figure, panel, (i, label), control.t, counts.astype(float), shape="hv")
        for panel in (0, 1):
            figure.update_yaxes(type="log", dtick=1, **place(panel))
        for deadline in {float(run.summary["controller"]["deadline_ms"]) for _, _, run in self._runs}:
            draw_bound(figure, 0, deadline, 0.0, self._end)
        return self._timed(figure, "times", "Time to compute a command, against its deadline")

    def _path(self) -> Plot:
        from plotly.graph_objects import Figure, Scatter3d

        def line(path: Array, style: dict[str, Any], identity: dict[str, Any]) -> Scatter3d:
            x, y, z = path[:: max(1, len(path) // self._points)].T.astype(np.float32)
            return Scatter3d(x=x, y=y, z=z, mode="lines", line=style, **identity)

        figure = Figure()
        for limits in dict.fromkeys(run.limits for _, _, run in self._runs if has_space(run.limits)):
            self._space(figure, next(run for _, _, run in self._runs if run.limits == limits))
        for run in self._courses:
            style = {"color": REFERENCE, "width": 3, "dash": "dash"}
            figure.add_trace(line(run.log.control.reference[:, :3], style, {"name": "reference"}))
        for i, label, run in self._runs:
            style = {"color": line_colour(i), "width": 5}
            figure.add_trace(line(run.log.plant.state[:, POSITION], style, _identity(i, label)))
        axes = {f"{name}axis": {"title": {"text": f"{name} [m]"}} for name in "xyz"}
        camera = {"eye": {"x": 1.2, "y": -1.7, "z": 0.8}, "center": {"x": 0.0, "y": 0.0, "z": -0.12}}
        figure.update_layout(scene={"aspectmode": "data", "camera": camera, **axes}, margin=dict.fromkeys("lrtb", 0))
        return finished(figure, "path", "Path in space", height=560, timed=False)

    def _space(self, figure: Figure, run: Run) -> None:
        """Obstacles, those that move where they are at first, and the edges of regions."""
        from plotly.graph_objects import Mesh3d, Scatter3d

        ways = np.random.default_rng(0).normal(size=(_WAYS, 3))
        for obstacle in obstacles_in(run.limits):
            for solid in obstacle.solids:
                x, y, z = (np.unique(solid.support(ways).round(4), axis=0) + obstacle.position).T.astype(np.float32)
                look: dict[str, Any] = {"color": OBSTACLE, "opacity": 0.6, "name": html.escape(obstacle.name)}
                figure.add_trace(Mesh3d(x=x, y=y, z=z, alphahull=0, hoverinfo="name", **look))
        for limit, edges in region_edges(run):
            x, y, z = np.insert(edges, 2, np.nan, axis=1).reshape(-1, 3).T.astype(np.float32)
            line, name = {"color": BOUND, "width": 2}, html.escape(limit.name)
            figure.add_trace(Scatter3d(x=x, y=y, z=z, mode="lines", line=line, name=name, hoverinfo="name"))

    def _line(
        self, figure: Figure, panel: int, who: _Named, t: Array, values: Array, shape: str = "linear", **own: Any
    ) -> None:
        colour = line_colour(who[0])
        line, marker = {"color": colour, "width": 1.6, "shape": shape}, {"color": colour, "size": 3.5}
        self._curve(figure, panel, t, values, **{"line": line, "marker": marker, **_identity(*who), **own})

    def _curve(self, figure: Figure, panel: int, t: Array, values: Array, mode: str = "lines", **style: Any) -> None:
        from plotly.graph_objects import Scatter

        thinned = thin(values, self._points)
        x, y = t[thinned].astype(np.float32), values[thinned].astype(np.float32)
        figure.add_trace(Scatter(x=x, y=y, mode=mode, **style), **place(panel))

    def _references(self, figure: Figure, panel: int, name: str) -> None:
        """Each distinct filtered reference of a quantity that has one."""
        line = {"color": REFERENCE, "width": 1.6, "dash": "dash"}
        for run in self._courses if name in REFERENCE_NAMES else ():
            values = reference_curve(run.log.control, name)
            self._curve(figure, panel, run.log.control.t, values, line=line, name="reference")

    def _bounds(self, figure: Figure, panel: int, signal: str) -> None:
        limits = [limit for _, _, run in self._runs for limit in run.limits]
        for bound, start, stop in bounds_of(limits, signal, self._end):
            draw_bound(figure, panel, bound, start, stop)

    def _timed(self, figure: Figure, key: str, title: str) -> Plot:
        rows = len(figure.layout.annotations) // 2
        figure.update_xaxes(range=[-0.01 * self._end, self._end], showticklabels=True)
        figure.update_xaxes(title={"text": "time [s]", "standoff": 6}, row=rows)
        figure.update_layout(margin={"l": 52, "r": 12, "t": TOP, "b": BOTTOM}, hovermode="x unified", dragmode="zoom")
        figure.update_annotations(font={"size": 13})
        return finished(figure, key, title, height=rows * PANEL_HEIGHT + TOP + BOTTOM, timed=True)


def _identity(i: int, label: str) -> dict[str, Any]:
    """Name and toggle of a run's line; plotly reads names as HTML."""
    return {"name": html.escape(label), "legendgroup": f"run{i}"}
