"""The command line as a process: signals, streams that are closed or full, and what is left when it is stopped."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import sysconfig
import time as clock
from importlib import metadata
from pathlib import Path

import psutil
import pytest

from quadsim.console.results import EXIT_DONE, EXIT_FAILED, EXIT_WRONG_INPUT
from quadsim.flight import rundir
from quadsim.rollout.stored import read_flight

pytestmark = pytest.mark.slow("process")

ROOT = Path(__file__).resolve().parents[2]
TABLES = ("--no-video", "--no-recording", "--no-figures")
SHORT = ("--set", "duration=0.5")
MOMENTS = 12
TERMINATED = 143
"""Exit status, as of a shell: 128 and the number of the signal."""


def environment() -> dict[str, str]:
    return os.environ | {"PYTHONPATH": str(ROOT)}


@pytest.mark.representative("process")
def test_a_reader_that_goes_away_gets_no_traceback_and_no_status_0() -> None:
    """`quadsim list | true`."""
    command = [sys.executable, "-m", "quadsim.commands.entry", "list"]
    process = subprocess.Popen(command, env=environment(), stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    assert process.stdout is not None
    assert process.stderr is not None
    process.stdout.close()
    output = process.stderr.read()
    process.stderr.close()
    assert (process.wait(timeout=60), output) == (EXIT_FAILED, b"")


@pytest.mark.representative("process")
@pytest.mark.parametrize("words", [["--version"], ["no-such-command"]])
def test_the_package_is_a_command_too(words: list[str]) -> None:
    script = [str(Path(sysconfig.get_path("scripts")) / "quadsim")]
    results = []
    for command in (script, [sys.executable, "-m", "quadsim"]):
        done = subprocess.run([*command, *words], env=environment(), capture_output=True, text=True, check=False)
        results.append((done.returncode, done.stdout, done.stderr))
    assert results[0] == results[1]


HELD = "import numpy as np\ndef held(now, state, reference):\n    import random\n    return np.full(4, 192.8)\n"


@pytest.fixture
def trapped(tmp_path: Path) -> Path:
    """A folder with a file of the name of every module there is, which notes that it was executed."""
    modules = {*sys.stdlib_module_names, *metadata.packages_distributions(), "quadsim"}
    for name in modules - {"__main__"}:
        (tmp_path / f"{name}.py").write_text(f"open({str(tmp_path / 'executed')!r}, 'a').write(__name__ + '\\n')\n")
    return tmp_path


def test_no_command_imports_from_the_current_directory(trapped: Path) -> None:
    """But for a controller that was named, whose own imports find what is installed first."""
    (trapped / "my_law.py").write_text(HELD)
    settings = [*SHORT, "--set", "constraints=[]", "--set", "controller='my_law:held'"]
    done = subprocess.run(
        [Path(sysconfig.get_path("scripts")) / "quadsim", "run", "hover", *settings, "--no-video", "--out", "run"],
        cwd=trapped,
        capture_output=True,
        text=True,
        check=False,
        timeout=120.0,
    )
    executed = trapped / "executed"
    assert not executed.exists(), executed.read_text()
    notice, *_ = done.stderr.splitlines()  # then, where this takes its time, progress
    assert (done.returncode, notice) == (EXIT_DONE, f"quadsim: imported my_law from {trapped}/my_law.py")
    subprocess.run([sys.executable, "-c", "import mujoco"], cwd=trapped, check=False, capture_output=True)
    assert executed.read_text(), "else nothing above could fail"


def spent(process: subprocess.Popen[str]) -> float:
    """Processor time of a process until now [s]."""
    times = psutil.Process(process.pid).cpu_times()
    return float(times.user + times.system)


def listening() -> None:
    """A shell's `&` has these signals ignored."""
    for stop in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(stop, signal.SIG_DFL)


@pytest.mark.parametrize("closed", [(1,), (0, 2)])
def test_closed_streams_do_no_harm(tmp_path: Path, closed: tuple[int, ...]) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "quadsim.commands.entry", "run", "hover", *TABLES, *SHORT, "--out", "run"],
        cwd=tmp_path,
        env=environment(),
        capture_output=True,
        text=True,
        timeout=60,
        preexec_fn=lambda: [os.close(number) for number in closed],
    )
    if 1 in closed:
        message = "" if 2 in closed else "quadsim: stdout is closed; to do without what is printed: >/dev/null\n"
        assert (done.returncode, done.stderr, list(tmp_path.iterdir())) == (EXIT_WRONG_INPUT, message, [])
    else:
        assert (done.returncode, done.stderr) == (EXIT_DONE, "")
        read_flight(tmp_path / "run")


def test_a_long_flight_that_is_stopped_is_saved_up_to_there(tmp_path: Path) -> None:
    process = subprocess.Popen(
        [
            sys.executable,
            "-m",
            "quadsim.commands.entry",
            "run",
            "hover",
            *TABLES,
            "--set",
            "duration=1800",
            "--out",
            "run",
        ],
        cwd=tmp_path,
        env=environment(),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=listening,
    )
    deadline = clock.monotonic() + 30.0
    while not (tmp_path / "run").exists():
        assert clock.monotonic() < deadline, "the flight did not begin"
        clock.sleep(0.02)
    begun = spent(process)
    while spent(process) < begun + 0.3:  # however busy the machine is: it is built in a fifth of that
        assert clock.monotonic() < deadline + 60.0, "the flight does not go on"
        clock.sleep(0.02)
    process.send_signal(signal.SIGTERM)
    out, err = process.communicate(timeout=60)
    assert process.returncode == TERMINATED
    assert "SIGTERM" in err
    assert len(err.splitlines()) == 1
    assert "interrupted" in out
    assert [path.name for path in tmp_path.iterdir()] == ["run"]
    run = read_flight(tmp_path / "run")
    assert run.summary["status"] == "aborted"
    assert run.summary["reason"].endswith("interrupted (Ctrl-C)")
    assert 0.0 < run.summary["duration"] < 1800.0
    assert run.log.control.t.size * 0.05 == pytest.approx(run.summary["duration"])
    assert run.log.plant.t[-1] == pytest.approx(run.summary["duration"])
    assert rundir.damaged_files(run.directory, run.summary) == []


STOPPING = """
import atexit, importlib, os, signal, sys
place, caught, number = sys.argv.pop(1), sys.argv.pop(1) == "caught", int(sys.argv.pop(1))
module_name, name = place.rsplit(".", 1)
module = importlib.import_module(module_name)
whole = getattr(module, name)
def stopped(*arguments, **options):
    setattr(module, name, whole)
    try:
        os.kill(os.getpid(), number)
    except BaseException:
        if not caught:
            raise
    return whole(*arguments, **options)
setattr(module, name, stopped)
if name == "shutdown":
    atexit.register(stopped)
from quadsim.commands.entry import main
sys.exit(main())
"""
"""A command line that gets a signal where a function is called first."""


@pytest.mark.parametrize(
    ("place", "caught"),
    [
        ("quadsim.sim.loop.flight_log", ""),
        pytest.param("quadsim.rollout.rollout.audit", "", marks=pytest.mark.representative("process")),
        ("quadsim.rollout.rollout.audit", "caught"),
        ("quadsim.rollout.flown.summarise", ""),
        ("quadsim.rollout.flown.write_log", ""),
        ("quadsim.report.recording.write_recording", ""),
        ("quadsim.report.flight_figures.write_figures", ""),
        pytest.param(
            "quadsim.report.flight_figures.write_figures", "caught", marks=pytest.mark.representative("process")
        ),
        ("quadsim.rollout.flown.amend", ""),
        ("quadsim.console.console.show", ""),
        ("logging.shutdown", ""),
    ],
)
def test_a_command_that_is_stopped_never_ends_with_0_and_keeps_what_is_finished(
    tmp_path: Path, place: str, caught: str
) -> None:
    number = signal.SIGTERM if caught else signal.SIGINT
    command = [sys.executable, "-c", STOPPING, place, caught, str(int(number))]
    done = subprocess.run(
        [*command, "run", "hover", "--no-video", *SHORT, "--out", "run"],
        cwd=tmp_path,
        env=environment(),
        capture_output=True,
        text=True,
        timeout=120,
        preexec_fn=listening,
    )
    assert "Traceback" not in done.stderr
    if place == "logging.shutdown":  # all was said and done
        assert done.returncode == -number
    else:
        assert done.returncode == 128 + number
        said = "quadsim: interrupted (SIGTERM); " if caught else "quadsim: interrupted (Ctrl-C); "
        assert done.stderr.splitlines()[-1].startswith(said)
    assert [path.name for path in tmp_path.iterdir()] == ["run"]
    run = read_flight(tmp_path / "run")
    assert rundir.damaged_files(run.directory, run.summary) == []
    assert (run.summary["status"], run.log.control.t.size) == ("completed", 10)


def test_a_run_that_is_stopped_at_any_moment_ends_with_another_status_than_0(tmp_path: Path) -> None:
    def started(place: str) -> subprocess.Popen[str]:
        command = [sys.executable, "-m", "quadsim.commands.entry", "run", "hover", "--no-video", *SHORT]
        (tmp_path / place).mkdir()
        return subprocess.Popen(
            [*command, "--out", "run"],
            cwd=tmp_path / place,
            env=environment(),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            text=True,
            preexec_fn=listening,
        )

    begun = clock.monotonic()
    assert started("whole").wait(timeout=120) == EXIT_DONE
    whole = clock.monotonic() - begun
    for moment in range(MOMENTS):
        process = started(str(moment))
        try:
            process.wait(timeout=whole * (moment + 0.5) / MOMENTS)
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGTERM if moment % 2 else signal.SIGINT)
        status = process.wait(timeout=120)
        folder = tmp_path / str(moment)
        assert [path.name for path in folder.iterdir() if path.name != "run"] == []
        if (folder / "run").exists():
            summary = rundir.read_summary(folder / "run")
            assert rundir.damaged_files(folder / "run", summary) == []
        if status == EXIT_DONE:  # it was done before the signal
            assert set(summary["products"].values()) == {"made"}
            assert summary["status"] == "completed"


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full to write to")
def test_output_that_cannot_be_written_is_reported() -> None:
    with Path("/dev/full").open("w") as full:
        command = [sys.executable, "-m", "quadsim.commands.entry", "list", "--json"]
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, cwd=ROOT)
    assert done.stderr.endswith(": No space left on device\n")
    assert done.returncode == EXIT_WRONG_INPUT
