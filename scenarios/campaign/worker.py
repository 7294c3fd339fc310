"""A process that flies what its keeper hands it, and says what came of each flight."""

from __future__ import annotations

import os
import pickle
import struct
from mmap import mmap
from typing import Final, NamedTuple, NoReturn

from quadsim.campaign.table import MEMORY
from scenarios.campaign.engine import Answer, Pilot, fly_one
from scenarios.campaign.processes import die_with, limit_memory
from scenarios.campaign.traces import Traces

FLIGHT: Final = struct.Struct("=q")
"""A flight's number, as a keeper hands it out."""
SIZE: Final = struct.Struct("=Q")
"""Of what follows, a pickled `Told` [bytes]."""
PULSE_BYTES: Final = 8


class Told(NamedTuple):
    """What a worker says of a flight.

    Attributes:
        answer: what came of it.
        spent: whether the flight left something in the process that the next one would meet.
    """

    answer: Answer
    spent: bool


def fly_for(keeper: int, pilot: Pilot, inbox: int, outbox: int, pulse: mmap) -> NoReturn:
    """Fly until somebody ends this process.

    Args:
        keeper: the process that this one was forked from, and is not to outlive.
        pilot: flies.
        inbox: file descriptor that flights are read from.
        outbox: file descriptor that takes what is said.
        pulse: shared with the keeper: 0 outside of control periods, else a number that changes with each.
    """
    os.setpgid(0, 0)  # so that all that a controller starts can be ended in one stroke
    die_with(keeper)
    os.dup2(2, 1)  # what controllers print is no part of a campaign's answer
    limit_memory(pilot.limits.memory)
    pilot.prepare()
    me, pipes, traces = os.getpid(), (_identity(inbox), _identity(outbox)), Traces()
    periods = memoryview(pulse).cast("Q")

    def beat(stage: str, done: int, total: int) -> None:
        if os.getpid() != me:  # a controller forked: there is one flight, not two
            os._exit(0)
        periods[0] = done + 1 if done < total else 0

    while True:
        (flight,) = FLIGHT.unpack(_read(inbox, FLIGHT.size))
        answer = fly_one(pilot, flight, beat)
        periods[0] = 0
        if os.getpid() != me or (_identity(inbox), _identity(outbox)) != pipes:
            os._exit(1)
        spent = answer.row.get("verdict") == MEMORY or traces.found()
        said = pickle.dumps(Told(answer, spent))
        _write(outbox, SIZE.pack(len(said)) + said)


def _identity(descriptor: int) -> tuple[int, int]:
    """What a file descriptor stands for: a controller that closes it may open another file in its place."""
    try:
        found = os.fstat(descriptor)
    except OSError:
        return -1, -1
    return found.st_dev, found.st_ino


def _read(descriptor: int, size: int) -> bytes:
    content = b""
    while len(content) < size:
        piece = os.read(descriptor, size - len(content))
        if not piece:
            os._exit(0)
        content += piece
    return content


def _write(descriptor: int, content: bytes) -> None:
    while content:
        content = content[os.write(descriptor, content) :]
