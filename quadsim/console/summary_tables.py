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
from quadsim.report.comparison_rows import NOT_REQUIRED, required, rounded_margin, tracking_values
from quadsim.report.flight_sentences import (
    crash,
    departing,
    event_sentences,
    failure_sentences,
    violated_otherwise,
    violated_unrequired,
)
from quadsim.report.table import ABSENT, short_number

_NAMED: Final = 3  # violated constraints named in the first line
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
    line = _judged(flight, colour, remark)
    if sentence := departing(flight):
        line += console.styled("; ", (sentence, "yellow"))
    return line


def _judged(flight: FlightRecord, colour: str, remark: str) -> Text:
    """Return the verdict on the required constraints of a flight that was flown to its end."""
    verdict = flight.outcome
    if verdict in ("incomplete", "unaudited"):
        if remark and flight.numbers.get("as_expected", True):
            colour = "green"
        else:
            colour = "yellow"
        if verdict == "incomplete":
            what = required(flight).text
        else:
            what = "no constraint was audited"
        return console.styled((f"{verdict}, {what}{remark}", colour))
    if verdict == "satisfied":
        phrase = "every required constraint holds"
    else:
        phrase = _violations(flight.findings)
    phrase = violated_otherwise(flight) or phrase
    line = console.styled((f"{crash(flight) or 'completed'}, {phrase}{remark}", colour))
    if violated := violated_unrequired(flight.findings):
        line += console.styled("; ", (f"{NOT_REQUIRED}: {', '.join(violated)}", "yellow"))
    return line


def _violations(findings: Sequence[Finding]) -> str:
    """Return the violated required constraints, with the largest violation of each and its time."""
    violated = []
    for finding in findings:
        if finding.limit.required and finding.verdict == "violated":
            margin, _ = finding.deciding
            by = ""
            if math.isfinite(margin):
                if margin == finding.worst_margin:
                    when = f"{finding.worst_time:.2f} s"
                else:
                    when = "the samples"
                by = f" by {short_number(-margin)} {finding.limit.unit} at {when}"
            violated.append(f"{finding.limit.name}{by}")
    if len(violated) > _NAMED:
        more = f" and {len(violated) - _NAMED} more"
    else:
        more = ""
    return ": ".join(filter(None, ["a required constraint is violated", ", ".join(violated[:_NAMED]) + more]))


def audit_table(findings: Sequence[Finding]) -> Table:
    """Return every constraint with its bounds, peaks, smallest margin, tolerances and verdict."""
    margins = [rounded_margin(finding.margin, finding.limit.tolerances[0]) for finding in findings]
    head = ("constraint", "bounds", "sampled", "plant", "margin", "tolerance", "at samples", "beyond", "verdict")
    lines = []
    for finding, margin in zip(findings, margins, strict=True):
        at_physics, at_samples = finding.limit.tolerances
        lines.append(
            (
                f"{finding.limit.name} [{finding.limit.unit}]",
                _range(finding.limit.lower, finding.limit.upper),
                *(short_number(peak, finding.limit.unit) for peak in (finding.peak_sampled, finding.peak_plant)),
                short_number(margin),
                ABSENT if finding.limit.source.plant is None else f"{at_physics:.3g}",
                f"{at_samples:.3g}",
                short_number(finding.time_violated),
                _verdict(finding),
            )
        )
    occurring = {
        "margin: the smallest, negative = beyond the bound": any(margin < 0.0 for margin in margins),
        "tolerance: at the physics rate, and at the samples": any(
            finding.limit.source.plant is not None for finding in findings
        ),
        "beyond: time outside bound and tolerance [s]": any(finding.time_violated for finding in findings),
        "-: no value": any(ABSENT in line for line in lines),
        "*: reported, not required": bool(violated_unrequired(findings)),
    }
    caption = "; ".join(text for text, occurs in occurring.items() if occurs) or None
    return console.table("audit at the physics rate", head, lines, caption=caption, left=("verdict",), spare=_SPARE)


def _verdict(finding: Finding) -> Text:
    text = VERDICT_TEXT[finding.verdict]
    if finding.verdict == "violated":
        return console.styled((text, "red") if finding.limit.required else (f"{text}*", "yellow"))
    return console.styled((text, "green" if finding.verdict == "satisfied" else "yellow"))


def _tracking_table(flight: FlightRecord) -> Table:
    channels = [*flight.numbers["tracking"]["unit"]]
    lines = []
    for measure in ("rmse", "max_error", "final_error", "overshoot"):
        columns = [tracking_values([flight], measure, channel) for channel in channels]
        head = ["", *(f"{channel} [{unit}]" for channel, (unit, _) in zip(channels, columns, strict=True))]
        numbers = (math.nan if value is None else value for _, (value,) in columns)
        cells = (short_number(number, unit) for number, (unit, _) in zip(numbers, columns, strict=True))
        lines.append((measure.replace("_", " ").replace("rmse", "RMS error"), *cells))
    return console.table("tracking, real minus filtered reference", head, lines)


def _controller_lines(numbers: Mapping[str, Any]) -> Iterator[str]:
    control = numbers["control"]
    controller = numbers["controller"]
    times = controller["step_ms"]
    usual = OPTIMAL | {Phase.LANDED, Phase.CRASHED}
    refused = ", ".join(f"{n} {status}" for status, n in controller["statuses"].items() if status not in usual)
    if controller["solver"].startswith("C99"):
        where = f" ({controller['solver']})"
    else:
        where = ""
    yield (
        f"{law_name(controller['name'])}{where}: {counts(controller['answered_by'])}"
        f"{f' ({refused})' if refused else ''}"
    )
    yield (
        f"whole step: median {times['p50']:.3g}, p99 {times['p99']:.3g}, max {times['max']:.3g} ms, "
        f"deadline {controller['deadline_ms']:g} ms"
    )
    speeds, steps = (
        " .. ".join(short_number(control[f"{what}_{end}"], "rad/s") for end in ("min", "max"))
        for what in ("speed", "slew")
    )
    yield (
        f"commanded speeds {speeds} rad/s, steps {steps} rad/s per period; "
        f"simulated in {numbers['wall_s']['simulate']:.2f} s"
    )


def _effect_lines(numbers: Mapping[str, Any]) -> Iterator[str]:
    """Yield the effects of a flight, if any: events, ground, late commands, errors of the estimate."""
    if events := numbers.get("events"):
        yield f"events: {'; '.join(event_sentences(events))}"
    if "ground" in numbers:
        ground = numbers["ground"]
        if ground["started"] == "flying":
            left = "started in the air"
        else:
            left = "never left it"
        if ground["takeoff_time"] is not None:
            left = f"left it at {ground['takeoff_time']:.2f} s"
        touch = ground["touchdown"]
        met = ""
        if touch is not None:
            met = (
                f", met it at {touch['time']:.2f} s with {touch['speed']:.3g} m/s down, "
                f"{touch['horizontal_speed']:.3g} m/s along and {touch['tilt']:.3g} deg of tilt"
            )
        yield f"ground: {left}{met}; {ground['phase']} at the end"
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


def _range(lower: float, upper: float) -> str:
    if lower == -upper:
        return f"±{short_number(upper)}"
    return "..".join(short_number(bound) if math.isfinite(bound) else "-" for bound in (lower, upper))
