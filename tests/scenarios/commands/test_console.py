"""What comes from outside is shown as text: markup, codes and characters that steer a terminal do nothing."""

from __future__ import annotations

import copy
import json
import shutil
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
from rich.table import Table

from quadsim.controller import Command, Moment
from quadsim.errors import FileError, FlightError, OutputError, printable
from quadsim.report.table import Cell, Grid, Mark, Row, to_markdown
from quadsim.state import Array
from scenarios.cli import main
from scenarios.commands import EXIT_DONE, EXIT_WRONG_INPUT, campaign_console, console
from scenarios.commands.console import stdout, styled
from scenarios.junit import write_cases
from scenarios.parts.plugin import PluginController

TABLES = ("--no-video", "--no-recording", "--no-figures")
NASTY = (
    "[/bold]",
    "[red]x",
    "[link=file:///decoy]x[/link]",
    "[@click=app.bell]x",
    ":smile:",
    "\x1b[2J\x1b]0;title\x07",
    "\x9b31m",
    "a\r\nquadsim: all is well",
    "\u202egnp.exe",
    "\ud800",
    "\x00",
)


def is_plain(text: str) -> bool:
    """Whether a printed text steers nothing."""
    return all(each.isprintable() or each == "\n" for each in text)


def test_what_steers_a_terminal_becomes_an_escape() -> None:
    assert printable("a\x1b[31m\n\x00\u202e\ud800") == r"a\x1b[31m\n\x00\u202e\ud800"
    assert printable("quadratisch, 四, 🚁, °, ü, [bold]") == "quadratisch, 四, 🚁, °, ü, [bold]"
    assert printable("a\nb\r", keep="\n") == "a\nb\\r"


@pytest.mark.parametrize("nasty", NASTY)
def test_the_console_shows_every_string_as_it_is(nasty: str, capsys: pytest.CaptureFixture[str]) -> None:
    table = Table(title=nasty, caption=nasty)
    table.add_column(nasty)
    table.add_row(nasty)
    for shown in (nasty, styled((nasty, "bold"), nasty), table):
        stdout().print(shown, soft_wrap=True)
    output = capsys.readouterr().out
    assert output.replace("\n", "").count(printable(nasty)) >= 3
    assert is_plain(output)


@pytest.mark.parametrize("nasty", NASTY)
def test_a_foreign_summary_is_shown_as_text(nasty: str, short_run: Any, capsys: pytest.CaptureFixture[str]) -> None:
    summary = copy.deepcopy(short_run.summary)
    summary |= {"scenario": nasty, "status": nasty, "reason": nasty, "expected": nasty, "as_expected": False}
    summary["controller"] |= {"name": nasty, "solver": nasty, "statuses": {nasty: 3}}
    summary["course"]["sentence"] = nasty
    for entry in summary["constraints"]:
        entry |= {"name": nasty, "unit": nasty}
    console.print_summary(summary, where=nasty)
    console.print_notice(nasty)
    console.say(nasty)
    console.print_listing({nasty: {nasty: nasty}})
    cells = tuple(Cell(text=nasty, mark=mark) for mark in (Mark.NONE, Mark.BAD))
    row = Row(group=nasty, label="outcome", unit=nasty, cells=cells, headline=True)
    console.print_comparison([row], [nasty, nasty], nasty)
    console.print_grids([Grid(key="k", title=nasty, head=(nasty, nasty), lines=(cells,), note=nasty)], nasty)
    campaign_console.print_replay(3, {"a": 1}, [nasty])
    print(to_markdown([row], [nasty, nasty]))
    output = capsys.readouterr()
    assert is_plain(output.out + output.err)
    assert output.out.count(printable(nasty)) > 20


def test_a_path_with_markup_is_written_and_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("a[/b]c", "[bold]", "x[red]y"):
        out = tmp_path / name
        assert main(["run", "hover", "--set", "duration=0.1", *TABLES, "--out", str(out)]) == EXIT_DONE
        assert f"written to {out}" in capsys.readouterr().out


@pytest.mark.parametrize("nasty", NASTY)
def test_a_reason_in_a_run_of_others_is_shown_as_text(
    nasty: str, tmp_path: Path, short_run_directory: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """An aborted flight of an older version, whose reason someone wrote."""
    run = shutil.copytree(short_run_directory, tmp_path / "run")
    summary = json.loads((run / "summary.json").read_text())
    summary |= {"status": "aborted", "reason": nasty, "verdict": "lost", "satisfied": False, "as_expected": False}
    (run / "summary.json").write_text(json.dumps(summary))
    status = main(["check", str(run), "--junit", str(tmp_path / "junit.xml")])
    output = capsys.readouterr()
    assert is_plain(output.out + output.err)
    if nasty == "\ud800":  # which no file may hold
        assert status == EXIT_WRONG_INPUT
        assert "surrogates not allowed" in output.err
    else:
        assert status == 1
        assert f"aborted: {printable(nasty)}" in output.out.replace("\n", " ") + output.out
        failure = ElementTree.parse(tmp_path / "junit.xml").getroot()[0][0]
        assert failure.get("message") == printable(nasty)


@pytest.mark.parametrize("nasty", [*NASTY, "\x0b", "\uffff", "\ufffe"])
def test_junit_is_valid_xml_whatever_names_hold(nasty: str, tmp_path: Path) -> None:
    cases = [(nasty, True, nasty), (nasty, False, nasty)]
    write_cases(nasty, cases, tmp_path / "a.xml")
    root = ElementTree.parse(tmp_path / "a.xml").getroot()
    assert [case.get("name") for case in root] == [printable(nasty)] * 2
    assert root.get("name") == f"quadsim.{printable(nasty)}"


@pytest.mark.parametrize("nasty", NASTY)
def test_messages_name_paths_as_text(nasty: str) -> None:
    for error in (FileError(nasty, "is wrong"), OutputError(nasty, "full"), FlightError(nasty, time=1.0)):
        assert printable(nasty) in str(error)
        assert is_plain(str(error))
        assert "\n" not in str(error)


@pytest.mark.parametrize(
    "arguments", [["run", "\x1b[31m.toml"], ["check", "a\x1b[0m"], ["\x1b[1mfly"], ["list", "\x07"]]
)
def test_arguments_are_shown_as_text(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    try:
        status = main(arguments)
    except SystemExit as leaving:
        status = int(leaving.code or 0)
    assert status == EXIT_WRONG_INPUT
    assert is_plain(capsys.readouterr().err)


@pytest.mark.parametrize("nasty", NASTY)
def test_a_controller_of_the_user_names_itself_as_text(nasty: str) -> None:
    class Law:
        name = nasty
        solver = nasty

        def step(self, now: Moment, state: Array, reference: Array) -> Command:
            return Command(speeds=state[:4], plan=reference[:1], status=nasty)

    law = PluginController(Law(), horizon=1)
    assert law.name == law.solver == printable(nasty)


@pytest.mark.usefixtures("undrawn")
def test_folders_of_any_name_are_compared_and_checked(
    tmp_path: Path,
    short_run_directory: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    r"""Runs of such names in such a folder; `\udcff` is how Python names a byte that is no UTF-8."""
    names = ["[bold]run", "a\nb", "run\udcff", "\x1b[31mred", "\u202eevil"]
    folder = tmp_path.joinpath(*names)
    runs = [shutil.copytree(short_run_directory, folder / each) for each in names]
    page = folder / "page"
    assert main(["compare", *map(str, runs), "--out", str(page)]) == EXIT_DONE
    assert main(["compare", *map(str, runs), "--out", str(page), "--overwrite", "--markdown"]) == EXIT_DONE
    for run in runs:
        assert main(["check", str(run)]) == 1  # its windows are not reached
    output = capsys.readouterr()
    for text in (output.out, output.err, (page / "comparison.md").read_text()):
        assert is_plain(text)
    for name in names:
        assert printable(name) in (page / "index.html").read_text()


@pytest.mark.usefixtures("undrawn")
def test_a_run_is_written_to_a_folder_whose_name_is_no_unicode(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run\udcff"
    assert main(["run", "hover", "--set", "duration=0.2", "--no-video", "--out", str(out)]) == EXIT_DONE
    assert r"run\udcff" in capsys.readouterr().out
    assert main(["check", str(out)]) == EXIT_DONE
