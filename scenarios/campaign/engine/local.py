"""Processes on this machine, started in milliseconds by a server that has the libraries loaded; replaced if killed.

Each is a supervisor with a worker of its own, see `scenarios.campaign.engine.supervisor`.  Once started it needs the
server no more.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import pickle
import signal
import sys
import time as clock
import warnings
from collections import Counter, deque
from collections.abc import Generator, Iterator, Sequence
from dataclasses import dataclass, field
from multiprocessing import connection, resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.context import ForkServerProcess
from pathlib import Path
from types import ModuleType
from typing import Final

from quadsim.errors import ParameterError
from scenarios.campaign.engine.processes import end_session, is_stopped
from scenarios.campaign.engine.protocol import MOST_DEATHS, ONE_THREAD, Answer, EngineError, Pace, Pilot, fair_share
from scenarios.campaign.engine.supervisor import Died, Ready, Unfit, serve
from scenarios.campaign.results.table import Row
from scenarios.machine import usable_cores

_AHEAD_S: Final = 1.0
"""Work [s] that a worker has in hand before it gets more: the parent may be writing files meanwhile."""
_SETTLED: Final = "scenarios.campaign.preload"
"""To be loaded by the server that forks the workers, and by no other process."""
_MOST_STARTS: Final = 5
_SILENCE_S: Final = 1.0  # after which supervisors are looked at: one that was stopped would keep silent for ever [s]
_LEAVING_S: Final = 8.0  # for a supervisor to end all processes below it [s]
_UNKNOWN: Final = 255  # the exit code of a process whose server died without reporting it


class LocalEngine:
    """Processes on this machine, one per usable core by default.

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
        pool = _Pool(pilot, flights, min(self._workers, len(flights)))
        try:
            yield from pool.answers()
        finally:
            pool.dismiss()


@dataclass(eq=False)
class _Supervisor:
    """A process, and what it has been handed and not answered; the first of it is being flown.

    One whose server died is orphaned: it flies what it has, and is replaced.
    """

    process: ForkServerProcess
    pipe: Connection
    pid: int
    ready: bool = False
    orphaned: bool = False
    flights: deque[int] = field(default_factory=deque)

    def dismiss(self) -> None:
        """Request its end, with all processes below it."""
        with contextlib.suppress(OSError):
            self.pipe.send(None)

    def ending(self) -> str:
        """How it ended, after a while by force; frees what it held."""
        until = clock.monotonic() + _LEAVING_S
        with contextlib.suppress(EOFError, OSError):  # a sign that it is gone, also after its server's death
            while self.pipe.poll(max(until - clock.monotonic(), 0.0)):
                self.pipe.recv_bytes()
            self.process.kill()
        self.pipe.close()
        self.process.join(timeout=_LEAVING_S)
        code = self.process.exitcode
        if code is not None:
            self.process.close()
        if code is None or code == _UNKNOWN:
            return "for an unknown reason"
        return f"by signal {-code}" if code < 0 else f"with exit status {code}"


class _Pool:
    """The processes of one campaign, and the flights that are not answered yet."""

    def __init__(self, pilot: Pilot, flights: Sequence[int], size: int) -> None:
        self._pilot, self._size = pilot, size
        self._pickled = pickle.dumps(pilot)
        self._waiting, self._unanswered = deque(flights), len(flights)
        self._supervisors: list[_Supervisor] = []
        self._deaths: Counter[int] = Counter()
        self._failed_starts = 0
        self._pace = Pace()

    def answers(self) -> Generator[Row]:
        self._replenish()
        while self._unanswered:
            rows = self._hear()
            self._unanswered -= len(rows)
            self._replenish()  # before the caller gets to use what is answered, which may take a while
            yield from rows

    def dismiss(self) -> None:
        for supervisor in self._supervisors:
            supervisor.dismiss()
        for supervisor in self._supervisors:
            supervisor.ending()
        self._supervisors.clear()

    def _replenish(self) -> None:
        """See that there are as many workers as can be used, and that all have work."""
        for supervisor in [each for each in self._supervisors if each.orphaned and not each.flights]:
            self._supervisors.remove(supervisor)
            supervisor.dismiss()
            supervisor.ending()
        while len(self._supervisors) < min(self._size, self._unanswered):
            self._supervisors.append(_start_supervisor(self._pilot, self._pickled))
        for supervisor in self._supervisors:
            self._hand_out(supervisor)

    def _hear(self) -> list[Row]:
        """Wait until a message comes or a process dies; all messages there are then."""
        pipes = [supervisor.pipe for supervisor in self._supervisors]
        sentinels = [supervisor.process.sentinel for supervisor in self._supervisors if not supervisor.orphaned]
        heard = connection.wait([*pipes, *sentinels], timeout=_SILENCE_S)
        rows: list[Row] = []
        if not heard:
            for supervisor in [each for each in self._supervisors if is_stopped(each.pid)]:
                rows += self._remove(supervisor)
        for supervisor in list(self._supervisors):
            supervisor.orphaned |= supervisor.process.sentinel in heard
            if supervisor.pipe in heard:
                rows += self._listen(supervisor)
        return rows

    def _listen(self, supervisor: _Supervisor) -> list[Row]:
        rows: list[Row] = []
        try:
            while supervisor.pipe.poll():
                match supervisor.pipe.recv():
                    case Answer() as answer if supervisor.flights and answer.row["flight"] == supervisor.flights[0]:
                        supervisor.flights.popleft()
                        self._pace.note(answer)
                        rows.append(answer.row)
                    case Died(ending) if supervisor.flights:
                        rows += self._again_or_lost(supervisor.flights.popleft(), ending)
                    case Unfit(reason):
                        raise EngineError(f"a worker process cannot fly here: {reason}")
                    case Ready():
                        supervisor.ready, self._failed_starts = True, 0
                    case _:  # unrequested
                        return rows + self._remove(supervisor)
        except (EOFError, OSError):
            return rows + self._remove(supervisor)
        return rows

    def _hand_out(self, supervisor: _Supervisor) -> None:
        """Hand out more, unless the supervisor has enough or there is nothing left."""
        waiting = len(self._waiting)
        enough = min(self._pace.flights_in(_AHEAD_S), fair_share(waiting, self._size))
        if supervisor.orphaned or not supervisor.ready or not waiting or len(supervisor.flights) > enough:
            return
        chunk = [self._waiting.popleft() for _ in range(min(waiting, self._pace.chunk(waiting, self._size)))]
        supervisor.flights.extend(chunk)
        with contextlib.suppress(OSError):  # as in `_start_supervisor`
            supervisor.pipe.send(chunk)

    def _remove(self, supervisor: _Supervisor) -> list[Row]:
        """Take a dead supervisor's flights back; it may be the first of them that it died of."""
        self._supervisors.remove(supervisor)
        supervisor.process.kill()
        ending = supervisor.ending()
        end_session(supervisor.pid)  # it had no time for that
        rows: list[Row] = []
        if supervisor.flights:
            rows += self._again_or_lost(supervisor.flights.popleft(), ending)
        elif not supervisor.ready:
            self._failed_starts += 1
            if self._failed_starts == _MOST_STARTS:
                raise EngineError(f"{_MOST_STARTS} worker processes died while they started, the last {ending}")
        self._waiting.extendleft(reversed(supervisor.flights))
        return rows

    def _again_or_lost(self, flight: int, ending: str) -> list[Row]:
        """A flight whose process died flies again, unless too many have died of it."""
        self._deaths[flight] += 1
        if self._deaths[flight] < MOST_DEATHS:
            self._waiting.appendleft(flight)
            return []
        return [self._pilot.lost(flight, f"its process died {MOST_DEATHS} times, last {ending}")]


class FlightByFlight:
    """Flies one flight at a time beside this process, which has no other use; a worker that dies is replaced."""

    def __init__(self, pilot: Pilot, pickled: bytes) -> None:
        self._pilot, self._pickled = pilot, pickled
        self._supervisor: _Supervisor | None = None

    def fly(self, flight: int) -> Answer:
        """What became of a flight, after as many tries as its process may die.

        Raises:
            EngineError: no worker can fly here.
        """
        ending = ""
        for _ in range(MOST_DEATHS):
            try:
                pipe = (self._supervisor or self._start()).pipe
                pipe.send([flight])
                match pipe.recv():
                    case Answer() as answer:
                        return answer
                    case Unfit(reason):
                        raise EngineError(f"a worker process cannot fly here: {reason}")
                    case Died(ending):
                        pass
            except (EOFError, OSError):
                ending = "for an unknown reason"
                self.stop()
        reason = f"its process died {MOST_DEATHS} times, last {ending}"
        return Answer(self._pilot.lost(flight, reason), 0.0)

    def stop(self) -> None:
        """End the supervisor, which ends everybody whom it keeps."""
        if self._supervisor is not None:
            self._supervisor.dismiss()
            self._supervisor.ending()
            self._supervisor = None

    def _start(self) -> _Supervisor:
        self._supervisor = _start_supervisor(self._pilot, self._pickled)
        match self._supervisor.pipe.recv():
            case Unfit(reason):
                raise EngineError(f"a worker process cannot fly here: {reason}")
            case Ready():
                return self._supervisor
        raise EOFError


def _start_supervisor(pilot: Pilot, pickled: bytes) -> _Supervisor:
    """Start a supervisor for a pilot, and hand it the pilot.

    Raises:
        EngineError: none can be started.
    """
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([__name__, type(pilot).__module__, _SETTLED])
    for start in range(_MOST_STARTS):
        ours, theirs = context.Pipe()
        process = context.Process(target=serve, args=(theirs, str(Path.cwd())), daemon=True)
        try:
            with _undisturbed():
                process.start()
        except (OSError, EOFError) as error:  # the server was killed just now; the next start makes a new one
            ours.close()
            problem = error
            clock.sleep(0.1 * start)
            continue
        finally:
            theirs.close()
        with contextlib.suppress(OSError):  # it is dead already, which its pipe will show
            ours.send_bytes(pickled)
        return _Supervisor(process, ours, process.pid or 0)
    raise EngineError(f"no supervisor process can be started here ({type(problem).__name__}: {problem})")


@contextlib.contextmanager
def _undisturbed() -> Iterator[None]:
    """What is started here keeps linear algebra to one thread, and never sees Ctrl-C, which waits here meanwhile.

    Nor does it run the parent's script again, as multiprocessing's children do, which takes longer than all the rest:
    nothing that a worker is handed belongs to that.  A daemon, such as Dask's workers, may start it too: it ends with
    its parent without multiprocessing's help.
    """
    before = {name: os.environ.get(name) for name in ONE_THREAD}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of one that was killed; it has nothing of ours
        resource_tracker.ensure_running()  # it lets signals through when it starts
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    os.environ.update(ONE_THREAD)
    script, sys.modules["__main__"] = sys.modules["__main__"], ModuleType("__main__")
    ours: dict[str, object] = multiprocessing.current_process()._config  # type: ignore[attr-defined]
    daemon = ours.pop("daemon", False)
    try:
        yield
    finally:
        ours["daemon"] = daemon
        sys.modules["__main__"] = script
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
