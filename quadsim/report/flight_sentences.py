"""What a reader is told of one flight, in sentences: why it failed, where there was no optimum, what happened when.

Read from the flight's audit and the numbers of its summary; pages, terminal, films and recordings say the same.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final

from quadsim.controller import Phase
from quadsim.flight.audit import Finding, SpaceLimit, Verdict
from quadsim.flight.record import FlightRecord
from quadsim.report.table import format_number
from quadsim.space import Obstacle

_MOST_EVENTS: Final = 12  # most events of a flight that are named


def nested(data: Any, *keys: str) -> Any:
    """Return a nested value, or None if a key is missing: a run that ended at once has no numbers."""
    for key in keys:
        if not isinstance(data, Mapping):
            return None
        data = data.get(key)
    return data


def names_with_verdict(findings: Iterable[Finding], verdict: Verdict) -> list[str]:
    """Return the names of the constraints with a verdict."""
    return [finding.limit.name for finding in findings if finding.verdict == verdict]


def violated_unrequired(findings: Iterable[Finding]) -> list[str]:
    """Return the names of the constraints that are violated but not required."""
    unrequired = [finding for finding in findings if not finding.limit.required]
    return names_with_verdict(unrequired, "violated")


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


def departing(flight: FlightRecord) -> str | None:
    """Say that a flight left its course at its end, not far enough to be lost; None if it did not, or ended early."""
    departure = flight.departure
    if flight.reason is not None or departure is None or not departure.leaving:
        return None
    return departure.sentence


def fallback_sentence(periods: int) -> str:
    """Say that a flight ended in fallback, after so many periods of it."""
    return f"{periods} periods in fallback, never recovered"


def takeoff_sentence(commanded: float) -> str:
    """Say that the vehicle never left the ground that it was told to leave at a time [s]."""
    return f"told to take off at t = {format_number(commanded)} s, never left the ground"


def failed_takeoff(flight: FlightRecord) -> str | None:
    """Say when a vehicle that never left the ground was told to; None if it need not, or did."""
    commanded = flight.numbers["controller"].get("never_took_off")
    if commanded is None:
        return None
    return takeoff_sentence(commanded)


def crash(flight: FlightRecord) -> str | None:
    """Say that the vehicle crashed, and which obstacles it touched; None if it did not."""
    if Phase.CRASHED not in flight.numbers["controller"].get("statuses", ()):
        return None
    touched = []
    for finding in flight.findings:
        limit = finding.limit
        is_obstacle = isinstance(limit, SpaceLimit) and isinstance(limit.shape, Obstacle)
        if is_obstacle and finding.verdict == "violated":
            touched.append(limit.name)
    if touched:
        return f"crashed, touched {', '.join(touched)}"
    return "crashed"


def failure_sentences(flight: FlightRecord) -> list[str]:
    """Return what failed other than a constraint: the take-off, or as in `optimum_sentences`."""
    sentences = optimum_sentences(flight)
    takeoff = failed_takeoff(flight)
    if takeoff is not None:
        sentences.insert(0, takeoff)
    return sentences


def optimum_sentences(flight: FlightRecord) -> list[str]:
    """Return why there was no optimum: permanent fallback, and the reason for the first QP without an answer."""
    sentences = []
    periods = flight.numbers["controller"].get("unrecovered")
    if periods:
        sentences.append(fallback_sentence(periods))
    diagnosis = flight.diagnosis
    if diagnosis is None:
        return sentences
    sentences.append(diagnosis["sentence"])
    loop = diagnosis.get("loop", {}).get("sentence")
    if loop:
        sentences.append(loop)
    if diagnosis["advice"]:
        sentences.append(diagnosis["advice"])
    return sentences


def event_sentences(events: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the events with their times, only the first ones if there are many."""
    sentences = [f"{event['text']} at {format_number(event['time'])} s" for event in events[:_MOST_EVENTS]]
    if len(events) > _MOST_EVENTS:
        sentences.append(f"{len(events) - _MOST_EVENTS} more")
    return sentences


def mismatch_sentence(flight: FlightRecord) -> str:
    """Return the vehicle parameters that the controller has wrong, e.g. `mass 0.5 for 0.55`; empty without any."""
    modelled = flight.numbers["vehicle"]
    wrong = []
    for name, value in flight.numbers.get("actual", {}).items():
        if value != modelled[name]:
            wrong.append(f"{name} {modelled[name]} for {value}")
    return ", ".join(wrong)


def with_mismatch(flight: FlightRecord, vehicle: str) -> str:
    """Return a vehicle's name, and what the controller has wrong about it, if anything."""
    mismatch = mismatch_sentence(flight)
    if mismatch:
        return f"{vehicle}, modelled with {mismatch}"
    return vehicle
