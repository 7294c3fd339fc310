"""A process that flies what its supervisor hands it, and reports the outcome of each flight."""

from __future__ import annotations

import gc
import locale
import os
import pickle
import resource
import signal
import struct
import sys
import threading
import warnings
from mmap import mmap
from operator import is_
from pathlib import Path
from types import ModuleType
from typing import Any, Final, NamedTuple, NoReturn

import numpy as np

from scenarios.campaign.engine.processes import die_with, limit_memory
from scenarios.campaign.engine.protocol import Answer, Pilot, fly_one
from scenarios.campaign.results.verdicts import MEMORY

_PACKAGES: Final = ("quadsim", "mpc", "scenarios")
_MODULES: Final = (
    *("builtins", "gc", "math", "os", "random", "time", "warnings"),
    *("mujoco", "numpy", "numpy.linalg", "piqp", "scipy.linalg"),
)
"""Besides our own packages: modules that flights use, which user code may replace."""
_LIMITS: Final = tuple(getattr(resource, name) for name in dir(resource) if name.startswith("RLIMIT_"))
_TIMERS: Final = (signal.ITIMER_REAL, signal.ITIMER_VIRTUAL, signal.ITIMER_PROF)
_ONE, _THREE, _SMALLEST = 1.0, 3.0, 5e-324
_Settings = tuple[Any, ...]
FLIGHT: Final = struct.Struct("=q")  # a flight's number, as a supervisor hands it out
SIZE: Final = struct.Struct("=Q")  # of what follows, a pickled `FlightReport` [bytes]
PULSE_BYTES: Final = 8


class Traces:
    """Finds what a flight has left behind in its process.

    What a process is like when this is made is how it should stay: its working directory, environment, signals,
    threads, limits, the arithmetic of numpy and the processor, and what our modules, and those that they compute
    with, consist of.  What a controller's own module keeps in its own variables is not looked for.
    """

    def __init__(self) -> None:
        self._settings = _settings()
        self._content = _content()

    def found(self) -> bool:
        """Whether anything is not as it was."""
        try:
            return _settings() != self._settings or not all(
                all(map(is_, map(vars(owner).get, then), then.values())) for owner, then in self._content
            )
        except Exception:  # of something that was put in the place of what this uses
            return True


def _content() -> list[tuple[ModuleType | type, dict[str, Any]]]:
    """Our modules and the classes in them, and the others, each with what it consists of."""
    ours = [module for name, module in sys.modules.items() if name.partition(".")[0] in _PACKAGES]
    classes = {
        each
        for module in ours
        for each in vars(module).values()
        if isinstance(each, type) and each.__module__.partition(".")[0] in _PACKAGES
    }
    others = [sys.modules[name] for name in _MODULES if name in sys.modules]
    owners: list[ModuleType | type] = [*ours, *classes, *others]
    return [(owner, dict(vars(owner))) for owner in owners]


def _settings() -> _Settings:
    """What belongs to the whole process, or to the thread that flies."""
    return (
        _folder(),
        dict(os.environ),
        list(sys.path),
        sys.getrecursionlimit(),
        locale.setlocale(locale.LC_ALL),
        np.geterr(),
        np.geterrcall(),
        _rounding(),
        gc.isenabled(),
        gc.get_threshold(),
        [each for each in warnings.filters if each[0] == "error"],
        [signal.getsignal(number) for number in signal.valid_signals()],
        signal.pthread_sigmask(signal.SIG_BLOCK, ()),
        [any(signal.getitimer(which)) for which in _TIMERS],
        [resource.getrlimit(which) for which in _LIMITS],
        threading.active_count(),
    )


def _folder() -> str:
    try:
        return str(Path.cwd())
    except OSError:  # it is no longer there
        return ""


def _rounding() -> tuple[float, ...]:
    """What a library may change in the processor: how it rounds, and whether it knows the smallest numbers."""
    return _ONE / _THREE, -_ONE / _THREE, _SMALLEST * _ONE


class FlightReport(NamedTuple):
    """A worker's report on a flight."""

    answer: Answer  # the outcome
    spent: bool  # whether the flight left something in the process that the next one would meet


def fly_for(supervisor: int, pilot: Pilot, inbox: int, outbox: int, pulse: mmap) -> NoReturn:
    """Fly until this process is ended.

    Args:
        supervisor: the process that this one was forked from, and is not to outlive.
        pilot: flies.
        inbox: file descriptor that flights are read from.
        outbox: file descriptor that takes the messages.
        pulse: shared with the supervisor: 0 outside of control periods, else a number that changes with each.
    """
    os.setpgid(0, 0)  # so that all that a controller starts can be ended in one stroke
    die_with(supervisor)
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
        message = pickle.dumps(FlightReport(answer, spent))
        _write(outbox, SIZE.pack(len(message)) + message)


def _identity(descriptor: int) -> tuple[int, int]:
    """What a file descriptor refers to: a controller that closes it may open another file in its place."""
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
