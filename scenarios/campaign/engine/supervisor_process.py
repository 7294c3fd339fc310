"""A supervisor as a process of its own, for a Dask worker, which has threads and so may not fork."""

from __future__ import annotations

import contextlib
import json
import os
import socket
import subprocess
import sys
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Final

from scenarios.campaign.engine.protocol import MOST_DEATHS, ONE_THREAD, Answer, EngineError, Pilot
from scenarios.campaign.engine.supervisor import Died, Ready, Unfit, serve

_MAIN: Final = (
    "import json, sys; sys.path[:] = json.loads(sys.argv[2]); import scenarios.campaign.preload; "
    "from scenarios.campaign.engine.supervisor_process import main; main(int(sys.argv[1]))"
)


class SupervisorProcess:
    """Flies one flight at a time beside this process; whoever dies of it is replaced."""

    def __init__(self, pilot: Pilot, pickled: bytes) -> None:
        self._pilot, self._pickled = pilot, pickled
        self._process: subprocess.Popen[bytes] | None = None
        self._pipe: Connection | None = None

    def fly(self, flight: int) -> Answer:
        """What became of a flight, after as many tries as its process may die.

        Raises:
            EngineError: nobody can fly here.
        """
        ending = ""
        for _ in range(MOST_DEATHS):
            try:
                pipe = self._pipe or self._start()
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
        if self._pipe is not None and self._process is not None:
            self._pipe.close()
            self._process.wait()
            self._pipe = None

    def _start(self) -> Connection:
        ours, theirs = socket.socketpair()
        with theirs:
            command = [sys.executable, "-c", _MAIN, str(theirs.fileno()), json.dumps(sys.path)]
            self._process = subprocess.Popen(
                command, pass_fds=[theirs.fileno()], stdin=subprocess.DEVNULL, env={**os.environ, **ONE_THREAD}
            )
        self._pipe = Connection(ours.detach())
        self._pipe.send_bytes(self._pickled)
        match self._pipe.recv():
            case Unfit(reason):
                raise EngineError(f"a worker process cannot fly here: {reason}")
            case Ready():
                return self._pipe
        raise EOFError


def main(descriptor: int) -> None:
    """What the process runs; `descriptor` is its end of the pipe."""
    with contextlib.closing(Connection(descriptor)) as pipe:
        serve(pipe, str(Path.cwd()))
