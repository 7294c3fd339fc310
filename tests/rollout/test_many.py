"""Many flights: the same rows whoever flies them, one row for whatever a flight does, and no process left."""

from __future__ import annotations

import itertools
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import dask
import distributed
import psutil
import pytest
from toy_flights import Toy, below, fly, fly_slowly, living, report, until

from quadsim.errors import MissingPackageError, ParameterError
from quadsim.rollout import many
from quadsim.rollout.many import ClusterError, fly_many

pytestmark = pytest.mark.slow("workers")

ROOT = Path(__file__).resolve().parents[2]
CALM: list[Toy] = [(number, "calm") for number in range(30)]


def rows_of(flights: Sequence[Any], function: Callable[[Any], Any] = fly, **options: Any) -> list[dict[str, Any]]:
    """The rows in the order of the flights; each has one."""
    rows = list(fly_many(flights, function, **options))
    assert sorted(at for at, _ in rows) == list(range(len(flights)))
    return [row for _, row in sorted(rows, key=lambda each: each[0])]


def values(rows: Sequence[dict[str, Any]]) -> list[float | None]:
    return [row.get("value") for row in rows]


EXPECTED = [number * number / 7.0 for number in range(30)]


@pytest.mark.representative("workers")
@pytest.mark.parametrize("options", [{"workers": 1}, {"workers": 3}, {"workers": 2, "isolate": True}])
def test_rows_are_the_same_whatever_the_workers(options: dict[str, Any]) -> None:
    rows = rows_of(CALM, **options)
    assert values(rows) == EXPECTED
    processes = {row["process"] for row in rows}
    assert len(processes) == 30 if "isolate" in options else len(processes) <= options["workers"]
    assert not below()


BAD = {
    "raises": ("error", "ZeroDivisionError: of its own"),
    "asks to leave": ("error", "SystemExit: 3"),
    "gives no row": ("error", "TypeError: "),
    "exits": ("died", "its process ended with exit status 0"),
    "is killed": ("died", "its process ended by signal 9"),
    "crashes": ("died", "its process ended by signal 11"),
    "stops": ("timeout", "it took longer than 3 s"),
    "hangs": ("timeout", "it took longer than 3 s"),
    "holds the interpreter": ("timeout", "it took longer than 3 s"),
    "takes memory": ("memory", "MemoryError: "),
}


@pytest.mark.parametrize("isolate", [False, True])
def test_a_bad_flight_is_one_row_and_changes_no_other(isolate: bool) -> None:
    flights = [*CALM]
    bad = dict(zip(range(2, 30, 2), BAD, strict=False))
    for number, kind in bad.items():
        flights[number] = (number, kind)
    flights[1] = (1, "leaves a command")
    rows = rows_of(flights, workers=3, timeout=3.0, memory=300.0, isolate=isolate)
    for number, row in enumerate(rows):
        if number in bad:
            verdict, reason = BAD[bad[number]]
            assert (row["verdict"], reason in row["reason"]) == (verdict, True), (bad[number], row)
        else:
            assert row["value"] == EXPECTED[number]
    assert not living({rows[1]["left"]})
    assert not below()


def test_a_worker_that_ran_out_of_memory_flies_no_more() -> None:
    rows = rows_of([(0, "calm"), (1, "takes memory"), (2, "calm")], workers=1, memory=300.0)
    assert rows[1]["verdict"] == "memory"
    assert rows[0]["process"] != rows[2]["process"]


def test_flights_are_drawn_as_they_are_flown_and_closing_ends_all() -> None:
    drawn = itertools.count()
    with closing(fly_many(((number, "calm") for number in drawn), fly, workers=2)) as rows:
        for _ in range(5):
            next(rows)
    assert next(drawn) <= 10
    assert not below()


def test_a_worker_is_where_its_caller_is_and_prints_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    (row,) = rows_of([None], report, workers=1)
    assert row == {"folder": str(tmp_path), "threads": "1"}
    assert os.environ["OMP_NUM_THREADS"] == "7"
    assert capfd.readouterr().out == ""


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"workers": 0}, "--workers must be 1 or more; got 0"),
        ({"workers": 2, "cluster": "tcp://a:1"}, "--workers must be absent with --cluster; got 2"),
        (
            {"cluster": "slurm.toml"},
            "--cluster must be the address of a Dask scheduler, e.g. tcp://",
        ),
    ],
)
def test_workers_that_cannot_be_are_refused_at_once(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ParameterError, match=message):
        fly_many([], fly, **options)
    with pytest.raises(ParameterError, match=message):
        many.count_workers(options.get("workers"), options.get("cluster"))


# --- a caller that ends ----------------------------------------------------------------------------------------------

PARENT = """
import sys
from pathlib import Path
from quadsim.rollout.many import fly_many
from toy_flights import fly_and_note
print("started", flush=True)
kinds = sys.argv[2:]
try:
    for _ in fly_many([(Path(sys.argv[1]), kind) for kind in kinds], fly_and_note, workers=len(kinds)):
        pass
except KeyboardInterrupt:
    print("interrupted")
"""


@pytest.fixture
def parent(tmp_path: Path) -> Iterator[tuple[subprocess.Popen[str], set[int]]]:
    """A script, not guarded by `__main__`, in the middle of three flights, and all processes below it."""
    script = tmp_path / "parent.py"
    diary = tmp_path / "diary"
    script.write_text(PARENT)
    diary.touch()
    kinds = ["holds the interpreter", "hangs", "stops"]
    process = subprocess.Popen(
        [sys.executable, str(script), str(diary), *kinds],
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT / "tests"), str(ROOT)])},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    assert until(lambda: len(diary.read_text().split()) == len(kinds))
    yield process, {child.pid for child in psutil.Process(process.pid).children(recursive=True)}
    if living({process.pid}):
        process.kill()
    process.communicate()


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_no_process_outlives_a_caller_that_is_killed(
    parent: tuple[subprocess.Popen[str], set[int]], number: signal.Signals
) -> None:
    process, family = parent
    assert len(living(family)) >= 5  # with the server of workers, and a command of the first
    process.send_signal(number)
    assert until(lambda: not living(family), 5.0)
    assert process.communicate()[0] == "started\n"


def test_ctrl_c_ends_all_and_the_caller_alone_reports_it(parent: tuple[subprocess.Popen[str], set[int]]) -> None:
    process, family = parent
    os.killpg(process.pid, signal.SIGINT)  # as a terminal does
    assert process.communicate(timeout=10.0) == ("started\ninterrupted\n", "")
    assert until(lambda: not living(family), 5.0)


# --- a cluster -------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def cluster() -> Iterator[distributed.LocalCluster]:
    """A scheduler in this process, and two workers in theirs."""
    with (
        dask.config.set({"distributed.worker.multiprocessing-method": "forkserver"}),
        distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, processes=True, dashboard_address=":0", scheduler_port=0
        ) as started,
    ):
        yield started


@pytest.fixture
def address(cluster: distributed.LocalCluster) -> str:
    cluster.wait_for_workers(2, timeout=30.0)
    return str(cluster.scheduler_address)


def test_a_cluster_gives_the_same_rows_and_one_for_each_bad_flight(address: str) -> None:
    flights = CALM[:12]
    for number, kind in {3: "raises", 5: "is killed", 7: "hangs", 8: "takes memory"}.items():
        flights[number] = (number, kind)
    rows = rows_of(flights, timeout=3.0, memory=300.0, cluster=address)
    bad = {number: row["verdict"] for number, row in enumerate(rows) if "value" not in row}
    assert bad == {3: "error", 5: "died", 7: "timeout", 8: "memory"}
    assert [row.get("value", EXPECTED[number]) for number, row in enumerate(rows)] == EXPECTED[:12]
    assert many.count_workers(None, address) == 2


def test_a_dask_worker_that_is_killed_costs_nothing_but_time(address: str) -> None:
    rows = dict[int, Any]()
    killed = 0
    for at, row in fly_many(range(12), fly_slowly, cluster=address):
        rows[at] = row
        if len(rows) == 3:
            with distributed.Client(address, set_as_default=False) as client:
                killed = next(iter(client.run(os.getpid).values()))
            os.kill(killed, signal.SIGKILL)
    assert [rows[at]["value"] for at in range(12)] == EXPECTED[:12]
    assert not living({killed})


def test_an_address_without_a_scheduler_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(many, "_CONNECT_S", 0.3)
    with pytest.raises(ClusterError, match=r"127\.0\.0\.1:9"):
        list(fly_many(CALM, fly, cluster="tcp://127.0.0.1:9"))


def test_without_the_extra_the_message_names_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(MissingPackageError, match=r"pip install 'quadsim\[cluster\]'"):
        many.count_workers(None, "tcp://127.0.0.1:9")
