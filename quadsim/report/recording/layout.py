"""The layout a recording opens on: nothing is left to be clicked or unfolded."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from quadsim.flight.audit import SIGNALS, Limit
from quadsim.flight.rundir import Run
from quadsim.report.curves import commanded_speeds, effect_curves, least_range, reference_curve
from quadsim.report.recording.style import FRONT_PANELS, TIMELINE, panels
from quadsim.state import POSITION, REFERENCE_NAMES, Array

if TYPE_CHECKING:
    import rerun.blueprint as rrb


def blueprint(run: Run) -> rrb.Blueprint:
    """Course, vehicle and summary on the left, plots on the right; nothing is left to be clicked or unfolded."""
    import rerun.blueprint as rrb

    end, limits = run.end, run.limits
    plots = [
        _plot(title, _contents(names, limits), end, ends=_least_range(run, names))
        for title, names in panels(run.log).items()
    ]
    if run.log.plant.attitude is not None:
        plots += [_plot("Quaternion", ["signals/quaternion"], end), _plot("Body rates", ["signals/body_rates"], end)]
    margins = [
        _plot(f"Margins [{unit}]", [f"margins/{limit.name}" for limit in limits if limit.unit == unit], end)
        for unit in dict.fromkeys(limit.unit for limit in limits)
    ]
    times = _plot("Computation", ["solver/solve_ms", "solver/step_ms", "solver/deadline_ms"], end)
    work = _plot("Solver", ["solver/iterations", "solver/active"], end)
    failures = _plot("Fallback and slack", ["solver/fallback", "solver/slack"], end)
    lanes = [f"verdicts/{limit.name}" for limit in limits if limit.start == 0.0]
    verdicts = rrb.StateTimelineView(name="Constraints on the whole flight", contents=lanes)
    events = rrb.TextLogView(name="Events", origin="/events")
    effects = [_plot(title, contents, end) for title, contents in _effects(run).items()]
    behind = run.vehicle.arm_length * np.array([-3.0, -3.5, 2.2])
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(
                _view("Course", "/world", *_overview(run)),
                rrb.Horizontal(
                    _view("Vehicle", "/world/vehicle", behind, np.zeros(3)),
                    rrb.TextDocumentView(name="Summary", origin="/summary"),
                ),
                row_shares=[3, 2],
            ),
            rrb.Tabs(
                rrb.Grid(*plots[:FRONT_PANELS], verdicts, times, grid_columns=2, name="Flight"),
                rrb.Grid(*plots[FRONT_PANELS:], grid_columns=2, name="More signals"),
                rrb.Grid(*margins, work, failures, events, grid_columns=2, name="Margins and solver"),
                *([rrb.Grid(*effects, grid_columns=2, name="Effects")] if effects else []),
            ),
            column_shares=[4, 5],
        ),
        rrb.TimePanel(state="collapsed", timeline=TIMELINE, play_state="playing", loop_mode="all"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        auto_layout=False,
        auto_views=False,
    )


def _overview(run: Run) -> tuple[Array, Array]:
    """Where the eye is and where it looks [m] to see the whole course."""
    path, course = run.log.plant.state[:, POSITION], run.log.control.reference[:, :3]
    path = path[np.isfinite(path).all(axis=1)]  # a flight that diverged ends in anything
    course = course if len(course) else path
    low, high, least = course.min(axis=0), course.max(axis=0), 10 * run.vehicle.arm_length
    slack = max(float((high - low).max()), least)
    path = np.clip(path, low - slack, high + slack)  # a lost vehicle leaves the picture
    low, high = np.minimum(low, path.min(axis=0)), np.maximum(high, path.max(axis=0))
    centre, size = (low + high) / 2, max(float(np.linalg.norm(high - low)), least)
    return centre + size * np.array([0.35, -0.9, 0.3]), centre


def _view(name: str, origin: str, eye: Array, target: Array) -> rrb.Spatial3DView:
    """The scene seen from a point at rest in the frame of `origin`, and the ground, in the frame of the world."""
    import rerun.blueprint as rrb

    start, now = rrb.TimeRangeBoundary.infinite(), rrb.TimeRangeBoundary.cursor_relative()
    return rrb.Spatial3DView(
        name=name,
        origin=origin,
        contents="/world/**",
        line_grid=rrb.LineGrid3D(visible=origin == "/world", spacing=1.0),
        eye_controls=rrb.EyeControls3D(position=eye, look_target=target),
        overrides={"/world/flown": rrb.VisibleTimeRanges(timeline=TIMELINE, start=start, end=now)},
    )


def _effects(run: Run) -> dict[str, list[str]]:
    """Titles and entities of the plots of what acted beyond the paper's model; none in its own flights."""
    titles = {
        f"{entry.title[0].upper()}{entry.title[1:]}": [f"effects/{entry.key}"] for entry in effect_curves(run.log)
    }
    lagging = {"Rotor speeds, commanded and acting": ["effects/commanded", "signals/speed"]}
    return (lagging if commanded_speeds(run.log) is not None else {}) | titles


def _contents(names: Sequence[str], limits: Iterable[Limit]) -> list[str]:
    """The entities drawn together: some signals, their references and their bounds."""
    return [
        *(f"signals/{name}" for name in names),
        *(f"reference/{name}" for name in names if name in REFERENCE_NAMES),
        *(f"limits/{limit.name}" for limit in limits if limit.signal in names),
    ]


def _least_range(run: Run, names: Sequence[str]) -> tuple[float, float] | None:
    """Ends of the axis of signals that stand still, with their references and bounds; see `quadsim.report.curves`."""
    curves = [SIGNALS[name].finest(run.log)[1] for name in names]
    curves += [reference_curve(run.log.control, name) for name in names if name in REFERENCE_NAMES]
    curves += [np.array([limit.lower, limit.upper]) for limit in run.limits if limit.signal in names]
    return least_range(curves, SIGNALS[names[0]].unit)


def _plot(
    title: str, contents: Sequence[str], end: float, ends: tuple[float, float] | None = None
) -> rrb.TimeSeriesView:
    """Curves over the whole flight, up to `end` [s], and the legend to their right; `ends` of the vertical axis."""
    import rerun as rr
    import rerun.blueprint as rrb

    first, last = (rr.TimeRangeBoundary.absolute(seconds=seconds) for seconds in (0.0, 1.4 * max(end, 1e-3)))
    return rrb.TimeSeriesView(
        name=title,
        contents=list(contents),
        plot_legend=rrb.PlotLegend("RightTop"),
        axis_y=None if ends is None else rrb.ScalarAxis(range=ends),
        axis_x=rrb.TimeAxis(view_range=rr.TimeRange(start=first, end=last)),
    )
