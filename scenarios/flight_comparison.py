"""Compare flights: find the targets, fly those not yet flown, and lay them out on a page."""

from __future__ import annotations

import contextlib
import logging
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from quadsim.errors import InputError
from quadsim.flight import rundir
from quadsim.outputs import reserving
from quadsim.report.table import Row
from scenarios.campaign.store import is_campaign as is_campaign
from scenarios.campaign.store import stored_plan
from scenarios.flight import Flight, worst_margin
from scenarios.loading import load_scenario
from scenarios.progress import Progress, silent
from scenarios.reaudit import reaudit
from scenarios.results import Result, Shown, after
from scenarios.rollout import Rollout
from scenarios.schema.scenario import Scenario

if TYPE_CHECKING:
    from quadsim.report.figure import Figure
    from scenarios.campaign.paired import PairedComparison

_log: Final = logging.getLogger("quadsim")
_FIRST: Final = 4  # flights of which its repr has two lines
_BRIEF: Final = ("outcome", "required constraints", "RMS error", "verdict", "answered by", "statuses", "whole step, m")
"""Starts of the row labels to show; the page and its `comparison.md` have all rows."""

Target = Flight | Scenario | str | Path
"""A flight, a run directory, or a scenario to fly, as an object or by name."""


@dataclass(frozen=True, kw_only=True, repr=False)
class FlightComparison(Result):
    """Flights side by side."""

    runs: tuple[rundir.Run, ...]  # the flights
    rows: list[Row]  # the table, a row per quantity
    names: tuple[str, ...]  # column names, one per flight
    page: Path | None  # `index.html`, if it was written

    def __repr__(self) -> str:
        flights = []
        for name, run in zip(self.names, self.runs, strict=True):
            findings = map(rundir.finding_from_json, run.summary["constraints"])
            flights.append(f"\n {name}: {run.summary['verdict']}{worst_margin(findings)}")
        more = f"\n and {len(flights) - _FIRST} more" if len(flights) > _FIRST else ""
        return f"<FlightComparison of {len(flights)} flights{''.join(flights[:_FIRST])}{more}>"

    def small_plot(self) -> Figure | None:
        """See `Result.small_plot`: position over time."""
        from quadsim.report.flight_figures import signals

        flown = [run for run in self.runs if run.log.control.t.size]
        return signals(self.runs, ("x", "y", "z")) if flown else None

    def to_markdown(self) -> str:
        """The table as Markdown."""
        from quadsim.report.table import to_markdown

        return to_markdown(self.rows, self.names)

    def shown(self) -> Shown:
        """See `Result.shown`."""
        from scenarios import console

        lines = [
            (
                (row.group if row.headline else row.label) + (f" [{row.unit}]" if row.unit else ""),
                *map(console.cell, row.cells),
            )
            for row in self.rows
            if row.label.startswith(_BRIEF)
        ]
        yield console.table("comparison", ["", *self.names], lines)
        if self.page is not None:
            yield "every number, plots and films:"
            yield console.to_open(self.page)

    def to_json(self) -> list[dict[str, Any]]:
        """Return one row per quantity, with a text for each flight."""
        return [
            {
                "group": row.group,
                "label": row.label,
                "unit": row.unit,
                "values": dict(zip(self.names, (cell.text for cell in row.cells), strict=True)),
            }
            for row in self.rows
        ]


def compare_flights(
    targets: Sequence[Target],
    out: Path | None = None,
    progress: Progress = silent,
    *,
    overwrite: bool = False,
) -> FlightComparison:
    """Compare flights, and write the page to `out`; scenarios are flown and saved beside it, in `OUT-runs`.

    Raises:
        InputError: a target is neither a flight nor a scenario; nothing was flown.
        OutputError: the directory cannot be written.
    """
    from quadsim.report.comparison import comparison_rows, run_names
    from quadsim.report.comparison_page import write_comparison

    for target in targets:
        _check(target)
    with contextlib.ExitStack() as stack:
        scratch = stack.enter_context(tempfile.TemporaryDirectory())
        if out is not None:
            stack.enter_context(reserving(out, overwrite=overwrite))
        beside = Path(scratch) if out is None else out.parent / f"{out.name}-runs"
        runs = tuple(_run_of(target, beside, progress, pictures=out is not None) for target in targets)
        progress("comparison", 0, 1)
        comparison = FlightComparison(runs=runs, rows=comparison_rows(runs), names=run_names(runs), page=None)
        if out is None:
            return comparison
        with after(comparison, out):
            return replace(comparison, page=write_comparison(runs, out, overwrite=overwrite))


def _check(target: Target) -> None:
    """Reject targets that cannot be compared, before any flight."""
    if isinstance(target, Flight | Scenario):
        return
    if Path(target).is_dir():
        for note in reaudit(Path(target), products=False).notes:
            _log.info("%s: %s", target, note)
    else:
        load_scenario(str(target))


def _run_of(target: Target, beside: Path, progress: Progress, *, pictures: bool) -> rundir.Run:
    """Return a target as a run; fly and save it beside the page if necessary."""
    if isinstance(target, Flight):
        if target.directory is not None or not pictures:
            return target.run
        with reserving(beside / target.scenario.name, free=True) as place:
            return rundir.load_run(target.save(place, progress=progress))
    if not isinstance(target, Scenario) and Path(target).is_dir():
        return rundir.load_run(Path(target))
    scenario = target if isinstance(target, Scenario) else load_scenario(str(target))
    products = None if pictures else False
    with reserving(beside / scenario.name, free=True) as place:
        flight = Rollout(scenario).fly(progress)
        return rundir.load_run(
            flight.save(place, video=products, recording=products, figures=products, progress=progress)
        )


def compare_campaigns(
    directories: Sequence[Path], out: Path | None = None, *, overwrite: bool = False
) -> PairedComparison:
    """Compare two campaigns flight by flight, and write the report if a directory is given.

    Raises:
        InputError: they are not two finished campaigns.
        OutputError: the directory cannot be written.
    """
    from scenarios.campaign.paired import compare_pairs
    from scenarios.campaign.plan import plan_differences
    from scenarios.campaign.store import FLIGHTS_FILE, read_flights

    if len(directories) != 2:
        raise InputError(f"compare takes two campaigns, each by itself, not {len(directories)}")
    first, second = directories
    plans = (stored_plan(first), stored_plan(second))
    names = (plans[0].spec.name, plans[1].spec.name)
    failures = (plans[0].spec.failure, plans[1].spec.failure)
    a, b = (read_flights(path / FLIGHTS_FILE, plan.schema) for path, plan in zip((first, second), plans, strict=True))
    comparison = compare_pairs(a, b, names, failures, plan_differences(*plans))
    if out is None:
        return comparison
    with after(comparison, out):
        return replace(comparison, page=comparison.write_report(out, overwrite=overwrite))
