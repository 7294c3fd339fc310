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
"""Verdicts of flights without a row: an exception, a timeout, too much memory, or a dead process."""
_ONE_THREAD: Final = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
_PRELOAD: Final = (
    "quadsim",
    "quadsim.features.campaign.plan",
    "quadsim.mpc.laws.constrained",
    "quadsim.mpc.laws.parts.preparation",
    "quadsim.mpc.laws.unconstrained",
)
"""Preloaded by the server that workers are forked from; the first one finds the others by their place."""
_DRAWING: Final = "scipy.stats"
"""Preloaded where it is loaded here: it is slow to import, and some campaigns draw with it."""
_STARTING: Final = threading.Lock()  # a Dask worker may have several threads
_ADDRESS: Final = re.compile(r"(tcp|tls|ws|wss|ucx)://\S+:\d+")
_START_S: Final = 60.0  # longest start of a worker, or of the first one of a cluster; not counted as flight time
_CONNECT_S: Final = 10.0


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


def _here(flights: Iterable[Any], fly: bytes, count: int, timeout: float, memory: float, isolate: bool) -> FlownRows:
    """Yield the rows of flights by a number of workers, each with its index; arguments as `fly_many`."""
    remaining = enumerate(flights)
    workers = list[_Worker]()
    try:
        flight = next(remaining, None)
        while flight is not None or workers:
            while flight is not None and len(workers) < count:
                worker = _Worker(fly, timeout, memory)
                workers.append(worker)
                worker.hand(*flight)
                flight = next(remaining, None)
            ready = _wait(workers)
            rows = []
            for worker in workers[:]:
                row = worker.row(ready)
                if row is None:
                    continue
                rows.append((worker.place, row))
                if flight is not None and worker.usable and not isolate:
                    worker.hand(*flight)
                    flight = next(remaining, None)
                else:
                    workers.remove(worker)
                    worker.end()
            yield from rows  # not before every worker has its next flight: the caller may take its time
    finally:
        for worker in workers:
            worker.end()


def _wait(workers: Sequence[_Worker]) -> Sequence[object]:
    """Wait until one of the workers has news, or its time is up; return the ends that are ready."""
    ends: list[Any] = []
    for worker in workers:
        ends += worker.ends
    first_deadline = min(worker.deadline for worker in workers)
    return connection.wait(ends, max(first_deadline - clock.monotonic(), 0.0))


class _Worker:
    """A process that flies one flight at a time."""

    def __init__(self, fly: bytes, timeout: float, memory: float) -> None:
        self._timeout = timeout
        self.place = -1
        self.usable = True
        self.deadline = 0.0
        self._start_s = _START_S
        context = multiprocessing.get_context("forkserver")
        preload = [*_PRELOAD]
        if _DRAWING in sys.modules:
            preload.append(_DRAWING)
        context.set_forkserver_preload(preload)
        self.pipe, theirs = context.Pipe()
        self.process = context.Process(target=_serve, args=(theirs, fly, memory), daemon=True)
        with closing(theirs), _starting():
            self.process.start()
        self.ends = (self.pipe, self.process.sentinel)  # either becomes ready when there is news

    def hand(self, place: int, flight: Any) -> None:
        """Give it a flight to fly, with its index."""
        self.place = place
        self.deadline = clock.monotonic() + self._timeout + self._start_s
        with suppress(OSError):  # it is dead already, which its sentinel shows
            self.pipe.send(flight)

    def row(self, ready: Sequence[object]) -> Row | None:
        """Return the row of its flight; None while it flies."""
        if self.pipe in ready:
            with suppress(Exception):  # it died while sending it
                row = self.pipe.recv()
                if row is None:  # it has started: its first flight begins now
                    self._start_s = 0.0
                    self.deadline = clock.monotonic() + self._timeout
                    return None
                if isinstance(row, dict):
                    self.usable = row.get("verdict") != MEMORY
                    return row
        self.usable = False
        if self.pipe in ready or self.process.sentinel in ready:
            self.process.join(0.5)
            code = self.process.exitcode
            if code is None:
                how = "without a row"
            elif code < 0:
                how = f"by signal {-code}"
            else:
                how = f"with exit status {code}"
            return {"verdict": DIED, "reason": f"its process ended {how}"}
        if clock.monotonic() >= self.deadline:
            return {"verdict": TIMEOUT, "reason": f"it took longer than {self._timeout:g} s"}
        self.usable = True
        return None

    def end(self) -> None:
        """Kill it, and its process group."""
        for kill in (os.killpg, os.kill):  # the second if it has no group yet
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
        before = {name: os.environ.get(name) for name in _ONE_THREAD}
        os.environ.update(dict.fromkeys(_ONE_THREAD, "1"))
        script = sys.modules["__main__"]
        sys.modules["__main__"] = ModuleType("__main__")
        try:
            yield
        finally:
            sys.modules["__main__"] = script
            for name, value in before.items():
                if value is None:
                    del os.environ[name]
                else:
                    os.environ[name] = value
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)


def _serve(pipe: connection.Connection, fly: bytes, memory: float) -> None:
    """Fly what arrives until the caller exits."""
    os.setpgid(0, 0)  # Ctrl-C is for the caller; one signal ends everything that a flight starts
    _die_with_caller()
    os.dup2(2, 1)  # output of controllers must not mix with the caller's
    _limit_memory(memory)
    load = functools.cache(pickle.loads)
    with suppress(EOFError, OSError):
        pipe.send(None)
        while True:
            flight = pipe.recv()
            gc.freeze()  # so that the pass below, up to 30 ms, is over what the flight has made alone
            pipe.send_bytes(_row(lambda flight: load(fly)(flight), flight, memory))
            gc.collect()  # a flight may leave a dozen megabytes in cycles


def _die_with_caller() -> None:
    """Ask the system to kill this group when the caller exits, even while a controller holds the interpreter."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    fcntl.fcntl(parent.sentinel, fcntl.F_SETOWN, -os.getpgrp())
    fcntl.fcntl(parent.sentinel, fcntl.F_SETSIG, signal.SIGKILL)
    fcntl.fcntl(parent.sentinel, fcntl.F_SETFL, fcntl.fcntl(parent.sentinel, fcntl.F_GETFL) | os.O_ASYNC)
    if connection.wait([parent.sentinel], 0.0):
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
    """Limit this process's memory; if the machine runs out of memory, the system kills it first."""
    status = Path("/proc/self/status").read_text(encoding="ascii", errors="replace")
    held = re.search(r"^VmData:\s*(\d+) kB", status, flags=re.MULTILINE)
    assert held is not None
    most = int(1024 * int(held[1]) + megabytes * 1e6)
    resource.setrlimit(resource.RLIMIT_DATA, (most, most))
    Path("/proc/self/oom_score_adj").write_text("1000", encoding="ascii")


# --- on a cluster ----------------------------------------------------------------------------------------------------


def _on_cluster(address: str, flights: Iterable[Any], fly: bytes, timeout: float, memory: float) -> FlownRows:
    remaining = enumerate(flights)
    places = dict[str, int]()
    with _client(address) as client:
        distributed = _distributed()
        work = distributed.as_completed(loop=client.loop)

        def submit() -> None:
            """Submit two flights per thread, so that no thread waits for its next one."""
            for place, flight in remaining:
                future = client.submit(_beside, fly, flight, timeout, memory, _code(), pure=False)
                places[future.key] = place
                work.add(future)
                if len(places) >= 2 * _threads(client):
                    break

        submit()
        for future in work:
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


def _beside(fly: bytes, flight: Any, timeout: float, memory: float, code: Mapping[str, str]) -> Row:
    """In a Dask worker, fly in a child process, so that no flight can harm the worker."""
    differing = []
    for name, value in _code().items():
        if code.get(name) != value:
            differing.append(f"{name} {value}, not {code.get(name)}")
    if differing:
        raise ClusterError(f"it has {', '.join(differing)}")
    multiprocessing.current_process()._config["daemon"] = False  # type: ignore[attr-defined]  # it may have children
    with closing(_here([flight], fly, 1, timeout, memory, isolate=True)) as rows:
        return next(rows)[1]


def _distributed() -> Any:
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
