"""Several runs -> what is said of them together: a name for each, who holds the constraints, who tracks closer."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Sequence
from typing import Final

import numpy as np

from quadsim.errors import ParameterError, printable
from quadsim.flight.audit import limit_differences
from quadsim.flight.record import FlightRecord
from quadsim.mpc.laws import law_name
from quadsim.report.comparison_rows import position_error
from quadsim.report.flight_sentences import names_with_verdict, nested, violated_otherwise
from quadsim.report.table import ABSENT, Cell, Mark, short_number
from quadsim.ties import TIE_SHARE, tied

_MOST_DIFFERENCES: Final = 4  # differences of two audits that a sentence names


def run_names(runs: Sequence[FlightRecord]) -> tuple[str, ...]:
    """A distinct name for each run: its label, or else its scenario's name.

    Runs of one scenario add what tells them apart: their controllers' names, or else those of their directories; or
    they are numbered.
    """
    parts: list[tuple[str, ...]] = [(run.label or run.name,) for run in runs]
    parts = _told_apart(parts, [_controller_name(run) for run in runs])
    parts = _told_apart(parts, [_folder_name(run) for run in runs])
    names = []
    for name, *additions in parts:
        if additions:
            names.append(f"{name} ({', '.join(additions)})")
        else:
            names.append(name)
    return _numbered(names)


def _controller_name(run: FlightRecord) -> str:
    """Return the name of the control law, or `-` where a run does not say."""
    name = nested(run.numbers, "controller", "name") or ABSENT
    return law_name(printable(str(name)))


def _folder_name(run: FlightRecord) -> str:
    """Return the name of a flight's directory, or of its scenario where it has none."""
    if run.directory is None:
        return printable(run.name)
    return printable(run.directory.name)


def _told_apart(parts: Sequence[tuple[str, ...]], additions: Sequence[str]) -> list[tuple[str, ...]]:
    """Add to the parts of each run's name an addition, if it differs among the runs with equal parts."""
    variants: dict[tuple[str, ...], set[str]] = defaultdict(set)
    for name, addition in zip(parts, additions, strict=True):
        variants[name].add(addition)
    longer = []
    for name, addition in zip(parts, additions, strict=True):
        if len(variants[name]) > 1:
            longer.append((*name, addition))
        else:
            longer.append(name)
    return longer


def _numbered(names: Sequence[str]) -> tuple[str, ...]:
    """Number the names that occur more than once."""
    counts = Counter(names)
    seen = Counter[str]()
    numbered = []
    for name in names:
        seen[name] += 1
        if counts[name] == 1:
            numbered.append(name)
        else:
            numbered.append(f"{name}, {seen[name]}")
    return tuple(numbered)


def check_names(names: Sequence[str], count: int, field: str = "names") -> None:
    """Reject names of flights that do not tell them apart.

    Raises:
        ParameterError: `field` is neither empty nor a different text for each of `count` targets.
    """
    distinct = set()
    for name in names:
        if isinstance(name, str) and name.strip() and printable(name) == name:
            distinct.add(name)
    rule = f"{count} different texts, one for each target"
    if not names:
        return
    if isinstance(names, str):
        raise ParameterError("", field, names, rule)
    if not len(names) == len(distinct) == count:
        raise ParameterError("", field, list(names), rule)


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
    shown = list(differences[:_MOST_DIFFERENCES])
    if len(differences) > _MOST_DIFFERENCES:
        shown.append("...")
    return (
        f"Audited differently: {'; '.join(shown)} (first: {first}, second: {second}). "
        "Compare their margins, not their verdicts, or audit all against the same constraints with --constraints."
    )


def conclusion(runs: Sequence[FlightRecord], names: Sequence[str]) -> Cell:
    """Return who holds the constraints, and who tracks closer by how much, as a sentence.

    Errors are compared among completed flights of one course.
    """
    text = _who_holds(runs, names)
    closer = _who_is_closer(runs, names)
    if closer is not None:
        text = f"{text}; {closer}"
    marks = [_holding_mark(run) for run in runs]
    worst = Mark.GOOD
    for mark in (Mark.NONE, Mark.WARN, Mark.BAD):
        if mark in marks:
            worst = mark
    return Cell(text=f"{text}.", mark=worst)


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
    holding = list[str]()
    others = list[str]()
    for run, name in zip(runs, names, strict=True):
        failures = _failures(run)
        if failures:
            others.append(f"{name} {' and '.join(failures)}")
        else:
            holding.append(name)
    held = _held(runs, len(holding))
    if others and holding:
        text = f"{_joined(holding)} {held}, {_joined(others)}"
    elif others:
        text = _joined(others)
    elif len(holding) == 1:
        text = f"{holding[0]} {held}"
    elif len(holding) == 2:
        text = f"both flights {held}"
    else:
        text = f"all {len(holding)} flights {held}"
    if text.startswith(tuple(names)):
        return text
    return text[0].upper() + text[1:]


def _failures(run: FlightRecord) -> list[str]:
    """What a flight does instead of holding its constraints, e.g. `violates roll`; empty if it holds them."""
    violated = names_with_verdict(run.findings, "violated")
    missed = names_with_verdict(run.findings, "incomplete")
    if run.outcome == "violated" and not violated:
        reason = violated_otherwise(run)
        if reason:
            return [f"holds its constraints, {reason}"]
    failures = []
    if run.outcome in ("lost", "aborted"):
        failures.append(f"was {run.outcome}")
    if violated:
        failures.append(f"violates {_joined(violated)}")
    if missed and not failures:
        failures.append(f"does not reach {_joined(missed)}")
    if not run.findings and not failures:
        failures.append("is not audited")
    return failures


def _held(runs: Sequence[FlightRecord], count: int) -> str:
    """What so many of the runs do that hold their constraints: `every constraint` if all are audited alike."""
    if any(limit_differences(runs[0].limits, run.limits, demands=False) for run in runs[1:]):
        if count == 1:
            return "holds its own constraints"
        return "hold their own constraints"
    if count == 1:
        return "holds every constraint"
    return "hold every constraint"


def _who_is_closer(runs: Sequence[FlightRecord], names: Sequence[str]) -> str | None:
    """Compare position errors (RMS); None unless two completed flights or more followed one course."""
    errors = dict[str, float]()
    compared = list[FlightRecord]()
    for run, name in zip(runs, names, strict=True):
        error = position_error(run)
        if error is not None and run.log.status == "completed":
            errors[name] = error
            compared.append(run)
    if len(errors) < 2 or len(distinct_courses(compared)) > 1:
        return None
    closest, next_closest = sorted(errors, key=errors.__getitem__)[:2]
    least = errors[closest]
    second = errors[next_closest]
    shown = _metres(least)
    shown_second = _metres(second)
    if shown == shown_second or len(tied([least, second], TIE_SHARE * second)) > 1:
        return f"position errors are equal: {shown} RMS"
    difference = f"{100.0 * (1.0 - least / second):.0f} % less"
    if len(errors) == 2:
        return f"{closest} tracks closer: {shown} RMS position error against {shown_second} ({difference})"
    return f"{closest} tracks closest: {shown} RMS position error against {shown_second} of the next ({difference})"


def _metres(length: float) -> str:
    """A length [m] with its unit, also one that is only rounding."""
    shown = short_number(length, "m")
    if shown.startswith("<"):
        return shown
    return f"{shown} m"


def _joined(names: Sequence[str]) -> str:
    """Join names as in a sentence."""
    if len(names) == 1:
        return names[0]
    return f"{', '.join(names[:-1])} and {names[-1]}"
