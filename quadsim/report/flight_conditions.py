"""Several runs -> the rows of what their flights met: course, ground, measurement errors, delays of commands."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

from quadsim.report.table import ABSENT, Cell, Mark, Row, format_number

Summary = Mapping[str, Any]

_COURSE: Final = {
    "tilt": ("largest tilt required", "deg"),
    "velocity": ("highest speed asked for", "m/s"),
    "rotor_min": ("lowest rotor speed asked for", "rad/s"),
    "rotor_max": ("highest rotor speed asked for", "rad/s"),
}
_TOUCHDOWN: Final = {
    "time": ("touchdown at", "s"),
    "speed": ("touchdown, descending with", "m/s"),
    "horizontal_speed": ("touchdown, along the ground with", "m/s"),
    "tilt": ("touchdown, tilt", "deg"),
}
_ERRORS: Final = {"rmse": "RMS error of the measured", "max_error": "largest error of the measured"}
_VERDICTS: Final = {
    "satisfied": "holds every required constraint",
    "violated": "does not hold every required constraint",
    "lost": "is lost",
}
FOR_GOOD: Final = "ends in fallback for good"
"""Of a flight whose verdict rests on that alone; see `quadsim.flight.metrics.unrecovered`."""
_MEASURED: Final = ("x", "y", "z", "roll", "pitch", "yaw")


def nested(data: Any, *keys: str) -> Any:
    """A nested value, or None where a key is missing: a run that ended at once has no numbers."""
    for key in keys:
        data = data.get(key) if isinstance(data, Mapping) else None
    return data


def verdict(summary: Summary) -> str:
    """The verdict on a flight in one word: satisfied, violated, or lost."""
    if summary["status"] != "completed":
        return "lost"
    whole = not (summary["controller"].get("unrecovered") or nested(summary, "ground", "crashed"))
    return "satisfied" if whole and _all_held(summary) else "violated"


def verdict_sentence(summary: Summary) -> str:
    """What the verdict rests on, after the name of the flight."""
    found = verdict(summary)
    if found == "violated" and _all_held(summary):
        return FOR_GOOD if summary["controller"].get("unrecovered") else "crashes"
    return _VERDICTS[found]


def _all_held(summary: Summary) -> bool:
    return all(entry["satisfied"] for entry in summary["constraints"] if entry["required"])


def fallback_sentence(periods: int) -> str:
    """That a flight ended in fallback, after so many periods of it."""
    return f"{periods} periods in fallback, never recovered"


def failure_sentences(summary: Summary) -> list[str]:
    """What kept the controller from its optimum: fallback for good, and why the first QP without an answer had none."""
    periods, found = summary["controller"].get("unrecovered"), summary.get("diagnosis")
    sentences = [fallback_sentence(periods)] if periods else []
    return sentences + ([] if found is None else [found["sentence"], *filter(None, [found["advice"]])])


def verdict_cell(summary: Summary) -> Cell:
    """The verdict, and whether it is the one that the scenario states; a run of an older version states none."""
    found, expected = verdict(summary), summary.get("expected")
    if expected is None:
        return Cell(text=found)
    if summary.get("as_expected"):
        return Cell(text=f"{found}, as expected", mark=Mark.GOOD if found == "satisfied" else Mark.NONE)
    if found == expected:
        return Cell(text=f"{found}, but interrupted", mark=Mark.BAD)
    return Cell(text=f"{found}, expected: {expected}", mark=Mark.BAD)


def course_rows(summaries: Sequence[Summary]) -> Iterator[Row]:
    """What each course asks for, by differential flatness, and what of it is beyond the vehicle or its bounds."""
    if not _any(summaries, "course"):
        return
    for key, (label, unit) in _COURSE.items():
        yield _numbers("Course", label, unit, [nested(summary, "course", key) for summary in summaries])
    yield _row("Course", "jumps", [_listed(nested(summary, "course", "jumps"), "at {:g} s") for summary in summaries])
    problems = [_listed(nested(summary, "course", "problems"), "{}", Mark.WARN) for summary in summaries]
    yield _row("Course", "beyond the bounds", problems)


def ground_rows(summaries: Sequence[Summary]) -> Iterator[Row]:
    """Take-off and touchdown, of flights that have a ground."""
    if not _any(summaries, "ground"):
        return
    yield _numbers("Ground", "take-off at", "s", [nested(summary, "ground", "takeoff_time") for summary in summaries])
    for key, (label, unit) in _TOUCHDOWN.items():
        yield _numbers("Ground", label, unit, [nested(summary, "ground", "touchdown", key) for summary in summaries])
    yield _row("Ground", "at the end", [_phase(summary) for summary in summaries])


def estimation_rows(summaries: Sequence[Summary]) -> Iterator[Row]:
    """Errors of the measured or estimated state, and the samples that a filter rejected."""
    if not _any(summaries, "estimation"):
        return
    for measure, label in _ERRORS.items():
        for name in _MEASURED:
            angle = name in ("roll", "pitch", "yaw")
            values = [nested(summary, "estimation", measure, name) for summary in summaries]
            shown = [math.degrees(value) if angle and value is not None else value for value in values]
            yield _numbers("Measured state", f"{label} {name}", "deg" if angle else "m", shown)
    gone = [nested(summary, "estimation", "not_finite") for summary in summaries]
    yield _numbers("Measured state", "periods without a number", "", gone)
    yield _row("Measured state", "samples rejected by the filter", [_refused(summary) for summary in summaries])


def computation_rows(summaries: Sequence[Summary]) -> Iterator[Row]:
    """When commands came, in simulated time."""
    if not _any(summaries, "computation"):
        return
    for measure, label in {"p50": "median", "max": "maximum"}.items():
        values = [nested(summary, "computation", "delay_ms", measure) for summary in summaries]
        yield _numbers("Simulated computation", f"command after its measurement, {label}", "ms", values)
    missed = [nested(summary, "computation", "missed") for summary in summaries]
    cells = [Cell(text=format_number(value), mark=Mark.WARN if value else Mark.NONE) for value in missed]
    yield _row("Simulated computation", "commands too late to be used", cells)


def _any(summaries: Sequence[Summary], key: str) -> bool:
    return any(summary.get(key) for summary in summaries)


def _row(group: str, label: str, cells: Sequence[Cell], unit: str = "") -> Row:
    return Row(group=group, label=label, unit=unit, cells=tuple(cells))


def _numbers(group: str, label: str, unit: str, values: Sequence[float | None]) -> Row:
    return _row(group, label, [Cell(text=format_number(value)) for value in values], unit)


def _listed(entries: Sequence[Any] | None, form: str, mark: Mark = Mark.NONE) -> Cell:
    """Entries in one cell; `none` where there are none, `-` where a run does not say."""
    if entries is None:
        return Cell()
    return Cell(text="; ".join(map(form.format, entries)), mark=mark) if entries else Cell(text="none")


def _phase(summary: Summary) -> Cell:
    if not summary.get("ground"):
        return Cell()
    crashed = nested(summary, "ground", "crashed")
    return Cell(text=str(nested(summary, "ground", "phase")), mark=Mark.BAD if crashed else Mark.NONE)


def _refused(summary: Summary) -> Cell:
    samples = nested(summary, "estimation", "samples") or {}
    parts = [f"{name} {n['rejected']} of {n['accepted'] + n['rejected']}" for name, n in samples.items()]
    return Cell(text=", ".join(parts) or ABSENT)
