"""Processes on this machine, started in milliseconds by a server that has the libraries loaded; replaced if killed."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import pickle
import signal
import sys
import time as clock
from collections import Counter, deque
from collections.abc import Generator, Iterator, Sequence
from dataclasses import dataclass, field
from multiprocessing import connection, resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.context import ForkServerProcess
from pathlib import Path
from types import ModuleType
from typing import Final

from quadsim.campaign.table import Row
from quadsim.errors import ParameterError
from scenarios.campaign.engine import MOST_DEATHS, Answer, EngineError, Pace, Pilot, fair_share
from scenarios.campaign.worker import Unfit, serve
from scenarios.runner import usable_cores

_AHEAD_S: Final = 1.0
"""Work [s] that a worker has in hand before it gets more: the parent may be writing files meanwhile."""
_SETTLED: Final = "scenarios.campaign.preload"
"""To be loaded by the server that forks the workers, and by no other process."""
_MOST_STARTS: Final = 5
_UNKNOWN: Final = 255
"""The exit code of a process whose server died, which would have told."""
_ONE_THREAD: Final = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}


class LocalEngine:
    """Processes on this machine.

    Args:
        workers: how many; one per usable core by default.

    Raises:
        ParameterError: fewer than one.
    """

    name = "local"

    def __init__(self, workers: int | None = None) -> None:
        if workers is not None and workers < 1:
            raise ParameterError("", "workers", workers, "1 or more")
        self._workers = workers or usable_cores()

    @property
    def workers(self) -> int:
        """See `Engine`."""
        return self._workers

    def answers(self, pilot: Pilot, flights: Sequence[int]) -> Generator[Row]:
        """See `Engine.answers`."""
        crew = _Crew(pilot, flights, min(self._workers, len(flights)))
        try:
            yield from crew.answers()
        finally:
            crew.dismiss()


@dataclass(eq=False)
class _Worker:
    """A process, and what it has been handed and not answered; the first of it is being flown."""

    process: ForkServerProcess
    pipe: Connection
    ready: bool = False
    flights: deque[int] = field(default_factory=deque)

    def stop(self) -> None:
        self.process.kill()
        self.pipe.close()

    def ending(self) -> str:
        """How it ended; frees what it held."""
        self.process.join(timeout=5.0)
        code = self.process.exitcode
        if code is not None:
            self.process.close()
        if code is None or code == _UNKNOWN:
            return "for an unknown reason"
        return f"by signal {-code}" if code < 0 else f"with exit status {code}"


class _Crew:
    """The processes of one campaign, and the flights that are not answered yet."""

    def __init__(self, pilot: Pilot, flights: Sequence[int], size: int) -> None:
        self._pilot, self._size = pilot, size
        self._pickled = pickle.dumps(pilot)
        self._waiting, self._unanswered = deque(flights), len(flights)
        self._workers: list[_Worker] = []
        self._deaths: Counter[int] = Counter()
        self._failed_starts = 0
        self._pace = Pace()
        self._context = multiprocessing.get_context("forkserver")
        self._context.set_forkserver_preload([__name__, type(pilot).__module__, _SETTLED])

    def answers(self) -> Generator[Row]:
        self._employ()
        while self._unanswered:
            rows = self._hear()
            self._unanswered -= len(rows)
            self._employ()  # before the caller gets to use what is answered, which may take a while
            yield from rows

    def dismiss(self) -> None:
        """Stop everybody at once."""
        for worker in self._workers:
            worker.stop()
        for worker in self._workers:
            worker.ending()
        self._workers.clear()

    def _employ(self) -> None:
        """See that there are as many workers as can be used, and that all have work."""
        while len(self._workers) < min(self._size, self._unanswered):
            self._hire()
        for worker in self._workers:
            self._feed(worker)

    def _hire(self) -> None:
        for start in range(_MOST_STARTS):
            ours, theirs = self._context.Pipe()
            process = self._context.Process(target=serve, args=(theirs, str(Path.cwd())), daemon=True)
            try:
                with _undisturbed():
                    process.start()
                    self._workers.append(_Worker(process, ours))
            except (OSError, EOFError) as error:  # the server was killed just now; the next start makes a new one
                ours.close()
                problem = error
                clock.sleep(0.1 * start)
                continue
            finally:
                theirs.close()
            with contextlib.suppress(OSError):  # it is dead already, which its pipe will tell
                ours.send_bytes(self._pickled)
            return
        raise EngineError(f"no worker process can be started here ({type(problem).__name__}: {problem})")

    def _hear(self) -> list[Row]:
        """Wait until somebody says something or dies; everything that is said then."""
        pipes = {worker.pipe: worker for worker in self._workers}
        sentinels = {worker.process.sentinel: worker for worker in self._workers}
        heard = connection.wait([*pipes, *sentinels])
        rows: list[Row] = []
        for worker in list(self._workers):
            ended = worker.process.sentinel in heard
            if ended or worker.pipe in heard:
                rows += self._listen(worker, ended=ended)
        return rows

    def _listen(self, worker: _Worker, *, ended: bool) -> list[Row]:
        rows: list[Row] = []
        try:
            while worker.pipe.poll():
                match worker.pipe.recv():
                    case Answer() as answer:
                        worker.flights.popleft()
                        self._pace.note(answer)
                        rows.append(answer.row)
                    case Unfit(reason):
                        raise EngineError(f"a worker process cannot fly here: {reason}")
                    case _:
                        worker.ready, self._failed_starts = True, 0
        except (EOFError, OSError):
            ended = True
        return rows + self._bury(worker) if ended else rows

    def _feed(self, worker: _Worker) -> None:
        """Hand out more, unless the worker has enough or there is nothing left."""
        waiting = len(self._waiting)
        enough = min(self._pace.flights_in(_AHEAD_S), fair_share(waiting, self._size))
        if not worker.ready or not waiting or len(worker.flights) > enough:
            return
        chunk = [self._waiting.popleft() for _ in range(min(waiting, self._pace.chunk(waiting, self._size)))]
        worker.flights.extend(chunk)
        with contextlib.suppress(OSError):  # as in `_hire`
            worker.pipe.send(chunk)

    def _bury(self, worker: _Worker) -> list[Row]:
        """Take a dead worker's flights back; the one that it was flying is lost once too many have died of it."""
        self._workers.remove(worker)
        worker.stop()
        ending = worker.ending()
        lost: list[Row] = []
        if worker.flights:
            flight = worker.flights[0]
            self._deaths[flight] += 1
            if self._deaths[flight] == MOST_DEATHS:
                worker.flights.popleft()
                lost.append(self._pilot.lost(flight, f"its process died {MOST_DEATHS} times, last {ending}"))
        elif not worker.ready:
            self._failed_starts += 1
            if self._failed_starts == _MOST_STARTS:
                raise EngineError(f"{_MOST_STARTS} worker processes died while they started, the last {ending}")
        self._waiting.extendleft(reversed(worker.flights))
        return lost


@contextlib.contextmanager
def _undisturbed() -> Iterator[None]:
    """What is started here keeps linear algebra to one thread, and never sees Ctrl-C, which waits here meanwhile.

    Nor does it run the parent's script again, as multiprocessing's children do, which takes longer than all the rest:
    nothing that a worker is handed belongs to that.
    """
    before = {name: os.environ.get(name) for name in _ONE_THREAD}
    resource_tracker.ensure_running()  # it lets signals through when it starts
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    os.environ.update(_ONE_THREAD)
    script, sys.modules["__main__"] = sys.modules["__main__"], ModuleType("__main__")
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
