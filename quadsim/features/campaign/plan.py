"""A campaign ready to fly: its file and scenario, from which the scenario and the row of each flight follow.

A flight's scenario is the campaign's with the drawn values in its fields (`with_drawn_values`); where an entry is
relative, a drawn value multiplies the scenario's own.  `campaign_file` draws, `campaign` flies the plan, `rows` has the
columns.
"""

from __future__ import annotations

import math
import time as clock
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Final, TypeGuard

import pyarrow as pa

from quadsim.errors import FileError, InputError, ParameterError, QuadsimError
from quadsim.features.campaign.campaign_file import CampaignFile, Draws, Value, Varied
from quadsim.features.campaign.events import CountedEvent, parse_event, standard_forms
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

CHECKED_FIRST: Final = 5  # flights that are built before the first is flown; one at least has to be possible
DEFAULT_FLIGHTS: Final = 1000
"""Flights that are drawn where entries of `[[vary]]` are given without a campaign."""
DrawnChange = tuple[Varied, Value]
_VEHICLE_FIELDS: Final = ("vehicle", "vehicle.file")  # fields that choose the vehicle
_DRAW_FIELDS: Final[tuple[str, ...]] = ("name", "flights", "seed", "sampling", "vary")
"""Fields of a campaign file that define its draws."""


@dataclass(frozen=True)
class Plan:
    """A campaign's file and the scenario that its flights differ from."""

    spec: CampaignFile  # the file
    scenario: Scenario  # with the file's changes, and the numbers of its vehicle's file recorded
    one_seed: bool = False  # whether all flights have the scenario's seed, as in a sweep

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
        drawn = {entry.name: (column_type(entry), entry.unit) for entry in self.spec.vary}
        return make_schema(drawn, self.limits, standard_forms(self.spec.failure))

    @cached_property
    def limits(self) -> tuple[Limit, ...]:
        """The limits of the audit, those of a user's controller too; where bounds are drawn, a flight has its own."""
        return Assembly(self.scenario).audited().limits

    @property
    def flies_user_code(self) -> bool:
        """Whether any flight uses a user-defined controller or force."""
        drawn: set[str] = set()
        for entry in self.spec.vary:
            drawn.update(entry.fields)
        may_be_drawn = not drawn.isdisjoint(("controller", "controller.type", "forces"))
        return may_be_drawn or isinstance(self.scenario.controller, Plugin) or bool(self.scenario.forces)

    @property
    def columns(self) -> dict[str, pa.DataType]:
        """The columns that events may be about, with their types: no clock times, number, seed or `failed`."""
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
        if self.one_seed:
            seed = self.scenario.seed
        else:
            seed = self.draws.seed(flight)
        return self._varied(changes, name=f"{self.spec.name[:70]}-{flight}", seed=seed)

    def identity(self, flight: int) -> Row:
        """The columns that identify a flight."""
        row: Row = {"flight": flight, "seed": self.draws.seed(flight)}
        for name, value in self.draws.values(flight).items():
            row[DRAW + name] = table_value(value)
        return row

    def check(self) -> None:
        """Refuse, before the first flight, values that cannot be flown.

        Raises:
            InputError: a value at the end of the range of an entry of `[[vary]]` cannot be flown; none of the first
                flights can; or a failure event is about a column that the results do not have.
        """
        _ = self.failure  # its first access refuses texts that are no events

        def check_one(entry: Varied, value: Value) -> None:
            checked(Assembly(self._varied([(entry, value)], name=self.scenario.name, seed=0)))

        check_ends(self.spec.vary, check_one, table=self._table)
        refusals = []
        for flight in range(min(CHECKED_FIRST, self.spec.flights)):
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
        if flown.log.traceback:  # a flight that raised has no other results
            reason = str(flown.log.reason)
            if flown.log.traceback[-1].startswith(MemoryError.__name__):
                return self.failed(flight, f"{reason} (it may take {self.spec.limits.memory:g} MB)", MEMORY)
            return self.failed(flight, reason)
        return self.row_of(flight, flown, clock.perf_counter() - started)

    def fly_all(
        self, flights: Sequence[int], *, workers: int | None = None, cluster: str | None = None
    ) -> Generator[Row]:
        """The rows of flights, each once, in whatever order they come; see `quadsim.rollout.many.fly_many`."""
        many = fly_many(
            flights,
            self.fly,
            workers=workers,
            cluster=cluster,
            isolate=self.flies_user_code,
            timeout=self.spec.limits.flight,
            memory=self.spec.limits.memory,
        )
        with closing(many) as rows:
            for place, row in rows:
                if "flight" in row:
                    yield row
                else:  # it met a limit, or its process died
                    yield self.failed(flights[place], row["reason"], row["verdict"])

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
        outcome = {"status": verdict, "verdict": verdict, "reason": reason, "violated": True, "crashed": False}
        return self._row(flight, outcome)

    def _row(self, flight: int, outcome: Row) -> Row:
        """Return the whole row of a flight: its identity, its outcome, null for all other columns, and `failed`."""
        row = dict.fromkeys(self.schema.names) | self.identity(flight) | outcome
        failed = any(event.holds(row) for event in self.failure)
        return row | {"failed": failed}

    def _varied(self, changes: Sequence[DrawnChange], *, name: str, seed: int) -> Scenario:
        """Return the scenario with drawn values; where the vehicle is drawn, relative values are multiples of its own.

        The drawn vehicle is therefore set first, and its numbers recorded, before the other values are.
        """
        scenario = self.scenario
        vehicles = []
        for entry, value in changes:
            if not {*_VEHICLE_FIELDS}.isdisjoint(entry.fields):
                vehicles.append((entry, value))
        if vehicles:
            scenario = Assembly(with_drawn_values(scenario, vehicles, {}, table=self._table)).recorded.scenario
        return with_drawn_values(scenario, changes, {"name": name, "seed": seed}, table=self._table)


def read_campaign(name: str) -> dict[str, Any]:
    """The tables of a campaign's file, merged over its base's.

    Raises:
        FileError, UnknownNameError: there is none, or it cannot be read.
    """
    try:
        path = campaign_path(name)
        data = read_merged((path, {}), lambda base: (campaign_path(base), {}), resolve_paths)
        resolve_paths(data, path.parent)
        return data
    except OSError as error:
        raise FileError(str(error.filename)[:100], f"cannot be read ({error.strerror})") from error


def load_plan(name: str, settings: Sequence[str] = (), *, flights: int | None = None, seed: int | None = None) -> Plan:
    """Read and check a campaign that ships, or a file, with the scenario it names; the other arguments change it."""
    path = campaign_path(name)
    data = read_campaign(name)
    if flights is not None:
        data["flights"] = flights
    if seed is not None:
        data["seed"] = seed
    spec = parse_campaign(data, source=path.name)
    plan = Plan(spec, campaign_scenario(spec, path, settings))
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


def campaign_scenario(spec: CampaignFile, path: Path, settings: Sequence[str] = ()) -> Scenario:
    """The scenario of a campaign's file, with its changes and then those of the command line."""
    data = merge(read_scenario(spec.scenario), spec.set)
    file, _ = scenario_source(spec.scenario)
    note_changes(data, spec.set)
    owners = {"seed": "give --seed"}
    for entry in spec.vary:
        if not entry.relative:
            owners |= {field: f"{entry.name} draws {field}" for field in entry.fields}
    for setting in settings:
        field, _, _value = setting.partition("=")
        owner = owners.get(field.strip())
        if owner is not None:
            rule = f"of a field that flights do not have each of their own; {owner}"
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
    both_draw = _replaced_fields(first) & _replaced_fields(second)
    entries = differences(_described(first), _described(second))
    return tuple(entry for entry in entries if entry[0] not in both_draw)


def _described(plan: Plan) -> dict[str, Any]:
    """Return the fields of a campaign's scenario, with those of its draws and limits beside them."""
    tables = plain(plan.scenario)
    for name in (*NOT_DESCRIBED, RECORDED):
        tables.pop(name, None)
    campaign = asdict(plan.spec)
    for name in ("seed", "sampling", "limits", "vary"):
        tables[name] = campaign[name]
    return tables


def _replaced_fields(plan: Plan) -> set[str]:
    """Return the fields whose values are drawn, other than as a factor of the scenario's own."""
    fields: set[str] = set()
    for entry in plan.spec.vary:
        if not entry.relative:
            fields.update(entry.fields)
    return fields


def resolve_paths(data: dict[str, Any], directory: Path) -> None:
    """Make the paths in a campaign's tables independent of its folder, in place."""
    for name in ("scenario", "base"):
        file = data.get(name)
        if isinstance(file, str) and file.endswith(".toml") and (directory / file).is_file():
            data[name] = str((directory / file).resolve())
    changes = data.get("set")
    if isinstance(changes, dict):
        locate_files(changes, directory)


def column_type(entry: Varied) -> pa.DataType:
    """The type of the column that holds an entry's values."""
    first = entry.extremes()[0]
    if isinstance(first, bool):
        return pa.bool_()
    if isinstance(first, int | float):
        return pa.float64()
    return pa.string()


def table_value(value: Value) -> Value | str:
    """Return a drawn value as in the results: whole numbers as numbers, lists and tables as texts."""
    if isinstance(value, bool | str):
        return value
    if isinstance(value, int | float):
        return float(value)
    return str(value)


def with_drawn_values(
    scenario: Scenario, changes: Sequence[DrawnChange], identity: Mapping[str, Any], *, table: str
) -> Scenario:
    """A scenario with the fields of some entries replaced.

    Args:
        scenario: the scenario.
        changes: entries with their drawn values.
        identity: the new name and seed; empty to keep both.
        table: name of the file's table with the entries, for messages.

    Raises:
        InputError: the changed fields make no valid scenario.
    """
    tables = scenario.tables
    defaults = plain(scenario)
    for entry, _ in changes:
        for field in entry.fields:
            _state_actual(field, tables, defaults)
    modelled = merge(defaults, {})  # a copy, as `get_field` adds the tables on the path to a field
    for entry, value in changes:
        for field, single in separate({tuple(entry.fields): value}, source=table).items():
            if entry.relative:
                new = _scaled(scenario, modelled, entry, field, single, table)
            else:
                new = single
            set_field(tables, field, new, source=f"{table}.{entry.name}.fields", defaults=defaults)
    return scenario.derive({**tables, **identity}, source=identity.get("name"))


def _state_actual(field: str, tables: dict[str, Any], defaults: dict[str, Any]) -> None:
    """Set a field of `[actual]` to the vehicle's value, in place, so that a relative draw has a number to multiply."""
    above, *names = field.split(".")
    if above != "actual" or not names:
        return
    name = names[0]
    modelled = defaults["vehicle"]
    if name in modelled:
        for data in (tables, defaults):
            data.setdefault("actual", {}).setdefault(name, modelled[name])


def _scaled(scenario: Scenario, tables: dict[str, Any], entry: Varied, field: str, value: Value, table: str) -> Value:
    """Return the product of a drawn value and the scenario's number in a field.

    Raises:
        InputError: there is no such field, or one of the two is no number.
    """
    modelled = get_field(tables, field)
    if modelled is None:  # setting a field that does not exist raises the message on it
        with_drawn_values(scenario, [(replace(entry, relative=False), value)], {}, table=table)
    owner = f"{table}.{entry.name}"
    if not _is_number(modelled):
        raise ParameterError(owner, "relative", True, f"false where the scenario has no number at {field}")
    if not _is_number(value):
        raise ParameterError(owner, "relative", True, "false where what is drawn is no number")
    return value * modelled


def _is_number(value: object) -> TypeGuard[int | float]:
    return isinstance(value, int | float) and not isinstance(value, bool)


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
                message = str(error)
                if not message.startswith(f"{table}."):
                    message = f"{where}: {message}"
                raise InputError(message) from None


def plan_for_scenario(scenario: Scenario, vary: str | Sequence[Mapping[str, Any]]) -> Plan:
    """The draws of a campaign, with its `[set]`, for a scenario that need not be its own.

    Args:
        scenario: the scenario that they vary.
        vary: the campaign's name or file; or entries as of its `[[vary]]`, of which `DEFAULT_FLIGHTS` flights are
            drawn, or more, so that each combination of grids is flown equally often.

    Raises:
        InputError: there is no such campaign, or what it draws cannot be flown.
    """
    if not isinstance(vary, str):
        entries = list(vary)
        cells = math.prod(_grid_size(entry) for entry in entries)
        repetitions = max(1, math.ceil(DEFAULT_FLIGHTS / cells))
        return make_plan(scenario, {"flights": repetitions * cells, "vary": entries})
    data = read_campaign(vary)
    if data.get("set"):
        merged = merge(scenario.tables, data["set"])
        scenario = scenario.derive(merged, source=f"{scenario.name}, as {vary} sets it")
    draws = {name: data[name] for name in _DRAW_FIELDS if name in data}
    return make_plan(scenario, draws)


def _grid_size(entry: Any) -> int:
    """Number of a grid's values, 1 of another entry; an entry that is wrong is refused when it is parsed."""
    if not isinstance(entry, Mapping) or entry.get("distribution") != "grid":
        return 1
    values = entry.get("values")
    if isinstance(values, list | tuple) and values:
        return len(values)
    return 1
