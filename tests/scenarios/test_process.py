"""The command line as a process: signals, streams that are closed or full, and what is left when it is stopped."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time as clock
from pathlib import Path

import psutil
import pytest

from quadsim.flight import rundir
from scenarios.commands import EXIT_DONE, EXIT_FAILED, EXIT_WRONG_INPUT

ROOT = Path(__file__).resolve().parents[2]
TABLES = ("--no-video", "--no-recording", "--no-figures")
SHORT = ("--set", "duration=0.5")


def environment() -> dict[str, str]:
    return os.environ | {"PYTHONPATH": str(ROOT)}


def quadsim(*arguments: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "scenarios.cli", *arguments]
    return subprocess.run(command, cwd=cwd, env=environment(), capture_output=True, text=True, check=False, timeout=60)


def test_a_process_prints_one_message_and_no_traceback(tmp_path: Path) -> None:
    done = quadsim("run", "hover", "--set", "controller.horizon=0", cwd=tmp_path)
    assert (done.returncode, done.stdout) == (EXIT_WRONG_INPUT, "")
    assert done.stderr == "quadsim: hover.toml: controller.horizon must be >= 1; got 0\n"
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("options", [[], ["--json"]])
def test_a_reader_that_goes_away_gets_no_traceback_and_no_status_0(options: list[str]) -> None:
    """`quadsim list | true`."""
    command = [sys.executable, "-m", "scenarios.cli", "list", *options]
    process = subprocess.Popen(command, env=environment(), stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    assert process.stdout is not None
    assert process.stderr is not None
    process.stdout.close()
    output = process.stderr.read()
    process.stderr.close()
    assert (process.wait(timeout=60), output) == (EXIT_FAILED, b"")


ITSELF = """
import os, signal, sys, threading
from scenarios.entry import main
after, stop = float(sys.argv[1]), int(sys.argv[2])
timers = [threading.Timer(after, os.kill, (os.getpid(), stop))]
listen = signal.signal
def listening(which, handler):
    before = listen(which, handler)
    if which == signal.SIGHUP and timers:  # the last that is listened to
        timers.pop().start()
    return before
signal.signal = listening
if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN:
    timers.pop().start()
sys.argv[:] = ["quadsim", *sys.argv[3:]]
sys.exit(main())
"""


@pytest.mark.parametrize(
    ("stop", "delay"),
    [
        *((signal.SIGINT, delay) for delay in (0.0, 0.03, 0.3)),
        (signal.SIGTERM, 0.1),
        (signal.SIGHUP, 0.0),
    ],
)
def test_a_signal_in_the_first_moments_ends_it_in_order(tmp_path: Path, stop: signal.Signals, delay: float) -> None:
    done = subprocess.run(
        [sys.executable, "-c", ITSELF, str(delay), str(int(stop)), "run", "hover", "--set", "duration=600"],
        cwd=tmp_path,
        env=environment(),
        capture_output=True,
        text=True,
        timeout=60,
        preexec_fn=listening,
    )
    assert done.returncode == EXIT_FAILED, done.stderr
    assert "Traceback" not in done.stderr
    assert "interrupted (Ctrl-C)" in done.stderr + done.stdout
    assert {path.name for path in tmp_path.iterdir()} <= {"runs"}


SWALLOWED = """
import os, signal, sys, time
from scenarios import cli, entry
class Dying:
    def __del__(self):
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(0.1)
def run():
    Dying()
    time.sleep(5)
    return 0
cli.main = run
sys.exit(entry.main())
"""


def test_a_stop_that_python_ignores_is_heard(tmp_path: Path) -> None:
    """It does so in destructors and callbacks, of which imports have many."""
    done = subprocess.run(
        [sys.executable, "-c", SWALLOWED],
        cwd=tmp_path,
        env=environment(),
        capture_output=True,
        timeout=60,
        preexec_fn=listening,
    )
    assert done.returncode == EXIT_FAILED
    assert done.stderr.startswith(b"quadsim: interrupted (Ctrl-C)")


DISPENSABLE = """
import os, signal, time
try:
    os.kill(os.getpid(), signal.SIGINT)
    time.sleep(0.1)
except KeyboardInterrupt:
    raise ImportError("as of a compiled module") from None
"""
ENDLESS = """
import os, signal
os.kill(os.getpid(), signal.SIGINT)
while True:
    pass
"""
IMPORTING = """
import sys, time
from scenarios import cli, entry
def run():
    try:
        import module
    except ImportError:
        pass
    time.sleep(5)
    return 0
cli.main = run
entry._LONGEST_IMPORT_S = 1.0
sys.exit(entry.main())
"""


@pytest.mark.parametrize("module", [DISPENSABLE, ENDLESS])
def test_a_stop_within_an_import_is_heard(tmp_path: Path, module: str) -> None:
    (tmp_path / "module.py").write_text(module)
    done = subprocess.run(
        [sys.executable, "-c", IMPORTING],
        cwd=tmp_path,
        env=environment(),
        capture_output=True,
        timeout=60,
        preexec_fn=listening,
    )
    assert done.returncode == EXIT_FAILED
    assert done.stderr.startswith(b"quadsim: interrupted (Ctrl-C)")


def spent(process: subprocess.Popen[str]) -> float:
    """Processor time of a process until now [s]."""
    times = psutil.Process(process.pid).cpu_times()
    return float(times.user + times.system)


def listening() -> None:
    """A shell's `&` has these signals ignored."""
    for stop in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(stop, signal.SIG_DFL)


def test_who_was_started_by_nohup_goes_on(tmp_path: Path) -> None:
    command = [sys.executable, "-c", ITSELF, "0.5", str(int(signal.SIGHUP)), "run", "hover", *TABLES, *SHORT]
    done = subprocess.run(
        command,
        cwd=tmp_path,
        env=environment(),
        capture_output=True,
        timeout=60,
        preexec_fn=lambda: signal.signal(signal.SIGHUP, signal.SIG_IGN),
    )
    assert (done.returncode, done.stderr) == (EXIT_DONE, b"")


@pytest.mark.parametrize("closed", [(1,), (0, 1, 2), (0, 2)])
def test_closed_streams_do_no_harm(tmp_path: Path, closed: tuple[int, ...]) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "scenarios.cli", "run", "hover", *TABLES, *SHORT, "--out", "run"],
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
        rundir.load_run(tmp_path / "run")


def test_characters_that_a_terminal_lacks_are_spelt_out(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "scenarios.cli", "check", "hover", *SHORT],
        cwd=tmp_path,
        env=environment() | {"PYTHONIOENCODING": "ascii"},
        capture_output=True,
        timeout=60,
    )
    assert (done.returncode, done.stderr) == (EXIT_DONE, b"")
    assert rb"\xb15" in done.stdout  # of the bounds on roll


def test_a_long_flight_that_is_stopped_is_saved_up_to_there(tmp_path: Path) -> None:
    process = subprocess.Popen(
        [sys.executable, "-m", "scenarios.cli", "run", "hover", *TABLES, "--set", "duration=1800", "--out", "run"],
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
    assert (process.returncode, err) == (EXIT_FAILED, "")
    assert "interrupted (Ctrl-C)" in out
    assert [path.name for path in tmp_path.iterdir()] == ["run"]
    run = rundir.load_run(tmp_path / "run")
    assert run.summary["status"] == "aborted"
    assert run.summary["reason"].endswith("interrupted (Ctrl-C)")
    assert 0.0 < run.summary["duration"] < 1800.0
    assert run.log.control.t.size * 0.05 == pytest.approx(run.summary["duration"])
    assert run.log.plant.t[-1] == pytest.approx(run.summary["duration"])
    assert rundir.damaged_files(run.directory, run.summary) == []


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full to write to")
def test_output_that_cannot_be_written_is_reported() -> None:
    with Path("/dev/full").open("w") as full:
        command = [sys.executable, "-m", "scenarios.cli", "list", "--json"]
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, cwd=ROOT)
    assert done.stderr == "quadsim: cannot write the output: No space left on device\n"
    assert done.returncode == EXIT_WRONG_INPUT
