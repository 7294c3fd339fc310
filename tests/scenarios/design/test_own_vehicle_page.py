"""docs/own-vehicle.md: its commands lead from nothing to a good flight."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from scenarios.cli import main
from scenarios.commands import EXIT_DONE
from scenarios.design import first_scenario, tuning

PAGE = (Path(__file__).resolve().parents[3] / "docs" / "own-vehicle.md").read_text(encoding="utf-8")


def test_its_commands_end_with_a_good_flight(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    commands = re.findall(r"^quadsim (.*)$", PAGE.partition("```sh\n")[2].partition("```")[0], flags=re.MULTILINE)
    assert 3 <= len(commands) <= 5
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


def test_the_readme_names_the_same_commands() -> None:
    readme = (Path(__file__).resolve().parents[3] / "README.md").read_text(encoding="utf-8")
    named = [line.partition("#")[0].strip() for line in re.findall(r"^  (quadsim .*)$", readme, flags=re.MULTILINE)]
    assert len(named) == 3
    assert [line for line in named if line not in PAGE.splitlines()] == []


def test_its_rules_have_the_numbers_of_the_code() -> None:
    rows = PAGE.partition("## The rules")[2].partition("## Limits")[0]
    assert f"1 / ({tuning.LAG_RATIO:g} (T + tau / 2))" in rows
    assert f"and {tuning.FASTEST:g} rad/s" in rows
    assert f"w tau <= {tuning.PERIOD_SHARE:g}" in rows
    assert ", ".join(f"{1e3 * period:g}" for period in tuning.PERIODS) + " ms" in rows
    assert f"{tuning.HORIZON_TIMES:g} / (w tau)" in rows
    assert f"or where {100 * tuning.THRUST_SHARE:g} % of the thrust" in rows
    assert f"at most {tuning.HEIGHT_RATIO:g} w and {tuning.HEADING_RATIO:g} w" in rows
    assert f"as speeds cost at {tuning.MOVE_RATIO:g} w" in rows
    assert f"at most {100 * first_scenario.ROOM:g} % of the course's size" in rows
    assert f"{first_scenario.LOWEST:g} m, or {first_scenario.CLEARANCE:g} times the largest error allowed" in rows
    assert f"at most {100 * first_scenario.BASELINE_SHARE:g} % of the tilt bound" in rows
    assert f"`lqr`: {first_scenario.LQR_TILT:g} deg" in rows
    assert f"the next {first_scenario.PREVIEW:g} / w; an MPC's horizon is {tuning.HORIZON_TIMES:g} / w" in rows
    assert first_scenario.LAG_SHARE == 0.5, "half, in words"
    assert f"{100 * first_scenario.SHARE:g} % of the level acceleration within the tilt bound" in rows
    assert f"turns with {first_scenario.EIGHT_RATIO:g} w | M of {1.0 / (1.0 - first_scenario.SHARE):g} or more" in rows
