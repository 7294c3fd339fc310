"""The engine of processes: every flight once whatever dies, and nobody left behind."""

from __future__ import annotations

import gc
import multiprocessing.forkserver
import os
import pickle
import signal
import subprocess
import sys
import time as clock
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import psutil
import pytest
from campaign_pilots import ToyPilot, known, light_server, living, until, value_of

from quadsim.errors import ParameterError, QuadsimError
from scenarios.campaign.engine import local as module
from scenarios.campaign.engine.local import LocalEngine
from scenarios.campaign.engine.protocol import CHUNK_S, MOST_DEATHS, Answer, EngineError, Pace, fair_share
from scenarios.campaign.results.table import Row
from scenarios.machine import usable_cores
from scenarios.progress import Progress, silent

ROOT = Path(__file__).resolve().parents[4]
SETTLED = module._SETTLED
FLIGHTS = range(40)
ALL = [value_of(flight) for flight in FLIGHTS]
PARENT = """
import signal
import sys
import time as clock
from pathlib import Path
from campaign_pilots import ToyPilot, light_server
from scenarios.campaign.engine.local import LocalEngine

if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs inherit that it is ignored
    pilot = ToyPilot(seconds=float(sys.argv[2]), asleep=float(sys.argv[3]), diary=Path(sys.argv[1]))
    try:
        with light_server():
            for _ in LocalEngine(2).answers(pilot, range(1000)):
                pass
    except KeyboardInterrupt:
        print("interrupted")
"""


@pytest.fixture(scope="module", autouse=True)
def light() -> Iterator[None]:
    with light_server(__name__):
        yield


def fly(pilot: ToyPilot, flights: Sequence[int] = FLIGHTS, workers: int = 2) -> list[Row]:
    return list(LocalEngine(workers).answers(pilot, flights))


@pytest.mark.parametrize("workers", [1, 2, 5])
def test_every_flight_is_answered_once_whatever_the_number_of_workers(workers: int) -> None:
    rows = fly(ToyPilot(asleep=0.02), workers=workers)
    assert known(rows) == ALL
    processes = {row["process"] for row in rows}
    assert min(2, workers) <= len(processes) <= workers
    assert os.getpid() not in processes


def test_nothing_to_fly_starts_no_worker() -> None:
    assert list(LocalEngine(2).answers(ToyPilot(), [])) == []


def test_workers_are_the_usable_cores_by_default() -> None:
    assert LocalEngine().workers == usable_cores()
    assert LocalEngine(7).workers == 7
    assert LocalEngine.name == "local"
    with pytest.raises(ParameterError, match="workers must be 1 or more; got 0"):
        LocalEngine(0)


def test_what_fly_raises_is_the_reason_of_its_rows_alone() -> None:
    raised = {3: ValueError("two\nlines"), 7: SystemExit(4), 11: MemoryError()}
    rows = known(fly(ToyPilot(raises=raised)))
    reasons = {3: "ValueError: two lines", 7: "SystemExit: 4", 11: "MemoryError:"}
    assert {row["flight"]: row["reason"] for row in rows if row["reason"]} == reasons
    assert [row for row in rows if row["flight"] not in raised] == [row for row in ALL if row["flight"] not in raised]


class _Unspeakable(ToyPilot):
    def fly(self, flight: int, progress: Progress = silent) -> Row:
        return super().fly(flight) | ({"value": lambda: None} if flight == 1 else {})


def test_a_row_that_cannot_be_sent_home_is_lost_with_a_reason() -> None:
    rows = known(fly(_Unspeakable(), FLIGHTS[:3]))
    assert [row["value"] for row in rows] == [0.0, None, 4 / 7.0]
    assert "local object '_Unspeakable.fly.<locals>.<lambda>'" in rows[1]["reason"]


def test_killed_workers_are_replaced_and_nothing_is_lost_or_doubled() -> None:
    killed: list[int] = []
    rows: list[Row] = []
    for row in LocalEngine(2).answers(ToyPilot(asleep=0.01), range(200)):
        rows.append(row)
        if len(rows) % 25 == 0:
            killed.append(row["process"])
            os.kill(killed[-1], signal.SIGKILL)
    assert known(rows) == [value_of(flight) for flight in range(200)]
    assert len(set(killed)) >= 6
    assert len({row["process"] for row in rows}) > len(set(killed))


def test_a_flight_that_kills_its_process_once_is_flown_again(tmp_path: Path) -> None:
    once = {flight: tmp_path / str(flight) for flight in (0, 13, 39)}
    assert known(fly(ToyPilot(kills_once=once))) == ALL


def test_a_flight_that_always_kills_its_process_is_lost_in_the_end(tmp_path: Path) -> None:
    diary = tmp_path / "diary"
    rows = known(fly(ToyPilot(kills={5: signal.SIGSEGV, 20: signal.SIGKILL}, diary=diary)))
    begun = Counter(int(line.split()[0]) for line in diary.read_text().splitlines())
    assert {row["flight"]: row["reason"] for row in rows if row["reason"]} == {
        5: f"its process died {MOST_DEATHS} times, last by signal 11",
        20: f"its process died {MOST_DEATHS} times, last by signal 9",
    }
    assert begun == {flight: MOST_DEATHS if flight in (5, 20) else 1 for flight in range(40)}
    assert [row for row in rows if not row["reason"]] == [row for row in ALL if row["flight"] not in (5, 20)]


def test_the_server_that_starts_processes_may_be_killed_too(tmp_path: Path) -> None:
    rows: list[Row] = []
    pilot = ToyPilot(asleep=0.02, kills_once={25: tmp_path / "25"})
    for row in LocalEngine(2).answers(pilot, FLIGHTS):
        rows.append(row)
        if len(rows) == 10:
            server = multiprocessing.forkserver._forkserver._forkserver_pid
            os.kill(server, signal.SIGKILL)
    assert known(rows) == ALL


def test_closing_the_iterator_stops_everybody() -> None:
    before = {child.pid for child in psutil.Process().children(recursive=True)}
    answers = LocalEngine(2).answers(ToyPilot(asleep=0.2), FLIGHTS)
    flying = {next(answers)["process"], next(answers)["process"]} - before
    assert flying
    began = clock.monotonic()
    answers.close()
    assert until(lambda: not living(flying), seconds=2.0)
    assert clock.monotonic() - began < 4.0


class _Thrifty(ToyPilot):
    def fly(self, flight: int, progress: Progress = silent) -> Row:
        return super().fly(flight) | {"threshold": gc.get_threshold()}


def test_workers_seldom_look_for_cycles() -> None:
    assert {row["threshold"] for row in fly(_Thrifty())} == {(100_000, 50, 100)}
    assert gc.get_threshold() != (100_000, 50, 100)


class _Settled(ToyPilot):
    def fly(self, flight: int, progress: Progress = silent) -> Row:
        loaded = {name: name in sys.modules for name in ("scenarios.campaign.preload", "scipy.stats")}
        return super().fly(flight) | {"loaded": loaded}


def test_the_server_of_workers_and_not_their_parent_has_settled(monkeypatch: pytest.MonkeyPatch) -> None:
    """It has what flies, and not the statistics, which take half a second to load."""
    monkeypatch.setattr(module, "_SETTLED", SETTLED)
    multiprocessing.forkserver._forkserver._stop()  # the light one
    expected = {"scenarios.campaign.preload": True, "scipy.stats": False}
    assert all(row["loaded"] == expected for row in fly(_Settled()))
    assert "scenarios.campaign.preload" not in sys.modules
    multiprocessing.forkserver._forkserver._stop()


def test_a_script_is_not_run_again_by_its_workers(tmp_path: Path) -> None:
    """So that it needs no guard against that."""
    script = tmp_path / "script.py"
    script.write_text(
        "from campaign_pilots import ToyPilot\n"
        "from scenarios.campaign.engine.local import LocalEngine\n"
        "print('run')\n"
        "print(len(list(LocalEngine(2).answers(ToyPilot(), range(6)))))\n"
        "import sys\n"
        "print(sys.modules['__main__'].__file__)\n"
    )
    path = os.pathsep.join([str(ROOT), str(ROOT / "tests"), str(Path(__file__).parent)])
    ran = subprocess.run(
        [sys.executable, str(script)],
        env={**os.environ, "PYTHONPATH": path},
        capture_output=True,
        text=True,
        check=True,
        timeout=60.0,
    )
    assert ran.stdout.split() == ["run", "6", str(script)]


class _Unwelcome(ToyPilot):
    def __setstate__(self, state: object) -> None:
        raise RuntimeError("not here")


def test_a_pilot_that_workers_cannot_take_is_refused_with_the_reason() -> None:
    with pytest.raises(EngineError, match="cannot fly here: RuntimeError: not here"):
        fly(_Unwelcome())


class _Deadly(ToyPilot):
    def __setstate__(self, state: object) -> None:
        os._exit(3)


def test_workers_that_die_while_they_start_are_not_started_for_ever() -> None:
    with pytest.raises(EngineError, match="5 worker processes died while they started, the last with exit status 3"):
        fly(_Deadly())


def test_engine_errors_are_typed_and_cross_processes() -> None:
    error = EngineError("nobody")
    assert isinstance(error, QuadsimError)
    assert error.exit_status == 2
    assert str(pickle.loads(pickle.dumps(error))) == "nobody"


@pytest.fixture
def start_parent(tmp_path: Path) -> Iterator[Callable[..., tuple[subprocess.Popen[str], set[int]]]]:
    """Starts a campaign in a process of its own, in a group of its own, and waits until two workers fly."""
    script, diary = tmp_path / "parent.py", tmp_path / "diary"
    script.write_text(PARENT)
    diary.touch()
    started: list[subprocess.Popen[str]] = []

    def flown_by() -> set[int]:
        return {int(line.split()[1]) for line in diary.read_text().splitlines()}

    def start(*, seconds: float, asleep: float) -> tuple[subprocess.Popen[str], set[int]]:
        command = [sys.executable, str(script), str(diary), str(seconds), str(asleep)]
        paths = os.pathsep.join([str(ROOT / "tests"), str(ROOT)])
        started.append(
            subprocess.Popen(
                command,
                env={**os.environ, "PYTHONPATH": paths},
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                text=True,
                start_new_session=True,
            )
        )
        assert until(lambda: len(flown_by()) == 2)
        return started[-1], {child.pid for child in psutil.Process(started[-1].pid).children(recursive=True)}

    yield start
    for process in started:
        if living({process.pid}):
            os.killpg(process.pid, signal.SIGKILL)
        process.communicate()


@pytest.mark.parametrize(("seconds", "asleep"), [(60.0, 0.0), (0.0, 60.0)], ids=["computing", "asleep"])
def test_no_process_outlives_a_parent_that_is_killed_in_mid_flight(
    seconds: float, asleep: float, start_parent: Callable[..., tuple[subprocess.Popen[str], set[int]]]
) -> None:
    parent, family = start_parent(seconds=seconds, asleep=asleep)
    assert len(living(family)) >= 3  # two workers and the server that started them
    parent.kill()
    assert until(lambda: not living(family))
    assert parent.communicate()[1] == ""


def test_ctrl_c_stops_everybody_and_only_the_parent_reports_it(
    start_parent: Callable[..., tuple[subprocess.Popen[str], set[int]]],
) -> None:
    parent, family = start_parent(seconds=60.0, asleep=0.0)
    for pid in family:
        os.kill(pid, signal.SIGINT)
    clock.sleep(0.3)
    assert living(family) == family  # what the terminal sends to all moves the parent alone
    os.killpg(parent.pid, signal.SIGINT)
    assert parent.communicate(timeout=30.0) == ("interrupted\n", "")
    assert until(lambda: not living(family))


def test_chunks_are_seconds_of_work_and_get_smaller_near_the_end() -> None:
    pace = Pace()
    assert pace.chunk(1000, 2) == 1
    assert pace.flights_in(10.0) == 0
    for _ in range(4):
        pace.note(Answer({}, 0.5))
    assert pace.chunk(1000, 2) == CHUNK_S / 0.5
    assert pace.chunk(40, 2) == 10
    assert pace.chunk(3, 2) == pace.chunk(1, 2) == 1
    assert fair_share(100, 5) == 10
    pace.note(Answer({}, 1e6))
    assert pace.chunk(1000, 2) == 1


def test_the_memory_of_a_worker_does_not_grow() -> None:
    used: dict[int, list[int]] = {}
    for number, row in enumerate(LocalEngine(1).answers(ToyPilot(), range(800))):
        if number % 200 == 199:
            worker = psutil.Process(row["process"])
            used.setdefault(worker.pid, []).append(worker.memory_info().rss)
    (sizes,) = used.values()
    assert len(sizes) >= 4
    assert sizes[-1] - sizes[1] < 4e5
