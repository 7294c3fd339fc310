"""What comes from outside is shown as text: markup, codes and characters that steer a terminal do nothing."""

from __future__ import annotations

import io
import math
import re
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
from rich.console import RenderableType
from rich.text import Text
from support import recording, renamed

from quadsim.console import console
from quadsim.console.junit import write_cases
from quadsim.console.summary_tables import audit_table, summary_tables
from quadsim.errors import printable
from quadsim.flight.audit import Finding
from quadsim.report.table import Cell, Grid, Mark, QuantityRow, short_number, to_markdown

NASTY = ("[/bold]", "[link=file:///decoy]x[/link]", "\x1b[2J\x1b]0;title\x07", "a\r\nquadsim: all is well", "\ud800")


def is_plain(text: str) -> bool:
    """Whether a printed text steers nothing."""
    return all(each.isprintable() or each == "\n" for each in text)


def test_what_steers_a_terminal_becomes_an_escape() -> None:
    assert printable("a\x1b[31m\n\x00\u202e\ud800") == r"a\x1b[31m\n\x00\u202e\ud800"
    assert printable("quadratisch, 四, 🚁, °, ü, [bold]") == "quadratisch, 四, 🚁, °, ü, [bold]"
    assert printable("a\nb\r", keep="\n") == "a\nb\\r"


@pytest.mark.parametrize("nasty", NASTY)
def test_a_foreign_summary_is_shown_as_text(nasty: str, short_run: Any, capsys: pytest.CaptureFixture[str]) -> None:
    course = {**short_run.summary["course"], "sentence": nasty}
    controller = {**short_run.summary["controller"], "name": nasty, "solver": nasty, "statuses": {nasty: 3}}
    flight = recording(
        renamed(short_run, nasty), expected=nasty, as_expected=False, course=course, controller=controller
    )
    findings = [replace(each, limit=replace(each.limit, name=nasty)) for each in short_run.findings]
    flight = replace(flight, findings=tuple(findings), log=replace(short_run.log, reason=nasty))
    cells = tuple(Cell(text=nasty, mark=mark) for mark in (Mark.NONE, Mark.BAD))
    row = QuantityRow(group=nasty, label="outcome", unit=nasty, cells=cells, headline=True)
    grid = Grid(key="k", title=nasty, head=(nasty, nasty), lines=(cells,), note=nasty)
    path = Path(nasty.encode(errors="replace").decode())
    parts = [*summary_tables(flight), console.written_to(path), console.to_open(path), *console.grids([grid])]
    parts += [*console.listing({nasty: {nasty: nasty}}), console.table(nasty, [nasty], [[nasty]])]
    console.show(parts)
    console.say(nasty)
    assert console.to_text(parts).count(printable(nasty)) > 20
    assert "<b>" not in console.to_html([nasty, Text("<b>")])
    print(to_markdown([row], [nasty, nasty]))
    output = capsys.readouterr()
    assert is_plain(output.out + output.err)
    assert output.out.count(printable(nasty)) > 20


def shown(parts: Iterable[RenderableType], width: int) -> list[str]:
    """The lines on a console of that width."""
    screen = console.PlainConsole(file=io.StringIO(), width=width)
    console.show(parts, screen)
    return [line.rstrip() for line in screen.export_text().splitlines()]


@pytest.mark.parametrize("width", [80, 120])
def test_sentences_break_at_spaces_and_paths_and_commands_stay_whole(short_run: Any, width: int) -> None:
    path = Path("/", *["folder"] * 30)
    words = ["constraint"] * 40
    sentence = f"{' '.join(words)} {path} {' '.join(words)}"
    lines = shown([sentence, Text(sentence)], width)
    assert " ".join(lines).split() == [*words, str(path), *words] * 2
    assert [line for line in lines if len(line) > width] == [str(path)] * 2
    assert shown([console.to_open(path / "a flight.mp4")], width) == [f"open '{path}/a flight.mp4'"]
    assert max(map(len, shown(summary_tables(short_run), width))) <= width


@pytest.mark.parametrize("width", [60, 80, 120, 160])
def test_a_verdict_is_never_cut_and_names_the_tolerance_that_it_needs(short_run: Any, width: int) -> None:
    roll, *others = short_run.findings
    limit = replace(roll.limit, name="roll_of_the_" + "vehicle" * 6)
    roll = replace(roll, limit=limit, worst_margin=-0.04, worst_margin_sampled=0.0)
    table = audit_table([roll, *others])
    text = "\n".join(lines := shown([table], width))
    assert re.search(r"0\.05 +0\.01\b", text)
    assert "-0.04" in text
    assert text.count("not reached") == 4
    assert max(map(len, lines)) <= width
    assert ("beyond verdict" in text) == (width == 160)


def test_the_legend_of_an_audit_explains_only_what_occurs(short_run: Any) -> None:
    roll = short_run.findings[0]
    slew = short_run.findings[3]
    assert (slew.limit.name, roll.limit.name) == ("slew", "roll")
    roll = replace(roll, worst_margin=2.0, worst_margin_sampled=2.0, peak_plant=3.0, peak_sampled=3.0)
    reported = replace(roll.limit, required=False)
    violated = replace(roll, limit=reported, worst_margin=-2.0, time_violated=0.3, peak_plant=math.nan)

    def legend(finding: Finding) -> str:
        return audit_table([finding]).caption or ""  # type: ignore[return-value]

    assert legend(roll) == "tolerance: at the physics rate, and at the samples"
    assert legend(replace(slew, worst_margin=1.0, worst_margin_sampled=1.0)) == "-: no value"
    assert [part.partition(":")[0] for part in legend(violated).split("; ")] == [
        *("margin", "tolerance", "beyond", "-", "*"),
    ]


def test_a_summary_begins_with_its_verdict_and_shows_deg_and_no_rounding(short_run: Any) -> None:
    flight = recording(short_run)
    summary = flight.numbers
    summary["tracking"]["rmse"] |= {"x": -3e-11, "y": 0.56712, "yaw": math.radians(4.64)}
    summary["control"] |= {"slew_min": -1e-9, "slew_max": 0.0}
    summary["controller"]["answered_by"] = {"piqp-multistage": 3, "gain": 197}
    verdict, *lines = shown(summary_tables(flight), 120)
    text = "\n".join(lines)
    assert verdict.startswith("paper-constrained  ")
    titles = ["audit at the physics rate", "tracking, real minus", "constrained MPC: ", "whole step: median"]
    assert sorted(map(text.index, titles)) == list(map(text.index, titles))
    (row,) = (line.split() for line in lines if line.startswith(" RMS error"))
    assert (row[2:6], row[-1]) == (["<", "1", "nm", "0.567"], "4.64")
    assert "yaw [deg]" in text
    assert "steps 0 .. 0 rad/s per period" in text
    assert "197 periods" in text
    assert "3 by piqp-multistage" in text


@pytest.mark.parametrize(
    ("value", "unit", "text"),
    [
        *(
            (1e-11, "m", "< 1 nm"),
            (-1e-11, "deg", "0"),
            (-0.0, "s", "0"),
            (math.nan, "m", "-"),
            (-0.03771, "deg", "-0.0377"),
        ),
        *((1234.5, "rad/s", "1234"), (3.46e-5, "m", "3.46e-5"), (0.0, "m", "0")),
    ],
)
def test_a_number_is_rounded_to_what_a_person_uses(value: float, unit: str, text: str) -> None:
    assert short_number(value, unit) == text


@pytest.mark.parametrize("nasty", [*NASTY, "\x0b", "\uffff", "\ufffe"])
def test_junit_is_valid_xml_whatever_names_hold(nasty: str, tmp_path: Path) -> None:
    cases = [(nasty, True, nasty), (nasty, False, nasty)]
    write_cases(nasty, cases, tmp_path / "a.xml")
    root = ElementTree.parse(tmp_path / "a.xml").getroot()
    assert [case.get("name") for case in root] == [printable(nasty)] * 2
    assert root.get("name") == f"quadsim.{printable(nasty)}"
