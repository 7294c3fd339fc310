"""Python's cycle collector: what it looks through, and when.

A pass over all that is loaded takes 50 ms and more, the longer the more packages there are: as long as a control
period.  None is to fall into a flight.
"""

from __future__ import annotations

import contextlib
import gc
from collections.abc import Iterator
from typing import Final

COLLECT_EVERY: Final = 10
"""Flights in one process after which everything is looked through once: one leaves a few objects in cycles."""


class _Process:
    """What this process, and those forked from it, have done to the collector."""

    lasting = False
    flights = 0


_PROCESS: Final = _Process()


def freeze_for_good() -> None:
    """Take all that this process has loaded for lasting: neither it nor processes forked from it look through it."""
    gc.collect()
    gc.freeze()
    _PROCESS.lasting = True


def thaw() -> None:
    """Let passes look through everything again, but in a process that froze permanently."""
    if not _PROCESS.lasting:
        gc.unfreeze()


def collect_rarely() -> None:
    """Collect less often in this process: flights leave few cycles, and looking for them takes time."""
    gc.set_threshold(100_000, 50, 100)


@contextlib.contextmanager
def frozen() -> Iterator[None]:
    """Leave what exists out of all passes while the block, a flight, runs; collect between flights.

    Freezing takes no time, but starts the collector's counts anew, so that by itself it would never look through
    everything again.  In a process that froze permanently the first flight adds what it loaded; nothing is unfrozen.
    """
    if not _PROCESS.lasting or not _PROCESS.flights:
        gc.freeze()
    _PROCESS.flights += 1
    try:
        yield
    finally:
        thaw()
        if not _PROCESS.lasting and _PROCESS.flights % COLLECT_EVERY == 0:
            gc.collect()
