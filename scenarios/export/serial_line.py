"""The other end of the serial line of `mpc/export/c/serial.c`: questions of state and reference, and answers."""

from __future__ import annotations

import struct
import zlib
from enum import IntEnum
from typing import Final, NamedTuple, Protocol

import numpy as np

from quadsim.errors import FlightError
from quadsim.state import N_STATES, Array
from quadsim.vehicle import N_ROTORS

MARK: Final = 0x4D504351
_LETTER: Final = {"double": "d", "float": "f"}


class Kind(IntEnum):
    """The kind of a query."""

    START = 0  # begin anew after u(-1), the reference its one row throughout
    ROW = 1  # take one more row of the reference
    STEP = 2  # take one more row and solve


class Reply(NamedTuple):
    """An answer: the number of its question, u(k) (4,) [rad/s], and a status of `quadsim_mpc.h`."""

    number: int
    command: Array
    status: int


class Line(Protocol):
    """A serial line."""

    def send(self, data: bytes) -> None:
        """Send all of it."""
        ...

    def receive(self, count: int) -> bytes:
        """`count` bytes; fewer where the other end has closed, or no longer answers."""
        ...


class Frames:
    """Questions and answers as bytes, in a precision."""

    def __init__(self, precision: str) -> None:
        letter = _LETTER[precision]
        self._question = struct.Struct(f"<2I{N_STATES + 2 * N_ROTORS}{letter}2I")
        self._answer = struct.Struct(f"<2I{N_ROTORS}{letter}2I")

    @property
    def answer_size(self) -> int:
        """Bytes of an answer."""
        return self._answer.size

    def question(self, kind: Kind, number: int, state: Array, row: Array, acting: Array) -> bytes:
        """A question with its checksum; what its kind does not take may be anything."""
        data = self._question.pack(MARK, number % 2**32, *state, *row, *acting, kind, 0)[:-4]
        return data + zlib.crc32(data).to_bytes(4, "little")

    def reply(self, data: bytes) -> Reply | None:
        """The answer that these bytes are; None where they are none."""
        if len(data) != self._answer.size:
            return None
        mark, number, *command, status, checksum = self._answer.unpack(data)
        if mark != MARK or checksum != zlib.crc32(data[:-4]):
            return None
        return Reply(number, np.array(command, np.float64), status)


class SerialMPC:
    """An exported controller of `double` or `float` numbers at the other end of a serial line."""

    def __init__(self, line: Line, precision: str, horizon: int) -> None:
        self._line, self._frames, self._horizon = line, Frames(precision), horizon
        self._number, self._window, self._speeds = 0, np.zeros((0, 4)), np.zeros(N_ROTORS)

    def reset(self, speeds: Array) -> None:
        """Begin anew after u(-1) (4,) [rad/s]."""
        self._speeds, self._window = np.array(speeds, float), np.zeros((0, 4))

    def step(self, time: float, state: Array, reference: Array, acting: Array) -> Reply:
        """The answer at t_k [s] to x(k) (12,), the reference (N, 4) and u(k-1) (4,) [rad/s].

        Where the reference is the last one moved on, its last row alone is sent.

        Raises:
            FlightError: no answer came, or none that is whole.
        """
        if not len(self._window):
            self._query(time, Kind.START, state, reference[0], self._speeds)
        if not np.array_equal(self._window[1:], reference[:-1]):
            for row in reference[:-1]:
                self._query(time, Kind.ROW, state, row, acting)
        self._window = np.array(reference)
        return self._query(time, Kind.STEP, state, reference[-1], acting)

    def _query(self, time: float, kind: Kind, state: Array, row: Array, acting: Array) -> Reply:
        self._number += 1
        self._line.send(self._frames.question(kind, self._number, state, row, acting))
        while True:
            reply = self._frames.reply(self._line.receive(self._frames.answer_size))
            if reply is None:
                problem = f"the controller at the serial line gave no answer to question {self._number}"
                raise FlightError(problem, time=time)
            if reply.number == self._number:  # else what its watchdog had sent meanwhile
                return reply
