"""Verdicts as JUnit XML, which every CI server reads."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from quadsim.rundir import write_atomically


def write_junit(summary: Mapping[str, Any], path: Path) -> None:
    """Write one test case per constraint, and one for the flight itself.

    A constraint that is not required is a case that passes, with what was measured in its output.

    Raises:
        OutputError: the file cannot be written.
    """
    cases = [("flight", summary["status"] == "completed", str(summary["reason"] or "completed"))]
    cases += [
        (entry["name"], entry["satisfied"] or not entry["required"], _sentence(entry))
        for entry in summary["constraints"]
    ]
    failures = sum(not passed for _, passed, _ in cases)
    suite = ElementTree.Element(
        "testsuite", name=f"quadsim.{summary['scenario']}", tests=str(len(cases)), failures=str(failures)
    )
    for name, passed, sentence in cases:
        case = ElementTree.SubElement(suite, "testcase", classname=f"quadsim.{summary['scenario']}", name=name)
        if passed:
            ElementTree.SubElement(case, "system-out").text = sentence
        else:
            ElementTree.SubElement(case, "failure", message=sentence)
    write_atomically(path, ElementTree.tostring(suite, encoding="utf-8", xml_declaration=True).decode())


def _sentence(entry: Mapping[str, Any]) -> str:
    if entry["worst_margin"] is None or entry["worst_margin_sampled"] is None:
        return "the flight ended before the constraint's time window"
    return (
        f"worst margin {entry['worst_margin']:.6g} {entry['unit']} at t = {entry['worst_time']:.3f} s "
        f"(tolerance {entry['tolerance']:g}), {entry['worst_margin_sampled']:.6g} at the samples "
        f"(tolerance {entry['tolerance_sampled']:g}); violated for {entry['time_violated']:.3f} s"
    )
