"""A flight as tables and sentences: outcome, tracking, audit, controller, effects."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

from rich.console import RenderableType
from rich.table import Table
from rich.text import Text

from quadsim.console import console
from quadsim.controller import OPTIMAL, Phase, counts
from quadsim.flight.audit import VERDICT_TEXT, Finding
from quadsim.flight.record import FlightRecord
from quadsim.mpc.laws import law_name
from quadsim.report.comparison_rows import NOT_REQUIRED, required, rounded_margin, tracking_values, verdict_mark
from quadsim.report.flight_sentences import (
    crash,
    departing,
    event_sentences,
    failure_sentences,
    violated_otherwise,
    violated_unrequired,
)
from quadsim.report.table import ABSENT, Cell, short_number

_MOST_NAMED: Final = 3  # violated constraints named in the first line
_SPARE: Final = ("beyond", "sampled", "plant", "bounds")  # columns that a narrow console does without, in this order


def summary_tables(flight: FlightRecord) -> Iterator[RenderableType]:
    """Yield a flight's tables and sentences: the verdict and its reasons, audit, tracking, timing, the rest."""
    numbers = flight.numbers
    flown = f"{numbers['duration']:.2f} s flown"
    course = numbers.get("course", {})
    if "cut_before" in course:
        flown += f", of a course that ends at {course['cut_before']:g} s"
    yield console.styled((flight.name, "bold"), "  ") + outcome_line(flight) + console.styled(f"  {flown}")
    if numbers.get("description"):
        yield numbers["description"]
    yield from flight.log.traceback
    yield from failure_sentences(flight)
    if "model_error" in numbers:
        yield numbers["model_error"]["sentence"]
    if flight.findings:
        yield audit_table(flight.findings)
    yield from numbers.get("audit_notes", ())
    if numbers["tracking"]:
        yield _tracking_table(flight)
        yield from _controller_lines(numbers)
    if course:
        yield f"{course['sentence']} {course.get('advice', '')}".rstrip()
        yield from course.get("notes", ())
    yield from numbers.get("model_notes", ())
    yield from _effect_lines(numbers)


def outcome_line(flight: FlightRecord) -> Text:
    """Return the outcome with its reason, or the verdict on the required constraints, and the expected verdict."""
    verdict = flight.outcome
    expected = flight.numbers.get("expected", "satisfied")
    as_expected = flight.numbers.get("as_expected", True)
    remark = ""
    if expected != "satisfied":
        if as_expected:
            remark = ", as the scenario expects"
        else:
            remark = f"; the scenario expects: {expected}"
    if as_expected and (remark or verdict == "satisfied"):
        colour = "green"
    else:
        colour = "red"
    if flight.reason is not None:
        return console.styled((f"{verdict}{remark}", colour), f": {flight.reason}")
    if verdict in ("incomplete", "unaudited"):
        if not (remark and as_expected):
            colour = "yellow"
        line = console.styled((f"{verdict}, {_missing(flight)}{remark}", colour))
    else:
        line = console.styled((f"{_judged(flight)}{remark}", colour))
        violated = violated_unrequired(flight.findings)
        if violated:
            line += console.styled("; ", (f"{NOT_REQUIRED}: {', '.join(violated)}", "yellow"))
    leaving = departing(flight)
    if leaving:
        line += console.styled("; ", (leaving, "yellow"))
    return line


def _missing(flight: FlightRecord) -> str:
    """Return why there is no verdict on the required constraints."""
    if flight.outcome == "incomplete":
        return required(flight).text
    return "no constraint was audited"


def _judged(flight: FlightRecord) -> str:
    """Return the verdict on the required constraints of a flight that was flown to its end."""
    end = crash(flight) or "completed"
    otherwise = violated_otherwise(flight)
    if otherwise:
        return f"{end}, {otherwise}"
    if flight.outcome == "satisfied":
        return f"{end}, every required constraint holds"
    return f"{end}, {_violations(flight.findings)}"


def _violations(findings: Sequence[Finding]) -> str:
    """Return the violated required constraints, with the largest violation of each and its time."""
    violated = []
    for finding in findings:
        if finding.limit.required and finding.verdict == "violated":
            violated.append(f"{finding.limit.name}{_largest_violation(finding)}")
    if not violated:
        return "a required constraint is violated"
    named = ", ".join(violated[:_MOST_NAMED])
    if len(violated) > _MOST_NAMED:
        named += f" and {len(violated) - _MOST_NAMED} more"
    return f"a required constraint is violated: {named}"


def _largest_violation(finding: Finding) -> str:
    """Return by how much a constraint is violated at most, and when; empty where that is not a number."""
    margin, _ = finding.deciding
    if not math.isfinite(margin):
        return ""
    if margin == finding.worst_margin:
        when = f"{finding.worst_time:.2f} s"
    else:
        when = "the samples"
    return f" by {short_number(-margin)} {finding.limit.unit} at {when}"


def audit_table(findings: Sequence[Finding]) -> Table:
    """Return every constraint with its bounds, peaks, smallest margin, tolerances and verdict."""
    head = ("constraint", "bounds", "sampled", "plant", "margin", "tolerance", "at samples", "beyond", "verdict")
    lines = [_audit_line(finding) for finding in findings]
    caption = "; ".join(_audit_legend(findings, lines)) or None
    return console.table("audit at the physics rate", head, lines, caption=caption, left=("verdict",), spare=_SPARE)


def _audit_line(finding: Finding) -> tuple[str | Text, ...]:
    limit = finding.limit
    at_physics, at_samples = limit.tolerances
    tolerance = ABSENT
    if limit.source.plant is not None:
        tolerance = f"{at_physics:.3g}"
    return (
        f"{limit.name} [{limit.unit}]",
        _range(limit.lower, limit.upper),
        short_number(finding.peak_sampled, limit.unit),
        short_number(finding.peak_plant, limit.unit),
        short_number(_shown_margin(finding)),
        tolerance,
        f"{at_samples:.3g}",
        short_number(finding.time_violated),
        _verdict(finding),
    )


def _shown_margin(finding: Finding) -> float:
    at_physics, _ = finding.limit.tolerances
    return rounded_margin(finding.margin, at_physics)


def _audit_legend(findings: Sequence[Finding], lines: Sequence[tuple[str | Text, ...]]) -> Iterator[str]:
    """Explain of an audit's columns and signs those that occur."""
    if any(_shown_margin(finding) < 0.0 for finding in findings):
        yield "margin: the smallest, negative = beyond the bound"
    if any(finding.limit.source.plant is not None for finding in findings):
        yield "tolerance: at the physics rate, and at the samples"
    if any(finding.time_violated for finding in findings):
        yield "beyond: time outside bound and tolerance [s]"
    if any(ABSENT in line for line in lines):
        yield "-: no value"
    if violated_unrequired(findings):
        yield "*: reported, not required"


def _verdict(finding: Finding) -> Text:
    text = VERDICT_TEXT[finding.verdict]
    if finding.verdict == "violated" and not finding.limit.required:
        text += "*"
    return console.styled_cell(Cell(text=text, mark=verdict_mark(finding)))


def _tracking_table(flight: FlightRecord) -> Table:
    labels = {
        "rmse": "RMS error",
        "max_error": "max error",
        "final_error": "final error",
        "overshoot": "overshoot",
    }
    head = [""]
    lines = {measure: [label] for measure, label in labels.items()}
    for channel in flight.numbers["tracking"]["unit"]:
        unit, _ = tracking_values([flight], "rmse", channel)
        head.append(f"{channel} [{unit}]")
        for measure, line in lines.items():
            _, (value,) = tracking_values([flight], measure, channel)
            if value is None:
                line.append(ABSENT)
            else:
                line.append(short_number(value, unit))
    return console.table("tracking, real minus filtered reference", head, lines.values())


def _controller_lines(numbers: Mapping[str, Any]) -> Iterator[str]:
    """Yield who answered, how long the controller took, and what it commanded."""
    controller = numbers["controller"]
    law = law_name(controller["name"])
    if controller["solver"].startswith("C99"):
        law += f" ({controller['solver']})"
    answers = counts(controller["answered_by"])
    failures = []
    for status, count in controller["statuses"].items():
        if status not in OPTIMAL | {Phase.LANDED, Phase.CRASHED}:
            failures.append(f"{count} {status}")
    if failures:
        answers += f" ({', '.join(failures)})"
    yield f"{law}: {answers}"
    times = controller["step_ms"]
    yield (
        f"whole step: median {times['p50']:.3g}, p99 {times['p99']:.3g}, max {times['max']:.3g} ms, "
        f"deadline {controller['deadline_ms']:g} ms"
    )
    control = numbers["control"]
    speeds = _span(control["speed_min"], control["speed_max"])
    steps = _span(control["slew_min"], control["slew_max"])
    yield (
        f"commanded speeds {speeds} rad/s, steps {steps} rad/s per period; "
        f"simulated in {numbers['wall_s']['simulate']:.2f} s"
    )


def _span(lowest: float, highest: float) -> str:
    """Return two rotor speeds [rad/s] as a range."""
    return f"{short_number(lowest, 'rad/s')} .. {short_number(highest, 'rad/s')}"


def _effect_lines(numbers: Mapping[str, Any]) -> Iterator[str]:
    """Yield the effects of a flight, if any: events, ground, late commands, errors of the estimate."""
    events = numbers.get("events")
    if events:
        yield f"events: {'; '.join(event_sentences(events))}"
    if "ground" in numbers:
        yield _ground_line(numbers["ground"])
    if "computation" in numbers:
        delay = numbers["computation"]["delay_ms"]
        yield (
            f"simulated computation: p50 {delay['p50']:.3g}, p99 {delay['p99']:.3g}, max {delay['max']:.3g} ms; "
            f"{numbers['computation']['missed']} commands arrived too late"
        )
    if "estimation" in numbers:
        rmse = numbers["estimation"]["rmse"]
        lengths = ", ".join(f"{name} {rmse[name]:.3g}" for name in ("x", "y", "z"))
        angles = ", ".join(f"{name} {math.degrees(rmse[name]):.3g}" for name in ("roll", "pitch", "yaw"))
        yield f"RMS error of the measured state: {lengths} m; {angles} deg"


def _ground_line(ground: Mapping[str, Any]) -> str:
    """Return when the vehicle left the ground, how it met it again, and its phase at the end."""
    if ground["takeoff_time"] is not None:
        left = f"left it at {ground['takeoff_time']:.2f} s"
    elif ground["started"] == "flying":
        left = "started in the air"
    else:
        left = "never left it"
    touchdown = ground["touchdown"]
    met = ""
    if touchdown is not None:
        met = (
            f", met it at {touchdown['time']:.2f} s with {touchdown['speed']:.3g} m/s down, "
            f"{touchdown['horizontal_speed']:.3g} m/s along and {touchdown['tilt']:.3g} deg of tilt"
        )
    return f"ground: {left}{met}; {ground['phase']} at the end"


def _range(lower: float, upper: float) -> str:
    """Return bounds as a range, `-` for one that there is not."""
    if lower == -upper:
        return f"±{short_number(upper)}"
    shown_lower = "-"
    shown_upper = "-"
    if math.isfinite(lower):
        shown_lower = short_number(lower)
    if math.isfinite(upper):
        shown_upper = short_number(upper)
    return f"{shown_lower}..{shown_upper}"
