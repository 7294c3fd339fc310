"""Several runs -> the rows of one table.

Plain data from the flights' audits and numbers, shown by the terminal, the page and the Markdown table.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np

from quadsim.controller import Phase
from quadsim.errors import ParameterError, printable
from quadsim.flight.audit import VERDICT_TEXT, Finding, Limit, SpaceLimit, limit_differences, worst_finding
from quadsim.flight.record import FlightRecord
from quadsim.mpc.laws import law_name
from quadsim.report.table import ABSENT, Cell, Mark, QuantityRow, format_number, short_number
from quadsim.space import Obstacle
from quadsim.state import VELOCITY
from quadsim.ties import TIE_SHARE, tied

GLANCE: Final = "At a glance"
NOT_REQUIRED: Final = "violated, not required"
_ROUNDING: Final = 1e-3  # share of its tolerance below which a margin is shown as 0
_MOST_DIFFERENCES: Final = 4  # differences of two audits that a sentence names
_MOST_EVENTS: Final = 12  # most events of a flight that are named
_Line = tuple[str, str, Callable[[FlightRecord], Cell]]  # a row's label, its unit, and the cell of a flight


def nested(data: Any, *keys: str) -> Any:
    """Return a nested value, or None if a key is missing: a run that ended at once has no numbers."""
    for key in keys:
        if isinstance(data, Mapping):
            data = data.get(key)
        else:
            data = None
    return data


def run_names(runs: Sequence[FlightRecord]) -> tuple[str, ...]:
    """A distinct name for each run: its label, or else its scenario's name.

    Runs of one scenario add what tells them apart: their controllers' names, or else those of their directories; or
    they are numbered.
    """
    parts: list[tuple[str, ...]] = [(run.label or run.name,) for run in runs]
    laws = [law_name(printable(str(nested(run.numbers, "controller", "name") or ABSENT))) for run in runs]
    for further in (laws, [printable(_folder_name(run)) for run in runs]):
        peers = {}
        for part in parts:
            peers[part] = {more for more, other in zip(further, parts, strict=True) if other == part}
        parts = [(*part, more) if len(peers[part]) > 1 else part for part, more in zip(parts, further, strict=True)]
    names = [part[0] + (f" ({', '.join(part[1:])})" if part[1:] else "") for part in parts]
    seen = Counter(names)
    return tuple(name if seen[name] == 1 else f"{name}, {names[: i + 1].count(name)}" for i, name in enumerate(names))


def _folder_name(run: FlightRecord) -> str:
    """Return the name of a flight's directory, or of its scenario where it has none."""
    if run.directory is None:
        return run.name
    return run.directory.name


def check_names(names: Sequence[str], count: int, field: str = "names") -> None:
    """Reject names of flights that do not tell them apart.

    Raises:
        ParameterError: `field` is neither empty nor a different text for each of `count` targets.
    """
    plain = {name for name in names if isinstance(name, str) and name.strip() and printable(name) == name}
    if names and (isinstance(names, str) or not len(names) == len(plain) == count):
        shown = names if isinstance(names, str) else list(names)
        raise ParameterError("", field, shown, f"{count} different texts, one for each target")


def distinct_courses(runs: Sequence[FlightRecord]) -> list[FlightRecord]:
    """Return one run per filtered reference; of runs with equal references as far as both flew, the longest."""
    chosen: list[FlightRecord] = []
    for run in sorted(runs, key=lambda run: run.log.control.t.size, reverse=True):
        course = run.log.control.reference
        if not any(np.array_equal(course, other.log.control.reference[: len(course)]) for other in chosen):
            chosen.append(run)
    return chosen


def different_audits(first: str, second: str, differences: Sequence[str]) -> str:
    """Return the sentence about two audits that differ, and what to do."""
    shown = "; ".join(differences[:_MOST_DIFFERENCES]) + ("; ..." if len(differences) > _MOST_DIFFERENCES else "")
    return (
        f"Audited differently: {shown} (first: {first}, second: {second}). Compare their margins, not their verdicts, "
        "or audit all against the same constraints with --constraints."
    )


def conclusion(runs: Sequence[FlightRecord], names: Sequence[str]) -> Cell:
    """Return who holds the constraints, and who tracks closer by how much, as a sentence.

    Errors are compared among completed flights of one course.
    """
    marks = [_holding_mark(run) for run in runs]
    mark = next((mark for mark in (Mark.BAD, Mark.WARN, Mark.NONE) if mark in marks), Mark.GOOD)
    parts = [_who_holds(runs, names), *filter(None, [_who_is_closer(runs, names)])]
    return Cell(text=f"{'; '.join(parts)}.", mark=mark)


def _holding_mark(run: FlightRecord) -> Mark:
    if run.outcome in ("violated", "lost", "aborted"):
        return Mark.BAD
    if not run.findings:
        return Mark.NONE
    if all(finding.verdict == "satisfied" for finding in run.findings):
        return Mark.GOOD
    return Mark.WARN


def _who_holds(runs: Sequence[FlightRecord], names: Sequence[str]) -> str:
    """Name the flights that hold their constraints, and what the others do instead."""
    holds = list[str]()
    others = list[str]()
    for run, name in zip(runs, names, strict=True):
        failing = [finding.limit.name for finding in run.findings if finding.verdict == "violated"]
        missed = [finding.limit.name for finding in run.findings if finding.verdict == "incomplete"]
        verdict = run.outcome
        if verdict in ("lost", "aborted"):
            deeds = [f"was {verdict}"]
        else:
            deeds = []
        deeds += [f"violates {_joined(failing)}"] if failing else []
        deeds += [f"does not reach {_joined(missed)}"] if missed and not deeds else []
        if verdict == "violated" and not failing and (reason := violated_otherwise(run)):
            deeds = [f"holds its constraints, {reason}"]
        deeds += ["is not audited"] if not run.findings and not deeds else []
        if deeds:
            others.append(f"{name} {' and '.join(deeds)}")
        else:
            holds.append(name)
    alike = not any(limit_differences(runs[0].limits, run.limits, demands=False) for run in runs[1:])
    if alike:
        one = "holds every constraint"
    else:
        one = "holds its own constraints"
    if len(holds) == 1:
        held = one
    else:
        held = one.replace("holds its", "hold their").replace("holds", "hold")
    if not others:
        text = {1: _joined(holds), 2: "both flights"}.get(len(holds), f"all {len(holds)} flights") + f" {held}"
    else:
        text = ", ".join([*([f"{_joined(holds)} {held}"] if holds else []), _joined(others)])
    if text.startswith(tuple(names)):
        return text
    return text[0].upper() + text[1:]


def _who_is_closer(runs: Sequence[FlightRecord], names: Sequence[str]) -> str | None:
    """Compare position errors (RMS); None unless two completed flights or more followed one course."""
    errors = {
        name: (error, run)
        for run, name in zip(runs, names, strict=True)
        if (error := _position_error(run)) is not None and run.log.status == "completed"
    }
    if len(errors) < 2 or len(distinct_courses([run for _, run in errors.values()])) > 1:
        return None
    (first, (least, _)), (_, (second, _)), *_ = sorted(errors.items(), key=lambda entry: entry[1][0])
    shown, other = map(_metres, (least, second))
    if shown == other or len(tied([least, second], TIE_SHARE * second)) > 1:
        return f"position errors are equal: {shown} RMS"
    if len(errors) == 2:
        closer, whose = ("closer", "")
    else:
        closer, whose = ("closest", " of the next")
    less = 100.0 * (1.0 - least / second)
    return f"{first} tracks {closer}: {shown} RMS position error against {other}{whose} ({less:.0f} % less)"


def _metres(length: float) -> str:
    """A length [m] with its unit, also one that is only rounding."""
    shown = short_number(length, "m")
    if shown.startswith("<"):
        return shown
    return f"{shown} m"


def _joined(names: Sequence[str]) -> str:
    """Join names as in a sentence."""
    return " and ".join(filter(None, [", ".join(names[:-1]), names[-1]]))


def comparison_rows(runs: Sequence[FlightRecord]) -> list[QuantityRow]:
    """Everything that is known of flights, side by side; a value that a run lacks is shown as `-`."""

    def rows(group: str, lines: Iterable[_Line], only_with: str = "") -> Iterator[QuantityRow]:
        if not only_with or any(run.numbers.get(only_with) for run in runs):
            for label, unit, cell in lines:
                yield QuantityRow(group=group, label=label, unit=unit, cells=tuple(map(cell, runs)))

    return [
        *rows(GLANCE, _GLANCE),
        _best_smallest(GLANCE, "RMS error, position", "m", runs, list(map(_position_error, runs))),
        QuantityRow(group=GLANCE, label="highest speed", unit="m/s", cells=tuple(map(_highest_speed, runs))),
        *rows(GLANCE, [("step time", "ms", _step_time)]),
        *rows("Flight", _FLIGHT),
        *rows("Course", _COURSE, "course"),
        *_tracking_rows(runs),
        *_constraint_rows(runs),
        *rows("Ground", _GROUND, "ground"),
        *rows("Measured state", _ESTIMATION, "estimation"),
        *rows("Commands", _COMMANDS),
        *rows("Solver", _SOLVER),
        *rows("Simulated computation", _COMPUTATION, "computation"),
        *_step_time_rows(runs),
        *rows("Time", _TIMES),
    ]


def outcome(flight: FlightRecord) -> Cell:
    """Return the verdict with its reason, and the constraints that are violated but not required."""
    cell = verdict_cell(flight)
    if flight.reason is not None:
        cell = replace(cell, text=f"{cell.text}: {flight.reason}")
    elif flight.outcome == "incomplete":
        cell = replace(cell, text=f"{cell.text}; {required(flight).text}")
    elif sentence := failed_takeoff(flight):
        cell = replace(cell, text=f"{cell.text}: {sentence}")
    remarks = list(filter(None, [departing(flight)]))
    if violated := violated_unrequired(flight.findings):
        remarks.append(f"{NOT_REQUIRED}: {', '.join(violated)}")
    if remarks:
        mark = Mark.WARN if cell.mark is Mark.GOOD else cell.mark
        cell = Cell(text="; ".join([cell.text, *remarks]), mark=mark)
    return cell


def departing(flight: FlightRecord) -> str | None:
    """Say that a flight left its course at its end, not far enough to be lost; None if it did not, or ended early."""
    departure = flight.departure
    if flight.reason is not None or departure is None or not departure.leaving:
        return None
    return departure.sentence


def violated_unrequired(findings: Iterable[Finding]) -> list[str]:
    """Return the names of the constraints that are violated but not required."""
    return [finding.limit.name for finding in findings if finding.verdict == "violated" and not finding.limit.required]


def _worst_constraint(flight: FlightRecord) -> Cell:
    """Return the constraint that came closest to its bound, or went furthest beyond it, with its verdict."""
    worst = worst_finding(flight.findings)
    if worst is None:
        return Cell()
    cell = _verdict(worst)
    return replace(cell, text=f"{worst.limit.name} {cell.text}")


def _position_error(flight: FlightRecord) -> float | None:
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
    median, longest = (nested(flight.numbers, "controller", "step_ms", measure) for measure in ("p50", "max"))
    deadline = nested(flight.numbers, "controller", "deadline_ms")
    if median is None:
        return Cell()
    text = f"median {format_number(median)}, maximum {format_number(longest)}, deadline {format_number(deadline)}"
    return Cell(text=text, mark=Mark.WARN if nested(flight.numbers, "controller", "deadline_misses") else Mark.NONE)


def violated_otherwise(flight: FlightRecord) -> str | None:
    """Return what else than a required constraint, none of which is violated, makes a completed flight `violated`.

    That is no take-off, or permanent fallback; None if it is neither.
    """
    if any(finding.limit.required and finding.verdict == "violated" for finding in flight.findings):
        return None
    if failed_takeoff(flight):
        return "but it never took off"
    if flight.numbers["controller"].get("unrecovered"):
        return "but in permanent fallback"
    return None


def fallback_sentence(periods: int) -> str:
    """Say that a flight ended in fallback, after so many periods of it."""
    return f"{periods} periods in fallback, never recovered"


def takeoff_sentence(told: float) -> str:
    """Say that the vehicle never left the ground that it was told to leave at a time [s]."""
    return f"told to take off at t = {format_number(told)} s, never left the ground"


def failed_takeoff(flight: FlightRecord) -> str | None:
    """Say when a vehicle that never left the ground was told to; None if it need not, or did."""
    told = flight.numbers["controller"].get("never_took_off")
    if told is None:
        return None
    return takeoff_sentence(told)


def crash(flight: FlightRecord) -> str | None:
    """Say that the vehicle crashed, and which obstacles it touched; None if it did not."""
    if Phase.CRASHED not in flight.numbers["controller"].get("statuses", ()):
        return None
    violated = [finding.limit for finding in flight.findings if finding.verdict == "violated"]
    touched = []
    for limit in violated:
        if isinstance(limit, SpaceLimit) and isinstance(limit.shape, Obstacle):
            touched.append(limit.name)
    if touched:
        return f"crashed, touched {', '.join(touched)}"
    return "crashed"


def failure_sentences(flight: FlightRecord) -> list[str]:
    """Return what failed other than a constraint: the take-off, or as in `optimum_sentences`."""
    return [*filter(None, [failed_takeoff(flight)]), *optimum_sentences(flight)]


def optimum_sentences(flight: FlightRecord) -> list[str]:
    """Return why there was no optimum: permanent fallback, and the reason for the first QP without an answer."""
    periods = flight.numbers["controller"].get("unrecovered")
    diagnosis = flight.diagnosis
    if periods:
        sentences = [fallback_sentence(periods)]
    else:
        sentences = []
    if diagnosis is None:
        return sentences
    loop = diagnosis.get("loop", {})
    return [*sentences, diagnosis["sentence"], *filter(None, [loop.get("sentence"), diagnosis["advice"]])]


def event_sentences(events: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the events with their times, only the first ones if there are many."""
    sentences = [f"{event['text']} at {format_number(event['time'])} s" for event in events[:_MOST_EVENTS]]
    return sentences + ([f"{len(events) - _MOST_EVENTS} more"] if len(events) > _MOST_EVENTS else [])


def verdict_cell(flight: FlightRecord) -> Cell:
    """Return the verdict, and whether the scenario expects it; runs of older versions state no expectation."""
    word = flight.outcome
    expected = flight.numbers.get("expected")
    if expected is None:
        return Cell(text=word)
    if flight.numbers.get("as_expected"):
        return Cell(text=f"{word}, as expected", mark=Mark.GOOD if word == "satisfied" else Mark.NONE)
    return Cell(text=f"{word} (expected {expected})", mark=Mark.BAD)


def required(flight: FlightRecord) -> Cell:
    """The verdict on the constraints that the scenario demands, naming those that do not hold."""
    findings = flight.findings
    if not findings:
        return Cell(text="none audited", mark=Mark.WARN)
    demanded = [finding for finding in findings if finding.limit.required]
    failing = {}
    for verdict, text in VERDICT_TEXT.items():
        if verdict != "satisfied":
            failing[text] = [finding.limit.name for finding in demanded if finding.verdict == verdict]
    if parts := [f"{text}: {', '.join(names)}" for text, names in failing.items() if names]:
        return Cell(text="; ".join(parts), mark=Mark.BAD if failing["violated"] else Mark.WARN)
    if demanded:
        return Cell(text=f"all {len(demanded)} hold", mark=Mark.GOOD)
    return Cell(text="none required")


def tracking_values(runs: Sequence[FlightRecord], measure: str, channel: str) -> tuple[str, list[float | None]]:
    """Unit and values of one tracking measure; angles in degrees."""
    units = {nested(run.numbers, "tracking", "unit", channel) for run in runs} - {None}
    values = [nested(run.numbers, "tracking", measure, channel) for run in runs]
    if units == {"rad"}:
        return "deg", [None if value is None else math.degrees(value) for value in values]
    return "/".join(sorted(units)), values


def _present_keys(runs: Sequence[FlightRecord], *path: str) -> list[str]:
    """Keys that any flight has at a path of its numbers, in order."""
    return list(dict.fromkeys(key for run in runs for key in nested(run.numbers, *path) or {}))


def _bounds(finding: Finding) -> Cell:
    """Format the bounds of a constraint and its window, e.g. `-5 .. 5`, `at least -0.5` or `0 .. 1, from 59 s`."""
    limit = finding.limit
    lower = format_number(limit.lower)
    upper = format_number(limit.upper)
    bounds = f"{lower} .. {upper}"
    if math.isinf(limit.lower) or math.isinf(limit.upper):
        if math.isinf(limit.upper):
            bounds = f"at least {lower}"
        else:
            bounds = f"at most {upper}"
    if limit.start or math.isfinite(limit.stop):
        window = f", from {limit.start:g} s"
    else:
        window = ""
    return Cell(text=bounds + window + (f" to {limit.stop:g} s" if math.isfinite(limit.stop) else ""))


def tolerance_text(limit: Limit) -> str:
    """Return the tolerance, and the one at the control samples where it is another."""
    plant, sampled = limit.tolerances
    if limit.source.plant is None:
        return f"{sampled:.3g}"
    if plant == sampled:
        return f"{plant:.3g}"
    return f"{plant:.3g}, {sampled:.3g} at the samples"


def _tracking_rows(runs: Sequence[FlightRecord]) -> Iterator[QuantityRow]:
    measures = {"rmse": "RMS error", "max_error": "largest error", "final_error": "final error"}
    for measure, label in {**measures, "overshoot": "overshoot"}.items():
        for channel in _present_keys(runs, "tracking", measure):
            unit, values = tracking_values(runs, measure, channel)
            yield _best_smallest("Tracking", f"{label}, {channel}", unit, runs, values)
    # One row per step of the courses; `-` where an output does not settle or a run has no such step.
    settled = []
    for run in runs:
        settled.append(
            {
                (entry["channel"], entry["time"]): entry["settled"]
                for entry in nested(run.numbers, "tracking", "settling") or ()
            }
        )
    for channel, time in dict.fromkeys(step for steps in settled for step in steps):
        times = [steps.get((channel, time)) for steps in settled]
        yield _best_smallest("Tracking", f"settling, {channel} at {time:g} s", "s", runs, times)


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
    eligible = {}
    for i, (run, value) in enumerate(zip(runs, values, strict=True)):
        if value is not None and run.log.status == "completed":
            eligible[i] = abs(value)
    differ = len({texts[i] for i in eligible}) > 1
    best = {i for i in eligible if differ and texts[i] == texts[min(eligible, key=eligible.__getitem__)]}
    cells = tuple(Cell(text=text, mark=Mark.BEST if i in best else Mark.NONE) for i, text in enumerate(texts))
    return QuantityRow(group=group, label=label, unit=unit, cells=cells)


def _constraint_rows(runs: Sequence[FlightRecord]) -> Iterator[QuantityRow]:
    audits = []
    for run in runs:
        audits.append({finding.limit.name: finding for finding in run.findings})
    for name in dict.fromkeys(name for audit in audits for name in audit):
        entries = [audit.get(name) for audit in audits]
        own_unit = next(entry.limit.unit for entry in entries if entry is not None)
        for label, unit, cell in _CONSTRAINT:
            yield QuantityRow(
                group=f"Constraint {name}",
                label=label,
                unit=own_unit if unit == _OWN else unit,
                cells=tuple(Cell() if entry is None else cell(entry) for entry in entries),
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
        if margin != finding.worst_margin:
            at_samples = " at the samples"
        else:
            at_samples = ""
        shown = rounded_margin(margin, tolerance)
        text += f" (margin {format_number(shown)} {finding.limit.unit}{at_samples}, tolerance {tolerance:.3g})"
    return Cell(text=text, mark=_verdict_mark(finding))


def rounded_margin(margin: float, tolerance: float) -> float:
    """Return a margin, or 0 if it is far smaller than its tolerance."""
    if abs(margin) < _ROUNDING * tolerance:
        return 0.0
    return margin


def _verdict_mark(finding: Finding) -> Mark:
    if finding.verdict == "satisfied":
        return Mark.GOOD
    if finding.verdict == "violated" and finding.limit.required:
        return Mark.BAD
    return Mark.WARN


def _margin(*, sampled: bool) -> Callable[[Finding], Cell]:
    def cell(finding: Finding) -> Cell:
        if sampled:
            margin = finding.worst_margin_sampled
        else:
            margin = finding.worst_margin
        violated = finding.limit.violated(margin, sampled=sampled)
        return Cell(text=format_number(margin), mark=_verdict_mark(finding) if violated else Mark.NONE)

    return cell


def _violation(finding: Finding) -> Cell:
    seconds = finding.time_violated
    return Cell(text=format_number(seconds), mark=_verdict_mark(finding) if seconds > 0.0 else Mark.NONE)


def _lowest_speed(flight: FlightRecord) -> Cell:
    """Return the lowest rotor speed that the course requires; none if it requires a negative thrust."""
    if any("not flyable" in problem for problem in nested(flight.numbers, "course", "problems") or ()):
        return Cell(text="not flyable", mark=Mark.BAD)
    return _number("course", "rotor_min")(flight)


def mismatch(flight: FlightRecord) -> tuple[str, ...]:
    """Return the vehicle parameters that the controller has wrong, as one text; none if there are none."""
    actual = flight.numbers.get("actual", {})
    modelled = flight.numbers["vehicle"]
    wrong = []
    for name, value in actual.items():
        if value != modelled[name]:
            wrong.append(f"{name} {modelled[name]} for {value}")
    if wrong:
        return (", ".join(wrong),)
    return ()


def _text(value: Callable[[FlightRecord], object]) -> Callable[[FlightRecord], Cell]:
    return lambda flight: Cell(text=str(value(flight)))


def _number(*keys: str, unit: str = "", wrong: Mark = Mark.NONE) -> Callable[[FlightRecord], Cell]:
    """Return the number at a path, in degrees if that is its unit; marked as wrong unless zero."""

    def cell(flight: FlightRecord) -> Cell:
        value = nested(flight.numbers, *keys)
        if unit == "deg" and value is not None:
            shown = math.degrees(value)
        else:
            shown = value
        return Cell(text=format_number(shown), mark=wrong if value else Mark.NONE)

    return cell


def _counts(key: str) -> Callable[[FlightRecord], Cell]:
    def cell(flight: FlightRecord) -> Cell:
        counts = flight.numbers["controller"].get(key)
        if counts:
            return Cell(text=", ".join(f"{name}: {count}" for name, count in counts.items()))
        return Cell()

    return cell


def _iterations(measure: str) -> Callable[[FlightRecord], Cell]:
    """Iterations of each answerer that iterates: they are not comparable."""

    def cell(flight: FlightRecord) -> Cell:
        answerers = flight.numbers["controller"].get("iterations_by", {})
        return Cell(text=", ".join(f"{by}: {format_number(n[measure])}" for by, n in answerers.items()) or ABSENT)

    return cell


def _listed(key: str, form: str, mark: Mark) -> Callable[[FlightRecord], Cell]:
    """Entries of the course in one cell; `none` where there are none, `-` where a run does not say."""

    def cell(flight: FlightRecord) -> Cell:
        entries = nested(flight.numbers, "course", key)
        if not entries:
            if entries is None:
                return Cell()
            return Cell(text="none")
        return Cell(text="; ".join(map(form.format, entries)), mark=mark)

    return cell


def _phase(flight: FlightRecord) -> Cell:
    if not flight.numbers.get("ground"):
        return Cell()
    crashed = nested(flight.numbers, "ground", "crashed")
    return Cell(text=str(nested(flight.numbers, "ground", "phase")), mark=Mark.BAD if crashed else Mark.NONE)


def _refused(flight: FlightRecord) -> Cell:
    samples = nested(flight.numbers, "estimation", "samples") or {}
    parts = [f"{name} {n['rejected']} of {n['accepted'] + n['rejected']}" for name, n in samples.items()]
    return Cell(text=", ".join(parts) or ABSENT)


_GLANCE: Final[tuple[_Line, ...]] = (("outcome", "", outcome), ("worst constraint", "", _worst_constraint))
_FLIGHT: Final[tuple[_Line, ...]] = (
    ("required constraints", "", required),
    ("audit", "", _text(lambda flight: "; ".join(flight.numbers.get("audit_notes", ())) or "as the controller bounds")),
    ("why no optimum", "", _text(lambda flight: "; ".join(optimum_sentences(flight)) or ABSENT)),
    ("events", "", _text(lambda flight: "; ".join(event_sentences(flight.numbers.get("events", ()))) or ABSENT)),
    ("time flown", "s", _number("duration")),
    ("controller", "", _text(lambda flight: law_name(flight.numbers["controller"].get("name", ABSENT)))),
    ("QP solver", "", _text(lambda flight: flight.numbers["controller"].get("solver") or ABSENT)),
    ("horizon", "periods", _text(lambda flight: flight.numbers["controller"].get("horizon", ABSENT))),
    ("vehicle", "", _text(lambda flight: ", modelled with ".join([flight.actual.name, *mismatch(flight)]))),
    ("mass", "kg", _text(lambda flight: format_number(flight.actual.mass))),
    ("seed", "", _text(lambda flight: flight.numbers.get("seed", ABSENT))),
)
_COURSE: Final[tuple[_Line, ...]] = (
    ("largest tilt required", "deg", _number("course", "tilt")),
    ("highest speed required", "m/s", _number("course", "velocity")),
    ("lowest rotor speed required", "rad/s", _lowest_speed),
    ("highest rotor speed required", "rad/s", _number("course", "rotor_max")),
    ("jumps", "", _listed("jumps", "at {:g} s", Mark.NONE)),
    ("beyond the bounds", "", _listed("problems", "{}", Mark.WARN)),
)
_GROUND: Final[tuple[_Line, ...]] = (
    ("take-off at", "s", _number("ground", "takeoff_time")),
    ("touchdown at", "s", _number("ground", "touchdown", "time")),
    ("touchdown, descending with", "m/s", _number("ground", "touchdown", "speed")),
    ("touchdown, along the ground with", "m/s", _number("ground", "touchdown", "horizontal_speed")),
    ("touchdown, tilt", "deg", _number("ground", "touchdown", "tilt")),
    ("at the end", "", _phase),
)
_MEASURED: Final = {"x": "m", "y": "m", "z": "m", "roll": "deg", "pitch": "deg", "yaw": "deg"}
_ESTIMATION: Final[tuple[_Line, ...]] = (
    *(
        (f"{label} error of the measured {name}", unit, _number("estimation", measure, name, unit=unit))
        for measure, label in (("rmse", "RMS"), ("max_error", "largest"))
        for name, unit in _MEASURED.items()
    ),
    ("periods without a number", "", _number("estimation", "not_finite")),
    ("samples rejected by the filter", "", _refused),
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
_OWN: Final = "own"  # stands for the constraint's own unit
_CONSTRAINT: Final[tuple[tuple[str, str, Callable[[Finding], Cell]], ...]] = (
    ("verdict", "", _verdict),
    ("bounds", _OWN, _bounds),
    ("tolerance", _OWN, lambda finding: Cell(text=tolerance_text(finding.limit))),
    ("peak at the samples", _OWN, lambda finding: Cell(text=format_number(finding.peak_sampled))),
    ("peak at the physics rate", _OWN, lambda finding: Cell(text=format_number(finding.peak_plant))),
    ("worst margin at the samples", _OWN, _margin(sampled=True)),
    ("worst margin at the physics rate", _OWN, _margin(sampled=False)),
    ("when", "s", lambda finding: Cell(text=format_number(finding.worst_time))),
    ("time violated", "s", _violation),
)
