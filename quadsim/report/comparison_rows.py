"""Several runs -> the rows of one table: a cell for each run, or `-` where it has no such value.

Plain data from the flights' audits and numbers, shown by the terminal, the page and the Markdown table.  The rows of
each group are declared at the end of the file.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from quadsim.flight.audit import VERDICT_TEXT, Finding, Limit, worst_finding
from quadsim.flight.record import FlightRecord
from quadsim.mpc.laws import law_name
from quadsim.report.flight_sentences import (
    departing,
    event_sentences,
    failed_takeoff,
    names_with_verdict,
    nested,
    optimum_sentences,
    violated_unrequired,
    with_mismatch,
)
from quadsim.report.table import ABSENT, Cell, Mark, QuantityRow, format_number
from quadsim.state import VELOCITY

GLANCE: Final = "At a glance"
NOT_REQUIRED: Final = "violated, not required"
_NEGLIGIBLE_SHARE: Final = 1e-3  # share of its tolerance below which a margin is shown as 0
_FlightCell = Callable[[FlightRecord], Cell]
_Line = tuple[str, str, _FlightCell]  # a row's label, its unit, and the cell of a flight


def comparison_rows(runs: Sequence[FlightRecord]) -> list[QuantityRow]:
    """Everything that is known of flights, side by side; a value that a run lacks is shown as `-`."""
    position_errors = [position_error(run) for run in runs]
    return [
        *_rows(runs, GLANCE, _GLANCE),
        _best_smallest(GLANCE, "RMS error, position", "m", runs, position_errors),
        *_rows(runs, GLANCE, _SPEED_AND_TIME),
        *_rows(runs, "Flight", _FLIGHT),
        *_rows_if_any(runs, "Course", _COURSE, "course"),
        *_tracking_rows(runs),
        *_constraint_rows(runs),
        *_rows_if_any(runs, "Ground", _GROUND, "ground"),
        *_rows_if_any(runs, "Measured state", _ESTIMATION, "estimation"),
        *_rows(runs, "Commands", _COMMANDS),
        *_rows(runs, "Solver", _SOLVER),
        *_rows_if_any(runs, "Simulated computation", _COMPUTATION, "computation"),
        *_step_time_rows(runs),
        *_rows(runs, "Time", _TIMES),
    ]


def _rows(runs: Sequence[FlightRecord], group: str, lines: Iterable[_Line]) -> Iterator[QuantityRow]:
    for label, unit, cell in lines:
        yield QuantityRow(group=group, label=label, unit=unit, cells=tuple(map(cell, runs)))


def _rows_if_any(runs: Sequence[FlightRecord], group: str, lines: Iterable[_Line], key: str) -> Iterator[QuantityRow]:
    """Rows about what not every flight has, if any has it: `key` names it in the numbers."""
    if any(run.numbers.get(key) for run in runs):
        yield from _rows(runs, group, lines)


def outcome(flight: FlightRecord) -> Cell:
    """Return the verdict with its reason, and the constraints that are violated but not required."""
    cell = verdict_cell(flight)
    takeoff = failed_takeoff(flight)
    if flight.reason is not None:
        text = f"{cell.text}: {flight.reason}"
    elif flight.outcome == "incomplete":
        text = f"{cell.text}; {required(flight).text}"
    elif takeoff:
        text = f"{cell.text}: {takeoff}"
    else:
        text = cell.text
    remarks = []
    leaving = departing(flight)
    if leaving:
        remarks.append(leaving)
    violated = violated_unrequired(flight.findings)
    if violated:
        remarks.append(f"{NOT_REQUIRED}: {', '.join(violated)}")
    mark = cell.mark
    if remarks and mark is Mark.GOOD:
        mark = Mark.WARN
    return Cell(text="; ".join([text, *remarks]), mark=mark)


def verdict_cell(flight: FlightRecord) -> Cell:
    """Return the verdict, and whether the scenario expects it; runs of older versions state no expectation."""
    verdict = flight.outcome
    expected = flight.numbers.get("expected")
    if expected is None:
        return Cell(text=verdict)
    if flight.numbers.get("as_expected"):
        return _cell(f"{verdict}, as expected", mark=Mark.GOOD, marked=verdict == "satisfied")
    return Cell(text=f"{verdict} (expected {expected})", mark=Mark.BAD)


def required(flight: FlightRecord) -> Cell:
    """The verdict on the constraints that the scenario demands, naming those that do not hold."""
    if not flight.findings:
        return Cell(text="none audited", mark=Mark.WARN)
    demanded = [finding for finding in flight.findings if finding.limit.required]
    if not demanded:
        return Cell(text="none required")
    violated = names_with_verdict(demanded, "violated")
    incomplete = names_with_verdict(demanded, "incomplete")
    parts = []
    if violated:
        parts.append(f"{VERDICT_TEXT['violated']}: {', '.join(violated)}")
    if incomplete:
        parts.append(f"{VERDICT_TEXT['incomplete']}: {', '.join(incomplete)}")
    if violated:
        return Cell(text="; ".join(parts), mark=Mark.BAD)
    if incomplete:
        return Cell(text="; ".join(parts), mark=Mark.WARN)
    return Cell(text=f"all {len(demanded)} hold", mark=Mark.GOOD)


def _cell(text: str, *, mark: Mark, marked: bool) -> Cell:
    """A cell with a mark, if it is to be marked."""
    if marked:
        return Cell(text=text, mark=mark)
    return Cell(text=text)


def _worst_constraint(flight: FlightRecord) -> Cell:
    """Return the constraint that came closest to its bound, or went furthest beyond it, with its verdict."""
    worst = worst_finding(flight.findings)
    if worst is None:
        return Cell()
    cell = _verdict(worst)
    return replace(cell, text=f"{worst.limit.name} {cell.text}")


def position_error(flight: FlightRecord) -> float | None:
    """Return the RMS distance from the filtered reference [m]; None without numbers."""
    errors = [nested(flight.numbers, "tracking", "rmse", axis) for axis in "xyz"]
    if None in errors:
        return None
    return math.hypot(*errors)


def _highest_speed(run: FlightRecord) -> Cell:
    speeds = np.linalg.norm(run.log.plant.state[:, VELOCITY], axis=1)
    speeds = speeds[np.isfinite(speeds)]
    if speeds.size:
        return Cell(text=format_number(float(speeds.max())))
    return Cell()


def _step_time(flight: FlightRecord) -> Cell:
    median = nested(flight.numbers, "controller", "step_ms", "p50")
    longest = nested(flight.numbers, "controller", "step_ms", "max")
    deadline = nested(flight.numbers, "controller", "deadline_ms")
    misses = nested(flight.numbers, "controller", "deadline_misses")
    if median is None:
        return Cell()
    text = f"median {format_number(median)}, maximum {format_number(longest)}, deadline {format_number(deadline)}"
    return _cell(text, mark=Mark.WARN, marked=bool(misses))


def _in_degrees(angle: float | None) -> float | None:
    if angle is None:
        return None
    return math.degrees(angle)


def tracking_values(runs: Sequence[FlightRecord], measure: str, channel: str) -> tuple[str, list[float | None]]:
    """Unit and values of one tracking measure; angles in degrees."""
    units = {nested(run.numbers, "tracking", "unit", channel) for run in runs} - {None}
    values = [nested(run.numbers, "tracking", measure, channel) for run in runs]
    if units == {"rad"}:
        return "deg", [_in_degrees(value) for value in values]
    return "/".join(sorted(units)), values


def _tracking_rows(runs: Sequence[FlightRecord]) -> Iterator[QuantityRow]:
    for measure, label in _TRACKING.items():
        channels = dict[str, None]()
        for run in runs:
            channels.update(dict.fromkeys(nested(run.numbers, "tracking", measure) or ()))
        for channel in channels:
            unit, values = tracking_values(runs, measure, channel)
            yield _best_smallest("Tracking", f"{label}, {channel}", unit, runs, values)
    # One row per step of the courses; `-` where an output does not settle or a run has no such step.
    settling = [_settling_times(run) for run in runs]
    for channel, time in dict.fromkeys(itertools.chain.from_iterable(settling)):
        times = [times_of_run.get((channel, time)) for times_of_run in settling]
        yield _best_smallest("Tracking", f"settling, {channel} at {time:g} s", "s", runs, times)


def _settling_times(run: FlightRecord) -> dict[tuple[str, float], float | None]:
    """How long each step of the course takes to settle [s], by its channel and time; None if it does not."""
    times = {}
    for step in nested(run.numbers, "tracking", "settling") or ():
        times[step["channel"], step["time"]] = step["settled"]
    return times


def _step_time_rows(runs: Sequence[FlightRecord]) -> Iterator[QuantityRow]:
    measures = {"p50": "median", "p95": "95th percentile", "p99": "99th percentile", "max": "maximum"}
    for clock, part in {"step_ms": "whole step", "solve_ms": "optimum alone, by any answerer"}.items():
        for measure, label in measures.items():
            values = [nested(run.numbers, "controller", clock, measure) for run in runs]
            yield _best_smallest("Time", f"{part}, {label}", "ms", runs, values)


def _best_smallest(
    group: str, label: str, unit: str, runs: Sequence[FlightRecord], values: Sequence[float | None]
) -> QuantityRow:
    """Return a row with its smallest magnitude marked, among completed flights and if they differ."""
    texts = [format_number(value) for value in values]
    magnitudes = dict[int, float]()
    for i, (run, value) in enumerate(zip(runs, values, strict=True)):
        if value is not None and run.log.status == "completed":
            magnitudes[i] = abs(value)
    best = None
    if len({texts[i] for i in magnitudes}) > 1:
        best = texts[min(magnitudes, key=magnitudes.__getitem__)]
    cells = []
    for i, text in enumerate(texts):
        is_best = i in magnitudes and text == best
        cells.append(_cell(text, mark=Mark.BEST, marked=is_best))
    return QuantityRow(group=group, label=label, unit=unit, cells=tuple(cells))


def _constraint_rows(runs: Sequence[FlightRecord]) -> Iterator[QuantityRow]:
    audits = []
    for run in runs:
        audits.append({finding.limit.name: finding for finding in run.findings})
    for name in dict.fromkeys(itertools.chain.from_iterable(audits)):
        findings = [audit.get(name) for audit in audits]
        limit_unit = next(finding.limit.unit for finding in findings if finding is not None)
        for label, unit, cell in _CONSTRAINT:
            cells = []
            for finding in findings:
                if finding is None:
                    cells.append(Cell())
                else:
                    cells.append(cell(finding))
            yield QuantityRow(
                group=f"Constraint {name}",
                label=label,
                unit=limit_unit if unit == _LIMIT_UNIT else unit,
                cells=tuple(cells),
                headline=label == "verdict",
            )


def _verdict(finding: Finding) -> Cell:
    """Return the verdict on a constraint, the margin that decides and its tolerance.

    For example `holds (margin -0.0376 deg, tolerance 0.05)`.
    """
    text = VERDICT_TEXT[finding.verdict]
    if finding.verdict == "violated" and not finding.limit.required:
        text = NOT_REQUIRED
    if finding.verdict != "incomplete":
        margin, tolerance = finding.deciding
        shown = f"{format_number(rounded_margin(margin, tolerance))} {finding.limit.unit}"
        if margin != finding.worst_margin:
            shown += " at the samples"
        text += f" (margin {shown}, tolerance {tolerance:.3g})"
    return Cell(text=text, mark=verdict_mark(finding))


def rounded_margin(margin: float, tolerance: float) -> float:
    """Return a margin, or 0 if it is far smaller than its tolerance."""
    if abs(margin) < _NEGLIGIBLE_SHARE * tolerance:
        return 0.0
    return margin


def verdict_mark(finding: Finding) -> Mark:
    """Return the mark of the verdict on a constraint."""
    if finding.verdict == "satisfied":
        return Mark.GOOD
    if finding.verdict == "violated" and finding.limit.required:
        return Mark.BAD
    return Mark.WARN


def _bounds(finding: Finding) -> Cell:
    """Format the bounds of a constraint and its window, e.g. `-5 .. 5`, `at least -0.5` or `0 .. 1, from 59 s`."""
    limit = finding.limit
    lower = format_number(limit.lower)
    upper = format_number(limit.upper)
    if math.isinf(limit.upper):
        text = f"at least {lower}"
    elif math.isinf(limit.lower):
        text = f"at most {upper}"
    else:
        text = f"{lower} .. {upper}"
    if limit.start or math.isfinite(limit.stop):
        text += f", from {limit.start:g} s"
    if math.isfinite(limit.stop):
        text += f" to {limit.stop:g} s"
    return Cell(text=text)


def tolerance_text(limit: Limit) -> str:
    """Return the tolerance, and the one at the control samples where it is another."""
    plant, sampled = limit.tolerances
    if limit.source.plant is None:
        return f"{sampled:.3g}"
    if plant == sampled:
        return f"{plant:.3g}"
    return f"{plant:.3g}, {sampled:.3g} at the samples"


def _tolerance(finding: Finding) -> Cell:
    return Cell(text=tolerance_text(finding.limit))


def _sampled_margin(finding: Finding) -> Cell:
    margin = finding.worst_margin_sampled
    violated = finding.limit.violated(margin, sampled=True)
    return _cell(format_number(margin), mark=verdict_mark(finding), marked=bool(violated))


def _plant_margin(finding: Finding) -> Cell:
    margin = finding.worst_margin
    violated = finding.limit.violated(margin, sampled=False)
    return _cell(format_number(margin), mark=verdict_mark(finding), marked=bool(violated))


def _violation(finding: Finding) -> Cell:
    seconds = finding.time_violated
    return _cell(format_number(seconds), mark=verdict_mark(finding), marked=seconds > 0.0)


def _lowest_speed(flight: FlightRecord) -> Cell:
    """Return the lowest rotor speed that the course requires; none if it requires a negative thrust."""
    problems = nested(flight.numbers, "course", "problems") or ()
    if any("not flyable" in problem for problem in problems):
        return Cell(text="not flyable", mark=Mark.BAD)
    return _number("course", "rotor_min")(flight)


def _text(value: Callable[[FlightRecord], object]) -> _FlightCell:
    return lambda flight: Cell(text=str(value(flight)))


def _number(*keys: str, unit: str = "", wrong: Mark = Mark.NONE) -> _FlightCell:
    """Return the number at a path, in degrees if that is its unit; marked as wrong unless zero."""

    def cell(flight: FlightRecord) -> Cell:
        value = nested(flight.numbers, *keys)
        shown = value
        if unit == "deg":
            shown = _in_degrees(value)
        return _cell(format_number(shown), mark=wrong, marked=bool(value))

    return cell


def _counts(key: str) -> _FlightCell:
    def cell(flight: FlightRecord) -> Cell:
        counts = flight.numbers["controller"].get(key) or {}
        parts = [f"{name}: {count}" for name, count in counts.items()]
        return Cell(text=", ".join(parts) or ABSENT)

    return cell


def _iterations(measure: str) -> _FlightCell:
    """Iterations of each answerer that iterates: they are not comparable."""

    def cell(flight: FlightRecord) -> Cell:
        answerers = flight.numbers["controller"].get("iterations_by", {})
        parts = [f"{name}: {format_number(iterations[measure])}" for name, iterations in answerers.items()]
        return Cell(text=", ".join(parts) or ABSENT)

    return cell


def _course_entries(key: str, form: str, mark: Mark) -> _FlightCell:
    """Entries of the course in one cell; `none` where there are none, `-` where a run does not say."""

    def cell(flight: FlightRecord) -> Cell:
        entries = nested(flight.numbers, "course", key)
        if entries is None:
            return Cell()
        if not entries:
            return Cell(text="none")
        return Cell(text="; ".join(map(form.format, entries)), mark=mark)

    return cell


def _final_phase(flight: FlightRecord) -> Cell:
    if not flight.numbers.get("ground"):
        return Cell()
    phase = nested(flight.numbers, "ground", "phase")
    crashed = nested(flight.numbers, "ground", "crashed")
    return _cell(str(phase), mark=Mark.BAD, marked=bool(crashed))


def _rejected_samples(flight: FlightRecord) -> Cell:
    samples = nested(flight.numbers, "estimation", "samples") or {}
    parts = []
    for name, counts in samples.items():
        rejected = counts["rejected"]
        parts.append(f"{name} {rejected} of {counts['accepted'] + rejected}")
    return Cell(text=", ".join(parts) or ABSENT)


def _audit_notes(flight: FlightRecord) -> str:
    return "; ".join(flight.numbers.get("audit_notes", ())) or "as the controller bounds"


def _why_no_optimum(flight: FlightRecord) -> str:
    return "; ".join(optimum_sentences(flight)) or ABSENT


def _events(flight: FlightRecord) -> str:
    return "; ".join(event_sentences(flight.numbers.get("events", ()))) or ABSENT


def _estimation_errors() -> Iterator[_Line]:
    """Lines on the errors of the measured state."""
    units = {"x": "m", "y": "m", "z": "m", "roll": "deg", "pitch": "deg", "yaw": "deg"}
    for measure, label in (("rmse", "RMS"), ("max_error", "largest")):
        for name, unit in units.items():
            yield f"{label} error of the measured {name}", unit, _number("estimation", measure, name, unit=unit)


_GLANCE: Final[tuple[_Line, ...]] = (("outcome", "", outcome), ("worst constraint", "", _worst_constraint))
_SPEED_AND_TIME: Final[tuple[_Line, ...]] = (
    ("highest speed", "m/s", _highest_speed),
    ("step time", "ms", _step_time),
)
_FLIGHT: Final[tuple[_Line, ...]] = (
    ("required constraints", "", required),
    ("audit", "", _text(_audit_notes)),
    ("why no optimum", "", _text(_why_no_optimum)),
    ("events", "", _text(_events)),
    ("time flown", "s", _number("duration")),
    ("controller", "", _text(lambda flight: law_name(flight.numbers["controller"].get("name", ABSENT)))),
    ("QP solver", "", _text(lambda flight: flight.numbers["controller"].get("solver") or ABSENT)),
    ("horizon", "periods", _text(lambda flight: flight.numbers["controller"].get("horizon", ABSENT))),
    ("vehicle", "", _text(lambda flight: with_mismatch(flight, flight.actual.name))),
    ("mass", "kg", _text(lambda flight: format_number(flight.actual.mass))),
    ("seed", "", _text(lambda flight: flight.numbers.get("seed", ABSENT))),
)
_COURSE: Final[tuple[_Line, ...]] = (
    ("largest tilt required", "deg", _number("course", "tilt")),
    ("highest speed required", "m/s", _number("course", "velocity")),
    ("lowest rotor speed required", "rad/s", _lowest_speed),
    ("highest rotor speed required", "rad/s", _number("course", "rotor_max")),
    ("jumps", "", _course_entries("jumps", "at {:g} s", Mark.NONE)),
    ("beyond the bounds", "", _course_entries("problems", "{}", Mark.WARN)),
)
_GROUND: Final[tuple[_Line, ...]] = (
    ("take-off at", "s", _number("ground", "takeoff_time")),
    ("touchdown at", "s", _number("ground", "touchdown", "time")),
    ("touchdown, descending with", "m/s", _number("ground", "touchdown", "speed")),
    ("touchdown, along the ground with", "m/s", _number("ground", "touchdown", "horizontal_speed")),
    ("touchdown, tilt", "deg", _number("ground", "touchdown", "tilt")),
    ("at the end", "", _final_phase),
)
_ESTIMATION: Final[tuple[_Line, ...]] = (
    *_estimation_errors(),
    ("periods without a number", "", _number("estimation", "not_finite")),
    ("samples rejected by the filter", "", _rejected_samples),
)
_COMMANDS: Final[tuple[_Line, ...]] = (
    ("lowest rotor speed", "rad/s", _number("control", "speed_min")),
    ("highest rotor speed", "rad/s", _number("control", "speed_max")),
    ("largest step down, per period", "rad/s", _number("control", "slew_min")),
    ("largest step up, per period", "rad/s", _number("control", "slew_max")),
    ("total variation", "rad/s", _number("control", "total_variation")),
)
_SOLVER: Final[tuple[_Line, ...]] = (
    ("answered by", "", _counts("answered_by")),
    ("statuses", "", _counts("statuses")),
    ("periods by fallback level", "", _counts("fallbacks")),
    ("in permanent fallback", "", _number("controller", "unrecovered")),
    ("iterations, mean", "", _iterations("mean")),
    ("iterations, most", "", _iterations("max")),
    ("active constraints, most", "", _number("controller", "active_max")),
)
_COMPUTATION: Final[tuple[_Line, ...]] = (
    ("command after its measurement, median", "ms", _number("computation", "delay_ms", "p50")),
    ("command after its measurement, maximum", "ms", _number("computation", "delay_ms", "max")),
    ("commands arrived too late", "", _number("computation", "missed", wrong=Mark.WARN)),
)
_TIMES: Final[tuple[_Line, ...]] = (
    ("deadline", "ms", _number("controller", "deadline_ms")),
    ("deadline misses", "", _number("controller", "deadline_misses", wrong=Mark.BAD)),
    ("simulated in", "s", _number("wall_s", "simulate")),
    ("with all files", "s", _number("wall_s", "total")),
)
_TRACKING: Final = {
    "rmse": "RMS error",
    "max_error": "largest error",
    "final_error": "final error",
    "overshoot": "overshoot",
}
_LIMIT_UNIT: Final = "unit of the limit"  # stands for the constraint's own unit
_CONSTRAINT: Final[tuple[tuple[str, str, Callable[[Finding], Cell]], ...]] = (
    ("verdict", "", _verdict),
    ("bounds", _LIMIT_UNIT, _bounds),
    ("tolerance", _LIMIT_UNIT, _tolerance),
    ("peak at the samples", _LIMIT_UNIT, lambda finding: Cell(text=format_number(finding.peak_sampled))),
    ("peak at the physics rate", _LIMIT_UNIT, lambda finding: Cell(text=format_number(finding.peak_plant))),
    ("worst margin at the samples", _LIMIT_UNIT, _sampled_margin),
    ("worst margin at the physics rate", _LIMIT_UNIT, _plant_margin),
    ("when", "s", lambda finding: Cell(text=format_number(finding.worst_time))),
    ("time violated", "s", _violation),
)
