"""A soak of three short laps, in a process of its own; the hour is `python tests/soak.py --minutes 60`."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import soak

SCRIPT = Path(soak.__file__)


def measured(memory: list[float], medians: list[float]) -> soak.Soak:
    """A made-up soak of laps of 20 steps each."""
    step_ms = np.repeat(medians, 20)
    return soak.Soak(minutes=1.0, memory=np.array(memory), step_ms=step_ms, failures=0, end_error=0.0, laps_compared=1)


def test_a_leak_and_a_slowdown_are_reported() -> None:
    found = measured([100.0, 101.0, 103.0], [9.0, 2.0, 3.0])
    assert found.growth == pytest.approx(0.03)
    assert found.medians == (2.0, 3.0)  # the first lap warms up
    assert found.drift == pytest.approx(0.5)


@pytest.mark.skipif(not soak.MEMORY.exists(), reason="this system does not report a process's memory")
def test_three_laps_leave_memory_and_step_time_as_they_were() -> None:
    """Step times of a busy machine wander by tens of percent; the hour requires a tenth."""
    command = [sys.executable, str(SCRIPT), "--minutes", "3", "--lap", "15", "--drift", "0.6"]
    done = subprocess.run(command, cwd=SCRIPT.parent.parent, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, ""), done.stdout + done.stderr
    assert "900 steps, 0 without an optimum" in done.stdout


def test_too_short_a_soak_is_refused(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(sys, "argv", ["soak", "--minutes", "2"])
    with pytest.raises(SystemExit):
        soak.main()
    assert "--minutes: must be at least 3; got 2" in capsys.readouterr().err
