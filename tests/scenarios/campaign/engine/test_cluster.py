"""Campaigns on Dask: against a real scheduler with worker processes, some of which are killed."""

from __future__ import annotations

import contextlib
import gc
import json
import multiprocessing.forkserver
import os
import signal
import subprocess
import sys
import time as clock
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import dask
import distributed
import psutil
import pytest
from campaign_pilots import ToyPilot, known, living, until, value_of
from tuning_formula import write_tuning

from quadsim.errors import FileError, InputError, MissingPackageError, ParameterError, UnknownNameError
from scenarios.campaign.engine import cluster as module
from scenarios.campaign.engine.cluster import DaskEngine, versions
from scenarios.campaign.engine.jobs import Jobs, job_script, read_jobs, submit
from scenarios.campaign.engine.local import LocalEngine
from scenarios.campaign.engine.protocol import MOST_DEATHS, EngineError
from scenarios.campaign.plan import load_plan
from scenarios.campaign.results.table import Row
from scenarios.campaign.run import SUMMARY_FILE, Standing, fly_campaign
from scenarios.campaign.spec import LimitsSpec
from scenarios.progress import Progress, silent
from scenarios.tuning.plan import load_tuning
from scenarios.tuning.run import tune

ROOT = Path(__file__).resolve().parents[4]
FLIGHTS = range(40)
ALL = [value_of(flight) for flight in FLIGHTS]
LITTLE = """
name = "little"
scenario = "hover"
flights = 16
seed = 4
failure = ["lost", "max_error.z > 0.2"]
set = { duration = 0.5, constraints = [] }

[[vary]]
name = "mass"
fields = ["effects.load.mass_factor"]
distribution = "uniform"
low = 0.5
high = 1.5
"""
SLURM = '[slurm]\njobs = 2\ncores = 1\nmemory = "1GB"\nqueue = "short"\nwalltime = "00:10:00"\n'


@pytest.fixture(scope="module", autouse=True)
def forked() -> Iterator[None]:
    """Workers are forked from a server that has loaded what they need: loading is most of what starting one takes."""
    server, patch = multiprocessing.forkserver._forkserver, pytest.MonkeyPatch()
    server._stop()  # who had it before wanted other modules
    server.set_forkserver_preload(["distributed", "scenarios.campaign.engine.cluster", "scenarios.campaign.preload"])
    patch.setattr("distributed.utils._forkserver_preload_set", True)
    patch.setattr(module, "_LOOK_S", 0.3)  # as long as nobody knows that a worker has come
    with dask.config.set({"distributed.worker.multiprocessing-method": "forkserver"}):
        yield
    patch.undo()
    server._stop()


def start_cluster(workers: int = 2, threads: int = 1) -> distributed.LocalCluster:
    """A scheduler in this process, workers in theirs, no page to look at."""
    return distributed.LocalCluster(
        n_workers=workers, threads_per_worker=threads, processes=True, dashboard_address=":0", scheduler_port=0
    )


@pytest.fixture(scope="module")
def cluster() -> Iterator[distributed.LocalCluster]:
    with start_cluster() as started:
        yield started


@pytest.fixture(scope="module")
def two_workers(cluster: distributed.LocalCluster) -> str:
    return str(cluster.scheduler_address)


def fly(engine: DaskEngine, pilot: ToyPilot, flights: Sequence[int] = FLIGHTS) -> list[Row]:
    return list(engine.answers(pilot, flights))


def test_the_answers_are_those_of_processes_on_this_machine(two_workers: str) -> None:
    engine, pilot = DaskEngine(two_workers), ToyPilot(asleep=0.01)
    rows = fly(engine, pilot)
    assert known(rows) == known([*LocalEngine(2).answers(pilot, FLIGHTS)]) == ALL
    assert len({row["process"] for row in rows}) == engine.workers == 2
    assert engine.name == "dask"


class _Troubled(ToyPilot):
    """Flight 11 never ends; every other reports how seldom its process collects cycles."""

    def fly(self, flight: int, progress: Progress = silent) -> Row:
        if flight == 11:
            clock.sleep(100.0)
        return super().fly(flight) | {"threshold": gc.get_threshold()}


TROUBLED = {
    3: "ValueError: no",
    7: "SystemExit: 4",
    11: "limits.flight is 1.5 s",
    20: f"its process died {MOST_DEATHS} times, last by signal 11",
}


@pytest.fixture(scope="module")
def troubled(two_workers: str) -> list[Row]:
    """Flights of which two raise, one never ends and one kills its process, each time it is tried."""
    harm: dict[str, Any] = {"raises": {3: ValueError("no"), 7: SystemExit(4)}, "kills": {20: signal.SIGSEGV}}
    return known(fly(DaskEngine(two_workers), _Troubled(asleep=0.02, limits=LimitsSpec(flight=1.5), **harm)))


def test_a_flight_that_raises_hangs_or_kills_its_process_is_lost_alone(troubled: list[Row]) -> None:
    reasons = {row["flight"]: row["reason"] for row in troubled if row["reason"]}
    assert reasons.keys() == TROUBLED.keys()
    assert TROUBLED[11] in reasons.pop(11)
    assert all(reason == TROUBLED[flight] for flight, reason in reasons.items())
    others = [{name: row[name] for name in ("flight", "value", "reason")} for row in troubled if not row["reason"]]
    assert others == [row for row in ALL if row["flight"] not in TROUBLED]


def test_workers_seldom_look_for_cycles(troubled: list[Row]) -> None:
    assert {row["threshold"] for row in troubled if not row["reason"]} == {(100_000, 50, 100)}


def test_nothing_to_fly_calls_no_worker() -> None:
    assert list(DaskEngine("tcp://127.0.0.1:9").answers(ToyPilot(), [])) == []


def test_a_worker_killed_in_mid_campaign_costs_nothing_but_time(two_workers: str) -> None:
    rows: list[Row] = []
    killed = 0
    for row in DaskEngine(two_workers).answers(ToyPilot(asleep=0.05), range(60)):
        rows.append(row)
        if len(rows) >= 20 and not killed:
            killed = row["process"]
            os.kill(killed, signal.SIGKILL)
    assert known(rows) == [value_of(flight) for flight in range(60)]
    assert len({row["process"] for row in rows}) >= 2
    assert killed
    assert not living({killed})


def test_a_tuning_has_the_same_bytes_on_a_cluster(two_workers: str, tmp_path: Path) -> None:
    sizes = {"trials": 4, "batch": 2, "flights": [1, 2], "fresh": {"flights": 2, "seed": 1}}
    plan = load_tuning(str(write_tuning(tmp_path, **sizes)))
    here = tune(plan, tmp_path / "here", LocalEngine(workers=1), report=False)
    there = tune(plan, tmp_path / "there", DaskEngine(two_workers), report=False)
    for name in ("flights.parquet", SUMMARY_FILE, "best.toml", "start/flights.parquet"):
        assert (here.directory / name).read_bytes() == (there.directory / name).read_bytes(), name


def test_a_campaign_whose_worker_is_killed_ends_in_the_same_bytes(two_workers: str, tmp_path: Path) -> None:
    plan = load_plan(str(write(tmp_path / "little.toml", LITTLE)))
    killed: list[int] = []
    with distributed.Client(two_workers, set_as_default=False) as client:
        client.wait_for_workers(2, timeout=30.0)
        processes: dict[str, int] = client.run(os.getpid)

        def busy() -> list[int]:
            return [processes[address] for address, tasks in client.processing().items() if tasks]

        def kill_one(standing: Standing) -> None:
            if 4 <= standing.flown < 12 and not killed:
                assert until(lambda: bool(busy()))
                killed.append(busy()[0])
                os.kill(killed[0], signal.SIGKILL)

        disturbed = fly_campaign(plan, tmp_path / "dask", DaskEngine(two_workers), report=False, watch=kill_one)
    calm = fly_campaign(plan, tmp_path / "one", LocalEngine(1), report=False)
    assert len(processes) == 2
    assert killed
    assert not living({*killed})
    assert [session["engine"] for session in disturbed.manifest["sessions"]] == ["dask"]
    for name in ("flights.parquet", SUMMARY_FILE):
        assert (disturbed.directory / name).read_bytes() == (calm.directory / name).read_bytes()


class _Assassin(ToyPilot):
    def fly(self, flight: int, progress: Progress = silent) -> Row:
        if flight == 20:
            above = psutil.Process().parents()[2]  # above its keeper and the server, unless these are dead already
            if above.pid > 1:
                above.kill()
            clock.sleep(100.0)
        return super().fly(flight)


def test_a_flight_that_always_kills_its_worker_is_lost_in_the_end(
    cluster: distributed.LocalCluster, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The scheduler gives a chunk up at the first death; then each of its flights is tried alone; one is lost."""
    monkeypatch.setattr(module, "MOST_DEATHS", 2)
    monkeypatch.setattr(cluster.scheduler, "allowed_failures", 0)
    cluster.wait_for_workers(2, timeout=30.0)  # who restarts a worker has to know it before it dies
    rows = known(fly(DaskEngine(cluster.scheduler_address), _Assassin(asleep=0.02)))
    assert rows[20] == {"flight": 20, "value": None, "reason": "its process died 2 times"}
    assert [row for row in rows if row["flight"] != 20] == [row for row in ALL if row["flight"] != 20]


def test_closing_the_iterator_ends_the_work_after_the_flights_in_the_air(two_workers: str, tmp_path: Path) -> None:
    diary = tmp_path / "diary"
    answers = DaskEngine(two_workers).answers(ToyPilot(asleep=0.1, diary=diary), FLIGHTS)
    next(answers)
    next(answers)
    answers.close()
    begun = len(diary.read_text().splitlines())
    clock.sleep(0.5)
    assert len(diary.read_text().splitlines()) <= begun + 2


class _Unwelcome(ToyPilot):
    def __setstate__(self, state: object) -> None:
        raise RuntimeError("not here")


def test_a_pilot_that_workers_cannot_take_is_refused_with_the_reason(two_workers: str) -> None:
    with pytest.raises(EngineError, match=r"a worker cannot fly \(RuntimeError: not here\); every worker"):
        fly(DaskEngine(two_workers), _Unwelcome())


def test_a_worker_with_another_quadsim_is_refused(two_workers: str, monkeypatch: pytest.MonkeyPatch) -> None:
    here = versions()
    assert {"quadsim", "mujoco", "numpy", "piqp"} <= set(here)
    monkeypatch.setattr(module, "versions", lambda: {**here, "quadsim": "9.9"})
    with pytest.raises(EngineError, match=rf"the worker at tcp://\S+ has quadsim {here['quadsim']}, not 9.9 as here"):
        fly(DaskEngine(two_workers), ToyPilot())


def test_a_worker_of_several_threads_is_refused() -> None:
    with (
        start_cluster(workers=1, threads=2) as cluster,
        pytest.raises(EngineError, match="takes 2 flights at once, and has to take one: start workers with --nthreads"),
    ):
        fly(DaskEngine(cluster.scheduler_address), ToyPilot())


def test_no_worker_for_too_long_is_reported() -> None:
    with start_cluster(workers=0) as cluster:
        engine = DaskEngine(cluster.scheduler_address, patience=0.5)
        assert engine.workers == 0
        with pytest.raises(EngineError, match=r"no worker for 0.5 s; start some, then use --resume"):
            fly(engine, ToyPilot())


def test_an_address_without_an_answer_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_CONNECT_S", 0.3)
    with pytest.raises(EngineError, match=r"the scheduler at tcp://127\.0\.0\.1:9 does not answer"):
        fly(DaskEngine("tcp://127.0.0.1:9"), ToyPilot())


@pytest.fixture
def processes(tmp_path: Path) -> Iterator[Callable[..., subprocess.Popen[bytes]]]:
    """Starts Dask's own commands; what is left of them is killed in the end."""
    started: list[subprocess.Popen[bytes]] = []

    def start(command: str, *options: str) -> subprocess.Popen[bytes]:
        arguments = [sys.executable, "-m", f"distributed.cli.dask_{command}", *options]
        arguments += ["--scheduler-file", str(tmp_path / "scheduler.json"), "--no-dashboard"]
        paths = os.pathsep.join([str(ROOT / "tests"), str(ROOT)])
        environment = {**os.environ, "PYTHONPATH": paths}
        with (tmp_path / f"{command}.log").open("wb") as log:
            started.append(
                subprocess.Popen(
                    arguments, cwd=tmp_path, env=environment, stdout=log, stderr=log, start_new_session=True
                )
            )
        return started[-1]

    yield start
    for process in started:
        for each in [*psutil.Process(process.pid).children(recursive=True), process]:
            with contextlib.suppress(psutil.NoSuchProcess):
                each.kill()
        process.wait()


def test_a_killed_scheduler_ends_the_campaign_with_what_was_answered(
    processes: Callable[..., subprocess.Popen[bytes]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "_CONNECT_S", 1.0)  # as long as it is called again
    scheduler = processes("scheduler", "--host", "127.0.0.1", "--port", "0")
    processes("worker", "--nthreads", "1", "--no-nanny", "--death-timeout", "60")
    file = tmp_path / "scheduler.json"
    assert until(lambda: file.exists() and bool(file.read_text()), seconds=30.0), (
        tmp_path / "scheduler.log"
    ).read_text()
    answers = DaskEngine(json.loads(file.read_text())["address"]).answers(ToyPilot(asleep=0.05), range(400))
    rows = [next(answers) for _ in range(10)]
    scheduler.kill()
    killed = clock.monotonic()
    with pytest.raises(EngineError, match=r"is gone; finished flights are saved: continue with --resume"):
        rows.extend(answers)
    assert clock.monotonic() - killed < 60.0
    flown = {row["flight"] for row in rows}
    assert 10 <= len(flown) == len(rows) < 400
    assert known(rows) == [value_of(flight) for flight in sorted(flown)]


def write(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def test_a_slurm_file_becomes_a_job_script(tmp_path: Path) -> None:
    text = SLURM.replace("cores = 1", "cores = 4") + 'job_extra_directives = ["--exclusive"]\n'
    jobs = read_jobs(write(tmp_path / "slurm.toml", text))
    script = job_script(jobs)
    for line in ("#SBATCH -p short", "#SBATCH -t 00:10:00", "#SBATCH --cpus-per-task=4", "#SBATCH --exclusive"):
        assert line in script.splitlines()
    assert "--nthreads 1 " in script
    assert "--nworkers 4 " in script
    assert jobs.workers == DaskEngine(str(tmp_path / "slurm.toml")).workers == 8


def test_a_job_starts_the_python_that_submits_it_or_another(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "executable", "/home/me/my code/.venv/bin/python")
    assert "'/home/me/my code/.venv/bin/python' -m" in job_script(read_jobs(write(tmp_path / "a.toml", SLURM)))
    there = read_jobs(write(tmp_path / "b.toml", SLURM + 'python = "python3"\n'))
    assert "\npython3 -m" in job_script(there)


@pytest.mark.parametrize("system", ["htcondor", "lsf", "moab", "oar", "pbs", "sge"])
def test_every_batch_system_of_dask_jobqueue_is_there(system: str, tmp_path: Path) -> None:
    extra = {"htcondor": 'disk = "1GB"\n', "oar": 'memory_per_core_property_name = "memcore"\n'}.get(system, "")
    text = f'[{system}]\njobs = 1\ncores = 2\nmemory = "2GB"\n{extra}'
    jobs = read_jobs(write(tmp_path / "jobs.toml", text))
    assert jobs == Jobs(system=system, jobs=1, cores=2, options=jobs.options)
    assert "distributed.cli.dask_worker" in job_script(jobs)


@pytest.mark.parametrize(
    ("text", "kind", "message"),
    [
        ("[slurm\n", FileError, "is not TOML"),
        ("", FileError, r"must have one table, named for a batch system \(htcondor, lsf, .*slurm\); it has none"),
        ("[slurm]\n[pbs]\n", FileError, "it has slurm, pbs"),
        ("[slurn]\n", UnknownNameError, "no batch system named 'slurn'; did you mean 'slurm'?"),
        ("slurm = 3\n", ParameterError, r"slurm must be a table: \[slurm\]; got 3"),
        (SLURM + "wall = 3\n", UnknownNameError, r"no field in \[slurm\] named 'wall'.*walltime"),
        (SLURM + "processes = 4\n", UnknownNameError, r"no field in \[slurm\] named 'processes'"),
        (SLURM.replace('"00:10:00"', "00:10:00"), ParameterError, "slurm.walltime must be a text in quotes"),
        (
            SLURM.replace("jobs = 2", "jobs = 0"),
            ParameterError,
            "slurm.jobs must be a whole number of 1 or more; got 0",
        ),
        (SLURM.replace("cores = 1", "cores = true"), ParameterError, "slurm.cores must be a whole number"),
        (SLURM.replace("cores = 1\n", ""), InputError, "slurm.cores is missing"),
        (SLURM.replace('memory = "1GB"\n', ""), InputError, "slurm.memory is missing"),
        (SLURM.replace("1GB", "much"), FileError, r"\[slurm\] is refused by dask-jobqueue: .*much"),
    ],
)
def test_a_wrong_file_is_refused_with_the_field(text: str, kind: type[Exception], message: str, tmp_path: Path) -> None:
    with pytest.raises(kind, match=message):
        DaskEngine(str(write(tmp_path / "jobs.toml", text)))


def test_what_is_neither_address_nor_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FileError, match=r"cannot be read \(No such file or directory\)"):
        DaskEngine(str(tmp_path / "none.toml"))
    for wrong in ("tcp://nowhere", "10.0.0.1:8786", "slurm"):
        with pytest.raises(
            ParameterError, match=r"cluster must be an address such as tcp://.*, or a path ending in \.toml; got"
        ):
            DaskEngine(wrong)
    with pytest.raises(ParameterError, match="patience must be > 0 s; got 0"):
        DaskEngine("tcp://127.0.0.1:9", patience=0.0)


def test_without_the_extra_the_message_names_it(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setitem(sys.modules, "dask_jobqueue", None)
    with pytest.raises(
        MissingPackageError, match=r"needs the package 'dask-jobqueue': pip install 'quadsim\[cluster\]'"
    ):
        DaskEngine(str(write(tmp_path / "slurm.toml", SLURM)))
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(MissingPackageError, match=r"needs the package 'distributed': pip install 'quadsim\[cluster\]'"):
        DaskEngine("tcp://127.0.0.1:9")


def command(folder: Path, name: str, script: str) -> None:
    path = folder / name
    path.write_text(f"#!/bin/sh\n{script}\n")
    path.chmod(0o755)


@pytest.fixture
def slurm(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder on the path where the commands of Slurm are looked for first; files for one node, which is this one."""
    monkeypatch.setenv("PATH", f"{tmp_path}{os.pathsep}{os.environ['PATH']}")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(ROOT / "tests"), str(ROOT)]))
    write(tmp_path / "slurm.toml", SLURM + 'scheduler_options = { host = "127.0.0.1" }\n')
    return tmp_path


def test_jobs_are_submitted_flown_on_and_ended(slurm: Path) -> None:
    command(slurm, "sbatch", f'setsid sh "$1" >>{slurm}/log 2>&1 & echo Submitted batch job $!; sleep 0.1')
    command(slurm, "scancel", 'kill -9 -- -"$1"')
    rows = fly(DaskEngine(str(slurm / "slurm.toml")), ToyPilot(asleep=0.02))
    assert known(rows) == ALL
    assert until(lambda: not living({row["process"] for row in rows}))


def test_jobs_that_are_not_taken_are_an_error(slurm: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    engine = DaskEngine(str(slurm / "slurm.toml"))
    command(slurm, "sbatch", "echo no such queue >&2; exit 1")
    with pytest.raises(EngineError, match=r"slurm did not take the jobs: .*no such queue"):
        fly(engine, ToyPilot())
    monkeypatch.setenv("PATH", "")
    jobs: Any = read_jobs(slurm / "slurm.toml")
    with pytest.raises(EngineError, match="no command 'sbatch' here: start the campaign where jobs are submitted"):
        submit(jobs)
