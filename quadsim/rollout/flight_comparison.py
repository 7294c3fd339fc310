"""Compare flights: find the targets, fly those not yet flown, and lay them out on a page."""

from __future__ import annotations

import contextlib
import logging
import tempfile
import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final

from quadsim.assets import read_toml
from quadsim.console.progress import Progress, silent
from quadsim.console.results import Result, Shown, after
from quadsim.errors import OutputError, ParameterError
from quadsim.flight import metrics, rundir
from quadsim.flight.audit import Limit, audit, flight_verdict, limit_differences
from quadsim.outputs import reserving
from quadsim.report.comparison import check_names, different_audits
from quadsim.report.table import Cell, QuantityRow
from quadsim.rollout.flown import INTERRUPTED, Flight, add_films, require_film, worst_margin
from quadsim.rollout.reaudit import reaudit, stored_run
from quadsim.rollout.rollout import Rollout
from quadsim.scenarios.catalogue import names_directory
from quadsim.scenarios.loading import load_scenario
from quadsim.scenarios.schema.scenario import Scenario

if TYPE_CHECKING:
    from quadsim.report.figure import Figure

_log: Final = logging.getLogger("quadsim")
_FIRST: Final = 4  # flights of which its repr has two lines
_BRIEF: Final = ("outcome", "required constraints", "RMS error", "verdict", "answered by", "statuses", "whole step, m")
"""Starts of the row labels to show; the page and its `comparison.md` have all rows."""

Compared = Flight | Scenario | str | Path
"""A flight, a run directory, or a scenario to fly, as an object or by name."""


@dataclass(frozen=True, kw_only=True, repr=False)
class FlightComparison(Result):
    """Flights side by side."""

    runs: tuple[rundir.Run, ...]  # the flights
    rows: list[QuantityRow]  # the table, a row per quantity
    notes: tuple[str, ...]  # in what controllers and audits differ, and whose constraints they were audited against
    names: tuple[str, ...]  # column names, one per flight
    page: Path | None  # `index.html`, if it was written

    def __repr__(self) -> str:
        flights = []
        for name, run in zip(self.names, self.runs, strict=True):
            findings = map(rundir.finding_from_json, run.summary["constraints"])
            flights.append(f"\n {name}: {run.summary['verdict']}{worst_margin(findings)}")
        more = f"\n and {len(flights) - _FIRST} more" if len(flights) > _FIRST else ""
        return f"<FlightComparison of {len(flights)} flights{''.join(flights[:_FIRST])}{more}>"

    @property
    def conclusion(self) -> Cell:
        """Who holds the constraints, and who tracks closer."""
        from quadsim.report.comparison import conclusion

        return conclusion(self.runs, self.names)

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
        from quadsim.console import console

        yield from self.notes
        yield console.styled_cell(self.conclusion)
        lines = [
            (
                (row.group if row.headline else row.label) + (f" [{row.unit}]" if row.unit else ""),
                *map(console.styled_cell, row.cells),
            )
            for row in self.rows
            if row.label.startswith(_BRIEF)
        ]
        yield console.table("comparison", ["", *self.names], lines)

    def outputs(self) -> Shown:
        """See `Result.outputs`."""
        from quadsim.console import console

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
    targets: Sequence[Compared],
    out: Path | None = None,
    progress: Progress = silent,
    *,
    overwrite: bool = False,
    names: Sequence[str] = (),
    products: Mapping[str, bool | None] = MappingProxyType({}),
    constraints: Compared | None = None,
    fps: int | None = None,
    flown: Callable[[FlightComparison], object] | None = None,
) -> FlightComparison:
    """Compare flights, and write the page to `out`; scenarios are flown and saved beside it, in `OUT-runs`.

    `names` are the columns'; `products` and `fps` the options of `Flight.save` for what is saved; with `constraints`,
    one of the targets, all are audited against its constraints.  Films come last: `flown` is called with the comparison
    before they are made, and the page is written again with them.

    Raises:
        InputError: a target is neither a flight nor a scenario, `constraints` is none of them, or the names are wrong;
            nothing was flown.
        OutputError: the directory, or a film that is requested, cannot be written.
        RenderingUnavailableError: a video is requested but cannot be rendered; nothing was flown.
    """
    from quadsim.console.console import short_path
    from quadsim.report.comparison import comparison_rows, run_names
    from quadsim.report.comparison_page import write_comparison

    whose = None if constraints is None else place_of(constraints, targets)
    check_names(names, len(targets))
    require_film(products.get("video"), fps)
    for target in targets:
        _check(target)
    with contextlib.ExitStack() as stack:
        scratch = stack.enter_context(tempfile.TemporaryDirectory())
        if out is not None:
            stack.enter_context(reserving(out, overwrite=overwrite))
        beside = Path(scratch) if out is None else out.parent / f"{out.name}-runs"
        saved = dict.fromkeys(("recording", "figures"), False) if out is None else products
        runs = tuple(_run_of(target, beside, progress, saved, pictures=out is not None) for target in targets)
        if names:
            runs = tuple(replace(run, label=name) for run, name in zip(runs, names, strict=True))
        names = run_names(runs)
        if whose is None:
            notes = _differences(runs, names)
        else:
            limits = runs[whose].limits
            runs = tuple(audited_against(run, limits) for run in runs)
            notes = (f"All are audited against the constraints of {names[whose]}, at the rate of their tables.",)
        controllers = [_controller_of(target, run) for target, run in zip(targets, runs, strict=True)]
        notes = (*controller_differences(controllers, names), *notes)
        progress("comparison", 0, 1)
        comparison = FlightComparison(runs=runs, rows=comparison_rows(runs), names=names, notes=notes, page=None)
        if out is None:
            return comparison
        with after(comparison, out):
            page = write_comparison(runs, out, notes=notes, overwrite=overwrite)
            comparison = replace(comparison, page=page)
            if flown is not None:
                flown(comparison)
            if unfilmed := _unfilmed(runs, beside, products.get("video")):
                note = f"the page without them: {short_path(page)}"
                failed = add_films(unfilmed, note=note, progress=progress, fps=fps)
                write_comparison(runs, out, notes=notes, overwrite=True)
                for path, problem in failed.items():
                    if products.get("video") and problem != INTERRUPTED:
                        raise OutputError(path, f"{problem}; all else is there")
            return comparison


def _unfilmed(runs: Sequence[rundir.Run], beside: Path, video: bool | None) -> list[rundir.Run]:
    """Return what to film: on request all flights that have no film, else those that were saved beside the page."""
    directories = {run.directory: run for run in runs if video or run.directory.parent == beside}
    filmed = {place for place in directories if (place / rundir.VIDEO_FILE).exists()}
    return [
        run
        for place, run in directories.items()
        if video is not False and place not in filmed and run.log.control.t.size and not run.log.interrupted
    ]


def place_of(target: Compared, targets: Sequence[Compared]) -> int:
    """Return the place of the target whose constraints are to be used."""
    for i, each in enumerate(targets):
        if each is target or (isinstance(target, str | Path) and str(each) == str(target)):
            return i
    rule = f"one of what is compared: {', '.join(map(str, targets))}"
    raise ParameterError("", "--constraints", str(target), rule)


def _differences(runs: Sequence[rundir.Run], names: Sequence[str]) -> tuple[str, ...]:
    """Return a sentence if flights are audited against different constraints or tolerances."""
    for run, name in zip(runs[1:], names[1:], strict=True):
        if differences := limit_differences(runs[0].limits, run.limits, demands=False):
            return (different_audits(names[0], name, differences),)
    return ()


def _controller_of(target: Compared, run: rundir.Run) -> Mapping[str, Any] | None:
    """Return the table of a flight's controller; None where no scenario states what flew."""
    if isinstance(target, Flight) and target.directory is None:
        if target.own_code:
            return None
        tables = tomllib.loads(target.scenario.to_toml())
    else:
        path = run.directory / rundir.SCENARIO_FILE
        if not path.is_file():
            return None
        tables = read_toml(path)
    controller = tables.get("controller")
    return {"type": controller} if isinstance(controller, str) else controller


def controller_differences(controllers: Sequence[Mapping[str, Any] | None], names: Sequence[str]) -> tuple[str, ...]:
    """Return a sentence for each flight whose controller has other fields than the first one's, naming these fields."""
    first = controllers[0]
    sentences = []
    for controller, name in zip(controllers[1:], names[1:], strict=True):
        if first is None or controller is None:
            continue
        parts = _controller_difference(names[0], first, name, controller)
        if parts:
            sentences.append(f"The controllers of {names[0]} and {name}: {'; '.join(parts)}.")
    return tuple(sentences)


def _controller_difference(a: str, first: Mapping[str, Any], b: str, second: Mapping[str, Any]) -> list[str]:
    """Return the fields in which two controllers differ, scalars with their values, and those that one alone has."""
    common = [field for field in first if field in second and first[field] != second[field]]
    shown = []
    for field in common:
        values = (first[field], second[field])
        is_nested = any(isinstance(value, Mapping | list) for value in values)
        shown.append(field if is_nested else f"{field} ({values[0]}, {values[1]})")
    parts = [f"differ in {', '.join(shown)}"] if shown else []
    for name, one, other in ((a, first, second), (b, second, first)):
        alone = [field for field, value in one.items() if field not in other and value != []]
        if alone:
            parts.append(f"only that of {name} has {', '.join(alone)}")
    return parts


def audited_against(run: rundir.Run, limits: Sequence[Limit]) -> rundir.Run:
    """Return a run that is audited again from its tables, against other constraints."""
    findings = audit(run.log, limits)
    failed = metrics.failure(run.log.control) is not None
    verdict = flight_verdict(findings, aborted=run.log.aborted, lost=run.log.reason is not None, failed=failed)
    again = {
        "constraints": [rundir.limit_to_json(finding) for finding in findings],
        "verdict": verdict,
        "satisfied": verdict == "satisfied",
        "expected": None,
        "audit_notes": [],
    }
    return replace(run, summary={**run.summary, **again}, limits=tuple(finding.limit for finding in findings))


def _check(target: Compared) -> None:
    """Reject targets that cannot be compared, before any flight."""
    if isinstance(target, Flight | Scenario):
        return
    if names_directory(target):
        for note in reaudit(Path(target), products=False).notes:
            _log.info("%s: %s", target, note)
    else:
        load_scenario(str(target))


def _run_of(
    target: Compared, beside: Path, progress: Progress, products: Mapping[str, bool | None], *, pictures: bool
) -> rundir.Run:
    """Return a target as a run; fly and save it beside the page if necessary."""
    if isinstance(target, Flight):
        if target.directory is not None or not pictures:
            return target.run
        with reserving(beside / target.scenario.name, free=True) as place:
            return _saved(target, place, progress, products)
    if not isinstance(target, Scenario) and names_directory(target):
        return stored_run(Path(target))
    scenario = target if isinstance(target, Scenario) else load_scenario(str(target))
    with reserving(beside / scenario.name, free=True) as place:
        return _saved(Rollout(scenario).fly(progress), place, progress, products)


def _saved(flight: Flight, place: Path, progress: Progress, products: Mapping[str, bool | None]) -> rundir.Run:
    recording, figures = (products.get(name) for name in ("recording", "figures"))
    flight.save(place, video=False, recording=recording, figures=figures, progress=progress)
    return rundir.load_run(place)
