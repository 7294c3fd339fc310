"""A controller that holds still, and does harm in the fourth step of a flight: each kind of harm by its name.

It stands alone: the processes of a campaign import it by the place of this file.
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np


def hangs() -> None:
    while True:
        pass


def hangs_in_c() -> None:
    ctypes.PyDLL(None).sleep(1000)  # with the interpreter held


def takes_memory() -> None:
    held = []
    while True:
        held.append(bytearray(1 << 20))


def raises() -> None:
    raise RuntimeError("I will not")


def asks_to_leave() -> None:
    sys.exit(0)


def exits() -> None:
    os._exit(0)


def is_killed() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def leaves_a_process() -> None:
    if os.fork() == 0:
        time.sleep(1000.0)


VERDICTS: dict[Callable[[], None], set[str]] = {
    hangs: {"timeout"},
    hangs_in_c: {"timeout"},
    takes_memory: {"memory"},
    raises: {"error"},
    asks_to_leave: {"error"},
    exits: {"died"},
    is_killed: {"died"},
    leaves_a_process: {"satisfied"},
}
KINDS = {kind.__name__: kind for kind in VERDICTS}


class Hostile:
    """Rotor speeds that just hover; `kind` is the name of what is done in the fourth step, `calm` nothing."""

    def __init__(self, vehicle: Any, *, period: float, horizon: int, kind: str = "calm") -> None:
        self._speeds, self._harm, self._steps = np.full(4, vehicle.hover_speed), KINDS.get(kind.split()[-1]), 0

    def step(self, now: Any, state: Any, reference: Any) -> Any:
        """Hover."""
        self._steps += 1
        if self._harm is not None and self._steps == 4:
            self._harm()
        return self._speeds
