"""Progress of long work: bars on a terminal, lines elsewhere, or calls of a user's function."""

from __future__ import annotations

import contextlib
import signal
import threading
import time as clock
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Final

from quadsim.core.library import is_compiling

if TYPE_CHECKING:
    from rich.progress import TaskID

    from quadsim.console.console import PlainConsole

Progress = Callable[[str, int, int], None]  # called with (activity, done, total) during long work

LINE_EVERY: Final = 10.0  # time between lines of progress if stderr is not a terminal [s]


def silent(stage: str, done: int, total: int) -> None:
    """Report no progress."""


@contextlib.contextmanager
def reporting(progress: Progress | bool, what: str, *, bars: bool = True) -> Iterator[Progress]:
    """Yield the function that reports progress: a bar per stage on a terminal, elsewhere a line every `LINE_EVERY`.

    `what` is what starts, until the first stage is reported, e.g. `the flight`.  False reports nothing; a function
    replaces both.  Without `bars` a terminal has the lines too, which take no time from what is being timed.
    """
    if callable(progress):
        yield progress
        return
    from quadsim.console.console import stderr

    if not progress:
        yield silent
        return
    screen = stderr()
    if bars and screen.is_terminal:
        with _bars(screen) as report_bar:
            yield report_bar
        return
    with lines(screen, f"starting {what}") as tell:

        def report_line(stage: str, done: int, total: int) -> None:
            if total > 1:
                tell(f"{stage} {100 * done // total} %")
            else:
                tell(stage)

        yield report_line


@contextlib.contextmanager
def _bars(screen: PlainConsole) -> Iterator[Progress]:
    """Yield the function that moves a bar per stage, which pulses until a total is known or something is done."""
    from rich.progress import BarColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
    from rich.progress import Progress as Bars

    columns = (TextColumn("{task.description:<10}"), BarColumn(), TextColumn("{task.percentage:>3.0f} %"))
    with Bars(*columns, TimeElapsedColumn(), TimeRemainingColumn(), console=screen, transient=True) as stages:
        tasks: dict[str, TaskID] = {}

        def report(stage: str, done: int, total: int) -> None:
            if stage not in tasks:
                tasks[stage] = stages.add_task(stage)
            if total > 1 or done:
                stages.update(tasks[stage], completed=done, total=total)
            else:
                stages.update(tasks[stage], completed=done, total=None)

        yield report


@contextlib.contextmanager
def lines(screen: PlainConsole, first: str) -> Iterator[Callable[[str], None]]:
    """Yield a function that takes what is done now; the latest is printed every `LINE_EVERY`, also while it lasts.

    `first` is what is done at first.  While the C library compiles, the line says so instead.
    """
    from quadsim.console import console

    now = first
    started = clock.monotonic()
    over = threading.Event()

    def tell(text: str) -> None:
        nonlocal now
        now = text

    def tick() -> None:
        signal.pthread_sigmask(signal.SIG_BLOCK, signal.valid_signals())  # they are for the thread that works
        while not over.wait(LINE_EVERY):
            activity = now
            if is_compiling():
                activity = "compiling the C library"
            console.show([f"quadsim: {activity}, {clock.monotonic() - started:.0f} s so far"], screen)

    ticking = threading.Thread(target=tick, daemon=True)
    ticking.start()
    try:
        yield tell
    finally:
        over.set()
        ticking.join()
