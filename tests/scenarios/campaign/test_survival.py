"""A campaign survives its controllers: limits, forks, memory, any process killed or stopped, and no process left."""

from __future__ import annotations

import contextlib
import ctypes
import gc
import json
import math
import mmap
import multiprocessing.forkserver
import os
import signal
import subprocess
import sys
import threading
import time as clock
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from multiprocessing import resource_tracker
from pathlib import Path

import numpy as np
import psutil
import pytest
import tomlkit
from campaign_pilots import ToyPilot, known, light_server, living, until, value_of
from hostile_controller import KINDS
from safety_campaign import measure, planned, write

from quadsim.sim.plant import Plant
from scenarios.campaign.engine.local import LocalEngine
from scenarios.campaign.engine.protocol import MOST_DEATHS
from scenarios.campaign.engine.worker import Traces
from scenarios.campaign.plan import load_plan
from scenarios.campaign.results.table import Row
from scenarios.campaign.results.verdicts import ERROR
from scenarios.campaign.spec import LimitsSpec
from scenarios.cli import main
from scenarios.commands import EXIT_DONE, EXIT_FAILED
from scenarios.progress import Progress, silent
from scenarios.schema.problems import ScenarioError

ROOT = Path(__file__).resolve().parents[3]


@pytest.fixture(scope="module", autouse=True)
def light() -> Iterator[None]:
    with light_server(__name__):
        yield


FLIGHTS = range(12)
ALL = [value_of(flight) for flight in FLIGHTS]


def test_hostile_flights_change_no_other_flight_and_leave_no_process() -> None:
    """Hang, fork, memory, exits, killed processes, in one campaign; see `tests/hostile_controller.py`."""
    counts = measure(60, workers=3, deaths=2)  # most of its time is waiting for limits
    assert counts["hostile"] == len(KINDS) >= 40
    assert counts["calm"] == 60 - len(KINDS) >= 12
    assert counts["rows differ"] == counts["unexpected verdicts"] == counts["leftover processes"] == 0, counts
    assert counts["hostile: timeout"] >= 5
    assert counts["hostile: memory"] == 4


@pytest.mark.usefixtures("sketched")
def test_flights_that_met_a_limit_stand_in_every_page_and_gate(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    file = write(tmp_path, ["hangs_in_python", "takes_memory_at_once", "calm"], armed=True)
    gate = ["--require", "P(timeout) < 0.01 @ 95%"]
    assert main(["campaign", str(file), "--out", "c", *gate]) == EXIT_FAILED
    output = " ".join(capsys.readouterr().out.split())
    assert "2 of 3 flights failed" in output  # violated is what counts by default
    assert "1 was ended since it took too long, 1 was ended since it took too much memory" in output
    summary = json.loads((tmp_path / "c" / "summary.json").read_text())
    assert [summary["verdicts"][name] for name in ("satisfied", "timeout", "memory")] == [1, 1, 1]
    assert [summary["events"][name]["count"] for name in ("failure", "timeout", "memory", "lost")] == [2, 1, 1, 0]
    assert [flight["verdict"] for flight in summary["worst"]] == ["timeout", "memory", "satisfied"]
    page = (tmp_path / "c" / "index.html").read_text(encoding="utf-8")
    assert "limits.step is 3 s" in page
    assert "limits.memory is 300 MB" in page
    assert main(["compare", "c", "c", "--out", "pairs"]) == EXIT_DONE


@pytest.mark.parametrize(
    ("limits", "message"),
    [
        ({"step": 0.0}, "limits.step must be > 0.0; got 0.0"),
        ({"memory": 10.0}, "limits.memory must be >= 100.0; got 10.0"),
        ({"flight": "long"}, "limits.flight must be a number; got 'long'"),
        ({"steps": 1.0}, "limits.steps is not a field"),
    ],
)
def test_limits_that_are_none_are_refused(limits: dict[str, object], message: str, tmp_path: Path) -> None:
    file = write(tmp_path, ["calm"], armed=False)
    data = tomlkit.parse(file.read_text())
    data["limits"] = limits
    file.write_text(tomlkit.dumps(data))
    with pytest.raises(ScenarioError) as refused:
        load_plan(str(file))
    assert message in str(refused.value)


def test_limits_have_defaults_that_are_written_out(tmp_path: Path) -> None:
    file = write(tmp_path, ["calm"], armed=False)
    data = tomlkit.parse(file.read_text())
    del data["limits"]
    file.write_text(tomlkit.dumps(data))
    plan = load_plan(str(file))
    assert plan.spec.limits == LimitsSpec(flight=600.0, step=60.0, memory=2000.0)
    assert "[limits]" in plan.spec.to_toml()


def test_calm_flights_stand_between_hostile_ones() -> None:
    kinds = planned(60)
    assert len(kinds) == 60
    assert sorted(kind for kind in kinds if kind != "calm") == sorted(KINDS)
    assert "calm" in kinds[:5]
    assert "calm" in kinds[-5:]


@dataclass(frozen=True, kw_only=True)
class Hostile(ToyPilot):
    """Does harm in flight 5, after the second of ten periods.

    Attributes:
        harm: what it does.
    """

    harm: Callable[[], object] = bool

    def fly(self, flight: int, progress: Progress = silent) -> Row:
        if self.diary is not None:
            with self.diary.open("a") as diary:
                diary.write(f"{flight} {os.getpid()}\n")
        for done in range(11):
            progress("flight", done, 10)
            if flight == 5 and done == 2:
                self.harm()
        return super().fly(flight)

    def lost(self, flight: int, reason: str, verdict: str = ERROR) -> Row:
        return {**super().lost(flight, reason), "verdict": verdict}


def fly(harm: Callable[[], object], diary: Path | None = None, **limits: float) -> tuple[Row, list[Row]]:
    """Row 5, and all others."""
    pilot = Hostile(harm=harm, diary=diary, limits=LimitsSpec(**limits))
    rows = known(list(LocalEngine(2).answers(pilot, FLIGHTS)))
    return rows[5], [row for row in rows if row["flight"] != 5]


OTHERS = [row for row in ALL if row["flight"] != 5]


def hang() -> None:
    while True:
        pass


def test_a_step_that_takes_too_long_is_ended_and_not_tried_again(tmp_path: Path) -> None:
    row, others = fly(hang, tmp_path / "diary", step=0.5)
    assert row["verdict"] == "timeout"
    assert row["reason"].startswith("a control period took ")
    assert row["reason"].endswith(" s, and limits.step is 0.5 s")
    assert others == OTHERS
    begun = [int(line.split()[0]) for line in (tmp_path / "diary").read_text().splitlines()]
    assert begun.count(5) == 1


class _Slow(Hostile):
    def fly(self, flight: int, progress: Progress = silent) -> Row:
        if flight == 5:
            for done in range(100):
                progress("flight", done, 100)
                clock.sleep(0.1)
        return ToyPilot.fly(self, flight)


def test_a_flight_that_takes_too_long_is_ended_though_its_steps_are_short() -> None:
    rows = known(list(LocalEngine(2).answers(_Slow(limits=LimitsSpec(flight=1.0, step=0.5)), FLIGHTS)))
    assert rows[5]["verdict"] == "timeout"
    assert rows[5]["reason"].endswith("s, and limits.flight is 1 s")
    assert [row for row in rows if row["flight"] != 5] == OTHERS


class _Late(Hostile):
    def fly(self, flight: int, progress: Progress = silent) -> Row:
        row = super().fly(flight, progress)
        clock.sleep(0.8 if flight == 5 else 0.0)
        return row


def test_what_comes_before_and_after_the_periods_is_no_step() -> None:
    assert known(list(LocalEngine(2).answers(_Late(limits=LimitsSpec(step=0.3)), FLIGHTS))) == ALL


def take_memory() -> None:
    np.ones(1_000_000_000)


def share_memory() -> None:
    held = []
    while True:
        held.append(mmap.mmap(-1, 1 << 24))
        held[-1].write(bytes(1 << 24))


@pytest.mark.parametrize(
    ("harm", "reason"),
    [(take_memory, "MemoryError"), (share_memory, "MB were held, and limits.memory is 200 MB")],
    ids=["its own", "shared"],
)
def test_too_much_memory_is_a_verdict(harm: Callable[[], object], reason: str) -> None:
    row, others = fly(harm, memory=200.0)
    assert row["verdict"] == "memory"
    assert reason in row["reason"]
    assert others == OTHERS


class _Sharing(ToyPilot):
    """In flight 1 its process and five children share 64 MB, which counted six times would be too much."""

    def fly(self, flight: int, progress: Progress = silent) -> Row:
        if flight == 1:
            shared, children = np.ones(8_000_000), []
            for _ in range(5):
                children.append(os.fork())
                if children[-1] == 0:
                    clock.sleep(100.0)
            clock.sleep(0.4)
            assert shared.size
            for child in children:
                os.kill(child, signal.SIGKILL)
                os.waitpid(child, 0)
        return super().fly(flight)


def test_memory_that_children_share_counts_once() -> None:
    assert known(list(LocalEngine(1).answers(_Sharing(limits=LimitsSpec(memory=300.0)), range(2)))) == ALL[:2]


def fork() -> None:
    os.fork()


def fork_and_hang() -> None:
    if os.fork() == 0:
        clock.sleep(100.0)


def leave_a_daemon() -> None:
    if os.fork() == 0:
        os.setsid()
        if os.fork() == 0:
            clock.sleep(100.0)
        os._exit(0)
    os.wait()


@pytest.mark.parametrize("harm", [fork, fork_and_hang, leave_a_daemon])
def test_children_of_a_controller_answer_nothing_and_end_with_its_flight(harm: Callable[[], None]) -> None:
    """The campaign goes on after flight 5, and children are gone as soon as its process is replaced."""
    ours = psutil.Process()
    rows: list[Row] = []
    for row in LocalEngine(1).answers(Hostile(harm=harm, asleep=0.02), FLIGHTS):
        rows.append(row)
        if row["flight"] == 7:  # below this process: the server, the resource tracker, a keeper, a worker
            workers = [each for each in ours.children(recursive=True) if each.pid == row["process"]]
            assert workers
            assert len(workers[0].parents()[0].children(recursive=True)) == 1
    assert known(rows) == ALL


class _Regicide(ToyPilot):
    def fly(self, flight: int, progress: Progress = silent) -> Row:
        with contextlib.suppress(psutil.Error):
            server = psutil.Process().parents()[1]
            if "forkserver" in " ".join(server.cmdline()):
                server.kill()
        return super().fly(flight)


def test_the_server_may_be_killed_by_every_flight() -> None:
    """The other workers go on; no flight is blamed."""
    assert known(list(LocalEngine(2).answers(_Regicide(asleep=0.01), FLIGHTS[:3]))) == ALL[:3]


def test_the_resource_tracker_may_be_killed_without_a_word() -> None:
    rows: list[Row] = []
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for row in LocalEngine(2).answers(ToyPilot(asleep=0.02), FLIGHTS):
            rows.append(row)
            if len(rows) == 3:
                os.kill(resource_tracker._resource_tracker._pid, signal.SIGKILL)
                os.kill(row["process"], signal.SIGKILL)
                os.kill(multiprocessing.forkserver._forkserver._forkserver_pid, signal.SIGKILL)
    assert known(rows) == ALL


@pytest.mark.parametrize("by", [signal.SIGKILL, signal.SIGSTOP])
def test_a_keeper_that_is_killed_or_stopped_is_replaced_with_its_worker(by: signal.Signals) -> None:
    rows: list[Row] = []
    worker = 0
    for row in LocalEngine(1).answers(ToyPilot(asleep=0.05), FLIGHTS):
        rows.append(row)
        if len(rows) == 3:
            worker = row["process"]
            psutil.Process(worker).parents()[0].send_signal(by)
    assert known(rows) == ALL
    assert not living({worker})


class _Talker(ToyPilot):
    """In flight 5 it sends messages that nobody requested."""

    def fly(self, flight: int, progress: Progress = silent) -> Row:
        if flight == 5:
            for number in range(3, 64):
                if _is_pipe(number) and number != resource_tracker._resource_tracker._fd:
                    os.write(number, bytes([3]) + bytes(40))
        return super().fly(flight)


def _is_pipe(number: int) -> bool:
    try:
        return str(Path(f"/proc/self/fd/{number}").readlink()).startswith("pipe:") and _writable(number)
    except OSError:
        return False


def _writable(number: int) -> bool:
    flags = Path(f"/proc/self/fdinfo/{number}").read_text().split("flags:")[1].split()[0]
    return int(flags, 8) & os.O_ACCMODE != os.O_RDONLY


def test_an_unrequested_message_is_no_answer() -> None:
    rows = known(list(LocalEngine(2).answers(_Talker(), FLIGHTS)))
    assert rows[5]["reason"].startswith(f"its process died {MOST_DEATHS} times, last since what it answered is no")
    assert [row for row in rows if row["flight"] != 5] == OTHERS


class _Wrong(ToyPilot):
    def fly(self, flight: int, progress: Progress = silent) -> Row:
        return super().fly(flight) | ({"flight": 3} if flight == 5 else {})


def test_an_answer_to_another_flight_is_none() -> None:
    rows = known(list(LocalEngine(1).answers(_Wrong(), FLIGHTS)))
    assert "is no answer (unrequested)" in rows[5]["reason"]
    assert [row for row in rows if row["flight"] != 5] == OTHERS


class _Untidy(ToyPilot):
    """Leaves the directory in flight 5; reports where each flight began."""

    def fly(self, flight: int, progress: Progress = silent) -> Row:
        row = super().fly(flight) | {"folder": str(Path.cwd())}
        if flight == 5:
            os.chdir("/")
        return row


def test_a_worker_in_which_a_flight_left_something_flies_no_other() -> None:
    rows = sorted(LocalEngine(1).answers(_Untidy(), FLIGHTS), key=lambda row: row["flight"])
    assert {row["folder"] for row in rows} == {str(Path.cwd())}
    processes = [row["process"] for row in rows]
    assert len(set(processes[:6])) == len(set(processes[6:])) == 1
    assert processes[5] != processes[6]


PARENT = """
import sys
from pathlib import Path
from campaign_pilots import light_server
from test_survival import Hostile, hold_the_interpreter
from scenarios.campaign.engine.local import LocalEngine

with light_server():
    for _ in LocalEngine(2).answers(Hostile(harm=hold_the_interpreter, diary=Path(sys.argv[1])), [5]):
        pass
"""


def hold_the_interpreter() -> None:
    ctypes.PyDLL(None).sleep(1000)


def test_no_process_outlives_a_parent_killed_while_a_controller_holds_the_interpreter(tmp_path: Path) -> None:
    script, diary = tmp_path / "parent.py", tmp_path / "diary"
    script.write_text(PARENT)
    diary.touch()
    paths = os.pathsep.join([str(ROOT), str(ROOT / "tests"), str(Path(__file__).parent)])
    parent = subprocess.Popen(
        [sys.executable, str(script), str(diary)], env={**os.environ, "PYTHONPATH": paths}, start_new_session=True
    )
    try:
        assert until(lambda: bool(diary.read_text()))
        family = {child.pid for child in psutil.Process(parent.pid).children(recursive=True)}
        assert int(diary.read_text().split()[1]) in family
    finally:
        parent.kill()
        parent.wait()
    assert until(lambda: not living(family))


def _thread() -> Iterator[None]:
    leave = threading.Event()
    thread = threading.Thread(target=leave.wait)
    thread.start()
    yield
    leave.set()
    thread.join()


def _set(change: Callable[[], object], back: Callable[[], object]) -> Callable[[], Iterator[None]]:
    def changed() -> Iterator[None]:
        change()
        yield
        back()

    return changed


@pytest.mark.parametrize(
    "leave",
    [
        _thread,
        _set(gc.disable, gc.enable),
        _set(lambda: os.environ.update(QUADSIM_TRACE="1"), lambda: os.environ.pop("QUADSIM_TRACE")),
        _set(lambda: np.seterr(under="raise"), lambda: np.seterr(under="ignore")),
        _set(lambda: signal.setitimer(signal.ITIMER_REAL, 1000.0), lambda: signal.setitimer(signal.ITIMER_REAL, 0.0)),
        _set(lambda: signal.signal(signal.SIGUSR1, print), lambda: signal.signal(signal.SIGUSR1, signal.SIG_DFL)),
        _set(
            lambda: signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGUSR1}),
            lambda: signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGUSR1}),
        ),
        _set(lambda: sys.path.insert(0, "/nowhere"), lambda: sys.path.pop(0)),
        _set(lambda: setattr(math, "sin", math.cos), lambda: setattr(math, "sin", SIN)),
        _set(lambda: setattr(Plant, "state", None), lambda: setattr(Plant, "state", STATE)),
    ],
    ids=["thread", "gc", "environ", "seterr", "timer", "handler", "mask", "path", "math", "ours"],
)
def test_traces_are_found_until_they_are_gone(leave: Callable[[], Iterator[None]]) -> None:
    traces = Traces()
    assert not traces.found()
    left = leave()
    next(left)
    found = traces.found()
    assert list(left) == []
    assert found
    assert not traces.found()


SIN, STATE = math.sin, Plant.state


def test_warnings_that_are_made_errors_are_traces() -> None:
    with warnings.catch_warnings():
        warnings.resetwarnings()
        traces = Traces()
        warnings.simplefilter("ignore")
        assert not traces.found()
        warnings.simplefilter("error")
        assert traces.found()
