"""Long work says how far it is: by bars on a terminal, by a line every ten seconds elsewhere."""

from __future__ import annotations

import io
import time as clock
from collections.abc import Callable, Iterator

import pytest

from quadsim.console import console
from quadsim.console.console import PlainConsole
from quadsim.console.progress import reporting
from quadsim.features.campaign.campaign import CampaignProgress
from quadsim.features.campaign.watching import watching


@pytest.fixture
def lines(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[], list[str]]]:
    """Has a line come often, and returns the lines once two more have come."""
    monkeypatch.setattr("quadsim.console.progress.LINE_EVERY", 0.02)
    shown = io.StringIO()
    monkeypatch.setattr(console, "stderr", lambda: PlainConsole(stderr=True, file=shown))

    def wait() -> list[str]:
        there = shown.getvalue().count("\n")
        deadline = clock.monotonic() + 20.0
        while shown.getvalue().count("\n") < there + 2 and clock.monotonic() < deadline:
            clock.sleep(0.01)
        return shown.getvalue().splitlines()

    yield wait
    there = shown.getvalue()
    clock.sleep(0.1)
    assert shown.getvalue() == there, "it is over"


def test_elsewhere_lines_say_what_is_done_however_long_it_takes(lines: Callable[[], list[str]]) -> None:
    with reporting(True, "the flight") as report:
        assert lines()[-1] == "quadsim: starting the flight, 0 s so far"
        report("flight", 10, 40)
        assert lines()[-1] == "quadsim: flight 25 %, 0 s so far"
        report("figures", 0, 1)
        assert lines()[-1] == "quadsim: figures, 0 s so far"


def test_a_first_use_says_that_it_compiles(lines: Callable[[], list[str]], monkeypatch: pytest.MonkeyPatch) -> None:
    with reporting(True, "the flight"):
        monkeypatch.setattr("quadsim.console.progress.is_compiling", lambda: True)
        assert lines()[-1] == "quadsim: compiling the C library, 0 s so far"


def test_no_progress_is_silent(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr("quadsim.console.progress.LINE_EVERY", 0.01)
    with reporting(False, "the flight") as report:
        report("flight", 1, 2)
        clock.sleep(0.1)
    assert capsys.readouterr().err == ""


def test_a_campaign_says_how_far_it_is(lines: Callable[[], list[str]]) -> None:
    with watching(True) as watch:
        watch(CampaignProgress(flown=10, flights=25, failed=0, rate=1.0))
        assert lines()[-1].startswith("quadsim: flights 10/25, 1.00/s, 0:00:15 left; 0 failed (")
        watch(CampaignProgress(flown=25, flights=25, failed=0, rate=1.0))
        assert lines()[-1] == "quadsim: report, 0 s so far"


def test_a_terminal_has_bars(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TERM", "xterm")
    shown = io.StringIO()
    screen = PlainConsole(file=shown, width=80)
    screen._force_terminal = True
    screen.is_interactive = True
    monkeypatch.setattr(console, "stderr", lambda: screen)
    with reporting(True, "the flight") as report:
        report("flight", 1, 4)
        report("figures", 0, 1)
        report("video", 3, 4)
    assert "flight" in shown.getvalue()
    assert "75 %" in shown.getvalue()
