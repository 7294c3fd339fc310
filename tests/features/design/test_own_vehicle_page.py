"""docs/own-vehicle.md: its commands lead from nothing to a good flight."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from quadsim.commands.cli import main
from quadsim.console.results import EXIT_DONE

PAGE = (Path(__file__).resolve().parents[3] / "docs" / "own-vehicle.md").read_text(encoding="utf-8")


@pytest.mark.slow("pages")
def test_its_commands_end_with_a_good_flight(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    commands = re.findall(r"^quadsim (.*)$", PAGE.partition("```sh\n")[2].partition("```")[0], flags=re.MULTILINE)
    output = ""
    for command in commands:
        line, _, file = command.partition(" > ")
        arguments = line.split()
        if arguments[0] == "run":
            arguments += ["--no-video", "--no-recording", "--no-figures", "--json"]
        assert main(arguments) == EXIT_DONE, command
        output = capsys.readouterr().out
        if file:
            Path(file).write_text(output, encoding="utf-8")
        if "--scenario" in arguments:
            assert "hover is 495.2 rad/s, the scenario allows 250" in " ".join(output.split())
    summary = json.loads(output)
    assert summary["satisfied"] is True
    assert max(summary["tracking"]["rmse"][axis] for axis in "xyz") < 0.05
