"""Verdicts as JUnit XML, which CI servers read."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final, Protocol, TypeAlias
from xml.etree import ElementTree

from quadsim.errors import printable
from quadsim.flight.audit import Finding
from quadsim.flight.record import FlightRecord
from quadsim.outputs import absolute, require_file, writing_file
from quadsim.report.flight_sentences import failed_takeoff, failure_sentences
from quadsim.report.table import format_number

Cases: TypeAlias = Sequence[tuple[str, bool | None, str]]
"""Test cases: the name of each, whether it passes (None: skipped), and its message."""
_HEAD: Final = b"<?xml version='1.0' encoding='utf-8'?>\n<testsuite name=\"quadsim."


class Judged(Protocol):
    """A result with verdicts."""

    def verdicts(self) -> tuple[str, Cases]:
        """Return the suite's name and its cases."""


def junit_file(path: str | Path) -> Path:
    """Return the absolute path of a verdict file; it may replace earlier verdicts of quadsim, but nothing else.

    Raises:
        OutputError: it cannot be written, or holds something else.
    """
    path = absolute(path)
    ours = False
    if path.is_file():
        with path.open("rb") as file:
            ours = file.read(len(_HEAD)) == _HEAD
    return require_file(path, overwrite=ours)


def write_junit(result: Judged, path: str | Path) -> Path:
    """Write a result's verdicts as JUnit XML.

    Args:
        result: of `check`: a test case for the flight and one per constraint; of `campaign`: per requirement; of
            `reproduce`: per number.
        path: an XML file; one with earlier verdicts is replaced.

    Returns:
        The file.

    Raises:
        OutputError: it cannot be written.
    """
    return write_cases(*result.verdicts(), Path(path))


def flight_verdicts(flight: FlightRecord) -> tuple[str, Cases]:
    """Suite and cases of a flight: one for the flight, and one per constraint.

    A constraint that is not required is a case that passes, with what was measured in its output.  One that is
    required and was not reached is `skipped`: the flight shows neither that it holds nor that it does not.
    """
    text = "; ".join([flight.reason or "completed", *failure_sentences(flight)])
    failed = flight.numbers["controller"].get("unrecovered") or failed_takeoff(flight)
    passed = flight.reason is None and not failed
    cases = [("flight", passed, text), *map(_case, flight.findings)]
    if not flight.findings:
        cases.append(("audit", False, "; ".join(flight.numbers["audit_notes"])))
    return flight.name, cases


def write_cases(suite: str, cases: Cases, path: Path) -> Path:
    """Write test cases of a suite: the name of each, whether it passes (None: skipped), and its message.

    Characters that XML forbids, and others that steer a terminal, become escapes.
    """
    name = printable(f"quadsim.{suite}")
    results = [passed for _, passed, _ in cases]
    root = ElementTree.Element(
        "testsuite",
        name=name,
        tests=str(len(cases)),
        failures=str(results.count(False)),
        skipped=str(results.count(None)),
    )
    for case_name, passed, sentence in cases:
        case = ElementTree.SubElement(root, "testcase", classname=name, name=printable(case_name))
        message = printable(sentence)
        if passed is None:
            ElementTree.SubElement(case, "skipped", message=message)
        elif passed:
            ElementTree.SubElement(case, "system-out").text = message
        else:
            ElementTree.SubElement(case, "failure", message=message)
    with writing_file(junit_file(path), overwrite=True) as file:
        file.write_bytes(ElementTree.tostring(root, encoding="utf-8", xml_declaration=True))
    return path


def _case(finding: Finding) -> tuple[str, bool | None, str]:
    """A constraint's name, whether its case passes (None where it was required and not reached), and its numbers."""
    limit = finding.limit
    if finding.verdict == "incomplete":
        text = "not reached: the flight has no value in the constraint's time window"
        if limit.required:
            return limit.name, None, text
        return limit.name, True, text
    text = (
        f"worst margin {format_number(finding.worst_margin)} {limit.unit} at t = {finding.worst_time:.3f} s "
        f"(tolerance {limit.tolerances[0]:g}), {format_number(finding.worst_margin_sampled)} at the samples "
        f"(tolerance {limit.tolerances[1]:g}); violated for {finding.time_violated:.3f} s"
    )
    passes = finding.satisfied or not limit.required
    return limit.name, passes, text
