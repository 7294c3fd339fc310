"""What is seen in the plots: signals, references, bounds, margins, verdicts, the solver, effects; and what is read."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from quadsim.controller import OPTIMAL, Phase
from quadsim.flight.audit import SIGNALS, Limit, margins_sampled
from quadsim.flight.log import BODY_RATES, QUATERNION, FlightLog
from quadsim.flight.metrics import unrecovered
from quadsim.flight.rundir import Run
from quadsim.report.comparison import comparison_rows, fallback_sentence
from quadsim.report.curves import break_at_wraps, commanded_speeds, effect_curves, reference_curve
from quadsim.report.recording.style import BOUND, REFERENCE, SERIES, VERDICTS, Colour, panels, time_column
from quadsim.report.table import to_markdown
from quadsim.state import REFERENCE_NAMES, Array
from quadsim.vehicle import N_ROTORS

if TYPE_CHECKING:
    import rerun as rr

_ACTIVE: Final = 0.002  # A limit is active where its margin is below this fraction of the allowed band


def send_signals(recording: rr.RecordingStream, log: FlightLog) -> None:
    """Every signal there is, at the log rate where it exists between the control samples; and the reference.

    Of flights that may turn upside down quaternion and body rates as well.
    """
    for names in panels(log).values():
        for colour, name in zip(SERIES, names, strict=False):
            signal = SIGNALS[name]
            t, values = signal.finest(log)
            if values.ndim == 1:
                t, values = break_at_wraps(t, values, signal.unit)
                _send_curves(recording, f"signals/{name}", t, values, {f"{name} [{signal.unit}]": colour})
            else:
                rotors = {f"rotor {i} [{signal.unit}]": shade for i, shade in enumerate(SERIES, start=1)}
                _send_curves(recording, f"signals/{name}", t, values, rotors, stepped=True)
    for name, vectors, columns in (
        ("quaternion", log.plant.attitude, QUATERNION),
        ("body_rates", log.plant.body_rates, BODY_RATES),
    ):
        if vectors is not None:
            labels = [f"{column} [{unit}]" for column, unit in columns.items()]
            _send_curves(recording, f"signals/{name}", log.plant.t, vectors, dict(zip(labels, SERIES, strict=False)))
    for name in REFERENCE_NAMES:
        values, label = reference_curve(log.control, name), f"{name} ref [{SIGNALS[name].unit}]"
        _send_curves(recording, f"reference/{name}", log.control.t, values, {label: REFERENCE})


def send_limit(recording: rr.RecordingStream, limit: Limit, log: FlightLog, colour: Colour) -> None:
    """A limit's bounds over its time window, its margins, and what they say."""
    import rerun as rr

    t = log.control.t
    margins = margins_sampled(limit, log)
    inside = np.isfinite(margins)
    if not inside.any():
        return
    bounds = {sign: bound for sign, bound in (("≥", limit.lower), ("≤", limit.upper)) if math.isfinite(bound)}
    window = np.array([t[inside][0], min(limit.stop, log.plant.t[-1])])
    labels = {f"{limit.name} {sign} {bound:g} {limit.unit}": BOUND for sign, bound in bounds.items()}
    _send_curves(recording, f"limits/{limit.name}", window, np.tile([*bounds.values()], (2, 1)), labels)
    _send_curves(
        recording, f"margins/{limit.name}", t[inside], margins[inside], {f"{limit.name} [{limit.unit}]": colour}
    )

    names, entity = list(VERDICTS), f"verdicts/{limit.name}"
    band = limit.upper - limit.lower
    near = max(limit.tolerance_sampled, _ACTIVE * band if math.isfinite(band) else 0.0)
    verdicts = np.select([margins < -limit.tolerance_sampled, margins <= near, inside], [2, 1, 0], default=3)
    changes = np.flatnonzero(np.diff(verdicts, prepend=-1))
    style = rr.StateConfiguration(values=names, colors=list(VERDICTS.values()), visible=[True, True, True, False])
    recording.log(entity, style, static=True)
    states = rr.StateChange.columns(state=[names[verdicts[k]] for k in changes])
    recording.send_columns(entity, [time_column(t[changes])], states)


def send_solver(recording: rr.RecordingStream, run: Run) -> None:
    """Clock times, and what is known of the answers."""
    control, timing = run.log.control, run.log.timing
    first, second = SERIES[:2]
    for name, values, label, colour in (
        ("solve_ms", timing.solve_ms, "optimum alone [ms]", first),
        ("step_ms", timing.step_ms, "whole step [ms]", second),
        ("iterations", control.iterations, "iterations", first),
        ("active", control.active, "active constraints", second),
        ("fallback", control.fallback, "fallback, 0 = none", first),
        ("slack", np.degrees(control.slack), "slack [deg]", second),
    ):
        _send_curves(recording, f"solver/{name}", control.t, values, {label: colour})
    deadline = run.summary["controller"].get("deadline_ms")
    if deadline is not None:
        ends = run.log.plant.t[[0, -1]]
        _send_curves(recording, "solver/deadline_ms", ends, np.full(2, deadline), {"deadline [ms]": BOUND})


def send_effects(recording: rr.RecordingStream, log: FlightLog) -> None:
    """External force and torque and the wind, and the commands of rotors that turn otherwise; what there is of it."""
    for entry in effect_curves(log):
        labels = {f"{axis} [{entry.unit}]": colour for axis, colour in zip("xyz", SERIES, strict=False)}
        _send_curves(recording, f"effects/{entry.key}", log.plant.t, entry.values, labels)
    commanded = commanded_speeds(log)
    if commanded is not None:
        labels = {f"rotor {i}, commanded [rad/s]": REFERENCE for i in range(1, N_ROTORS + 1)}
        _send_curves(recording, "effects/commanded", log.plant.t, commanded, labels, stepped=True)


def send_texts(recording: rr.RecordingStream, run: Run) -> None:
    """The summary, and what happened when.

    Changes of the status, of who answers and of the phase; why the first QP without an answer had none; when permanent
    fallback begins; the flight's events and its end.
    """
    import rerun as rr

    log, summary = run.log.control, run.summary
    found, periods = summary.get("diagnosis") or {}, unrecovered(log)
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
    events += [(found["time"], found[name], "ERROR") for name in ("sentence", "advice") if found.get(name)]
    if periods:
        events.append((float(log.t[-periods]), fallback_sentence(periods), "ERROR"))
    events += [(event["time"], event["text"], "WARN") for event in summary.get("events", ())]
    reason = run.log.reason
    events.append((run.end, "completed", "INFO") if reason is None else (run.end, f"aborted: {reason}", "ERROR"))
    times, texts, levels = zip(*sorted(events, key=lambda event: event[0]), strict=True)
    recording.send_columns("events", [time_column(np.array(times))], rr.TextLog.columns(text=texts, level=levels))
    rows = [row for row in comparison_rows([run]) if row.group in ("Flight", "Tracking") or row.headline]
    document = rr.TextDocument(to_markdown(rows, [run.name]), media_type=rr.MediaType.MARKDOWN)
    recording.log("summary", document, static=True)


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
) -> None:
    """One curve per column of `values` (len(t),) or (len(t), j), at times `t` [s]; nothing where there is no row."""
    import rerun as rr

    if not t.size:
        return
    style = rr.SeriesLines(
        names=list(labels),
        colors=list(labels.values()),
        widths=[1.5] * len(labels),
        interpolation_mode="StepAfter" if stepped else "Linear",
        aggregation_policy="MinMax",  # zoomed out, the viewer would show averages: lower peaks than were flown
    )
    recording.log(entity, style, static=True)
    recording.send_columns(entity, [time_column(t)], rr.Scalars.columns(scalars=np.asarray(values, float)))
