"""The plots and texts of a recording, each with its view."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from quadsim.controller import OPTIMAL, Phase
from quadsim.errors import printable
from quadsim.flight.audit import SIGNALS, Limit, margins_sampled
from quadsim.flight.log import PlantLog, columns_of
from quadsim.flight.metrics import never_took_off, unrecovered
from quadsim.flight.record import FlightRecord
from quadsim.palette import line_colour
from quadsim.report.comparison import comparison_rows, fallback_sentence, takeoff_sentence
from quadsim.report.figure import (
    break_at_wraps,
    commanded_speeds,
    effect_curves,
    least_range,
    reference_curve,
)
from quadsim.report.recording.world import (
    BOUND,
    FRONT_PANELS,
    REFERENCE,
    SERIES,
    VERDICT_COLOURS,
    Colour,
    on_screen,
    panels,
    time_column,
)
from quadsim.report.table import ABSENT
from quadsim.state import REFERENCE_NAMES, Array
from quadsim.vehicle import N_ROTORS

_ACTIVE: Final = 0.002  # A limit is active where its margin is below this fraction of the allowed band


def send_plots(recording: rr.RecordingStream, run: FlightRecord) -> rrb.Tabs:
    """Send all signals over time, at the log rate where it exists between control samples; return their views.

    A view names only what was sent, and one without content is left out.
    """
    reached = [limit for limit in run.limits if _send_limit(recording, limit, run)]
    signals = _send_signals(recording, run, reached)
    margins = _send_margins(recording, run, reached)
    effects = _send_effects(recording, run)
    events = rrb.TextLogView(name="Events", origin="/events")
    times, solver = _send_solver(recording, run)
    lanes = [f"verdicts/{limit.name}" for limit in reached if limit.start == 0.0]
    if lanes:
        verdicts = [rrb.StateTimelineView(name="Constraints on the whole flight", contents=lanes)]
    else:
        verdicts = []
    return rrb.Tabs(
        rrb.Grid(*signals[:FRONT_PANELS], *verdicts, *times, grid_columns=2, name="Flight"),
        *([rrb.Grid(*signals[FRONT_PANELS:], grid_columns=2, name="More signals")] if signals[FRONT_PANELS:] else []),
        rrb.Grid(*margins, *solver, events, grid_columns=2, name="Margins and solver"),
        *([rrb.Grid(*effects, grid_columns=2, name="Effects")] if effects else []),
    )


def _send_signals(
    recording: rr.RecordingStream, run: FlightRecord, reached: Sequence[Limit]
) -> list[rrb.TimeSeriesView]:
    """Every signal there is, and the reference; of flights that may turn upside down quaternion and body rates too."""
    log = run.log
    views = list[rrb.TimeSeriesView]()
    for title, names in panels(log).items():
        contents = list[str]()
        values = list[Array]()
        for colour, name in zip(SERIES, names, strict=False):
            unit = SIGNALS[name].unit
            t, curve = SIGNALS[name].finest(log)
            labels = {f"{name} [{unit}]": colour}
            if curve.ndim == 2:
                labels = {f"rotor {i} [{unit}]": shade for i, shade in enumerate(SERIES, start=1)}
            else:
                t, curve = break_at_wraps(t, curve, unit)
            contents += _send_curves(recording, f"signals/{name}", t, curve, labels, stepped=curve.ndim == 2)
            values.append(curve)
            if name in REFERENCE_NAMES:
                values.append(reference_curve(log.control, name))
                labels = {f"{name} ref [{unit}]": REFERENCE}
                contents += _send_curves(recording, f"reference/{name}", log.control.t, values[-1], labels)
        bounding = [limit for limit in reached if limit.signal in names]
        values += [np.array([limit.lower, limit.upper]) for limit in bounding]
        contents += [f"limits/{limit.name}" for limit in bounding]
        views += _view(title, contents, run, ends=least_range(values, SIGNALS[names[0]].unit))
    stated = columns_of(PlantLog)
    for name, vectors, units in (
        ("quaternion", log.plant.attitude, stated["attitude"].units),
        ("body_rates", log.plant.body_rates, stated["body_rates"].units),
    ):
        if vectors is not None:
            labels = dict(zip((f"{column} [{unit}]" for column, unit in units.items()), SERIES, strict=False))
            contents = _send_curves(recording, f"signals/{name}", log.plant.t, vectors, labels)
            views += _view(name.replace("_", " ").capitalize(), contents, run)
    return views


def _send_margins(
    recording: rr.RecordingStream, run: FlightRecord, reached: Sequence[Limit]
) -> list[rrb.TimeSeriesView]:
    """The margins of limits at the samples; those of one unit in one plot."""
    views = list[rrb.TimeSeriesView]()
    for unit in dict.fromkeys(limit.unit for limit in reached):
        contents = list[str]()
        for i, limit in enumerate(limit for limit in reached if limit.unit == unit):
            margins = margins_sampled(limit, run.log)
            labels = {f"{limit.name} [{unit}]": on_screen(line_colour(i))}
            inside = np.isfinite(margins)
            t = run.log.control.t[inside]
            values = margins[inside]
            contents += _send_curves(recording, f"margins/{limit.name}", t, values, labels)
        views += _view(f"Margins [{unit}]", contents, run)
    return views


def _send_limit(recording: rr.RecordingStream, limit: Limit, run: FlightRecord) -> bool:
    """Send a limit's bounds over its time window and its verdicts; return whether the flight reached the window."""
    t = run.log.control.t
    margins = margins_sampled(limit, run.log)
    inside = np.isfinite(margins)
    if not inside.any():
        return False
    bounds = {sign: bound for sign, bound in (("≥", limit.lower), ("≤", limit.upper)) if math.isfinite(bound)}
    window = np.array([t[inside][0], min(limit.stop, run.end)])
    labels = {f"{limit.name} {sign} {bound:g} {limit.unit}": BOUND for sign, bound in bounds.items()}
    _send_curves(recording, f"limits/{limit.name}", window, np.tile([*bounds.values()], (2, 1)), labels)

    names = list(VERDICT_COLOURS)
    entity = f"verdicts/{limit.name}"
    band = limit.upper - limit.lower
    near = max(limit.tolerances[1], _ACTIVE * band if math.isfinite(band) else 0.0)
    violated = limit.violated(margins, sampled=True)
    verdicts = np.select([violated, margins <= near, inside], [2, 1, 0], default=3)
    changes = np.flatnonzero(np.diff(verdicts, prepend=-1))
    style = rr.StateConfiguration(
        values=names, colors=list(VERDICT_COLOURS.values()), visible=[True, True, True, False]
    )
    recording.log(entity, style, static=True)
    states = rr.StateChange.columns(state=[names[verdicts[k]] for k in changes])
    recording.send_columns(entity, [time_column(t[changes])], states)
    return True


def _send_solver(
    recording: rr.RecordingStream, run: FlightRecord
) -> tuple[list[rrb.TimeSeriesView], list[rrb.TimeSeriesView]]:
    """Clock times, and what is known of the answers."""
    sent = list[str]()
    control = run.log.control
    timing = run.log.timing
    first, second = SERIES[:2]
    for name, values, label, colour in (
        ("solve_ms", timing.solve_ms, "optimum alone [ms]", first),
        ("step_ms", timing.step_ms, "whole step [ms]", second),
        ("iterations", control.iterations, "iterations", first),
        ("active", control.active, "active constraints", second),
        ("fallback", control.fallback, "fallback, 0 = none", first),
        ("slack", np.degrees(control.slack), "slack [deg]", second),
    ):
        sent += _send_curves(recording, f"solver/{name}", control.t, values, {label: colour})
    deadline = run.numbers["controller"].get("deadline_ms")
    if deadline is not None:
        ends = run.log.plant.t[[0, -1]]
        sent += _send_curves(recording, "solver/deadline_ms", ends, np.full(2, deadline), {"deadline [ms]": BOUND})
    times, *answers = (
        _view(title, [entity for entity in (f"solver/{name}" for name in names) if entity in sent], run)
        for title, names in (
            ("Computation", ("solve_ms", "step_ms", "deadline_ms")),
            ("Solver", ("iterations", "active")),
            ("Fallback and slack", ("fallback", "slack")),
        )
    )
    return times, [view for views in answers for view in views]


def _send_effects(recording: rr.RecordingStream, run: FlightRecord) -> list[rrb.TimeSeriesView]:
    """Send commands that rotors do not follow at once, external force, wind, and battery, where they exist."""
    t = run.log.plant.t
    views = list[rrb.TimeSeriesView]()
    commanded = commanded_speeds(run.log)
    if commanded is not None:
        labels = {f"rotor {i}, commanded [rad/s]": REFERENCE for i in range(1, N_ROTORS + 1)}
        contents = _send_curves(recording, "effects/commanded", t, commanded, labels, stepped=True)
        views += _view("Rotor speeds, commanded and acting", [*contents, "signals/speed"], run)
    for entry in effect_curves(run.log):
        labels = {f"{axis} [{entry.unit}]": colour for axis, colour in zip(entry.names, SERIES, strict=False)}
        contents = _send_curves(recording, f"effects/{entry.key}", t, entry.values, labels)
        views += _view(f"{entry.title[0].upper()}{entry.title[1:]}", contents, run)
    return views


def send_texts(recording: rr.RecordingStream, run: FlightRecord) -> None:
    """The summary, and what happened when.

    Changes of the status, of who answers and of the phase; why the first QP without an answer had none; when permanent
    fallback begins; when a vehicle that stays on the ground was told to leave it; the flight's events and its end.
    """
    log = run.log.control
    diagnosis = run.diagnosis or {}
    periods = unrecovered(log)
    answers = list(zip(log.status, log.answered_by, log.fallback.tolist(), strict=True))
    events = [
        (
            t,
            f"{status}{'' if fallback else f' by {by}'}, fallback {fallback}",
            "INFO" if status in OPTIMAL | {Phase.LANDED} and not fallback else "WARN",
        )
        for t, (status, by, fallback) in _changes(log.t, answers)
    ]
    if any(phase != Phase.FLYING for phase in log.phase):
        for t, phase in _changes(log.t, log.phase):
            events.append((t, f"phase: {phase}", "WARN" if phase == Phase.CRASHED else "INFO"))
    events += [(diagnosis["time"], diagnosis[name], "ERROR") for name in ("sentence", "advice") if diagnosis.get(name)]
    if periods:
        events.append((float(log.t[-periods]), fallback_sentence(periods), "ERROR"))
    if (told := never_took_off(log)) is not None:
        events.append((told, takeoff_sentence(told), "ERROR"))
    events += [(event["time"], event["text"], "WARN") for event in run.numbers.get("events", ())]
    if run.log.reason is not None:
        events.append((run.end, f"aborted: {run.log.reason}", "ERROR"))
    elif run.reason is not None:
        events.append((run.end, f"lost: {run.reason}", "ERROR"))
    else:
        events.append((run.end, "completed", "INFO"))
    times, texts, levels = zip(*sorted(events, key=lambda event: event[0]), strict=True)
    recording.send_columns("events", [time_column(np.array(times))], rr.TextLog.columns(text=texts, level=levels))
    recording.log("summary", rr.TextDocument(_summary(run), media_type=rr.MediaType.MARKDOWN), static=True)


def _summary(run: FlightRecord) -> str:
    """The flight, its tracking and the verdicts, as lists: their lines wrap, where a narrow view cuts a table's."""
    lines = [f"**{run.name}**\n"]
    group = ""
    for row in comparison_rows([run]):
        is_shown = row.group in ("Flight", "Tracking") or row.headline
        (cell,) = row.cells
        if not is_shown or cell.text in ("", ABSENT):
            continue
        if row.group != group:
            lines.append(f"\n{row.group}\n")
            group = row.group
        name = row.label
        if row.unit:
            name += f" [{row.unit}]"
        lines.append(printable(f"- {name}: **{cell.text}**"))
    return "\n".join(lines) + "\n"


def _changes(t: Array, values: Sequence[Any]) -> list[tuple[float, Any]]:
    """The first value and those that differ from the one before, each with its time [s]."""
    pairs = zip(t.tolist(), [None, *values], values, strict=False)
    return [(time, value) for time, before, value in pairs if value != before]


def _send_curves(
    recording: rr.RecordingStream,
    entity: str,
    t: Array,
    values: np.ndarray[Any, np.dtype[Any]],
    labels: Mapping[str, Colour],
    *,
    stepped: bool = False,
) -> list[str]:
    """Send one curve per column of `values` (len(t),) or (len(t), j), at times `t` [s].

    Returns:
        The entity; nothing where no value is finite, and nothing was sent.
    """
    if not np.isfinite(values).any():
        return []
    style = rr.SeriesLines(
        names=list(labels),
        colors=list(labels.values()),
        widths=[1.5] * len(labels),
        interpolation_mode="StepAfter" if stepped else "Linear",
        aggregation_policy="MinMax",  # zoomed out, the viewer would show averages: lower peaks than were flown
    )
    recording.log(entity, style, static=True)
    recording.send_columns(entity, [time_column(t)], rr.Scalars.columns(scalars=np.asarray(values, float)))
    return [entity]


def _view(
    title: str, contents: Sequence[str], run: FlightRecord, *, ends: tuple[float, float] | None = None
) -> list[rrb.TimeSeriesView]:
    """Curves over the whole flight, with a legend; `ends` of the vertical axis; no view of nothing."""
    if not contents:
        return []
    first, last = (rr.TimeRangeBoundary.absolute(seconds=seconds) for seconds in (0.0, max(run.end, 1e-3)))
    view = rrb.TimeSeriesView(
        name=title,
        contents=list(contents),
        plot_legend=rrb.PlotLegend("RightTop"),
        axis_y=None if ends is None else rrb.ScalarAxis(range=ends),
        axis_x=rrb.TimeAxis(view_range=rr.TimeRange(start=first, end=last)),
    )
    return [view]
