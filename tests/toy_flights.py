"""Flights that need no simulator, most of them harmless, and a list of the processes that are left.

It stands alone: workers import it.
"""

from __future__ import annotations

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


def place(_: object) -> dict[str, Any]:
    """Where and how a flight is flown."""
    print("printed by a controller")
    return {"folder": str(Path.cwd()), "threads": os.environ["OMP_NUM_THREADS"], "script": "started" in sys.argv}


def _raises() -> NoReturn:
    raise ZeroDivisionError("of its\n own")


def _exits() -> NoReturn:
    os._exit(0)


def _hangs() -> NoReturn:
    signal.pthread_sigmask(signal.SIG_BLOCK, set(signal.Signals))
    while True:
        time.sleep(1.0)


def _takes_memory() -> object:
    return [np.ones(1 << 20) for _ in range(1 << 20)]


def _leaves_a_command() -> None:
    subprocess.Popen(["sleep", "1000"])


KINDS: dict[str, Callable[[], object]] = {
    "calm": lambda: None,
    "raises": _raises,
    "asks to leave": lambda: sys.exit(3),
    "exits": _exits,
    "is killed": lambda: os.kill(os.getpid(), signal.SIGKILL),
    "crashes": lambda: ctypes.string_at(0),
    "stops": lambda: os.kill(os.getpid(), signal.SIGSTOP),
    "hangs": _hangs,
    "holds the interpreter": lambda: ctypes.PyDLL(None).sleep(1000),
    "takes memory": _takes_memory,
    "gives no row": lambda: sys.stdout,
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
    """The processes that this one has started, and these, without the server of workers."""
    return {each.pid for each in psutil.Process().children(recursive=True) if "from multiprocessing" not in _line(each)}


def _line(process: psutil.Process) -> str:
    try:
        return " ".join(process.cmdline()) if process.parent().pid == os.getpid() else ""  # type: ignore[union-attr]
    except (psutil.NoSuchProcess, AttributeError):
        return ""
