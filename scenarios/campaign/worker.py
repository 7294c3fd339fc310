"""A process that flies what its parent hands it through a pipe, and that leaves when its parent does."""

from __future__ import annotations

import contextlib
import os
import pickle
import signal
from multiprocessing.connection import Connection
from queue import SimpleQueue
from threading import Thread
from typing import NamedTuple

from threadpoolctl import threadpool_limits

from scenarios.campaign.engine import Answer, Pilot, fly_one, said
from scenarios.garbage import collect_rarely, settle


class Ready(NamedTuple):
    """The process waits for work."""


class Unfit(NamedTuple):
    """The process cannot fly, and why."""

    reason: str


Said = Ready | Unfit | Answer
"""What a worker tells its parent."""


def serve(pipe: Connection, folder: str) -> None:
    """Fly until the parent's end of the pipe is closed, even in the middle of a flight.

    Each flight is answered as soon as it is flown, so that a death loses one at most.

    Args:
        pipe: brings the pickled pilot, then chunks, lists of flights; takes what is said.
        folder: the parent's working directory.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches every process of a terminal; the parent sees to it
    collect_rarely()
    with contextlib.suppress(OSError):
        os.chdir(folder)
    inbox: SimpleQueue[bytes] = SimpleQueue()
    Thread(target=_receive, args=(pipe, inbox), daemon=True).start()
    with threadpool_limits(limits=1):
        try:
            pilot: Pilot = pickle.loads(inbox.get())
        except Exception as error:
            return _tell(pipe, Unfit(said(error)))
        settle()
        _tell(pipe, Ready())
        while True:
            chunk: list[int] = pickle.loads(inbox.get())
            for flight in chunk:
                _tell(pipe, fly_one(pilot, flight))


def _receive(pipe: Connection, inbox: SimpleQueue[bytes]) -> None:
    """Pass on what comes; the end of it is the end of the process."""
    try:
        while True:
            inbox.put(pipe.recv_bytes())
    except (EOFError, OSError):
        os._exit(0)


def _tell(pipe: Connection, said: Said) -> None:
    try:
        pipe.send(said)
    except OSError:  # nobody listens any more
        os._exit(0)
