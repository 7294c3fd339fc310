"""Verdicts as JUnit XML, which every CI server reads."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from quadsim.errors import printable
from quadsim.outputs import writing_file
from quadsim.report.comparison import failure_sentences


def write_junit(summary: Mapping[str, Any], path: Path) -> None:
    """Write one test case per constraint, and one for the flight itself.

    A constraint that is not required is a case that passes, with what was measured in its output.

    Raises:
        OutputError: the file cannot be written.
    """
    said = "; ".join(filter(None, [summary["reason"] or "completed", *failure_sentences(summary)]))
    whole = summary["status"] == "completed" and not summary["controller"].get("unrecovered")
    cases = [("flight", whole, said)]
    cases += [
        (entry["name"], entry["satisfied"] or not entry["required"], _sentence(entry))
        for entry in summary["constraints"]
    ]
    write_cases(summary["scenario"], cases, path)


def write_cases(suite: str, cases: Sequence[tuple[str, bool, str]], path: Path) -> None:
    """Write test cases of a suite: the name of each, whether it passes, and its message.

    Characters that XML forbids, and others that steer a terminal, become escapes.

    Raises:
        OutputError: the file cannot be written.
    """
    name, failures = printable(f"quadsim.{suite}"), sum(not passed for _, passed, _ in cases)
    root = ElementTree.Element("testsuite", name=name, tests=str(len(cases)), failures=str(failures))
    for case_name, passed, sentence in cases:
        case = ElementTree.SubElement(root, "testcase", classname=name, name=printable(case_name))
        if passed:
            ElementTree.SubElement(case, "system-out").text = printable(sentence)
        else:
            ElementTree.SubElement(case, "failure", message=printable(sentence))
    with writing_file(path, ".xml") as file:
        file.write_bytes(ElementTree.tostring(root, encoding="utf-8", xml_declaration=True))


def _sentence(entry: Mapping[str, Any]) -> str:
    if entry["worst_margin"] is None or entry["worst_margin_sampled"] is None:
        return "the flight ended before the constraint's time window"
    return (
        f"worst margin {entry['worst_margin']:.6g} {entry['unit']} at t = {entry['worst_time']:.3f} s "
        f"(tolerance {entry['tolerance']:g}), {entry['worst_margin_sampled']:.6g} at the samples "
        f"(tolerance {entry['tolerance_sampled']:g}); violated for {entry['time_violated']:.3f} s"
    )
