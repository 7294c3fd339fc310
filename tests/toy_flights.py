"""Flights that need no simulator, most of them harmless, and a list of the processes that are left.

It stands alone: workers import it.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import psutil

Toy = tuple[int, str]
"""Number and kind of a flight; its row has the square of its number."""


def fly(flight: Toy) -> dict[str, Any]:
    """The row of a flight, after it has done what its kind does."""
    number, kind = flight
    left = KINDS[kind]()
    return {"value": number * number / 7.0, "process": os.getpid(), "left": left}


def fly_slowly(flight: int) -> dict[str, Any]:
    """The row of a flight that takes 20 ms."""
    time.sleep(0.02)
    return fly((flight, "calm"))


def fly_and_note(flight: tuple[Path, str]) -> dict[str, Any]:
    """The row of a flight that notes its process in a file before it does what its kind does."""
    diary, kind = flight
    with diary.open("a") as file:
        file.write(f"{os.getpid()}\n")
    return fly((0, kind))


def report(_: object) -> dict[str, Any]:
    """The row of a flight that prints: where it is flown, and with how many threads."""
    print("printed by a controller")
    return {"folder": str(Path.cwd()), "threads": os.environ["OMP_NUM_THREADS"]}


def _raises() -> NoReturn:
    raise ZeroDivisionError("of its\n own")


def _exits() -> NoReturn:
    os._exit(0)


def _hangs() -> NoReturn:
    signal.pthread_sigmask(signal.SIG_BLOCK, set(signal.Signals))
    while True:
        time.sleep(1.0)


def _leaves_a_command() -> int:
    return subprocess.Popen(["sleep", "1000"]).pid


def _hangs_with_a_command() -> None:
    _leaves_a_command()
    ctypes.PyDLL(None).sleep(1000)  # holds the interpreter


KINDS: dict[str, Callable[[], object]] = {
    "calm": lambda: None,
    "raises": _raises,
    "asks to leave": lambda: sys.exit(3),
    "exits": _exits,
    "is killed": lambda: os.kill(os.getpid(), signal.SIGKILL),
    "crashes": lambda: ctypes.string_at(0),
    "stops": lambda: os.kill(os.getpid(), signal.SIGSTOP),
    "hangs": _hangs,
    "holds the interpreter": _hangs_with_a_command,
    "takes memory": lambda: np.ones(1 << 30),
    "gives no row": lambda: sys.stderr,
    "leaves a command": _leaves_a_command,
}


def until(holds: Callable[[], bool], seconds: float = 30.0) -> bool:
    """Whether something becomes true before long."""
    end = time.monotonic() + seconds
    while not holds():
        if time.monotonic() > end:
            return False
        time.sleep(0.02)
    return True


def living(pids: Iterable[int]) -> set[int]:
    """Those that run; what only waits for its parent to notice its end does not."""
    return {pid for pid in pids if psutil.pid_exists(pid) and psutil.Process(pid).status() != psutil.STATUS_ZOMBIE}


def below() -> set[int]:
    """The workers of this process: what a process that it started has started."""
    result = set()
    for each in psutil.Process().children(recursive=True):
        with contextlib.suppress(psutil.NoSuchProcess):
            result |= {each.pid} if each.ppid() != os.getpid() else set()
    return result
