"""A flight that was flown is never lost, whatever controller, film or pilot do: through the real command."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import time as clock
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

import quadsim
from quadsim.flight import rundir
from quadsim.vehicle import Vehicle

pytestmark = pytest.mark.slow("process")

LAW = """
import os, signal, sys, time
class Law:
    def __init__(self, vehicle, **settings):
        self.speeds = [vehicle.hover_speed] * 4
    def step(self, now, state, reference):
        if now.time > 0.94:
            {late}
        return self.speeds
"""
BARE = ("--no-video", "--no-recording", "--no-figures")
OWN = ("--set", "duration=1.0", "--set", "constraints=[]", "--set", 'controller="late:Law"')


def quadsim_command(*arguments: str, here: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "quadsim.commands.entry", *arguments]
    env = {**os.environ, **environment}
    return subprocess.run(command, cwd=here, env=env, capture_output=True, text=True, timeout=300, check=False)


def summary_of(run: Path) -> dict[str, Any]:
    """The summary of a run whose files are all as it lists them."""
    summary = rundir.read_summary(run)
    assert rundir.damaged_files(run, summary) == []
    assert {"flight.parquet", "timing.parquet", "plant.parquet", "scenario.toml"} <= set(summary["files"])
    return summary


def test_a_controller_that_raises_ends_its_flight_as_aborted(tmp_path: Path) -> None:
    late = "raise ValueError('half way')"
    last = "ValueError: half way"
    (tmp_path / "late.py").write_text(LAW.format(late=late))
    done = quadsim_command("run", "hover", *OWN, *BARE, here=tmp_path)
    assert done.returncode == 1, done.stderr
    summary = summary_of(tmp_path / "runs" / "hover")
    assert (summary["status"], summary["verdict"], summary["duration"]) == ("aborted", "aborted", 0.95)
    assert summary["reason"] == f"at t = 0.950 s: the controller raised {last}"
    assert summary["traceback"][-1] == last
    assert late in summary["traceback"][-2] or late in summary["traceback"][-3]
    assert last in done.stdout
    read = quadsim.read(tmp_path / "runs" / "hover")
    assert (read.outcome, read.time.size, read.log.traceback) == ("aborted", 19, tuple(summary["traceback"]))
    checked = quadsim_command("check", "runs/hover", "--junit", "of_run.xml", here=tmp_path)
    assert checked.returncode == 1
    failure = ElementTree.parse(tmp_path / "of_run.xml").find("testcase[@name='flight']/failure")
    assert failure is not None
    assert last in failure.get("message", "")


def test_a_module_that_exits_does_not_pass_a_check(tmp_path: Path) -> None:
    (tmp_path / "late.py").write_text(LAW.format(late="pass") + "sys.exit(0)\n")
    done = quadsim_command("check", "hover", *OWN, "--junit", "v.xml", here=tmp_path)
    assert (done.returncode, (tmp_path / "v.xml").exists()) == (2, False)


@pytest.mark.representative("process")
def test_an_inner_loop_that_raises_ends_the_flight_there() -> None:
    class Inner:
        rate = 500.0

        def speeds(self, *_: object) -> list[float]:
            raise RuntimeError("inner")

    def law(now: quadsim.StepInputs, state: object, reference: np.ndarray[Any, Any]) -> quadsim.Command:
        speeds = np.full(4, 192.8)
        inner = Inner() if now.time > 0.38 else None
        return quadsim.Command(speeds=speeds, plan=speeds[None].repeat(len(reference), 0), inner=inner)

    flown = quadsim.fly(quadsim.load("hover", {"duration": 1.0}), controller=law, progress=False)
    assert (flown.outcome, flown.time.size) == ("aborted", 8)
    assert "RuntimeError: inner" in str(flown.log.reason)


def test_a_prediction_or_a_diagnosis_that_raises_loses_that_alone(caplog: pytest.LogCaptureFixture) -> None:
    class Law:
        infeasible_period = property(lambda self: 1 / 0)

        def __init__(self, vehicle: Vehicle, **settings: object) -> None:
            self.speeds = [vehicle.hover_speed] * 4

        def step(self, now: object, state: object, reference: object) -> list[float]:
            return self.speeds

        def predict(self, states: object, plans: object) -> object:
            raise IndexError("too far")

    flown = quadsim.fly(quadsim.load("hover", {"duration": 1.0}), controller=Law, progress=False)
    assert (flown.outcome, flown.time.size) == ("satisfied", 20)
    assert (flown.log.predicted, flown.diagnosis) == (None, None)
    assert "ZeroDivisionError" in caplog.text


def test_a_law_that_raises_as_it_takes_over_ends_the_flight_there(tmp_path: Path) -> None:
    (tmp_path / "late.py").write_text(LAW.format(late="pass") + "    def reset(self, speeds):\n        1 / 0\n")
    event = {"type": "controller", "at": 0.5, "fields": {"type": "late:Law", "folder": str(tmp_path)}}
    scenario = quadsim.load("hover").replace({"duration": 1.0, "events": [event]})
    flown = quadsim.fly(scenario, progress=False)
    assert (flown.outcome, flown.time.size) == ("aborted", 10)
    assert "ZeroDivisionError" in "".join(flown.log.traceback)


BROKEN = {
    "no ffmpeg": ({"IMAGEIO_FFMPEG_EXE": "/bin/false"}, "flight.mp4", ("--no-recording", "--no-figures")),
    "no rerun": ({"RERUN": "off"}, "flight.rrd", ("--no-figures", "--no-video")),
}


@pytest.mark.parametrize(("environment", "product", "without"), BROKEN.values(), ids=BROKEN)
def test_a_product_that_fails_is_named_and_decides_the_status_only_if_asked_for(
    tmp_path: Path, environment: dict[str, str], product: str, without: tuple[str, ...]
) -> None:
    run = ("run", "hover", "--set", "duration=0.5", *without)
    done = quadsim_command(*run, "--json", here=tmp_path, **environment)
    assert done.returncode == 0, done.stderr
    summary = summary_of(tmp_path / "runs" / "hover")
    assert summary["products"][product].startswith("failed: ")
    assert f"{product} failed: " in done.stderr
    assert json.loads(done.stdout) == summary
    option = {"flight.mp4": "--video", "flight.rrd": "--recording"}[product]
    done = quadsim_command(*run, option, here=tmp_path, **environment)
    assert done.returncode == 2
    assert "Traceback" not in done.stderr
    assert summary_of(tmp_path / "runs" / "hover-2")["satisfied"] is True
    assert quadsim_command("check", "runs/hover-2", here=tmp_path).returncode == 0


def test_ctrl_c_while_a_film_is_made_keeps_what_was_flown(tmp_path: Path) -> None:
    (tmp_path / "late.py").write_text(LAW.format(late="pass"))
    options = ("--set", "duration=20.0", "--no-recording", "--no-figures")
    command = [sys.executable, "-m", "quadsim.commands.entry", "run", "hover", *OWN, *options]
    with subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.PIPE, text=True, start_new_session=True) as process:
        summary = tmp_path / "runs" / "hover" / "summary.json"
        started = clock.monotonic()
        while clock.monotonic() - started < 120.0 and not summary.exists():
            clock.sleep(0.1)
        clock.sleep(1.0)
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGINT)
        process.communicate(timeout=120)
    result = summary_of(summary.parent)
    assert [path.name for path in (tmp_path / "runs").iterdir()] == ["hover"]
    assert (process.returncode, result["verdict"]) == (130, "unaudited")
    assert result["products"]["flight.mp4"].startswith(("interrupted (Ctrl-C)", "failed: "))
