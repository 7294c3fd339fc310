"""Progress of long work: bars on a terminal, lines elsewhere, or calls of a user's function."""

from __future__ import annotations

import contextlib
import datetime
import time as clock
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from rich.progress import TaskID

    from scenarios.campaign.campaign import Standing, Watch
    from scenarios.console import PlainConsole

Progress = Callable[[str, int, int], None]  # called with (activity, done, total) during long work

LINE_EVERY: Final = 10.0  # time between lines of progress if stderr is not a terminal [s]


def silent(stage: str, done: int, total: int) -> None:
    """Report no progress."""


@contextlib.contextmanager
def reporting(progress: Progress | bool) -> Iterator[Progress]:
    """Yield the function that reports progress: a bar per stage on a terminal, elsewhere a line every `LINE_EVERY`.

    False reports nothing; a function replaces both.
    """
    if callable(progress):
        yield progress
        return
    from scenarios.console import stderr

    if not progress:
        yield silent
        return
    if not (screen := stderr()).is_terminal:
        yield _lines(screen)
        return
    from rich.progress import BarColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
    from rich.progress import Progress as Bars

    columns = (TextColumn("{task.description:<10}"), BarColumn(), TextColumn("{task.percentage:>3.0f} %"))
    with Bars(*columns, TimeElapsedColumn(), TimeRemainingColumn(), console=screen, transient=True) as bars:
        tasks: dict[str, TaskID] = {}

        def report(stage: str, done: int, total: int) -> None:
            if stage not in tasks:
                tasks[stage] = bars.add_task(stage, total=total)
            bars.update(tasks[stage], completed=done, total=total)

        yield report


def _lines(screen: PlainConsole) -> Progress:
    """Return a function that prints the progress of a stage, at most one line per `LINE_EVERY`."""
    printed = clock.perf_counter()

    def report(stage: str, done: int, total: int) -> None:
        nonlocal printed
        if (now := clock.perf_counter()) - printed >= LINE_EVERY:
            printed = now
            screen.print(f"quadsim: {stage} {100 * done // max(total, 1)} %", soft_wrap=True)

    return report


@contextlib.contextmanager
def watching(progress: bool) -> Iterator[Watch]:
    """Yield the function that shows a campaign's progress: a bar on a terminal, elsewhere a line at intervals."""
    from scenarios.console import stderr

    screen, printed = stderr(), clock.perf_counter()
    if not progress:
        yield lambda standing: None
    elif screen.is_terminal:
        from rich.progress import BarColumn, TextColumn
        from rich.progress import Progress as Bars

        with Bars(
            TextColumn("flights"), BarColumn(), TextColumn("{task.description}"), console=screen, transient=True
        ) as bars:
            bar = bars.add_task("starting")
            yield lambda standing: bars.update(
                bar, completed=standing.flown, total=standing.flights, description=_describe(standing)
            )
    else:

        def show(standing: Standing) -> None:
            nonlocal printed
            if clock.perf_counter() - printed >= LINE_EVERY or standing.flown == standing.flights:
                printed = clock.perf_counter()
                screen.print(_describe(standing), soft_wrap=True)

        yield show


def _describe(standing: Standing) -> str:
    """Return flights done, rate, time left and failures in one line."""
    from scenarios.campaign.statistics import interval, proportion

    share = proportion(standing.failed, standing.flown)
    left = datetime.timedelta(seconds=round((standing.flights - standing.flown) / standing.rate))
    return (
        f"{standing.flown}/{standing.flights}, {standing.rate:.2f}/s, {left} left; "
        f"{standing.failed} failed ({interval(share['lower'], share['upper'])})"
    )
