"""Dask: workers that a scheduler knows, on whatever machines, or jobs of a batch system that start them."""

from __future__ import annotations

import contextlib
import importlib.metadata
import logging
import pickle
import queue
import re
import time as clock
from collections import Counter, deque
from collections.abc import Generator, Iterator, Mapping, Sequence
from functools import cache, cached_property
from pathlib import Path
from typing import Any, Final

from quadsim import __version__
from quadsim.errors import MissingPackageError, ParameterError
from scenarios.campaign.engine.jobs import Jobs, read_jobs, submit
from scenarios.campaign.engine.local import FlightByFlight
from scenarios.campaign.engine.protocol import MOST_DEATHS, Answer, EngineError, Pace, Pilot, describe
from scenarios.campaign.manifest import code_digest
from scenarios.campaign.results.table import Row

PATIENCE_S: Final = 60.0
PATIENCE_WITH_JOBS_S: Final = 86400.0  # jobs may stand in a queue for hours before the first worker is there
_DECIDE_NUMBERS: Final = ("mujoco", "numpy", "scipy", "piqp")
"""Packages that have to be the same everywhere for the same flight to give the same numbers."""
_ADDRESS: Final = re.compile(r"(tcp|tls|ws|wss|ucx)://\S+:\d+")
_LOOK_S: Final = 1.0
_CONNECT_S: Final = 10.0
_FETCH_S: Final = 10.0
_LOGGERS: Final = ("distributed", "distributed.client", "tornado.application", "asyncio")
_supervisors: dict[bytes, FlightByFlight] = {}  # of this worker: one at most, of the campaign that it flies


class DaskEngine:
    """Workers of a Dask scheduler, one flight at a time each.

    Args:
        cluster: the scheduler's address, e.g. `tcp://10.0.0.1:8786`, or a TOML file for `jobs.read_jobs`.
        patience: how long to wait without any worker [s]; by default a minute, or a day with jobs of a batch system.

    Raises:
        InputError: the address or the file is wrong.
        MissingPackageError: the extra `cluster` is not installed.
    """

    name = "dask"

    def __init__(self, cluster: str, *, patience: float | None = None) -> None:
        _distributed()
        if patience is not None and not patience > 0:
            raise ParameterError("", "patience", patience, "> 0 s")
        self._jobs = None if _ADDRESS.fullmatch(cluster) else _jobs(cluster)
        self._where = f"the scheduler at {cluster}" if self._jobs is None else f"the jobs of {cluster}"
        self._address = cluster
        self._patience = patience or (PATIENCE_S if self._jobs is None else PATIENCE_WITH_JOBS_S)

    @cached_property
    def workers(self) -> int:
        """Workers that the jobs will start, or that the scheduler knows at the first call.

        Raises:
            EngineError: no scheduler answers.
        """
        if self._jobs is not None:
            return self._jobs.workers
        with self._client() as client:
            return len(client.scheduler_info(n_workers=-1)["workers"])

    def answers(self, pilot: Pilot, flights: Sequence[int]) -> Generator[Row]:
        """See `Engine.answers`.

        Raises:
            EngineError: no worker is there for too long, the scheduler is gone, or a worker has another quadsim.
        """
        if not flights:
            return
        with self._client() as client:
            work = _Flights(client, pilot, flights, where=self._where, patience=self._patience)
            try:
                yield from work.answers()
            finally:
                work.stop()

    @contextlib.contextmanager
    def _client(self) -> Iterator[Any]:
        with contextlib.ExitStack() as stack:
            stack.enter_context(_silent())
            address: Any = self._address
            if self._jobs is not None:
                address = submit(self._jobs)
                stack.callback(address.close)
            try:
                client = _distributed().Client(address, timeout=_CONNECT_S, set_as_default=False)
            except (OSError, ValueError, ImportError) as error:
                raise EngineError(f"{self._where} does not answer ({describe(error)})") from error
            stack.callback(client.close, timeout=2.0)
            yield client


def fly_chunk(pickled: bytes, chunk: Sequence[int], expected: Mapping[str, str]) -> list[Answer]:
    """Have flights flown one after the other, beside a worker; those after a cancellation are left out.

    The pilot is small against seconds of work; each worker makes it once.

    Raises:
        EngineError: the worker has other versions than expected, or no worker can fly there.
    """
    worker = _distributed().get_worker()
    other = [f"{name} {found}, not {expected[name]}" for name, found in versions().items() if found != expected[name]]
    if other:
        raise EngineError(f"the worker at {worker.address} has {', '.join(other)} as here: install the same there")
    supervisor = _supervisor(pickled)
    key, answers = worker.get_current_task(), []
    for flight in chunk:
        task = worker.state.tasks.get(key)
        if task is None or task.state == "cancelled":
            break
        answers.append(supervisor.fly(flight))
    return answers


def _supervisor(pickled: bytes) -> FlightByFlight:
    """What a worker starts once for a campaign; an earlier one's is ended."""
    if pickled not in _supervisors:
        pilot: Pilot = pickle.loads(pickled)
        for other in _supervisors.values():
            other.stop()
        _supervisors.clear()
        _supervisors[pickled] = FlightByFlight(pilot, pickled)
    return _supervisors[pickled]


@cache
def versions() -> dict[str, str]:
    """Versions of what decides a flight's numbers, our own code by its digest."""
    packages = {name: importlib.metadata.version(name) for name in _DECIDE_NUMBERS}
    return {"quadsim": f"{__version__}, {code_digest()[:19]}", **packages}


class _Flights:
    """The flights of one campaign, waiting or with the scheduler.

    The scheduler has one chunk per worker, no more: it blames all that a worker has, flown or not, for its death.
    It may still give one worker two, so what it blames is only suspect: each suspect flies again in the end, alone.
    """

    def __init__(self, client: Any, pilot: Pilot, flights: Sequence[int], *, where: str, patience: float) -> None:
        self._client, self._pilot, self._where, self._patience = client, pilot, where, patience
        self._waiting, self._unanswered = deque(flights), len(flights)
        self._suspects: deque[int] = deque()
        self._deaths: Counter[int] = Counter()
        self._pace = Pace()
        self._flying: dict[str, tuple[Any, list[int]]] = {}
        self._landed: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._workers, self._looked = 0, -float("inf")
        self._seen = clock.monotonic()
        self._pickled = pickle.dumps(pilot)

    def answers(self) -> Generator[Row]:
        while self._unanswered:
            self._look()
            self._hand_out()
            rows = self._hear()
            self._unanswered -= len(rows)
            self._hand_out()  # everybody has work again before the caller gets to use what is answered
            yield from rows

    def stop(self) -> None:
        """Take back what is not flown."""
        if self._client.status == "running":
            with contextlib.suppress(Exception):  # the scheduler may go at this very moment
                self._client.cancel([future for future, _ in self._flying.values()], force=True)

    def _look(self) -> None:
        now = clock.monotonic()
        if now - self._looked < _LOOK_S:
            return
        if self._client.status != "running":
            raise self._gone()
        try:
            workers = self._client.scheduler_info(n_workers=-1)["workers"]
        except (OSError, RuntimeError) as error:
            raise self._gone() from error
        for address, worker in workers.items():
            if worker["nthreads"] != 1:
                raise EngineError(
                    f"the worker at {address} takes {worker['nthreads']} flights at once, and has to take one: "
                    "start workers with --nthreads 1, as many as there are cores"
                )
        self._workers, self._looked = len(workers), now
        if workers:
            self._seen = now
        elif now - self._seen > self._patience:
            raise EngineError(f"{self._where}: no worker for {self._patience:g} s; start some, then use --resume")

    def _hand_out(self) -> None:
        while self._waiting and len(self._flying) < self._workers:
            size = min(len(self._waiting), self._pace.chunk(len(self._waiting), self._workers))
            self._submit([self._waiting.popleft() for _ in range(size)])
        if self._suspects and self._workers and not self._flying:
            self._submit([self._suspects.popleft()])

    def _submit(self, chunk: list[int]) -> None:
        try:
            future = self._client.submit(fly_chunk, self._pickled, chunk, versions(), pure=False)
        except Exception as error:  # dask raises a bare Exception when it has lost its scheduler
            raise self._gone() from error
        self._flying[future.key] = future, chunk
        future.add_done_callback(self._landed.put)

    def _hear(self) -> list[Row]:
        """Wait for a chunk, but not for ever; the rows of all that have landed."""
        rows: list[Row] = []
        with contextlib.suppress(queue.Empty):
            rows += self._take(self._landed.get(timeout=_LOOK_S))
            while True:
                rows += self._take(self._landed.get_nowait())
        return rows

    def _take(self, future: Any) -> list[Row]:
        _, chunk = self._flying.pop(future.key)
        if future.status == "error":
            return self._failed(future.exception(), chunk)
        if future.status == "cancelled":
            raise self._gone()
        try:
            answers: list[Answer] = future.result(timeout=_FETCH_S)
        except _distributed().CancelledError as error:
            raise self._gone() from error
        except (OSError, TimeoutError):  # their worker died, no other has them
            self._waiting.extendleft(reversed(chunk))
            return []
        self._waiting.extendleft(reversed(chunk[len(answers) :]))  # of a chunk that was called off, and yet came
        for answer in answers:
            self._pace.note(answer)
        return [answer.row for answer in answers]

    def _failed(self, error: BaseException, chunk: list[int]) -> list[Row]:
        if isinstance(error, EngineError):
            raise error
        if not isinstance(error, _distributed().KilledWorker):
            raise EngineError(
                f"{self._where}: a worker cannot fly ({describe(error)}); every worker, and the scheduler, "
                f"needs quadsim {__version__} and what it needs"
            ) from error
        if not self._deaths.keys() >= set(chunk):  # not alone yet
            self._deaths.update(dict.fromkeys(chunk, 0))
            self._suspects.extend(chunk)
            return []
        (flight,) = chunk
        self._deaths[flight] += error.allowed_failures + 1
        if self._deaths[flight] < MOST_DEATHS:
            self._suspects.append(flight)
            return []
        return [self._pilot.lost(flight, f"its process died {self._deaths[flight]} times")]

    def _gone(self) -> EngineError:
        return EngineError(f"{self._where} is gone; finished flights are saved: continue with --resume")


def _jobs(file: str) -> Jobs:
    if not file.endswith(".toml"):
        raise ParameterError("", "cluster", file, "an address such as tcp://10.0.0.1:8786, or a path ending in .toml")
    return read_jobs(Path(file))


def _distributed() -> Any:
    try:
        import distributed
    except ModuleNotFoundError as error:
        raise MissingPackageError("a cluster", "distributed", extra="cluster") from error
    return distributed


@contextlib.contextmanager
def _silent() -> Iterator[None]:
    """Dask's own log is silent: what matters is raised."""
    loggers = [logging.getLogger(name) for name in _LOGGERS]
    levels = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)
