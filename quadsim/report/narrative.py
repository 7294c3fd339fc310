"""Several runs -> sentences that state their outcome and difference in numbers, all from the runs' summaries."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Final

from quadsim.flight.rundir import Run
from quadsim.flight.summary import constraint_verdict, deciding_margin
from quadsim.report.comparison import (
    Summary,
    distinct_courses,
    failure_sentences,
    format_bounds,
    format_excess,
    is_completed,
    nested,
    present_keys,
    run_names,
    tracking_values,
    verdict,
    verdict_sentence,
)
from quadsim.report.table import format_number

_MOST_EVENTS: Final = 12  # of a flight that a sentence names
_Named = Sequence[tuple[str, Summary]]


def comparison_sentences(runs: Sequence[Run]) -> list[str]:
    """What the runs show, one fact each: outcome, limits, tracking, effort."""
    named = list(zip(run_names(runs), (run.summary for run in runs), strict=True))
    return [
        *_outcome_sentences(named),
        *condition_sentences(named),
        *_limit_sentences(named),
        *_tracking_sentences(named, courses=len(distinct_courses(runs))),
        *_effort_sentences(named),
    ]


def _outcome_sentences(named: _Named) -> Iterator[str]:
    for name, summary in named:
        if not is_completed(summary):
            yield f"{name} was aborted after {summary['duration']:g} s: {summary.get('reason')}."
    completed = [name for name, summary in named if is_completed(summary)]
    if completed:
        yield f"{_list(completed)} {'was' if len(completed) == 1 else 'were'} flown to the end."


def condition_sentences(named: _Named) -> Iterator[str]:
    """What was expected of each flight, why a QP had no answer, and what it met: course, ground, errors, delays."""
    for name, summary in named:
        found, expected = verdict(summary), summary.get("expected")
        if expected is not None and not summary.get("as_expected"):
            yield f"{name} {verdict_sentence(summary)}; its scenario states the verdict {expected}."
        elif expected is not None and found != "satisfied":
            yield f"{name} {verdict_sentence(summary)}, as its scenario states."
    for name, summary in named:
        if parts := failure_sentences(summary):
            yield f"{name}: {'; '.join(parts)}."
    courses: dict[str, list[str]] = {}
    for name, summary in named:
        if sentence := nested(summary, "course", "sentence"):
            courses.setdefault(sentence, []).append(name)
    for sentence, names in courses.items():
        yield f"{_list(names)}: {sentence[0].lower()}{sentence[1:]}"
    for name, summary in named:
        if events := summary.get("events"):
            yield f"On the way of {name}: {'; '.join(event_sentences(events))}."
        yield from _ground_sentences(name, summary)
        yield from _estimation_sentences(name, summary)
        if delays := nested(summary, "computation", "delay_ms"):
            missed = summary["computation"]["missed"]
            yield (
                f"Commands of {name} come {format_number(delays['p50'])} ms after their measurement in the median and "
                f"{format_number(delays['max'])} ms at most; {missed or 'none'} too late to be used."
            )


def event_sentences(events: Sequence[Summary]) -> list[str]:
    """What happened when, the first of them where there are many."""
    sentences = [f"{event['text']} at {format_number(event['time'])} s" for event in events[:_MOST_EVENTS]]
    return sentences + ([f"{len(events) - _MOST_EVENTS} more"] if len(events) > _MOST_EVENTS else [])


def _ground_sentences(name: str, summary: Summary) -> Iterator[str]:
    if not summary.get("ground"):
        return
    ground = summary["ground"]
    phrases = [] if ground["takeoff_time"] is None else [f"takes off at {format_number(ground['takeoff_time'])} s"]
    if met := ground["touchdown"]:
        impact = f"{met['speed']:.2f} m/s downwards, {met['tilt']:.1f} deg of tilt"
        phrases.append(f"meets the ground at {format_number(met['time'])} s ({impact})")
    phrases.append("crashes" if ground["crashed"] else f"is {ground['phase']} at the end")
    yield f"{name} {_list(phrases)}."


def _estimation_sentences(name: str, summary: Summary) -> Iterator[str]:
    if not summary.get("estimation"):
        return
    rmse, gone = summary["estimation"]["rmse"], summary["estimation"]["not_finite"]
    position = math.hypot(*(rmse[axis] for axis in ("x", "y", "z")))
    attitude = math.degrees(math.hypot(*(rmse[angle] for angle in ("roll", "pitch", "yaw"))))
    yield (
        f"The controller of {name} received the position with an RMS error of {format_number(position)} m and the "
        f"attitude with one of {format_number(attitude)} deg{f', and no number in {gone} periods' if gone else ''}."
    )


def _limit_sentences(named: _Named) -> Iterator[str]:
    cases: dict[str, list[tuple[str, Summary]]] = {}
    unreached: dict[str, list[str]] = {}
    for name, summary in named:
        for entry in summary["constraints"]:
            cases.setdefault(entry["name"], []).append((name, entry))
            if constraint_verdict(entry) == "incomplete":
                unreached.setdefault(name, []).append(entry["name"])
    held = [constraint for constraint, entries in cases.items() if all(entry["satisfied"] for _, entry in entries)]
    if held:
        yield f"Held within tolerance by every run that is held to it: {_list(held)}."
    for constraint, entries in cases.items():
        reached = [(name, entry) for name, entry in entries if constraint_verdict(entry) != "incomplete"]
        if constraint in held or not reached:
            continue
        bounds = {format_bounds(entry, entry["unit"]) for _, entry in reached}
        own = {name: f" ({format_bounds(entry, entry['unit'])})" if len(bounds) > 1 else "" for name, entry in reached}
        phrases = "; ".join(f"{name}{own[name]} {_case(entry)}" for name, entry in reached)
        yield f"{constraint}, {bounds.pop() if len(bounds) == 1 else 'whose bounds differ'}: {phrases}."
    for name, constraints in unreached.items():
        yield f"{name} ended before it was held to {_list(constraints)}."


def _case(entry: Summary) -> str:
    """What one run did to one bound, e.g. `exceeds it by 5.62 deg, for 3.24 s in all`."""
    if not entry["satisfied"]:
        text = f"{'violates' if entry['required'] else 'exceeds'} it {format_excess(entry)}"
        seconds = entry["time_violated"]
        return f"{text}, for {format_number(seconds)} s in all" if seconds else text
    margin, _ = deciding_margin(entry)
    if margin is None or abs(margin) < 1e-6:
        return "reaches it and keeps it"
    distance = f"{format_number(abs(margin))} {entry['unit']}"
    return f"keeps it by {distance}" if margin > 0.0 else f"keeps it within tolerance, {distance} beyond"


def _tracking_sentences(named: _Named, *, courses: int) -> Iterator[str]:
    if courses > 1:
        yield f"The runs follow {courses} different courses, so their errors are not like for like."
    flown = [(name, summary) for name, summary in named if is_completed(summary) and summary["tracking"]]
    summaries = [summary for _, summary in flown]
    parts = []
    for channel in present_keys(summaries, "tracking", "rmse"):
        unit, values = tracking_values(summaries, "rmse", channel)
        pairs = sorted((value, name) for value, (name, _) in zip(values, flown, strict=True) if value is not None)
        values_text = " against ".join(f"{format_number(value)} {unit} ({name})" for value, name in pairs)
        parts.append(f"{channel} {values_text}")
    if parts:
        yield f"RMS error to the filtered reference: {'; '.join(parts)}."


def _effort_sentences(named: _Named) -> Iterator[str]:
    control = [(name, summary["control"]) for name, summary in named if summary["control"]]
    if control:
        text = "; ".join(
            f"{name} {format_number(c['speed_min'])} to {format_number(c['speed_max'])} rad/s, steps "
            f"{format_number(c['slew_min'])} to {format_number(c['slew_max'])} rad/s per period"
            for name, c in control
        )
        yield f"Rotor speeds commanded: {text}."
    timed = sorted((c["step_ms"]["p50"], name, c) for name, s in named if (c := s["controller"]).get("step_ms"))
    for median, name, c in timed:
        yield (
            f"One control step of {name} takes {format_number(median)} ms in the median and "
            f"{format_number(c['step_ms']['max'])} ms at most, of a period of {c['deadline_ms']:g} ms; "
            f"{c['deadline_misses'] or 'no'} deadline{'' if c['deadline_misses'] == 1 else 's'} missed."
        )
    if len(timed) > 1 and timed[0][0] > 0.0:
        yield f"In the median, {timed[-1][1]} takes {timed[-1][0] / timed[0][0]:.3g} times as long as {timed[0][1]}."


def _list(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
