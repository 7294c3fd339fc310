"""A process that starts a worker, hands it flights, watches it from outside and ends it with all that it started.

No controller ever runs in it: whatever one does, hang with the interpreter held, fork, take all memory, block signals,
it does to the worker, which the supervisor replaces.  It ends with its parent, and leaves no process.
"""

from __future__ import annotations

import contextlib
import gc
import os
import pickle
import signal
import time as clock
from collections import deque
from mmap import mmap
from multiprocessing import connection, forkserver
from multiprocessing.connection import Connection
from typing import Final, NamedTuple

from threadpoolctl import threadpool_limits

from scenarios.campaign.engine.processes import adopt_orphans, end_children, has_strays, memory_above
from scenarios.campaign.engine.protocol import Answer, Pilot, describe
from scenarios.campaign.engine.worker import FLIGHT, PULSE_BYTES, SIZE, FlightReport, fly_for
from scenarios.campaign.results.verdicts import MEMORY, TIMEOUT

LOOK_S: Final = 0.2  # between two looks at a worker that flies [s]
_TURN_S: Final = 1.0  # most that one look counts of the time since the last one [s]
_LEAVING_S: Final = 1.0  # for a worker without output to end [s]
_LARGEST: Final = 1 << 26  # largest message of a worker [bytes]


class Ready(NamedTuple):
    """The process waits for work."""


class Unfit(NamedTuple):
    """The process cannot fly, and why."""

    reason: str


class Died(NamedTuple):
    """The worker died while it flew the first of the flights that the supervisor had, which it does not try again."""

    ending: str


Message = Ready | Unfit | Died | Answer  # from a supervisor to its parent


def serve(pipe: Connection, folder: str) -> None:
    """Have flights flown until the parent ends it, or is gone, even in the middle of a flight.

    Each flight is answered as soon as it is flown, so that a death loses one at most.

    Args:
        pipe: brings the pickled pilot, then chunks, lists of flights, at last None; takes the answers.
        folder: the parent's working directory.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches every process of a terminal; the parent sees to it
    os.setsid()  # so that its parent can end its children, if it is killed
    with contextlib.suppress(AttributeError, TypeError, OSError):
        os.close(forkserver._forkserver._forkserver_alive_fd)  # type: ignore[attr-defined]  # what is written there kills the server
    adopt_orphans()
    with contextlib.suppress(OSError):
        os.chdir(folder)
    with threadpool_limits(limits=1), contextlib.suppress(EOFError, BrokenPipeError, ConnectionResetError):
        try:
            pilot: Pilot = pickle.loads(pipe.recv_bytes())
        except EOFError:
            raise
        except Exception as error:
            return pipe.send(Unfit(describe(error)))
        gc.collect()
        gc.freeze()
        _Supervisor(pilot, pipe).keep()
    return None


class _Worker:
    """A process that flies, and the ends of the pipes to it."""

    def __init__(self, pilot: Pilot, pulse: mmap, parents: Connection) -> None:
        supervisor = os.getpid()
        inbox, self._inbox = os.pipe()
        self.outbox, outbox = os.pipe()
        self.pid = os.fork()
        if self.pid == 0:
            try:
                parents.close()
                os.close(self._inbox)
                os.close(self.outbox)
                fly_for(supervisor, pilot, inbox, outbox, pulse)
            finally:
                os._exit(1)
        os.close(inbox)
        os.close(outbox)
        self._heard = b""

    def hand(self, flight: int) -> None:
        with contextlib.suppress(BrokenPipeError):  # it is dead already, which its supervisor will see
            os.write(self._inbox, FLIGHT.pack(flight))

    def hear(self) -> FlightReport | None:
        """Its message, once it is complete.

        Raises:
            EOFError: it will send no more messages.
            ValueError: the message is not one of a worker.
        """
        piece = os.read(self.outbox, 1 << 20)
        if not piece:
            raise EOFError
        self._heard += piece
        if len(self._heard) < SIZE.size:
            return None
        (size,) = SIZE.unpack_from(self._heard)
        if size > _LARGEST or len(self._heard) > SIZE.size + size:
            raise ValueError("too much")
        if len(self._heard) < SIZE.size + size:
            return None
        try:
            report = pickle.loads(self._heard[SIZE.size :])
        except Exception as error:
            raise ValueError("no pickle") from error
        if not isinstance(report, FlightReport):
            raise ValueError("something else")
        self._heard = b""
        return report

    def is_dead(self) -> bool:
        return os.waitid(os.P_PID, self.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is not None

    def ending(self) -> str:
        """How it ended; it gets a moment for that."""
        until = clock.monotonic() + _LEAVING_S
        while not self.is_dead():
            if clock.monotonic() > until:
                return "since it closed what it answers through"
            clock.sleep(0.001)
        code = os.waitstatus_to_exitcode(os.waitpid(self.pid, 0)[1])
        return f"by signal {-code}" if code < 0 else f"with exit status {code}"

    def end(self) -> None:
        """End it with all that it started."""
        os.close(self._inbox)
        os.close(self.outbox)
        end_children(self.pid)


class _Supervisor:
    def __init__(self, pilot: Pilot, pipe: Connection) -> None:
        self._pilot, self._pipe, self._limits = pilot, pipe, pilot.limits
        self._pulse = mmap(-1, PULSE_BYTES)
        self._flights: deque[int] = deque()
        self._worker: _Worker | None = None
        self._flying = False
        self._beat, self._spent, self._quiet = bytes(PULSE_BYTES), 0.0, 0.0

    def keep(self) -> None:
        try:
            self._send(Ready())
            while self._listen():
                if self._flights and not self._flying:
                    self._start()
        finally:
            self._dismiss()

    def _send(self, what: Message) -> None:
        self._pipe.send(what)

    def _start(self) -> None:
        if self._worker is None:
            try:
                self._worker = _Worker(self._pilot, self._pulse, self._pipe)
            except OSError as error:
                self._send(Unfit(describe(error)))
                raise EOFError from error
        self._pulse[:] = self._beat = bytes(PULSE_BYTES)
        self._spent = self._quiet = 0.0
        self._flying = True
        self._worker.hand(self._flights[0])

    def _dismiss(self) -> None:
        self._flying = False
        if self._worker is not None:
            self._worker.end()
            self._worker = None

    def _listen(self) -> bool:
        """Wait for whatever happens next, but not for long during a flight; False when it is time to leave."""
        worker, started = self._worker, clock.monotonic()
        watched: list[Connection | int] = [self._pipe, *((worker.outbox,) if worker else ())]
        happened = connection.wait(watched, timeout=LOOK_S if self._flying else None)
        if worker is not None and worker.outbox in happened:
            self._hear(worker)
        elif worker is not None and self._flying:
            waited = clock.monotonic() - started
            self._watch(worker, min(waited, _TURN_S))  # while this process was idle, it may have been too
        if self._pipe in happened:
            chunk = self._pipe.recv()
            if chunk is None:
                return False
            self._flights.extend(chunk)
        return True

    def _hear(self, worker: _Worker) -> None:
        try:
            report = worker.hear()
            if report is None:
                return
            if not self._flying or report.answer.row["flight"] != self._flights[0]:
                raise ValueError("unrequested")
        except EOFError:
            self._lose(worker.ending())
        except (ValueError, LookupError, AttributeError, TypeError) as error:
            self._lose(f"since what it answered is no answer ({error})")
        else:
            self._flights.popleft()
            self._flying = False
            self._send(report.answer)
            if report.spent or has_strays(worker.pid):
                self._dismiss()  # so that the next flight does not meet what this one left

    def _lose(self, ending: str) -> None:
        """The worker is gone, or unusable, and perhaps a flight with it."""
        flying = self._flying
        self._dismiss()
        if flying:
            self._flights.popleft()
            self._send(Died(ending))

    def _watch(self, worker: _Worker, waited: float) -> None:
        """See that a worker which flies is alive, and within its limits."""
        self._spent += waited
        beat = self._pulse[:]
        self._quiet = self._quiet + waited if beat == self._beat else 0.0
        self._beat = beat
        limits = self._limits
        in_a_period = any(beat)
        if worker.is_dead():
            self._lose(worker.ending())
        elif (held := memory_above(limits.memory, worker.pid)) is not None:
            self._stop(MEMORY, f"{held:.0f} MB were held, and limits.memory is {limits.memory:g} MB")
        elif in_a_period and self._quiet > limits.step:
            self._stop(TIMEOUT, f"a control period took {self._quiet:.1f} s, and limits.step is {limits.step:g} s")
        elif self._spent > limits.flight:
            self._stop(TIMEOUT, f"the flight took {self._spent:.1f} s, and limits.flight is {limits.flight:g} s")

    def _stop(self, verdict: str, reason: str) -> None:
        """End a flight that met a limit; once is enough."""
        self._dismiss()
        flight = self._flights.popleft()
        self._send(Answer(self._pilot.lost(flight, reason, verdict), self._spent))
