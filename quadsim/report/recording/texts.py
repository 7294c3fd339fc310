"""What is read: what happened when, and how the flight went."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from quadsim.controller import OPTIMAL, Phase
from quadsim.flight.metrics import unrecovered
from quadsim.flight.rundir import Run
from quadsim.report.comparison import comparison_rows, fallback_sentence
from quadsim.report.recording.style import time_column
from quadsim.report.table import to_markdown
from quadsim.state import Array

if TYPE_CHECKING:
    import rerun as rr


def send_texts(recording: rr.RecordingStream, run: Run) -> None:
    """The summary, and what happened when: changes of the status and of who answers, and the end."""
    import rerun as rr

    log = run.log.control
    good = OPTIMAL | {Phase.LANDED}
    events = [
        (
            t,
            f"{status}{'' if fallback else f' by {by}'}, fallback {fallback}",
            "INFO" if status in good and not fallback else "WARN",
        )
        for t, (status, by, fallback) in _changes(
            log.t, list(zip(log.status, log.answered_by, log.fallback.tolist(), strict=True))
        )
    ]
    events += _phase_changes(run)
    events += _failures(run)
    events += [(event["time"], event["text"], "WARN") for event in run.summary.get("events", ())]
    events.append((run.end, _outcome(run), "INFO" if run.log.reason is None else "ERROR"))
    times, texts, levels = zip(*sorted(events, key=lambda event: event[0]), strict=True)
    recording.log("summary", rr.TextDocument(_summary(run), media_type=rr.MediaType.MARKDOWN), static=True)
    recording.send_columns("events", [time_column(np.array(times))], rr.TextLog.columns(text=texts, level=levels))


def _phase_changes(run: Run) -> list[tuple[float, str, str]]:
    """Time, text and level of each change of the phase, in a flight that has a ground."""
    control = run.log.control
    if all(phase == Phase.FLYING for phase in control.phase):
        return []
    return [
        (t, f"phase: {phase}", "WARN" if phase == Phase.CRASHED else "INFO")
        for t, phase in _changes(control.t, control.phase)
    ]


def _changes(t: Array, values: Sequence[Any]) -> list[tuple[float, Any]]:
    """The first value and those that differ from the one before, each with its time [s]."""
    pairs = zip(t.tolist(), [None, *values], values, strict=False)
    return [(time, value) for time, before, value in pairs if value != before]


def _failures(run: Run) -> list[tuple[float, str, str]]:
    """Time, text and level of why the first QP without an answer had none, and of when permanent fallback begins."""
    found, periods = run.summary.get("diagnosis"), unrecovered(run.log.control)
    events = [] if found is None else [(found["time"], text) for text in (found["sentence"], found["advice"]) if text]
    if periods:
        events.append((float(run.log.control.t[-periods]), fallback_sentence(periods)))
    return [(time, text, "ERROR") for time, text in events]


def _outcome(run: Run) -> str:
    return "completed" if run.log.reason is None else f"aborted: {run.log.reason}"


def _summary(run: Run) -> str:
    """How the flight went, as Markdown: of the table of its page what is said of the flight, and each verdict."""
    rows = [row for row in comparison_rows([run]) if row.group in ("Flight", "Tracking") or row.headline]
    course = f"\n{run.summary['course']['sentence']}\n" if "course" in run.summary else ""
    return to_markdown(rows, [run.name]) + course
