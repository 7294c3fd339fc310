"""Long work says how far it is: by bars on a terminal, by a line every ten seconds elsewhere."""

from __future__ import annotations

import io
from collections.abc import Iterator

import pytest

from scenarios import console
from scenarios.campaign.campaign import CampaignProgress
from scenarios.console import PlainConsole
from scenarios.progress import reporting, watching


class Clock:
    """Shows what it is told."""

    now = 0.0

    def perf_counter(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Iterator[Clock]:
    clock = Clock()
    monkeypatch.setattr("scenarios.progress.clock", clock)
    return clock


def test_elsewhere_a_line_comes_every_ten_seconds(clock: Clock, capsys: pytest.CaptureFixture[str]) -> None:
    with reporting(True) as report:
        for second in range(1, 31):
            clock.now = float(second)
            report("flight" if second < 25 else "video", second, 40)
    assert capsys.readouterr().err.splitlines() == [
        "quadsim: flight 25 %",
        "quadsim: flight 50 %",
        "quadsim: video 75 %",
    ]


def test_no_progress_is_silent(clock: Clock, capsys: pytest.CaptureFixture[str]) -> None:
    with reporting(False) as report:
        clock.now = 100.0
        report("flight", 1, 2)
    assert capsys.readouterr().err == ""


def test_a_campaign_says_a_line_every_ten_seconds(clock: Clock, capsys: pytest.CaptureFixture[str]) -> None:
    with watching(True) as watch:
        for flown in range(1, 26):
            clock.now = float(flown)
            watch(CampaignProgress(flown=flown, flights=25, failed=0, rate=1.0))
    starts = [line.partition(",")[0] for line in capsys.readouterr().err.splitlines()]
    assert starts == ["10/25", "20/25", "25/25"]


def test_a_terminal_has_bars(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TERM", "xterm")
    shown = io.StringIO()
    screen = PlainConsole(file=shown, width=80)
    screen._force_terminal, screen.is_interactive = True, True
    monkeypatch.setattr(console, "stderr", lambda: screen)
    with reporting(True) as report:
        report("flight", 1, 4)
        report("video", 3, 4)
    assert "flight" in shown.getvalue()
    assert "75 %" in shown.getvalue()
