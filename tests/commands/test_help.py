"""Every command's help says what it does, and ends with examples that can be typed."""

from __future__ import annotations

import re
import shlex

import pytest

from quadsim.commands.app import app
from quadsim.commands.cli import main

COMMANDS = sorted(name for name in app if not name.startswith("-"))


@pytest.mark.parametrize("command", COMMANDS)
def test_the_help_of_a_command_has_examples_that_can_be_typed(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([command, "--help"]) == 0
    text = re.sub(r" *\n(?! *quadsim )", " ", capsys.readouterr().out.partition("examples:")[2])
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    assert lines
    for line in lines:
        words = shlex.split(line.partition(" > ")[0])
        assert words[:2] == ["quadsim", command]
        app.meta(words[1:], exit_on_error=False, print_error=False, result_action="return_value")  # parsed, not called


@pytest.mark.parametrize("command", COMMANDS)
def test_the_help_shows_no_option_that_takes_a_python_object(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([command, "--help"]) == 0
    shown = set(re.findall(r"--[a-z-]+", capsys.readouterr().out))
    assert not shown & {"--fields", "--vary", "--forces", "--reference", "--flown", "--progress", "--autopilot"}
