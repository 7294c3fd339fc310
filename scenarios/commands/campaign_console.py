"""What the command line prints of campaigns: progress on stderr, answers on stdout."""

from __future__ import annotations

import contextlib
import datetime
import time as clock
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, Final

from rich.progress import BarColumn, Progress, TextColumn

from quadsim.report.table import Grid
from scenarios.campaign.report.campaign_tables import (
    constraint_table,
    driver_sentence,
    event_table,
    replay_command,
    verdict_sentence,
    worst_table,
)
from scenarios.campaign.report.comparison_tables import comparison_tables, difference_table, pairing
from scenarios.campaign.run import Result, Standing, Watch
from scenarios.campaign.statistics.comparison import Comparison
from scenarios.campaign.statistics.inference import proportion
from scenarios.campaign.statistics.wording import interval
from scenarios.commands import console
from scenarios.commands.console import stderr, stdout, styled

MOST_LINES: Final = 8  # of a table on the terminal; the report has them all
LINE_EVERY: Final = 30.0  # between two lines of progress where stderr is no terminal [s]


@contextlib.contextmanager
def progress(*, enabled: bool, lines: bool = True) -> Iterator[Watch]:
    """A bar on stderr; where that is no terminal, as in a batch job, a line now and then, or nothing."""
    screen = stderr()
    if not enabled or not (lines or screen.is_terminal):
        yield lambda standing: None
    elif screen.is_terminal:
        columns = (TextColumn("flights"), BarColumn(), TextColumn("{task.description}"))
        with Progress(*columns, console=screen, transient=True) as bars:
            bar = bars.add_task("starting")
            yield lambda standing: bars.update(
                bar, completed=standing.flown, total=standing.flights, description=describe(standing)
            )
    else:
        printed = clock.perf_counter()

        def show(standing: Standing) -> None:
            nonlocal printed
            if clock.perf_counter() - printed > LINE_EVERY or standing.flown == standing.flights:
                printed = clock.perf_counter()
                screen.print(describe(standing), soft_wrap=True)

        yield show


def describe(standing: Standing) -> str:
    """How far it is, how fast, until when, and how it looks."""
    share = proportion(standing.failed, standing.flown)
    left = datetime.timedelta(seconds=round((standing.flights - standing.flown) / standing.rate))
    return (
        f"{standing.flown}/{standing.flights}, {standing.rate:.2f}/s, {left} left; "
        f"{standing.failed} failed ({interval(share.lower, share.upper)})"
    )


def print_campaign(result: Result, where: str) -> None:
    """What came of a campaign."""
    out, summary = stdout(), result.summary
    out.print(styled((summary["campaign"], "bold"), f": {verdict_sentence(summary)}"), soft_wrap=True)
    if summary["parameters"]:
        out.print(driver_sentence(summary), soft_wrap=True)
    tables = [event_table(summary), constraint_table(summary), worst_table(summary, where)]
    console.print_grids([_brief(grid) for grid in tables if grid.lines], None, prose=("constraint", "reason"))
    if summary["worst"]:
        command = replay_command(where, summary["worst"][0]["flight"])
        out.print(styled("to fly one of them again: ", (command, "bold")), soft_wrap=True)
    for judgement in result.judgements:
        out.print(styled((judgement.sentence, "green" if judgement.holds else "red")), soft_wrap=True)
    console.print_place(where)


def _brief(grid: Grid) -> Grid:
    """The first lines of a table, with a short last column."""
    ends = [(line, " ".join(line[-1].text.split())) for line in grid.lines[:MOST_LINES]]
    lines = [(*line[:-1], replace(line[-1], text=end if len(end) <= 60 else f"{end[:57]}...")) for line, end in ends]
    return replace(grid, note="", lines=tuple(lines))


def print_replay(number: int, row: Mapping[str, Any], differing: Sequence[str]) -> None:
    """Whether a replayed flight gave the campaign's numbers."""
    if differing:
        stdout().print(styled((f"flight {number} differs from the campaign's in {', '.join(differing)}", "red")))
    else:
        stdout().print(f"flight {number}: {len(row)} columns, each the same as in the campaign")


def print_comparison(comparison: Comparison, where: str) -> None:
    """Whether one campaign is better than another."""
    stdout().print(pairing(comparison), soft_wrap=True)
    console.print_grids(difference_table(comparison), None)
    stdout().print(comparison.sentence, soft_wrap=True)
    console.print_grids(comparison_tables(comparison), where)
