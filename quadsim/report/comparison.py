"""Several runs -> the rows of one table.

Plain data from the runs' summaries: the terminal, the page and the Markdown table all show these rows.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Final

import numpy as np

from quadsim.controller import law_name
from quadsim.errors import printable
from quadsim.flight.rundir import Run
from quadsim.report.flight_conditions import (
    Summary,
    computation_rows,
    course_rows,
    estimation_rows,
    ground_rows,
    nested,
    verdict_cell,
)
from quadsim.report.table import ABSENT, Cell, Mark, Row, format_number

TRACKING_MEASURES: Final = {
    "rmse": "RMS error",
    "max_error": "largest error",
    "final_error": "final error",
    "overshoot": "overshoot",
}
TIME_MEASURES: Final = {"p50": "median", "p95": "95th percentile", "p99": "99th percentile", "max": "maximum"}


def run_names(runs: Sequence[Run]) -> tuple[str, ...]:
    """A distinct name for each run: its scenario's, with its directory's where two share a scenario."""
    scenarios = Counter(run.name for run in runs)
    names = [run.name if scenarios[run.name] == 1 else f"{run.name} ({printable(run.directory.name)})" for run in runs]
    seen = Counter(names)
    return tuple(name if seen[name] == 1 else f"{name}, {names[: i + 1].count(name)}" for i, name in enumerate(names))


def distinct_courses(runs: Sequence[Run]) -> list[Run]:
    """One run for each filtered reference: of those whose references agree as far as both flew, the longest."""
    chosen: list[Run] = []
    for run in sorted(runs, key=lambda run: run.log.control.t.size, reverse=True):
        course = run.log.control.reference
        if not any(np.array_equal(course, other.log.control.reference[: len(course)]) for other in chosen):
            chosen.append(run)
    return chosen


def comparison_rows(runs: Sequence[Run]) -> list[Row]:
    """Everything the summaries say, side by side; a value that a run lacks is shown as `-`."""
    summaries = [run.summary for run in runs]
    return [
        *_flight_rows(runs),
        *course_rows(summaries),
        *_tracking_rows(summaries),
        *_constraint_rows(summaries),
        *ground_rows(summaries),
        *estimation_rows(summaries),
        *_command_rows(summaries),
        *_solver_rows(summaries),
        *computation_rows(summaries),
        *_time_rows(summaries),
    ]


def outcome(summary: Mapping[str, Any]) -> Cell:
    """Completed, or aborted with its reason."""
    if is_completed(summary):
        return Cell(text="completed", mark=Mark.GOOD)
    return Cell(text=f"aborted: {summary.get('reason')}", mark=Mark.BAD)


def required(summary: Mapping[str, Any]) -> Cell:
    """The verdict on the constraints that the scenario demands, naming those that do not hold."""
    demanded = [entry for entry in summary["constraints"] if entry["required"]]
    failed = [entry for entry in demanded if not entry["satisfied"]]
    missed = [entry["name"] for entry in failed if entry["worst_margin"] is None]
    broken = [entry["name"] for entry in failed if entry["worst_margin"] is not None]
    parts = [f"{what}: {', '.join(names)}" for what, names in (("violated", broken), ("not reached", missed)) if names]
    if parts:
        return Cell(text="; ".join(parts), mark=Mark.BAD)
    return Cell(text=f"all {len(demanded)} hold", mark=Mark.GOOD) if demanded else Cell(text="none")


def _flight_rows(runs: Sequence[Run]) -> Iterator[Row]:
    def row(label: str, cell: Callable[[Run], Cell], unit: str = "") -> Row:
        return Row(group="Flight", label=label, unit=unit, cells=tuple(cell(run) for run in runs))

    def text(value: Callable[[Run], object]) -> Callable[[Run], Cell]:
        return lambda run: Cell(text=str(value(run)))

    yield row("outcome", lambda run: outcome(run.summary))
    yield row("verdict on the flight", lambda run: verdict_cell(run.summary))
    yield row("required constraints", lambda run: required(run.summary))
    yield row("time flown", lambda run: Cell(text=format_number(run.summary.get("duration"))), "s")
    yield row("controller", text(lambda run: law_name(run.summary["controller"].get("name", ABSENT))))
    yield row("solver", text(lambda run: run.summary["controller"].get("solver") or "closed form"))
    yield row("horizon", text(lambda run: run.summary["controller"].get("horizon", ABSENT)), "periods")
    yield row("vehicle", text(lambda run: run.vehicle.name))
    yield row("mass", text(lambda run: format_number(run.vehicle.mass)), "kg")
    yield row("seed", text(lambda run: run.summary.get("seed", ABSENT)))


def _tracking_rows(summaries: Sequence[Summary]) -> Iterator[Row]:
    for measure, label in TRACKING_MEASURES.items():
        for channel in present_keys(summaries, "tracking", measure):
            unit, values = tracking_values(summaries, measure, channel)
            cells = _best_smallest(summaries, values)
            yield Row(group="Tracking", label=f"{label}, {channel}", unit=unit, cells=cells)
    yield from _settling_rows(summaries)


def _settling_rows(summaries: Sequence[Summary]) -> Iterator[Row]:
    """One row per step of the courses; `-` where an output does not settle or a run has no such step."""
    settled = [
        {(entry["channel"], entry["time"]): entry["settled"] for entry in nested(summary, "tracking", "settling") or ()}
        for summary in summaries
    ]
    for channel, time in dict.fromkeys(step for steps in settled for step in steps):
        cells = _best_smallest(summaries, [steps.get((channel, time)) for steps in settled])
        yield Row(group="Tracking", label=f"settling, {channel} at {time:g} s", unit="s", cells=cells)


def tracking_values(summaries: Sequence[Summary], measure: str, channel: str) -> tuple[str, list[float | None]]:
    """Unit and values of one tracking measure; angles in degrees."""
    units = {nested(summary, "tracking", "unit", channel) for summary in summaries} - {None}
    values = [nested(summary, "tracking", measure, channel) for summary in summaries]
    if units == {"rad"}:
        return "deg", [None if value is None else math.degrees(value) for value in values]
    return "/".join(sorted(units)), values


def _constraint_rows(summaries: Sequence[Summary]) -> Iterator[Row]:
    audits = [{entry["name"]: entry for entry in summary["constraints"]} for summary in summaries]
    for name in dict.fromkeys(name for audit in audits for name in audit):
        entries = [audit.get(name) for audit in audits]
        own_unit = next(entry["unit"] for entry in entries if entry is not None)
        for label, unit, cell in _CONSTRAINT_ROWS:
            yield Row(
                group=f"Constraint {name}",
                label=label,
                unit=own_unit if unit is None else unit,
                cells=tuple(Cell() if entry is None else cell(entry) for entry in entries),
                headline=label == "verdict",
            )


def _command_rows(summaries: Sequence[Summary]) -> Iterator[Row]:
    labels = {
        "speed_min": "lowest rotor speed",
        "speed_max": "highest rotor speed",
        "slew_min": "largest step down, per period",
        "slew_max": "largest step up, per period",
        "total_variation": "total variation",
    }
    for key, label in labels.items():
        cells = tuple(Cell(text=format_number(nested(summary, "control", key))) for summary in summaries)
        yield Row(group="Commands", label=label, unit="rad/s", cells=cells)


def _solver_rows(summaries: Sequence[Summary]) -> Iterator[Row]:
    def row(label: str, cell: Callable[[Summary], Cell]) -> Row:
        return Row(group="Solver", label=label, cells=tuple(cell(summary["controller"]) for summary in summaries))

    yield row("statuses", lambda controller: Cell(text=_counts(controller.get("statuses"))))
    yield row("periods by fallback level", lambda controller: Cell(text=_counts(controller.get("fallbacks"))))
    yield row("in fallback for good", lambda controller: Cell(text=format_number(controller.get("unrecovered"))))
    yield row("iterations, mean", lambda controller: Cell(text=format_number(nested(controller, "iterations", "mean"))))
    yield row("iterations, most", lambda controller: Cell(text=format_number(nested(controller, "iterations", "max"))))
    yield row("active constraints, most", lambda controller: Cell(text=format_number(controller.get("active_max"))))


def _time_rows(summaries: Sequence[Summary]) -> Iterator[Row]:
    for clock, what in {"step_ms": "whole step", "solve_ms": "solver alone"}.items():
        for measure, label in TIME_MEASURES.items():
            values = [nested(summary, "controller", clock, measure) for summary in summaries]
            yield Row(group="Time", label=f"{what}, {label}", unit="ms", cells=_best_smallest(summaries, values))

    def row(label: str, unit: str, keys: tuple[str, str]) -> Row:
        cells = tuple(Cell(text=format_number(nested(summary, *keys))) for summary in summaries)
        return Row(group="Time", label=label, unit=unit, cells=cells)

    yield row("deadline", "ms", ("controller", "deadline_ms"))
    misses = [nested(summary, "controller", "deadline_misses") for summary in summaries]
    cells = tuple(Cell(text=format_number(value), mark=Mark.BAD if value else Mark.NONE) for value in misses)
    yield Row(group="Time", label="deadline misses", cells=cells)
    yield row("simulated in", "s", ("wall_s", "simulate"))
    yield row("with all files", "s", ("wall_s", "total"))


def present_keys(summaries: Sequence[Summary], *path: str) -> list[str]:
    """Keys that any summary has at a path, in order."""
    return list(dict.fromkeys(key for summary in summaries for key in nested(summary, *path) or {}))


def _counts(counts: Mapping[str, int] | None) -> str:
    return ", ".join(f"{name}: {count}" for name, count in counts.items()) if counts else ABSENT


def is_completed(summary: Summary) -> bool:
    """Whether the flight was flown to its end."""
    return bool(summary["status"] == "completed")


def format_bounds(entry: Summary, unit: str = "") -> str:
    """Bounds of a constraint and the times it holds for, e.g. `-5 .. 5`, `at least -0.5` or `0 .. 1 m, from 59 s`."""
    lower, upper = entry["lower"], entry["upper"]
    if lower is None or upper is None:
        bounds = f"at least {format_number(lower)}" if upper is None else f"at most {format_number(upper)}"
    else:
        bounds = f"{format_number(lower)} .. {format_number(upper)}"
    window = "" if not entry["start"] and entry["stop"] is None else f", from {entry['start']:g} s"
    window += "" if entry["stop"] is None else f" to {entry['stop']:g} s"
    return f"{bounds} {unit}".rstrip() + window


def _verdict(entry: Summary) -> str:
    """The verdict and the tolerances it stands on, e.g. `holds (tolerance 0.01 / 0.05 deg)`."""
    tolerance = f"tolerance {entry['tolerance_sampled']:g} / {entry['tolerance']:g} {entry['unit']}"
    return f"{_finding(entry)} ({tolerance})"


def _finding(entry: Summary) -> str:
    if entry["worst_margin"] is None:
        return "not reached"
    if entry["satisfied"]:
        return "holds"
    return f"violated {format_excess(entry)}" if entry["required"] else f"exceeded {format_excess(entry)}, not required"


def format_excess(entry: Summary) -> str:
    """How far a constraint was exceeded; says so where that was at the samples alone, in what was commanded."""
    at_samples = entry["worst_margin"] >= -entry["tolerance"]
    margin = entry["worst_margin_sampled"] if at_samples else entry["worst_margin"]
    return f"by {format_number(-margin)} {entry['unit']}{' at the samples' if at_samples else ''}"


def _verdict_mark(entry: Summary) -> Mark:
    if entry["satisfied"]:
        return Mark.GOOD
    return Mark.BAD if entry["required"] else Mark.WARN


def _margin_cell(key: str, tolerance: str) -> Callable[[Summary], Cell]:
    def cell(entry: Summary) -> Cell:
        beyond = entry[key] is not None and entry[key] < -entry[tolerance]
        return Cell(text=format_number(entry[key]), mark=_verdict_mark(entry) if beyond else Mark.NONE)

    return cell


def _violation_cell(entry: Summary) -> Cell:
    seconds = entry["time_violated"]
    return Cell(text=format_number(seconds), mark=_verdict_mark(entry) if seconds > 0.0 else Mark.NONE)


def _best_smallest(summaries: Sequence[Summary], values: Sequence[float | None]) -> tuple[Cell, ...]:
    """Cells with the value nearest to zero marked, among the flights that were completed and when they differ."""
    texts = [format_number(value) for value in values]
    eligible = {
        i: abs(value)
        for i, (summary, value) in enumerate(zip(summaries, values, strict=True))
        if value is not None and is_completed(summary)
    }
    differ = len({texts[i] for i in eligible}) > 1
    best = {i for i in eligible if differ and texts[i] == texts[min(eligible, key=eligible.__getitem__)]}
    return tuple(Cell(text=text, mark=Mark.BEST if i in best else Mark.NONE) for i, text in enumerate(texts))


def _number_cell(key: str) -> Callable[[Summary], Cell]:
    return lambda entry: Cell(text=format_number(entry[key]))


_CONSTRAINT_ROWS: Final[tuple[tuple[str, str | None, Callable[[Summary], Cell]], ...]] = (
    ("verdict", "", lambda entry: Cell(text=_verdict(entry), mark=_verdict_mark(entry))),
    ("bounds", None, lambda entry: Cell(text=format_bounds(entry))),
    ("peak at the samples", None, _number_cell("peak_sampled")),
    ("peak at the physics rate", None, _number_cell("peak_plant")),
    ("worst margin at the samples", None, _margin_cell("worst_margin_sampled", "tolerance_sampled")),
    ("worst margin at the physics rate", None, _margin_cell("worst_margin", "tolerance")),
    ("when", "s", _number_cell("worst_time")),
    ("time violated", "s", _violation_cell),
)
"""Rows of a constraint: label, unit (None for the constraint's own), and the cell of an entry of the audit."""
