"""Many flights: a map over processes of this machine, or beside the workers of a Dask cluster.

Each flight gives one row, whatever happens: a flight that raises, hangs, dies or takes too much memory affects only
itself.  A worker is a process with its own pipe, forked in milliseconds from a server with preloaded libraries.
"""

from __future__ import annotations

import fcntl
import functools
import gc
import multiprocessing
import os
import pickle
import re
import resource
import signal
import sys
import threading
import time as clock
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from multiprocessing import connection, resource_tracker
from pathlib import Path
from types import ModuleType
from typing import Any, Final

from quadsim.errors import MissingPackageError, ParameterError, QuadsimError, described
from quadsim.rollout.machine import code_digest, usable_cores, versions

Row = dict[str, Any]  # one flight's values by column: numbers, texts, or None
FlownRows = Generator[tuple[int, Row]]
Fly = Callable[[Any], Row]
ERROR = "error"
TIMEOUT = "timeout"
MEMORY = "memory"
DIED = "died"
"""Verdicts of flights that returned no row: an exception, a timeout, too much memory, or a dead process."""
_ONE_THREAD: Final = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
_PRELOAD: Final = (
    "quadsim",
    "quadsim.features.campaign.plan",
    "quadsim.mpc.laws.constrained",
    "quadsim.mpc.laws.parts.preparation",
    "quadsim.mpc.laws.unconstrained",
)
"""Preloaded by the server that workers are forked from."""
_DRAWING: Final = "scipy.stats"
"""Preloaded where it is loaded here: it is slow to import, and some campaigns draw with it."""
_STARTING: Final = threading.Lock()  # a Dask worker may have several threads
_ADDRESS: Final = re.compile(r"(tcp|tls|ws|wss|ucx)://\S+:\d+")
_START_S: Final = 60.0  # longest start of a worker, or of the first one of a cluster; not counted as flight time
_CONNECT_S: Final = 10.0  # longest wait for a scheduler to answer


class ClusterError(QuadsimError):
    """A cluster cannot fly, or no longer; its earlier rows remain valid."""


def fly_many(
    flights: Iterable[Any],
    fly: Fly,
    *,
    workers: int | None = None,
    timeout: float = 600.0,
    memory: float = 2000.0,
    isolate: bool = False,
    cluster: str | None = None,
) -> FlownRows:
    """Yield the row of each flight with its index, as flights finish; closing the iterator, or Ctrl-C, stops all work.

    The row of a flight that failed has a `verdict` (error, timeout, memory, died) and a `reason`.

    Args:
        flights: what to fly, any picklable objects: scenarios, or numbers of a plan.
        fly: returns a flight's row; picklable as well.
        workers: number of processes; by default one per usable core.
        timeout: wall time limit per flight [s].
        memory: limit on a worker's memory beyond that at its start [MB].
        isolate: whether each flight gets a fresh process: for user code, whose flights could affect each other.
        cluster: address of a Dask scheduler; a process beside each of its workers flies.

    Raises:
        ParameterError: the number of workers or the address is invalid.
        MissingPackageError: the extra `cluster` is not installed.
        ClusterError: the scheduler does not answer, or its workers cannot fly.
    """
    _require(workers, cluster)
    if cluster is not None:
        return _on_cluster(cluster, flights, pickle.dumps(fly), timeout, memory)
    return _here(flights, pickle.dumps(fly), workers or usable_cores(), timeout, memory, isolate)


def count_workers(workers: int | None, cluster: str | None) -> int:
    """Return how many flights `fly_many` flies at a time; invalid arguments raise as they do there."""
    _require(workers, cluster)
    if cluster is None:
        return workers or usable_cores()
    with _client(cluster) as client:
        return _threads(client)


def _require(workers: int | None, cluster: str | None) -> None:
    """Raise if the number of workers, or the address of the cluster, is invalid."""
    if workers is not None and cluster is not None:
        raise ParameterError("", "--workers", workers, "absent with --cluster")
    if workers is not None and workers < 1:
        raise ParameterError("", "--workers", workers, "1 or more")
    if cluster is not None and not _ADDRESS.fullmatch(cluster):
        rule = "the address of a Dask scheduler, e.g. tcp://10.0.0.1:8786"
        raise ParameterError("", "--cluster", cluster, rule)


# --- on this machine -------------------------------------------------------------------------------------------------


def _here(
    flights: Iterable[Any], pickled_fly: bytes, count: int, timeout: float, memory: float, isolate: bool
) -> FlownRows:
    """Yield the rows of flights by `count` workers, each with its index; other arguments as `fly_many`."""
    remaining = enumerate(flights)
    workers = list[_Worker]()
    try:
        upcoming = next(remaining, None)  # the next flight, after its index; None after the last one
        while upcoming is not None or workers:
            while upcoming is not None and len(workers) < count:
                worker = _Worker(pickled_fly, timeout, memory)
                workers.append(worker)
                worker.hand(*upcoming)
                upcoming = next(remaining, None)
            ready = _wait(workers)
            rows = []
            for worker in workers[:]:
                row = worker.row(ready)
                if row is None:
                    continue
                rows.append((worker.place, row))
                flies_again = worker.usable and not isolate
                if upcoming is not None and flies_again:
                    worker.hand(*upcoming)
                    upcoming = next(remaining, None)
                else:
                    workers.remove(worker)
                    worker.end()
            yield from rows  # not before every worker has its next flight: the caller may take its time
    finally:
        for worker in workers:
            worker.end()


def _wait(workers: Sequence[_Worker]) -> Sequence[object]:
    """Wait until one of the workers has news, or its time is up; return those of all workers' `ends` that are ready."""
    ends: list[Any] = []
    for worker in workers:
        ends += worker.ends
    first_deadline = min(worker.deadline for worker in workers)
    return connection.wait(ends, max(first_deadline - clock.monotonic(), 0.0))


class _Worker:
    """A process that flies one flight at a time.

    Attributes:
        place: index of its flight.
        usable: whether it can fly another flight.
        deadline: monotonic time by which its flight must have a row [s].
        ends: its pipe and its process, one of which becomes ready when there is news.
    """

    def __init__(self, pickled_fly: bytes, timeout: float, memory: float) -> None:
        self._timeout = timeout
        self.place = -1
        self.usable = True
        self.deadline = 0.0
        self._start_s = _START_S  # time that its start may take, 0 once it has started
        context = multiprocessing.get_context("forkserver")
        preload = [*_PRELOAD]
        if _DRAWING in sys.modules:
            preload.append(_DRAWING)
        context.set_forkserver_preload(preload)
        self.pipe, theirs = context.Pipe()
        self.process = context.Process(target=_serve, args=(theirs, pickled_fly, memory), daemon=True)
        with closing(theirs), _starting():
            self.process.start()
        self.ends = (self.pipe, self.process.sentinel)

    def hand(self, place: int, flight: Any) -> None:
        """Give it a flight to fly, with its index."""
        self.place = place
        self.deadline = clock.monotonic() + self._timeout + self._start_s
        with suppress(OSError):  # it is dead already, which its sentinel shows
            self.pipe.send(flight)

    def row(self, ready: Sequence[object]) -> Row | None:
        """Return the row of its flight; None while it flies."""
        if self.pipe in ready:
            with suppress(Exception):  # it died while it sent the row
                row = self.pipe.recv()
                if row is None:  # it has started: its first flight begins now
                    self._start_s = 0.0
                    self.deadline = clock.monotonic() + self._timeout
                    return None
                if isinstance(row, dict):
                    self.usable = row.get("verdict") != MEMORY
                    return row
        if self.pipe in ready or self.process.sentinel in ready:
            self.usable = False
            return {"verdict": DIED, "reason": f"its process ended {self._cause_of_end()}"}
        if clock.monotonic() >= self.deadline:
            self.usable = False
            return {"verdict": TIMEOUT, "reason": f"it took longer than {self._timeout:g} s"}
        return None

    def _cause_of_end(self) -> str:
        """Return by what its process ended, in words."""
        self.process.join(0.5)
        code = self.process.exitcode
        if code is None:
            return "without a row"
        if code < 0:
            return f"by signal {-code}"
        return f"with exit status {code}"

    def end(self) -> None:
        """Kill it, and its process group."""
        for kill in (os.killpg, os.kill):  # the process alone, where it has no group yet
            with suppress(OSError):
                kill(self.process.pid or 0, signal.SIGKILL)
        self.process.join(5.0)
        self.pipe.close()


@contextmanager
def _starting() -> Iterator[None]:
    """Start processes with one linear-algebra thread, without Ctrl-C, and without rerunning the caller's script."""
    with _STARTING:
        resource_tracker.ensure_running()  # it unblocks signals when it starts
        mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        threads_before = {name: os.environ.get(name) for name in _ONE_THREAD}
        os.environ.update(dict.fromkeys(_ONE_THREAD, "1"))
        script = sys.modules["__main__"]
        sys.modules["__main__"] = ModuleType("__main__")  # it has no file that a new process would run
        try:
            yield
        finally:
            sys.modules["__main__"] = script
            for name, value in threads_before.items():
                if value is None:
                    del os.environ[name]
                else:
                    os.environ[name] = value
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)


def _serve(pipe: connection.Connection, pickled_fly: bytes, memory: float) -> None:
    """Fly what arrives until the caller exits."""
    os.setpgid(0, 0)  # Ctrl-C is for the caller; one signal ends everything that a flight starts
    _die_with_caller()
    os.dup2(2, 1)  # output of controllers must not mix with the caller's
    _limit_memory(memory)
    load = functools.cache(pickle.loads)

    def fly(flight: Any) -> Row:
        function = load(pickled_fly)  # here, so that an error of loading becomes the row of each flight
        row: Row = function(flight)
        return row

    with suppress(EOFError, OSError):
        pipe.send(None)  # it has started
        while True:
            flight = pipe.recv()
            gc.freeze()  # so that the collection below, up to 30 ms over all objects, is over this flight's alone
            pipe.send_bytes(_row(fly, flight, memory))
            gc.collect()  # a flight may leave a dozen megabytes in cycles


def _die_with_caller() -> None:
    """Ask the system to kill this group when the caller exits, even while a controller holds the interpreter."""
    caller = multiprocessing.parent_process()
    assert caller is not None
    sentinel = caller.sentinel  # a pipe that becomes ready when the caller exits
    flags = fcntl.fcntl(sentinel, fcntl.F_GETFL)
    fcntl.fcntl(sentinel, fcntl.F_SETOWN, -os.getpgrp())
    fcntl.fcntl(sentinel, fcntl.F_SETSIG, signal.SIGKILL)
    fcntl.fcntl(sentinel, fcntl.F_SETFL, flags | os.O_ASYNC)
    if connection.wait([sentinel], 0.0):  # the caller exited before this was set
        os.killpg(0, signal.SIGKILL)


def _row(fly: Fly, flight: Any, memory: float) -> bytes:
    """Return the pickled row of a flight, whatever it raises."""
    try:
        return pickle.dumps(fly(flight))
    except MemoryError as error:
        return pickle.dumps({"verdict": MEMORY, "reason": f"{described(error)} (it may take {memory:g} MB)"})
    except BaseException as error:  # a user's controller may call exit, too
        return pickle.dumps({"verdict": ERROR, "reason": described(error)})


def _limit_memory(megabytes: float) -> None:
    """Limit this process's memory beyond what it has; if the machine runs out of it, this one is killed first."""
    status = Path("/proc/self/status").read_text(encoding="ascii", errors="replace")
    held = re.search(r"^VmData:\s*(\d+) kB", status, flags=re.MULTILINE)
    assert held is not None
    most = int(1024 * int(held[1]) + megabytes * 1e6)
    resource.setrlimit(resource.RLIMIT_DATA, (most, most))
    Path("/proc/self/oom_score_adj").write_text("1000", encoding="ascii")


# --- on a cluster ----------------------------------------------------------------------------------------------------


def _on_cluster(address: str, flights: Iterable[Any], pickled_fly: bytes, timeout: float, memory: float) -> FlownRows:
    """Yield the rows of flights by a process beside each worker of a cluster; arguments and errors as `fly_many`."""
    remaining = enumerate(flights)
    places = dict[str, int]()  # of the flights that were submitted, by the keys of their futures
    with _client(address) as client:
        distributed = _distributed()
        futures = distributed.as_completed(loop=client.loop)

        def submit() -> None:
            """Submit two flights per thread, so that no thread waits for its next one."""
            for place, flight in remaining:
                future = client.submit(_beside, pickled_fly, flight, timeout, memory, _code(), pure=False)
                places[future.key] = place
                futures.add(future)
                if len(places) >= 2 * _threads(client):
                    break

        submit()
        for future in futures:
            try:
                row = future.result()
            except distributed.KilledWorker as error:  # several Dask workers died with the flight
                row = {"verdict": DIED, "reason": described(error)}
            except distributed.CancelledError as error:
                raise ClusterError(f"the scheduler at {address} is gone; continue with --resume") from error
            except Exception as error:
                rule = "every worker, and the scheduler, needs the quadsim, and the packages, that are here"
                raise ClusterError(f"{address}: a worker cannot fly ({described(error)}); {rule}") from error
            place = places.pop(future.key)
            submit()
            yield place, row


def _beside(pickled_fly: bytes, flight: Any, timeout: float, memory: float, code: Mapping[str, str]) -> Row:
    """In a Dask worker with the caller's `code`, fly in a child process, so that no flight can harm the worker."""
    differing = []
    for name, value in _code().items():
        if code.get(name) != value:
            differing.append(f"{name} {value}, not {code.get(name)}")
    if differing:
        raise ClusterError(f"it has {', '.join(differing)}")
    multiprocessing.current_process()._config["daemon"] = False  # type: ignore[attr-defined]  # it may have children
    with closing(_here([flight], pickled_fly, 1, timeout, memory, isolate=True)) as rows:
        _, row = next(rows)
        return row


def _distributed() -> Any:
    """Return the package of Dask's clusters.

    Raises:
        MissingPackageError: it is not installed.
    """
    try:
        import distributed
    except ModuleNotFoundError as error:
        raise MissingPackageError("a cluster", "distributed", extra="cluster") from error
    return distributed


@contextmanager
def _client(address: str) -> Iterator[Any]:
    """Yield a client of a scheduler with at least one worker."""
    distributed = _distributed()
    try:
        client = distributed.Client(address, timeout=_CONNECT_S, set_as_default=False)
    except (OSError, ValueError, ImportError) as error:
        raise ClusterError(f"the scheduler at {address} does not answer ({described(error)})") from error
    with client:
        try:
            client.wait_for_workers(1, timeout=_START_S)
        except TimeoutError as error:
            raise ClusterError(f"the scheduler at {address} has no worker; start one: dask worker {address}") from error
        yield client


def _threads(client: Any) -> int:
    """Return the number of threads of all workers of a cluster."""
    workers = client.scheduler_info(n_workers=-1)["workers"]
    return sum(worker["nthreads"] for worker in workers.values())


@functools.cache
def _code() -> dict[str, str]:
    """Return the versions of packages that determine a flight's numbers, and the digest of our code."""
    installed = versions()
    code = {name: installed[name] for name in ("mujoco", "numpy", "scipy", "piqp")}
    code["quadsim"] = code_digest()[:19]
    return code
