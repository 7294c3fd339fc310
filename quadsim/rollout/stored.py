"""A run directory -> the `Flight` that was written there: the one place where a flight is read.

`quadsim.rollout.flown` wrote it; `quadsim.read`, comparisons, figures and `quadsim.rollout.reaudit` take it from here.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from quadsim.console.summary_tables import summary_tables
from quadsim.errors import FileError, printable
from quadsim.flight import rundir
from quadsim.flight.log import FlightLog
from quadsim.flight.parquet import read_log
from quadsim.flight.record import FlightRecord
from quadsim.report.comparison_rows import comparison_rows
from quadsim.report.flight_figures import signal_names
from quadsim.rollout.flown import Flight
from quadsim.scenarios.assembly import Assembly
from quadsim.scenarios.courses.csv_course import Csv
from quadsim.scenarios.loading import parse_scenario
from quadsim.scenarios.plugin import is_plugin
from quadsim.scenarios.schema.bases import read_whole
from quadsim.scenarios.schema.controllers import LAWS
from quadsim.scenarios.schema.scenario import Scenario
from quadsim.vehicle import Vehicle

_DAMAGE = (ArithmeticError, AttributeError, LookupError, TypeError, ValueError)
"""What the entries of a damaged summary raise where they are used."""


def read_flight(directory: Path) -> Flight:
    """Read a flight back, and make sure that it can be shown; see `quadsim.read`.

    Raises:
        FileError: a file is missing or damaged.
        InputError: its scenario is malformed.
    """
    summary = rundir.read_summary(directory)
    try:
        vehicle = Vehicle(**summary["vehicle"])
        findings = rundir.findings_of(summary)
    except _DAMAGE as error:
        raise FileError(directory / rundir.SUMMARY_FILE, f"is damaged ({error})") from error
    log = _stored_log(directory, summary)
    scenario = stored_scenario(directory)
    try:
        flight = Flight(
            scenario=scenario,
            assembly=Assembly(scenario, vehicle),
            log=log,
            findings=findings,
            controller=summary["controller"]["name"],
            solver=summary["controller"]["solver"],
            simulate_s=summary["wall_s"]["simulate"],
            tallies={},
            directory=directory,
            recorded=summary,
            thinned=True,
        )
        # a damaged entry raises where it is shown
        list(comparison_rows([flight]))
        list(summary_tables(flight))
    except _DAMAGE as error:
        what = f"{type(error).__name__}: {printable(str(error))}"
        raise FileError(directory / rundir.SUMMARY_FILE, f"is damaged ({what[:200]})") from error
    return flight


def read_plotted(directory: Path, before: Sequence[FlightRecord]) -> Flight:
    """Read a run to plot, as `read_flight`; `before` are the flights named before it.

    Raises:
        FileError: it is no run.  A name that does not exist, behind a run, is taken for a signal: the error says how
            signals are named, and which there are.
        InputError: its scenario is malformed.
    """
    if before and not directory.exists() and len(directory.parts) == 1:
        names = ", ".join(signal_names(before))
        problem = "is not a run directory; signals are named behind --signals, as in quadsim plot RUN --signals z roll"
        raise FileError(directory, f"{problem} (there are: {names})")
    return read_flight(directory)


def _stored_log(directory: Path, summary: Mapping[str, Any]) -> FlightLog:
    """Return a run's log, with what its summary says of how the flight ended."""
    traceback = tuple(summary.get("traceback", ()))
    interrupted = summary["verdict"] == "aborted" and not traceback
    log = read_log(directory, reason=summary["reason"])
    return replace(log, interrupted=interrupted, traceback=traceback)


def stored_scenario(directory: Path) -> Scenario:
    """Return the scenario of a run from its directory, without reading any other file.

    Its controller is not needed: a controller of a package that is not installed here is replaced.

    Raises:
        InputError: it is missing or malformed.
    """
    path = directory / rundir.SCENARIO_FILE
    if not path.is_file():
        raise FileError(path, "is missing or no file")
    data = read_whole(path)
    _drop_obsolete(data)
    match data.get("controller"):
        case {"type": str(name), **fields} if name not in LAWS and not is_plugin(name):
            data["controller"] = {**fields, "type": "elsewhere:Controller"}
    scenario = parse_scenario(data, source=str(path))
    course = scenario.reference
    if isinstance(course, Csv):
        return scenario.altered(reference=course.located(directory))
    return scenario


def _drop_obsolete(data: dict[str, Any]) -> None:
    """Leave out, in place, what runs of earlier versions state and no flight depends on any more."""
    tables = [data.get("controller")]
    events = data.get("events")
    if isinstance(events, list):
        for event in events:
            if isinstance(event, dict):
                tables.append(event.get("fields"))
    for table in tables:
        if isinstance(table, dict):
            table.pop("compiled", None)
