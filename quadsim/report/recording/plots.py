"""The plots and texts of a recording, each with its view."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Final, Literal, NamedTuple

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from quadsim.controller import OPTIMAL, Phase
from quadsim.errors import printable
from quadsim.flight.audit import SIGNALS, Limit, margins_sampled
from quadsim.flight.log import ControlLog, FlightLog, PlantLog, columns_of
from quadsim.flight.metrics import never_took_off, unrecovered
from quadsim.flight.record import FlightRecord
from quadsim.palette import line_colour
from quadsim.report.comparison_rows import comparison_rows
from quadsim.report.figure import (
    break_at_wraps,
    commanded_speeds,
    effect_curves,
    least_range,
    reference_curve,
)
from quadsim.report.flight_sentences import fallback_sentence, takeoff_sentence
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

_ACTIVE: Final = 0.002  # a limit is active where its margin is below this fraction of the allowed band


class _Event(NamedTuple):
    """What happened when, for the log of the recording."""

    time: float  # [s]
    text: str
    level: str  # by rerun's name


def send_plots(recording: rr.RecordingStream, run: FlightRecord) -> rrb.Tabs:
    """Send all signals over time, at the log rate where it exists between control samples; return their views.

    A view names only what was sent, and one without content is left out.
    """
    reached = []
    for limit in run.limits:
        if _send_limit(recording, limit, run):
            reached.append(limit)
    signals = _send_signals(recording, run, reached)
    margins = _send_margins(recording, run, reached)
    effects = _send_effects(recording, run)
    events = rrb.TextLogView(name="Events", origin="/events")
    times, solver = _send_solver(recording, run)
    front = [*signals[:FRONT_PANELS], *_verdict_views(reached), *times]
    further = signals[FRONT_PANELS:]
    tabs = [rrb.Grid(*front, grid_columns=2, name="Flight")]
    if further:
        tabs.append(rrb.Grid(*further, grid_columns=2, name="More signals"))
    tabs.append(rrb.Grid(*margins, *solver, events, grid_columns=2, name="Margins and solver"))
    if effects:
        tabs.append(rrb.Grid(*effects, grid_columns=2, name="Effects"))
    return rrb.Tabs(*tabs)


def _verdict_views(reached: Sequence[Limit]) -> list[rrb.StateTimelineView]:
    """The view of the verdicts on limits that hold from the start; none without any."""
    lanes = [f"verdicts/{limit.name}" for limit in reached if limit.start == 0.0]
    if lanes:
        return [rrb.StateTimelineView(name="Constraints on the whole flight", contents=lanes)]
    return []


def _send_signals(
    recording: rr.RecordingStream, run: FlightRecord, reached: Sequence[Limit]
) -> list[rrb.TimeSeriesView]:
    """Every signal there is, and the reference; of flights that may turn upside down quaternion and body rates too."""
    views = list[rrb.TimeSeriesView]()
    for title, names in panels(run.log).items():
        contents = list[str]()
        drawn = list[Array]()
        for colour, name in zip(SERIES, names, strict=False):
            entities, curve = _send_signal(recording, run.log, name, colour)
            contents += entities
            drawn.append(curve)
            if name in REFERENCE_NAMES:
                reference = reference_curve(run.log.control, name)
                labels = {f"{name} ref [{SIGNALS[name].unit}]": REFERENCE}
                contents += _send_curves(recording, f"reference/{name}", run.log.control.t, reference, labels)
                drawn.append(reference)
        for limit in reached:
            if limit.signal in names:
                contents.append(f"limits/{limit.name}")
                drawn.append(np.array([limit.lower, limit.upper]))
        views += _view(title, contents, run, ends=least_range(drawn, SIGNALS[names[0]].unit))
    return [*views, *_send_attitude(recording, run)]


def _send_signal(recording: rr.RecordingStream, log: FlightLog, name: str, colour: Colour) -> tuple[list[str], Array]:
    """Send a signal of the audit in a colour, or a curve per rotor; return its entity and its values."""
    unit = SIGNALS[name].unit
    t, curve = SIGNALS[name].finest(log)
    by_rotor = curve.ndim == 2
    if by_rotor:
        labels = {f"rotor {i} [{unit}]": shade for i, shade in enumerate(SERIES, start=1)}
    else:
        labels = {f"{name} [{unit}]": colour}
        t, curve = break_at_wraps(t, curve, unit)
    return _send_curves(recording, f"signals/{name}", t, curve, labels, stepped=by_rotor), curve


def _send_attitude(recording: rr.RecordingStream, run: FlightRecord) -> list[rrb.TimeSeriesView]:
    """Quaternion and body rates of flights that may turn upside down."""
    plant = run.log.plant
    columns = columns_of(PlantLog)
    views = list[rrb.TimeSeriesView]()
    for name, title, vectors, units in (
        ("quaternion", "Quaternion", plant.attitude, columns["attitude"].units),
        ("body_rates", "Body rates", plant.body_rates, columns["body_rates"].units),
    ):
        if vectors is None:
            continue
        labels = {}
        for (column, unit), colour in zip(units.items(), SERIES, strict=False):
            labels[f"{column} [{unit}]"] = colour
        contents = _send_curves(recording, f"signals/{name}", plant.t, vectors, labels)
        views += _view(title, contents, run)
    return views


def _send_margins(
    recording: rr.RecordingStream, run: FlightRecord, reached: Sequence[Limit]
) -> list[rrb.TimeSeriesView]:
    """The margins of limits at the samples; those of one unit in one plot."""
    by_unit: dict[str, list[Limit]] = {}
    for limit in reached:
        by_unit.setdefault(limit.unit, []).append(limit)
    views = list[rrb.TimeSeriesView]()
    for unit, limits in by_unit.items():
        contents = list[str]()
        for i, limit in enumerate(limits):
            margins = margins_sampled(limit, run.log)
            labels = {f"{limit.name} [{unit}]": on_screen(line_colour(i))}
            inside = np.isfinite(margins)
            t = run.log.control.t[inside]
            contents += _send_curves(recording, f"margins/{limit.name}", t, margins[inside], labels)
        views += _view(f"Margins [{unit}]", contents, run)
    return views


def _send_limit(recording: rr.RecordingStream, limit: Limit, run: FlightRecord) -> bool:
    """Send a limit's bounds over its time window and its verdicts; return whether the flight reached the window."""
    t = run.log.control.t
    margins = margins_sampled(limit, run.log)
    inside = np.isfinite(margins)
    if not inside.any():
        return False
    bounds = []
    labels = {}
    for sign, bound in (("≥", limit.lower), ("≤", limit.upper)):
        if math.isfinite(bound):
            bounds.append(bound)
            labels[f"{limit.name} {sign} {bound:g} {limit.unit}"] = BOUND
    window = np.array([t[inside][0], min(limit.stop, run.end)])
    _send_curves(recording, f"limits/{limit.name}", window, np.tile(bounds, (2, 1)), labels)
    _send_verdicts(recording, limit, t, margins)
    return True


def _send_verdicts(recording: rr.RecordingStream, limit: Limit, t: Array, margins: Array) -> None:
    """Send where a limit holds, is active or violated, by its margins at instants t [s]; NaN where it is not in force.

    It is active where its margin is below its tolerance, or a small share of the allowed band.
    """
    band = limit.upper - limit.lower
    near = limit.tolerances[1]
    if math.isfinite(band):
        near = max(near, _ACTIVE * band)
    violated = limit.violated(margins, sampled=True)
    verdicts = np.select([violated, margins <= near, np.isfinite(margins)], [2, 1, 0], default=3)
    changes = np.flatnonzero(np.diff(verdicts, prepend=-1))
    names = list(VERDICT_COLOURS)
    entity = f"verdicts/{limit.name}"
    style = rr.StateConfiguration(
        values=names, colors=list(VERDICT_COLOURS.values()), visible=[True, True, True, False]
    )
    recording.log(entity, style, static=True)
    states = rr.StateChange.columns(state=[names[verdicts[k]] for k in changes])
    recording.send_columns(entity, [time_column(t[changes])], states)


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

    def view(title: str, *names: str) -> list[rrb.TimeSeriesView]:
        contents = [f"solver/{name}" for name in names if f"solver/{name}" in sent]
        return _view(title, contents, run)

    times = view("Computation", "solve_ms", "step_ms", "deadline_ms")
    answers = view("Solver", "iterations", "active") + view("Fallback and slack", "fallback", "slack")
    return times, answers


def _send_effects(recording: rr.RecordingStream, run: FlightRecord) -> list[rrb.TimeSeriesView]:
    """Send commands that rotors do not follow at once, external force, wind, and battery, where they exist."""
    t = run.log.plant.t
    views = list[rrb.TimeSeriesView]()
    commanded = commanded_speeds(run.log)
    if commanded is not None:
        labels = {f"rotor {i}, commanded [rad/s]": REFERENCE for i in range(1, N_ROTORS + 1)}
        contents = _send_curves(recording, "effects/commanded", t, commanded, labels, stepped=True)
        views += _view("Rotor speeds, commanded and acting", [*contents, "signals/speed"], run)
    for effect in effect_curves(run.log):
        labels = {}
        for axis, colour in zip(effect.names, SERIES, strict=False):
            labels[f"{axis} [{effect.unit}]"] = colour
        contents = _send_curves(recording, f"effects/{effect.key}", t, effect.values, labels)
        views += _view(effect.title[0].upper() + effect.title[1:], contents, run)
    return views


def send_texts(recording: rr.RecordingStream, run: FlightRecord) -> None:
    """The summary, and what happened when, see `_events`."""
    events = sorted(_events(run), key=lambda event: event.time)
    times = np.array([event.time for event in events])
    log = rr.TextLog.columns(text=[event.text for event in events], level=[event.level for event in events])
    recording.send_columns("events", [time_column(times)], log)
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


def _events(run: FlightRecord) -> list[_Event]:
    """What happened when.

    Changes of the status, of who answers and of the phase; why the first QP without an answer had none; when permanent
    fallback begins; when a vehicle that stays on the ground was told to leave it; the flight's events and its end.
    """
    log = run.log.control
    diagnosis = run.diagnosis or {}
    events = [*_answers(log), *_phases(log)]
    for name in ("sentence", "advice"):
        if diagnosis.get(name):
            events.append(_Event(diagnosis["time"], diagnosis[name], "ERROR"))
    periods = unrecovered(log)
    if periods:
        events.append(_Event(float(log.t[-periods]), fallback_sentence(periods), "ERROR"))
    commanded = never_took_off(log)
    if commanded is not None:
        events.append(_Event(commanded, takeoff_sentence(commanded), "ERROR"))
    for event in run.numbers.get("events", ()):
        events.append(_Event(event["time"], event["text"], "WARN"))
    if run.log.reason is not None:
        events.append(_Event(run.end, f"aborted: {run.log.reason}", "ERROR"))
    elif run.reason is not None:
        events.append(_Event(run.end, f"lost: {run.reason}", "ERROR"))
    else:
        events.append(_Event(run.end, "completed", "INFO"))
    return events


def _answers(log: ControlLog) -> list[_Event]:
    """Changes of the status, of who answers and of the fallback level."""
    events = []
    answers = list(zip(log.status, log.answered_by, log.fallback.tolist(), strict=True))
    for t, (status, answerer, fallback) in _changes(log.t, answers):
        if fallback:
            events.append(_Event(t, f"{status}, fallback {fallback}", "WARN"))
        elif status in OPTIMAL | {Phase.LANDED}:
            events.append(_Event(t, f"{status} by {answerer}, fallback {fallback}", "INFO"))
        else:
            events.append(_Event(t, f"{status} by {answerer}, fallback {fallback}", "WARN"))
    return events


def _phases(log: ControlLog) -> list[_Event]:
    """Changes of the phase, of a flight that begins or ends on a ground."""
    if all(phase == Phase.FLYING for phase in log.phase):
        return []
    events = []
    for t, phase in _changes(log.t, log.phase):
        if phase == Phase.CRASHED:
            events.append(_Event(t, f"phase: {phase}", "WARN"))
        else:
            events.append(_Event(t, f"phase: {phase}", "INFO"))
    return events


def _changes(t: Array, values: Sequence[Any]) -> list[tuple[float, Any]]:
    """The first value and those that differ from the one before, each with its time [s]."""
    changes = []
    before = None
    for time, value in zip(t.tolist(), values, strict=True):
        if value != before:
            changes.append((time, value))
        before = value
    return changes


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
    interpolation: Literal["Linear", "StepAfter"] = "Linear"
    if stepped:
        interpolation = "StepAfter"
    style = rr.SeriesLines(
        names=list(labels),
        colors=list(labels.values()),
        widths=[1.5] * len(labels),
        interpolation_mode=interpolation,
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
    axis = None
    if ends is not None:
        axis = rrb.ScalarAxis(range=ends)
    start = rr.TimeRangeBoundary.absolute(seconds=0.0)
    end = rr.TimeRangeBoundary.absolute(seconds=max(run.end, 1e-3))
    view = rrb.TimeSeriesView(
        name=title,
        contents=list(contents),
        plot_legend=rrb.PlotLegend("RightTop"),
        axis_y=axis,
        axis_x=rrb.TimeAxis(view_range=rr.TimeRange(start=start, end=end)),
    )
    return [view]
