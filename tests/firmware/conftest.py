"""Exported controllers, compiled; what takes a tool that is not installed is skipped, in CI an error."""

from __future__ import annotations

import functools
import json
import re
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from quadsim.features.export.exporter import export
from quadsim.mpc.export.ctext import Precision
from quadsim.mpc.export.targets import TARGETS
from quadsim.scenarios.loading import load_scenario

Answer = tuple[str, ...]
"""Number, status, changes, four commands, ticks, as main.c prints them."""
EVERY_PERIOD = "CPPFLAGS=-DPRINT_PERIODS=1"
"""Setting of an export's Makefile with which `make check` prints the answer to every period."""
Export = Callable[..., Path]
Answers = Callable[..., list[Answer]]
Run = Callable[..., subprocess.CompletedProcess[str]]
Measured = Callable[..., None]
MEASURED = Path(__file__).resolve().parents[2] / "runs" / "numbers" / "export.json"
"""What docs/tools/remake.py fills the table of docs/export.md from."""


def sources_of(directory: Path) -> list[Path]:
    """The controller's own C files in an export."""
    return sorted(directory.glob("quadsim_*.c"))


def defines_of(directory: Path) -> list[str]:
    """Flags that its files take, as its Makefile states them."""
    (line,) = re.findall(r"^DEFINES = ?(.*)$", (directory / "Makefile").read_text(), re.MULTILINE)
    return str(line).split()


@pytest.fixture(scope="session")
def run() -> Run:
    """Runs a command; skips where its program is not installed; fails with its output unless `check` is false."""

    def call(*command: object, check: bool = True, **options: object) -> subprocess.CompletedProcess[str]:
        words = [str(word) for word in command]
        if shutil.which(words[0]) is None:
            pytest.skip(f"{words[0]} is not installed: make firmware")
        options = {"timeout": 900, **options}
        done = subprocess.run(words, capture_output=True, text=True, **options)  # type: ignore[call-overload]
        assert done.returncode == 0 or not check, "\n".join([*words, done.stdout[-2000:], done.stderr[-4000:]])
        return done

    return call


@pytest.fixture(scope="session")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Export:
    """The export of a scenario with settings, for a target and in a precision; each is written once."""

    @functools.cache
    def write(target: str, precision: Precision, *settings: str, scenario: str = "paper-constrained") -> Path:
        result = load_scenario(scenario, list(settings))
        return export(result, tmp_path_factory.mktemp("export") / "c", precision=precision, target=target)

    return write


@pytest.fixture(scope="session")
def answers(exported: Export, run: Run, tmp_path_factory: pytest.TempPathFactory) -> Answers:
    """What a target answers to all recorded periods, built with settings of its Makefile; each is run once."""

    @functools.cache
    def check(target: str, precision: Precision, *make: str, scenario: str = "paper-constrained") -> list[Answer]:
        directory = tmp_path_factory.mktemp("build") / "c"
        shutil.copytree(exported(target, precision, scenario=scenario), directory)
        if TARGETS[target].board:
            run(TARGETS[target].compiler, "--version")
            run("qemu-system-arm", "--version")
        done = run("make", "-C", directory, "check", *make, EVERY_PERIOD)
        lines = [tuple(line.split()) for line in (done.stdout + done.stderr).splitlines()]
        return [line for line in lines if len(line) == 8]

    return check


@pytest.fixture
def measured(record_property: Callable[[str, object], None]) -> Measured:
    """Reports what a controller takes on a board."""

    def report(law: str, board: str, precision: str, **numbers: float) -> None:
        key = {"law": law, "target": TARGETS[board].title, "precision": precision}
        record_property("measured", key | {name: int(number) for name, number in numbers.items()})

    return report


def pytest_terminal_summary(terminalreporter: Any) -> None:
    """Save what was measured, once every board was."""
    reports = terminalreporter.getreports("passed")
    result = [value for report in reports for name, value in report.user_properties if name == "measured"]
    boards: dict[tuple[str, str, str], dict[str, Any]] = {}
    for numbers in result:
        boards.setdefault((numbers["law"], numbers["target"], numbers["precision"]), {}).update(numbers)
    if boards and all({"flash", "p50"} <= numbers.keys() for numbers in boards.values()):
        MEASURED.parent.mkdir(parents=True, exist_ok=True)
        MEASURED.write_text(json.dumps([boards[key] for key in sorted(boards)], indent=1), encoding="utf-8")
