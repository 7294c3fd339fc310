"""Signals that stop the process, held back from the end of a flight until its tables are on disk."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable
from types import FrameType
from typing import Any, Final, Self

STOPS: Final = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class SignalHold:
    """A block in which a flight is flown and written, and in which no signal can lose it in between.

    Signals go to their handlers before the flight and in it, where they end it in order.  From its end on they wait,
    until its tables are written or the block ends.  Signals that are ignored stay so.

    Attributes:
        flown: whether the flight has ended.  It is assigned: a signal may come before a call, but not before this.
    """

    def __init__(self) -> None:
        self.flown = False
        self._written = False
        self._waiting: int | None = None
        self._handlers: dict[int, Callable[[int, FrameType | None], Any]] = {}

    def __enter__(self) -> Self:
        if threading.current_thread() is threading.main_thread():  # no other one may set handlers
            for stop in STOPS:
                handler = signal.getsignal(stop)
                if callable(handler):
                    self._handlers[stop] = handler
                    signal.signal(stop, self._receive)
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        for stop, handler in self._handlers.items():
            signal.signal(stop, handler)
        if kind is None:
            self.release()

    def release(self) -> None:
        """Let signals through again, first of all the one that has waited."""
        self._written = self.flown
        number = self._waiting
        if number is not None:
            self._waiting = None
            self._handlers[number](number, None)

    def _receive(self, number: int, frame: FrameType | None) -> None:
        if self.flown and not self._written:
            self._waiting = number
        else:
            self._handlers[number](number, frame)


def current_hold() -> SignalHold:
    """Return the hold whose block this thread is in; one without effect where it is in none."""
    if threading.current_thread() is threading.main_thread():
        for stop in STOPS:
            receiver = getattr(signal.getsignal(stop), "__self__", None)
            if isinstance(receiver, SignalHold):
                return receiver
    return SignalHold()
