"""Verdicts as JUnit XML, which every CI server reads."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final
from xml.etree import ElementTree

from quadsim.errors import printable
from quadsim.flight.audit import Finding
from quadsim.flight.rundir import findings_of
from quadsim.outputs import absolute, require_file, writing_file
from quadsim.report.comparison import failed_takeoff, failure_sentences
from quadsim.report.table import format_number

if TYPE_CHECKING:
    from scenarios.campaign.campaign import CampaignResult
    from scenarios.campaign.statistics import Judgement
    from scenarios.papers.reproduction import Reproduction
    from scenarios.reaudit import Reaudit


_HEAD: Final = b"<?xml version='1.0' encoding='utf-8'?>\n<testsuite name=\"quadsim."


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


def write_junit(result: Reaudit | CampaignResult | Sequence[Reproduction], path: str | Path) -> Path:
    """Write verdicts as JUnit XML: a test case per constraint and one for the flight; per requirement; or per number.

    A constraint that is not required is a case that passes, with what was measured in its output.  One that is
    required and was not reached is `skipped`: the flight shows neither that it holds nor that it does not.

    Args:
        result: of `check`, of a `campaign` with requirements, or of `reproduce`.
        path: an XML file; one with earlier verdicts is replaced.

    Returns:
        The file.

    Raises:
        OutputError: it cannot be written.
    """
    if isinstance(result, Sequence):
        numbers = [(entry.paper.name, number) for entry in result for number in entry.numbers]
        test_cases = [(f"{paper}: {number.spec.name}", number.within, number.sentence) for paper, number in numbers]
        return write_cases("reproduce", test_cases, Path(path))
    summary = result.summary
    if "campaign" in summary:
        judged: Sequence[Judgement] = getattr(result, "judgements", ())
        test_cases = [(entry.requirement.text, entry.holds, entry.sentence) for entry in judged]
        return write_cases(summary["campaign"], test_cases, Path(path))
    text = "; ".join(filter(None, [summary["reason"] or "completed", *failure_sentences(summary)]))
    failed = summary["controller"].get("unrecovered") or failed_takeoff(summary)
    whole = summary["status"] == "completed" and not failed
    findings = findings_of(summary)
    cases = [("flight", whole, text), *map(_case, findings)]
    if not findings:
        cases.append(("audit", False, "; ".join(summary["audit_notes"])))
    return write_cases(summary["scenario"], cases, Path(path))


def write_cases(suite: str, cases: Sequence[tuple[str, bool | None, str]], path: Path) -> Path:
    """Write test cases of a suite: the name of each, whether it passes (None: skipped), and its message.

    Characters that XML forbids, and others that steer a terminal, become escapes.
    """
    name, results = printable(f"quadsim.{suite}"), [passed for _, passed, _ in cases]
    counts = {"tests": len(cases), "failures": results.count(False), "skipped": results.count(None)}
    root = ElementTree.Element("testsuite", {"name": name, **{key: str(count) for key, count in counts.items()}})
    for case_name, passed, sentence in cases:
        case = ElementTree.SubElement(root, "testcase", classname=name, name=printable(case_name))
        if passed:
            ElementTree.SubElement(case, "system-out").text = printable(sentence)
        else:
            ElementTree.SubElement(case, "skipped" if passed is None else "failure", message=printable(sentence))
    with writing_file(junit_file(path), overwrite=True) as file:
        file.write_bytes(ElementTree.tostring(root, encoding="utf-8", xml_declaration=True))
    return path


def _case(finding: Finding) -> tuple[str, bool | None, str]:
    """A constraint's name, whether its case passes (None where it was required and not reached), and its numbers."""
    limit = finding.limit
    if finding.verdict == "incomplete":
        text = "not reached: the flight has no value in the constraint's time window"
        return limit.name, None if limit.required else True, text
    text = (
        f"worst margin {format_number(finding.worst_margin)} {limit.unit} at t = {finding.worst_time:.3f} s "
        f"(tolerance {limit.tolerances[0]:g}), {format_number(finding.worst_margin_sampled)} at the samples "
        f"(tolerance {limit.tolerances[1]:g}); violated for {finding.time_violated:.3f} s"
    )
    return limit.name, finding.satisfied or not limit.required, text
