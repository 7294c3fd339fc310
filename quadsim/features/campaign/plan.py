"""A campaign ready to fly: its file and scenario, which define the scenario and the row of each flight."""

from __future__ import annotations

import math
import time as clock
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import pyarrow as pa

from quadsim.errors import FileError, InputError, ParameterError, QuadsimError
from quadsim.features.campaign.campaign_file import CampaignFile, Draws, Value, Varied
from quadsim.features.campaign.events import CountedEvent, parse_event
from quadsim.features.campaign.rows import DRAW, TIMES, flown_row, make_schema
from quadsim.flight.audit import Limit
from quadsim.rollout.flown import Flight
from quadsim.rollout.machine import processor_name
from quadsim.rollout.many import ERROR, MEMORY, Row, fly_many
from quadsim.rollout.rollout import fly_for_table
from quadsim.scenarios.assembly import Assembly
from quadsim.scenarios.catalogue import campaign_path, scenario_source
from quadsim.scenarios.loading import apply_settings, parse_scenario
from quadsim.scenarios.plugin import Plugin
from quadsim.scenarios.preflight import checked
from quadsim.scenarios.schema.bases import locate_files, merge, read_merged, read_scenario
from quadsim.scenarios.schema.problems import ScenarioError, parse_table
from quadsim.scenarios.schema.scenario import Scenario
from quadsim.scenarios.schema.settings import (
    NOT_DESCRIBED,
    RECORDED,
    differences,
    get_field,
    note_changes,
    separate,
    set_field,
)
from quadsim.scenarios.schema.writing import plain

FIRST: Final = 5  # flights of which one at least has to be possible
DRAWN: Final = 1000
"""Flights that are drawn where entries of `[[vary]]` are given without a campaign."""
DrawnChange = tuple[Varied, Value]
_OF_VEHICLE: Final = ("vehicle", "vehicle.file")  # fields that choose the vehicle


@dataclass(frozen=True)
class Plan:
    """A campaign's file and the scenario that its flights differ from."""

    spec: CampaignFile  # the file
    scenario: Scenario  # with the file's changes, and the numbers of its vehicle's file recorded
    one_seed: bool = False  # whether all flights have the scenario's own, as in a sweep

    @property
    def _table(self) -> str:
        """Name of the entries in messages."""
        if self.one_seed:
            return "sweep"
        return "vary"

    @cached_property
    def draws(self) -> Draws:
        """Random draws of the campaign."""
        return Draws(self.spec)

    @cached_property
    def schema(self) -> pa.Schema:
        """The columns of its results."""
        kinds = {entry.name: (column_type(entry), entry.unit) for entry in self.spec.vary}
        return make_schema(kinds, self.limits, [parse_event(text).text for text in self.spec.failure])

    @cached_property
    def limits(self) -> tuple[Limit, ...]:
        """The limits of the audit, those of a user's controller too; flights for which bounds are drawn have others."""
        return Assembly(self.scenario).audited().limits

    @property
    def flies_user_code(self) -> bool:
        """Whether any flight uses a user-defined controller or force."""
        drawn = {field for entry in self.spec.vary for field in entry.fields}
        chosen = not drawn.isdisjoint(("controller", "controller.type", "forces"))
        return chosen or isinstance(self.scenario.controller, Plugin) or bool(self.scenario.forces)

    @property
    def columns(self) -> dict[str, pa.DataType]:
        """The columns that events may be about, with their types: all but clock times and what only counts flights."""
        others = {*TIMES, "flight", "seed", "failed"}
        return {field.name: field.type for field in self.schema if field.name not in others}

    @cached_property
    def failure(self) -> tuple[CountedEvent, ...]:
        """Events that count as failure of a flight."""
        try:
            return tuple(parse_event(text, self.columns) for text in self.spec.failure)
        except InputError as error:
            raise InputError(f"failure: {error}") from None

    def of(self, flight: int) -> Scenario:
        """The scenario of one flight.

        Raises:
            InputError: what was drawn cannot be flown.
        """
        values = self.draws.values(flight)
        changes = [(entry, values[entry.name]) for entry in self.spec.vary]
        name = f"{self.spec.name[:70]}-{flight}"
        return self._varied(changes, name=name, seed=self.scenario.seed if self.one_seed else self.draws.seed(flight))

    def identity(self, flight: int) -> Row:
        """The columns that identify a flight."""
        drawn = {DRAW + name: cell(value) for name, value in self.draws.values(flight).items()}
        return {"flight": flight, "seed": self.draws.seed(flight), **drawn}

    def check(self) -> None:
        """Refuse, before the first flight, values that cannot be flown.

        Raises:
            InputError: a value of an entry of `[[vary]]`, at the end of its range, cannot be flown; none of the first
                flights can; or a failure event is about a column that the results do not have.
        """
        _ = self.failure
        check_ends(
            self.spec.vary,
            lambda entry, value: checked(Assembly(self._varied([(entry, value)], name=self.scenario.name, seed=0))),
            table=self._table,
        )
        refusals = []
        for flight in range(min(FIRST, self.spec.flights)):
            try:
                checked(Assembly(self.of(flight)))
                return
            except InputError as error:
                refusals.append(error)
        raise InputError(f"none of the first {len(refusals)} flights can be flown, the first since {refusals[0]}")

    def fly(self, flight: int) -> Row:
        """Return the row of a flight; a flight that cannot be flown has a row with the reason."""
        started = clock.perf_counter()
        try:
            flown = fly_for_table(self.of(flight))
        except QuadsimError as error:
            return self.failed(flight, str(error))
        if raised := flown.log.traceback:  # no more of such a flight is kept than that it raised
            reason = str(flown.log.reason)
            limit = f"(it may take {self.spec.limits.memory:g} MB)"
            short = raised[-1].startswith(MemoryError.__name__)
            if short:
                return self.failed(flight, f"{reason} {limit}", MEMORY)
            return self.failed(flight, reason)
        return self.row_of(flight, flown, clock.perf_counter() - started)

    def fly_all(
        self, flights: Sequence[int], *, workers: int | None = None, cluster: str | None = None
    ) -> Generator[Row]:
        """The rows of flights, each once, in whatever order they come; see `quadsim.rollout.many.fly_many`."""
        limits = {"timeout": self.spec.limits.flight, "memory": self.spec.limits.memory}
        many = fly_many(flights, self.fly, workers=workers, cluster=cluster, isolate=self.flies_user_code, **limits)
        with closing(many) as rows:
            for place, row in rows:
                yield row if "flight" in row else self.failed(flights[place], row["reason"], row["verdict"])

    def row_of(self, flight: int, flown: Flight, wall_s: float = 0.0) -> Row:
        """Return the row of a flight that took `wall_s` [s] to compute."""
        row = flown_row(
            flown.log,
            flown.findings,
            verdict=flown.outcome,
            reason=flown.reason,
            wall_s=wall_s,
            machine=processor_name(),
        )
        return self._row(flight, row)

    def failed(self, flight: int, reason: str, verdict: str = ERROR) -> Row:
        """The row of a flight that raised, met a limit of time or memory, or whose process died."""
        nothing = {"status": verdict, "verdict": verdict, "reason": reason, "violated": True, "crashed": False}
        return self._row(flight, nothing)

    def _row(self, flight: int, outcome: Row) -> Row:
        row = dict.fromkeys(self.schema.names) | self.identity(flight) | outcome
        return row | {"failed": any(event.holds(row) for event in self.failure)}

    def _varied(self, changes: Sequence[DrawnChange], *, name: str, seed: int) -> Scenario:
        scenario = self.scenario
        vehicles = [change for change in changes if not {*_OF_VEHICLE}.isdisjoint(change[0].fields)]
        if vehicles:  # shares of numbers are then of the vehicle at hand
            scenario = Assembly(changed(scenario, vehicles, {}, table=self._table)).recorded.scenario
        return changed(scenario, changes, {"name": name, "seed": seed}, table=self._table)


def read_campaign(name: str) -> dict[str, Any]:
    """The tables of a campaign's file, merged over its base's.

    Raises:
        FileError, UnknownNameError: there is none, or it cannot be read.
    """
    try:
        path = campaign_path(name)
        data = read_merged((path, {}), lambda base: (campaign_path(base), {}), locate)
        locate(data, path.parent)
        return data
    except OSError as error:
        raise FileError(str(error.filename)[:100], f"cannot be read ({error.strerror})") from error


def load_plan(name: str, settings: Sequence[str] = (), *, flights: int | None = None, seed: int | None = None) -> Plan:
    """Read and check a campaign that ships, or a file, with the scenario it names; the other arguments change it."""
    path = campaign_path(name)
    data = read_campaign(name)
    data |= {key: value for key, value in (("flights", flights), ("seed", seed)) if value is not None}
    spec = parse_campaign(data, source=path.name)
    plan = Plan(spec, flown_scenario(spec, path, settings))
    plan.check()
    return plan


def make_plan(scenario: Scenario, data: Mapping[str, Any]) -> Plan:
    """Return a campaign of a given scenario, with its other fields as in a file."""
    spec = parse_campaign({"name": scenario.name, **data, "scenario": scenario.name}, source="campaign")
    plan = Plan(spec, Assembly(scenario).recorded.scenario)
    plan.check()
    return plan


def parse_campaign(data: Mapping[str, Any], *, source: str) -> CampaignFile:
    """A campaign's file, given as nested tables."""
    return parse_table(CampaignFile, data, source, file="campaign")


def flown_scenario(spec: CampaignFile, path: Path, settings: Sequence[str] = ()) -> Scenario:
    """The scenario of a campaign's file, with its changes and then those of the command line."""
    data = merge(read_scenario(spec.scenario), spec.set)
    file, _ = scenario_source(spec.scenario)
    note_changes(data, spec.set)
    owners = {"seed": "give --seed"}
    owners |= {
        field: f"{entry.name} draws {field}" for entry in spec.vary if not entry.relative for field in entry.fields
    }
    for setting in settings:
        if (field := setting.partition("=")[0].strip()) in owners:
            rule = f"of a field that flights do not have each of their own; {owners[field]}"
            raise ParameterError("", "--set", setting, rule)
    try:
        apply_settings(data, settings, file.parent)
        scenario = parse_scenario(data, source=f"{path.name}, {Path(spec.scenario).name}", directory=file.parent)
    except OSError as error:
        raise FileError(str(error.filename)[:100], f"cannot be read ({error.strerror})") from error
    return checked(Assembly(scenario)).recorded.scenario


def plan_differences(first: Plan, second: Plan) -> tuple[tuple[str, Any, Any], ...]:
    """The fields in which two campaigns' scenarios, draws and limits differ, with the value of each, None for absent.

    Fields of the scenario that both draw are left out: their draws are compared.
    """
    tables = []
    drawn = []
    for plan in (first, second):
        left_out = (*NOT_DESCRIBED, RECORDED)
        scenario = {key: value for key, value in plain(plan.scenario).items() if key not in left_out}
        campaign = asdict(plan.spec)
        tables.append({**scenario, **{name: campaign[name] for name in ("seed", "sampling", "limits", "vary")}})
        drawn.append({field for entry in plan.spec.vary if not entry.relative for field in entry.fields})
    return tuple(entry for entry in differences(*tables) if entry[0] not in drawn[0] & drawn[1])


def locate(data: dict[str, Any], directory: Path) -> None:
    """Make the paths in a campaign's tables independent of its folder, in place."""
    for name in ("scenario", "base"):
        file = data.get(name)
        if isinstance(file, str) and file.endswith(".toml") and (directory / file).is_file():
            data[name] = str((directory / file).resolve())
    if isinstance(changes := data.get("set"), dict):
        locate_files(changes, directory)


def column_type(entry: Varied) -> pa.DataType:
    """The type of the column that holds an entry's values."""
    first = entry.extremes()[0]
    if isinstance(first, bool):
        return pa.bool_()
    if isinstance(first, int | float):
        return pa.float64()
    return pa.string()


def cell(value: Value) -> Value | str:
    """Return a drawn value as in the results: whole numbers as numbers, lists and tables as texts."""
    if isinstance(value, bool | str):
        return value
    if isinstance(value, int | float):
        return float(value)
    return str(value)


def changed(scenario: Scenario, changes: Sequence[DrawnChange], identity: Mapping[str, Any], *, table: str) -> Scenario:
    """A scenario with the fields of some entries replaced; `table` of the file has the entries.

    `identity` has its name and seed, which no description lists.

    Raises:
        InputError: what comes of it is no scenario.
    """
    tables = scenario.tables
    defaults = plain(scenario)
    for entry, _ in changes:  # a field of `[actual]` is as modelled until it is drawn
        for above, name, *_rest in (field.split(".") for field in entry.fields if "." in field):
            if above == "actual" and name in defaults["vehicle"]:
                for data in (tables, defaults):
                    data.setdefault("actual", {}).setdefault(name, defaults["vehicle"][name])
    modelled = merge(defaults, {})  # a copy, as looking up a field makes the tables on its way
    for entry, value in changes:
        for field, single in separate({tuple(entry.fields): value}, source=table).items():
            if entry.relative:
                new = _scaled(scenario, modelled, entry, field, single, table)
            else:
                new = single
            set_field(tables, field, new, source=f"{table}.{entry.name}.fields", defaults=defaults)
    return scenario.derive({**tables, **identity}, source=identity.get("name"))


def _scaled(scenario: Scenario, tables: dict[str, Any], entry: Varied, field: str, value: Value, table: str) -> Value:
    modelled = get_field(tables, field)
    if modelled is None:  # refused with its own message where there is no such field
        changed(scenario, [(replace(entry, relative=False), value)], {}, table=table)
    for what, number in ((f"the scenario has no number at {field}", modelled), ("what is drawn is no number", value)):
        if isinstance(number, bool) or not isinstance(number, int | float):
            raise ParameterError(f"{table}.{entry.name}", "relative", True, f"false where {what}")
    return value * modelled


def check_ends(entries: Iterable[Varied], check: Callable[[Varied, Value], object], *, table: str) -> None:
    """Refuse entries that cannot be flown at an end of their range; `check` raises where one cannot have a value.

    Raises:
        InputError: naming the entry and the value.
    """
    for entry in entries:
        for value in entry.extremes():
            where = f"{table}.{entry.name} at {value!r}"
            try:
                check(entry, value)
            except ScenarioError as error:
                raise ScenarioError(where, error.problems) from None
            except InputError as error:
                named = str(error).startswith(f"{table}.")
                raise InputError(str(error) if named else f"{where}: {error}") from None


def drawn_flights(scenario: Scenario, vary: str | Sequence[Mapping[str, Any]]) -> Plan:
    """The draws of a campaign, with its `[set]`, for a scenario that need not be its own.

    Args:
        scenario: the scenario that they vary.
        vary: the campaign's name or file; or entries as of its `[[vary]]`, of which `DRAWN` flights are drawn, or more
            to have each combination of grids as often as another.

    Raises:
        InputError: there is no such campaign, or what it draws cannot be flown.
    """
    if not isinstance(vary, str):
        entries = list(vary)
        cells = math.prod(len(entry["values"]) for entry in entries if _is_grid(entry))
        return make_plan(scenario, {"flights": max(1, -(-DRAWN // cells)) * cells, "vary": entries})
    data = read_campaign(vary)
    if data.get("set"):
        merged = merge(scenario.tables, data["set"])
        scenario = scenario.derive(merged, source=f"{scenario.name}, as {vary} sets it")
    return make_plan(
        scenario, {key: data[key] for key in ("name", "flights", "seed", "sampling", "vary") if key in data}
    )


def _is_grid(entry: Any) -> bool:
    """Whether an entry has the values of a grid; what is wrong with it is told when it is parsed."""
    if isinstance(entry, Mapping):
        values = entry.get("values")
    else:
        values = None
    return isinstance(values, list | tuple) and len(values) > 0 and entry.get("distribution") == "grid"
