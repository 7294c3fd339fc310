"""A pilot that needs no simulator and records which process flew what, and a list of the processes left."""

from __future__ import annotations

import contextlib
import multiprocessing.forkserver
import os
import sys
import time as clock
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from unittest import mock

import psutil

from scenarios.campaign.engine import local
from scenarios.campaign.results.table import Row
from scenarios.campaign.results.verdicts import ERROR
from scenarios.campaign.spec import LimitsSpec
from scenarios.progress import Progress, silent


@dataclass(frozen=True, kw_only=True)
class ToyPilot:
    """Flies by computing for a while.

    Attributes:
        seconds: processor time of a flight [s].
        asleep: seconds in which it does nothing, after that.
        kills: signals by flight that end the process each time.
        kills_once: files by flight; if one is not there, it is made, and the process killed by SIGKILL.
        raises: exceptions by flight.
        diary: takes a line with flight and process as each flight begins.
        limits: of each flight.
    """

    seconds: float = 0.0
    asleep: float = 0.0
    kills: Mapping[int, int] = field(default_factory=dict)
    kills_once: Mapping[int, Path] = field(default_factory=dict)
    raises: Mapping[int, BaseException] = field(default_factory=dict)
    diary: Path | None = None
    limits: LimitsSpec = field(default_factory=LimitsSpec)

    def prepare(self) -> None:
        pass

    def fly(self, flight: int, progress: Progress = silent) -> Row:
        if self.diary is not None:
            with self.diary.open("a") as diary:
                diary.write(f"{flight} {os.getpid()}\n")
        started = clock.thread_time()
        while clock.thread_time() - started < self.seconds:
            pass
        clock.sleep(self.asleep)
        once = self.kills_once.get(flight)
        if once is not None and not once.exists():
            once.touch()
            os.kill(os.getpid(), 9)
        if flight in self.kills:
            os.kill(os.getpid(), self.kills[flight])
        if flight in self.raises:
            raise self.raises[flight]
        return value_of(flight) | {"process": os.getpid()}

    def lost(self, flight: int, reason: str, verdict: str = ERROR) -> Row:
        return {"flight": flight, "value": None, "reason": reason}


@contextlib.contextmanager
def light_server(module: str = __name__) -> Iterator[None]:
    """Workers of toys are forked from a server that has loaded what these need, a module with others, and no more."""
    server = multiprocessing.forkserver._forkserver
    server._stop()  # who had it before wanted other modules
    found = mock.patch.dict(os.environ, PYTHONPATH=os.pathsep.join(sys.path))  # it is not told where ours are
    with found, mock.patch.object(local, "_SETTLED", module):
        yield
    server._stop()


def value_of(flight: int) -> Row:
    """What a flight that comes home answers, but for who flew it."""
    return {"flight": flight, "value": flight * flight / 7.0, "reason": None}


def known(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Rows in the order of the flights, without who flew them."""
    bare = [{key: value for key, value in row.items() if key != "process"} for row in rows]
    return sorted(bare, key=lambda row: row["flight"])


def until(holds: Callable[[], bool], seconds: float = 30.0) -> bool:
    """Whether something becomes true before long."""
    end = clock.monotonic() + seconds
    while not holds():
        if clock.monotonic() > end:
            return False
        clock.sleep(0.02)
    return True


def living(pids: set[int]) -> set[int]:
    """Those that run; what only waits for its parent to notice its end does not."""
    return {pid for pid in pids if psutil.pid_exists(pid) and psutil.Process(pid).status() != psutil.STATUS_ZOMBIE}
