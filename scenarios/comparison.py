"""Flights side by side: what is compared is found, flown where it has to be, and laid out on a page."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from quadsim.errors import InputError
from quadsim.flight import rundir
from quadsim.outputs import reserving
from quadsim.report.table import Row
from scenarios.campaign.manifest import is_campaign as is_campaign
from scenarios.campaign.manifest import stored_plan
from scenarios.flight import Flight, Outputs
from scenarios.loading import load_scenario
from scenarios.progress import Progress, silent
from scenarios.reaudit import reaudit
from scenarios.run import run_scenario
from scenarios.schema.scenario import Scenario

if TYPE_CHECKING:
    from scenarios.campaign.statistics.comparison import Comparison as CampaignComparison

Target = Flight | Scenario | str | Path
"""What can be compared: a flight, a run directory, or a scenario to fly, by itself or by its name."""


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """Flights side by side."""

    runs: tuple[rundir.Run, ...]  # the flights
    rows: list[Row]  # the table, a row per quantity
    names: tuple[str, ...]  # of its columns, one per flight
    page: Path | None  # `index.html`, where it was written
    notes: tuple[str, ...] = ()  # what a person should know of the runs that were read

    def to_markdown(self) -> str:
        """The table as Markdown."""
        from quadsim.report.table import to_markdown

        return to_markdown(self.rows, self.names)

    def _repr_markdown_(self) -> str:
        """The table, for notebooks."""
        return self.to_markdown()


def compare_flights(
    targets: Sequence[Target],
    out: Path | None = None,
    progress: Progress = silent,
    *,
    overwrite: bool = False,
) -> Comparison:
    """Compare flights, and write the page to `out`; what has to be flown is saved beside it, in `OUT-runs`.

    Raises:
        InputError: something is no flight and no scenario; nothing was flown.
        OutputError: the directory cannot be written.
    """
    from quadsim.report.comparison import comparison_rows, run_names
    from quadsim.report.comparison_page import write_comparison

    notes = [note for target in targets for note in _checked(target)]
    with contextlib.ExitStack() as stack:
        scratch = stack.enter_context(tempfile.TemporaryDirectory())
        if out is not None:
            stack.enter_context(reserving(out, overwrite=overwrite))
        beside = Path(scratch) if out is None else out.parent / f"{out.name}-runs"
        runs = tuple(_run_of(target, beside, progress, pictures=out is not None) for target in targets)
        page = None if out is None else write_comparison(runs, out, overwrite=overwrite)
    return Comparison(runs=runs, rows=comparison_rows(runs), names=run_names(runs), page=page, notes=tuple(notes))


def _checked(target: Target) -> Sequence[str]:
    """What a person should know of a target, before anything is flown."""
    if isinstance(target, Flight | Scenario):
        return ()
    if Path(target).is_dir():
        return [f"{target}: {note}" for note in reaudit(Path(target), products=False).notes]
    load_scenario(str(target))
    return ()


def _run_of(target: Target, beside: Path, progress: Progress, *, pictures: bool) -> rundir.Run:
    """A target as a run, flown and written beside the page where it is none yet."""
    if isinstance(target, Flight):
        if target.directory is not None or not pictures:
            return target.run
        with reserving(beside / target.scenario.name, free=True) as place:
            return rundir.load_run(target.save(place, progress=progress))
    if not isinstance(target, Scenario) and Path(target).is_dir():
        return rundir.load_run(Path(target))
    scenario = target if isinstance(target, Scenario) else load_scenario(str(target))
    wanted = None if pictures else False
    outputs = Outputs(video=wanted, recording=wanted, figures=wanted)
    with reserving(beside / scenario.name, free=True) as place:
        run_scenario(scenario, place, outputs, progress)
        return rundir.load_run(place)


def compare_campaigns(
    directories: Sequence[Path], out: Path | None = None, *, overwrite: bool = False
) -> CampaignComparison:
    """Compare two campaigns flight by flight, and write the report where a directory is given.

    Raises:
        InputError: they are not two finished campaigns.
        OutputError: the directory cannot be written.
    """
    from scenarios.campaign.plan import plan_differences
    from scenarios.campaign.report.campaign_page import write_comparison_report
    from scenarios.campaign.results.store import FLIGHTS_FILE, read_flights
    from scenarios.campaign.statistics.comparison import compare

    if len(directories) != 2:
        raise InputError(f"compare takes two campaigns, each by itself, not {len(directories)}")
    first, second = directories
    plans = (stored_plan(first), stored_plan(second))
    names = (plans[0].spec.name, plans[1].spec.name)
    failures = (plans[0].spec.failure, plans[1].spec.failure)
    a, b = (read_flights(path / FLIGHTS_FILE, plan.schema) for path, plan in zip((first, second), plans, strict=True))
    comparison = compare(a, b, names, failures, plan_differences(*plans))
    if out is not None:
        write_comparison_report(comparison, out, overwrite=overwrite)
    return comparison
