"""Compare flights: find the targets, fly those not yet flown, and lay them out on a page.

`quadsim compare` calls `compare_flights`; the table's rows and the page are those of `quadsim.report`.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final

from quadsim.console.progress import Progress, silent
from quadsim.console.results import Shown, Tabular, after
from quadsim.errors import ParameterError
from quadsim.flight.audit import Limit, audit, limit_differences
from quadsim.flight.rundir import VIDEO_FILE, limit_to_json
from quadsim.outputs import reserving
from quadsim.report.comparison import check_names, different_audits
from quadsim.report.table import Cell, QuantityRow
from quadsim.rollout.flown import Flight, add_films, require_film, require_product, worst_margin, write_run
from quadsim.rollout.reaudit import reaudit
from quadsim.rollout.rollout import Rollout
from quadsim.scenarios.catalogue import names_directory
from quadsim.scenarios.loading import load_scenario
from quadsim.scenarios.schema.scenario import Scenario
from quadsim.scenarios.schema.writing import plain

if TYPE_CHECKING:
    from quadsim.report.figure import Figure

_log: Final = logging.getLogger("quadsim")
_MOST_IN_REPR: Final = 4  # flights of which its repr has two lines
_SHOWN_ROWS: Final = (
    "outcome",
    "required constraints",
    "RMS error",
    "verdict",
    "answered by",
    "statuses",
    "whole step, m",
)
"""Starts of the row labels to show; the page and its `comparison.md` have all rows."""

Compared = Flight | Scenario | str | Path
"""A flight, a run directory, or a scenario to fly, as an object or by name."""


@dataclass(frozen=True, kw_only=True, repr=False)
class FlightComparison(Tabular):
    """Flights side by side."""

    flights: tuple[Flight, ...]
    rows: list[QuantityRow]  # the table, a row per quantity
    notes: tuple[str, ...]  # in what controllers and audits differ, and whose constraints they were audited against
    names: tuple[str, ...]  # column names, one per flight
    page: Path | None  # `index.html`, if it was written

    def __repr__(self) -> str:
        lines = [f"<FlightComparison of {len(self.flights)} flights"]
        for name, flight in zip(self.names, self.flights, strict=True):
            lines.append(f" {name}: {flight.outcome}{worst_margin(flight.findings)}")
        left_out = len(self.flights) - _MOST_IN_REPR
        if left_out > 0:
            lines[1 + _MOST_IN_REPR :] = [f" and {left_out} more"]
        return "\n".join(lines) + ">"

    @property
    def conclusion(self) -> Cell:
        """Who holds the constraints, and who tracks closer."""
        from quadsim.report.comparison import conclusion

        return conclusion(self.flights, self.names)

    def small_plot(self) -> Figure | None:
        """See `Result.small_plot`: position over time."""
        from quadsim.report.flight_figures import signals

        if any(flight.time.size for flight in self.flights):
            return signals(self.flights, ("x", "y", "z"))
        return None

    def records(self) -> list[dict[str, Any]]:
        """Return a row per flight: verdict, `Flight.metrics`, and of each constraint its margin and verdict.

        The columns are named as those of a sweep, e.g. `rmse.x`, `margin.roll`, `satisfied.roll`.
        """
        rows = []
        for name, flight in zip(self.names, self.flights, strict=True):
            row: dict[str, Any] = {
                "flight": name,
                "verdict": flight.outcome,
                "reason": flight.reason,
                "duration": flight.numbers["duration"],
                **flight.metrics,
            }
            for finding in flight.findings:
                constraint = finding.limit.name
                row[f"margin.{constraint}"] = finding.margin
                row[f"time_violated.{constraint}"] = finding.time_violated
                row[f"satisfied.{constraint}"] = finding.satisfied
            rows.append(row)
        return rows

    def to_markdown(self) -> str:
        """The table as Markdown."""
        from quadsim.report.table import to_markdown

        return to_markdown(self.rows, self.names)

    def shown(self) -> Shown:
        """See `Result.shown`."""
        from quadsim.console import console

        yield from self.notes
        yield console.styled_cell(self.conclusion)
        lines = []
        for row in self.rows:
            if not row.label.startswith(_SHOWN_ROWS):
                continue
            label = row.label
            if row.headline:
                label = row.group
            if row.unit:
                label += f" [{row.unit}]"
            lines.append((label, *map(console.styled_cell, row.cells)))
        yield console.table("comparison", ["", *self.names], lines)

    def outputs(self) -> Shown:
        """See `Result.outputs`."""
        from quadsim.console import console

        if self.page is not None:
            yield "every number, plots and films:"
            yield console.to_open(self.page)

    def to_json(self) -> list[dict[str, Any]]:
        """Return one row per quantity, with a text for each flight."""
        entries = []
        for row in self.rows:
            texts = [cell.text for cell in row.cells]
            values = dict(zip(self.names, texts, strict=True))
            entries.append({"group": row.group, "label": row.label, "unit": row.unit, "values": values})
        return entries


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
    from quadsim.report.comparison_page import write_comparison

    judge = None  # place of the flight against whose constraints all are audited
    if constraints is not None:
        judge = place_of(constraints, targets)
    check_names(names, len(targets))
    require_film(products.get("video"), fps)
    opened = [_opened(target) for target in targets]
    if out is None:
        flights = tuple(_flight_of(target, None, progress, products) for target in opened)
        return _compared(flights, names, judge, progress)
    beside = out.parent / f"{out.name}-runs"
    with reserving(out, overwrite=overwrite):
        flights = tuple(_flight_of(target, beside, progress, products) for target in opened)
        comparison = _compared(flights, names, judge, progress)
        with after(comparison, out):
            page = write_comparison(comparison.flights, out, notes=comparison.notes, overwrite=overwrite)
            comparison = replace(comparison, page=page)
            if flown is not None:
                flown(comparison)
            unfilmed = _unfilmed(comparison.flights, beside, products.get("video"))
            if unfilmed:
                _film(unfilmed, comparison, out, required=bool(products.get("video")), progress=progress, fps=fps)
            return comparison


def _compared(
    flights: tuple[Flight, ...], names: Sequence[str], judge: int | None, progress: Progress
) -> FlightComparison:
    """Return flights side by side, without a page.

    Args:
        flights: in the order of the columns.
        names: of the columns; empty for those of the flights.
        judge: place of the flight against whose constraints all are audited; None: each against its own.
        progress: called once, as the rows are made.
    """
    from quadsim.report.comparison import run_names
    from quadsim.report.comparison_rows import comparison_rows

    if names:
        flights = tuple(flight.labelled(name) for flight, name in zip(flights, names, strict=True))
    names = run_names(flights)
    if judge is None:
        audit_notes = _audit_differences(flights, names)
    else:
        limits = flights[judge].limits
        flights = tuple(audited_against(flight, limits) for flight in flights)
        audit_notes = (f"All are audited against the constraints of {names[judge]}, at the rate of their tables.",)
    controllers = [_controller_of(flight) for flight in flights]
    notes = (*controller_differences(controllers, names), *audit_notes)
    progress("comparison", 0, 1)
    return FlightComparison(flights=flights, rows=comparison_rows(flights), names=names, notes=notes, page=None)


def _film(
    unfilmed: Sequence[Flight],
    comparison: FlightComparison,
    out: Path,
    *,
    required: bool,
    progress: Progress,
    fps: int | None,
) -> None:
    """Film flights of a comparison, and write its page again with their films.

    Args:
        unfilmed: the flights.
        comparison: they are part of it.
        out: directory of its page, which has been written without the films.
        required: whether a film that cannot be made is an error.
        progress: of the films.
        fps: frames per second.

    Raises:
        OutputError: a film that is required cannot be made; the page is written.
    """
    from quadsim.console.console import short_path
    from quadsim.report.comparison_page import write_comparison

    note = f"the page without them: {short_path(out)}"
    filmed = add_films(unfilmed, note=note, progress=progress, fps=fps)
    write_comparison(comparison.flights, out, notes=comparison.notes, overwrite=True)
    if required:
        for flight in filmed:
            require_product(flight, VIDEO_FILE)


def _unfilmed(flights: Sequence[Flight], beside: Path, video: bool | None) -> list[Flight]:
    """Return what to film: on request all flights that have no film, else those that were saved beside the page."""
    unfilmed: dict[Path, Flight] = {}
    for flight in flights:
        place = flight.directory
        if place is None or video is False or not flight.time.size or flight.log.interrupted:
            continue
        if (video or place.parent == beside) and not (place / VIDEO_FILE).exists():
            unfilmed[place] = flight
    return list(unfilmed.values())


def place_of(target: Compared, targets: Sequence[Compared]) -> int:
    """Return the place of the target whose constraints are to be used."""
    for i, candidate in enumerate(targets):
        if candidate is target or (isinstance(target, str | Path) and str(candidate) == str(target)):
            return i
    rule = f"one of what is compared: {', '.join(map(str, targets))}"
    raise ParameterError("", "--constraints", str(target), rule)


def _audit_differences(flights: Sequence[Flight], names: Sequence[str]) -> tuple[str, ...]:
    """Return a sentence if flights are audited against different constraints or tolerances."""
    for flight, name in zip(flights[1:], names[1:], strict=True):
        differences = limit_differences(flights[0].limits, flight.limits, demands=False)
        if differences:
            return (different_audits(names[0], name, differences),)
    return ()


def _controller_of(flight: Flight) -> Mapping[str, Any] | None:
    """Return the table of a flight's controller; None where its scenario does not state what flew."""
    if flight.own_code:
        return None
    controller = plain(flight.scenario.controller)
    if isinstance(controller, str):
        return {"type": controller}
    return controller


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
    differing = []
    for field in first:
        if field in second and first[field] != second[field]:
            differing.append(_with_values(field, first[field], second[field]))
    parts = []
    if differing:
        parts.append(f"differ in {', '.join(differing)}")
    for name, one, other in ((a, first, second), (b, second, first)):
        alone = [field for field, value in one.items() if field not in other and value != []]
        if alone:
            parts.append(f"only that of {name} has {', '.join(alone)}")
    return parts


def _with_values(field: str, value: object, other: object) -> str:
    """Return a field's name with its two values, where both are scalars."""
    if isinstance(value, Mapping | list) or isinstance(other, Mapping | list):
        return field
    return f"{field} ({value}, {other})"


def audited_against(flight: Flight, limits: Sequence[Limit]) -> Flight:
    """Return a flight that is audited again, from the rows that it has, against other constraints."""
    findings = audit(flight.log, limits)
    verdict = flight.verdict_of(findings)
    again = {
        "constraints": [limit_to_json(finding) for finding in findings],
        "verdict": verdict,
        "satisfied": verdict == "satisfied",
        "expected": None,
        "audit_notes": [],
    }
    return replace(flight, findings=findings, recorded={**flight.summary, **again})


def _opened(target: Compared) -> Flight | Scenario:
    """Return a flight, read where the target is a run directory, or the scenario to fly.

    Raises:
        InputError: the target cannot be compared.
    """
    if isinstance(target, Flight | Scenario):
        return target
    if not names_directory(target):
        return load_scenario(str(target))
    flight = reaudit(Path(target), products=False)
    for note in flight.notes:
        _log.info("%s: %s", target, note)
    return flight


def _flight_of(
    target: Flight | Scenario, beside: Path | None, progress: Progress, products: Mapping[str, bool | None]
) -> Flight:
    """Return a target as a flight; fly it if necessary, and save it beside the page, if there is one."""
    if isinstance(target, Flight):
        flight = target
    else:
        flight = Rollout(target).fly(progress)
    if beside is None or flight.directory is not None:
        if isinstance(target, Flight):
            return flight
        return flight.as_stored()
    with reserving(beside / flight.name, free=True) as place:
        written = write_run(flight, place, {**products, "video": False}, overwrite=False, progress=progress, flown=None)
    return written.as_stored()
