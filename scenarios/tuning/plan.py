"""A tuning ready to be flown: its file, and the campaigns of its start and of each candidate."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from typing import Final

import numpy as np
import pyarrow as pa
import tomlkit
from pydantic import ValidationError

from quadsim.errors import InputError, ParameterError
from quadsim.state import Array
from scenarios.assembly import Assembly
from scenarios.campaign.plan import (
    Plan,
    cell,
    changed,
    check_ends,
    column_type,
    flown_scenario,
    parse_campaign,
    read_campaign,
)
from scenarios.campaign.results.events import Event, is_number, parse_event
from scenarios.campaign.results.table import Row
from scenarios.campaign.spec import CampaignSpec, Value, VaryBase, check_fields
from scenarios.campaign.statistics.requirement import Requirement, parse_requirement
from scenarios.catalogue import tuning_path
from scenarios.loading import parse_scenario
from scenarios.schema.bases import merge
from scenarios.schema.problems import ScenarioError, describe_all
from scenarios.schema.scenario import Scenario
from scenarios.schema.settings import get_field
from scenarios.schema.writing import to_toml
from scenarios.tuning.objective import value_of
from scenarios.tuning.spec import TuningSpec

START: Final = 0  # the candidate that is the scenario as it is
OWN: Final = ("name", "description", "flights", "seed")  # fields of a campaign that a tuning has itself
Values = Mapping[str, Value]
"""Of a candidate, by the names of the entries of `[[search]]`; empty of the start."""


@dataclass(frozen=True)
class TuningPlan:
    """A tuning's file and the campaign of its start."""

    spec: TuningSpec  # the file
    start: Plan  # on the draws of the search; its scenario has every number of its vehicle in it

    @property
    def most(self) -> int:
        """Flights of a candidate that goes on to the end."""
        return self.spec.flights[-1]

    @cached_property
    def requirement(self) -> Requirement:
        """The bound on the probability of an event."""
        return parse_requirement(self.spec.require)

    @cached_property
    def guard(self) -> Event:
        """The event that counts in the search."""
        return parse_event(self.spec.guard or self.requirement.event.text, self.start.columns)

    def objectives(self, rows: Sequence[Row]) -> Array:
        """(flights, objectives) of some flights; NaN for one that was not completed."""
        values = [
            [value_of(each.expression, row) if row["status"] == "completed" else math.nan for row in rows]
            for each in self.spec.objectives
        ]
        return np.array(values, float).T

    def candidate(self, values: Values, name: str) -> Scenario:
        """The scenario of a candidate.

        Raises:
            InputError: its values make none.
        """
        changes = [(entry, values[entry.name]) for entry in self.spec.search if entry.name in values]
        return changed(
            self.start.data, changes, lambda data: parse_scenario({**data, "name": name}, source=name), table="search"
        )

    def fresh(self, values: Values, name: str) -> Plan:
        """The campaign of a candidate on fresh draws; errors: `candidate`."""
        changes = {"name": name, **dict(self.spec.fresh)}
        return Plan(self.start.spec.model_copy(update=changes), self.candidate(values, name))

    def shown(self, values: Values) -> dict[str, Value | str | None]:
        """The searched values of a candidate as tables have them; None where the start has no single one."""
        own = values or self.start_values
        return {entry.name: cell(own[entry.name]) if entry.name in own else None for entry in self.spec.search}

    @cached_property
    def start_values(self) -> Values:
        """The start's values of what is searched; without entries for which it has no single one."""
        values: dict[str, Value] = {}
        for entry in self.spec.search:
            given = [1.0 if entry.relative else get_field(merge(self.start.data, {}), each) for each in entry.fields]
            if given[0] is not None and all(value == given[0] for value in given):
                values[entry.name] = given[0]
        return values

    def check(self) -> None:
        """Refuse, before anything is flown, what cannot be.

        Raises:
            InputError: an entry of `[[search]]`, at an end of its range, cannot be flown, or changes what flights are
                audited against; an objective or the requirement names no column of the results; or the campaign cannot
                be flown.
        """
        self.start.check()
        columns = self.start.columns
        with _field("require"):
            parse_event(self.requirement.event.text, columns)
            if not self.requirement.at_most:
                raise InputError(f"{self.spec.require!r} must keep a probability small, with < or <=")
        with _field("guard"):
            _ = self.guard
        for objective in self.spec.objectives:
            with _field(f"objectives.{objective.name}.expression"):
                value_of(objective.expression, {name: 1.0 for name, kind in columns.items() if is_number(kind)})
        check_ends(self.spec.search, self._check_at, table="search")

    def _check_at(self, entry: VaryBase, value: Value) -> None:
        scenario = self.candidate({entry.name: value}, self.spec.name)
        if Assembly(scenario).limits != Assembly(self.start.scenario).limits:
            rule = (
                "of fields that leave alone what flights are audited against: constraints, obstacles, regions, and the "
                "controller's bounds and polytopes"
            )
            raise ParameterError(f"search.{entry.name}", "fields", entry.fields, rule)
        Assembly(scenario).check()

    def to_toml(self) -> str:
        """The file with every field, for a directory that has the start as `scenario.toml`."""
        campaign = self.start.spec.model_copy(update={"scenario": "scenario.toml", "set": {}})
        document = tomlkit.parse(to_toml(self.spec.model_copy(update={"campaign": {}})))
        document["campaign"] = {
            key: value for key, value in tomlkit.parse(campaign.to_toml()).items() if key not in OWN
        }
        return document.as_string()


@dataclass(frozen=True, kw_only=True)
class SearchPlan(Plan):
    """The search as one campaign: its flight c * `TuningPlan.most` + i is that of candidate c on draw i."""

    tuning: TuningPlan
    candidates: Mapping[int, Values]
    _plans: dict[int, Plan] = field(default_factory=dict)  # of candidates, where they fly

    @cached_property
    def schema(self) -> pa.Schema:
        """The columns of all flights: a campaign's, and the candidate with its values."""
        own = [("candidate", "-", pa.int64())]
        own += [(f"search.{entry.name}", entry.unit, column_type(entry)) for entry in self.tuning.spec.search]
        first, *others = super().schema
        return pa.schema([first, *(pa.field(name, kind, metadata={"unit": unit}) for name, unit, kind in own), *others])

    def of(self, flight: int) -> Scenario:
        """The scenario of one flight; errors: `TuningPlan.candidate`."""
        candidate, draw = divmod(flight, self.tuning.most)
        if candidate not in self._plans:
            scenario = self.tuning.candidate(self.candidates[candidate], self.spec.name)
            self._plans[candidate] = Plan(self.spec, scenario)
        return self._plans[candidate].of(draw)

    def identity(self, flight: int) -> Row:
        """The columns that identify a flight."""
        candidate, draw = divmod(flight, self.tuning.most)
        values = {f"search.{name}": value for name, value in self.tuning.shown(self.candidates[candidate]).items()}
        return {**super().identity(draw), "flight": flight, "candidate": candidate, **values}


@contextmanager
def _field(name: str) -> Iterator[None]:
    """Name the field of the file in what it raises."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{name}: {error}") from error


def load_tuning(name: str, *, trials: int | None = None, seed: int | None = None) -> TuningPlan:
    """Read and check a tuning that ships, or a file: its campaign, its scenario, and `trials` and `seed` where given.

    Raises:
        InputError: the file is missing or malformed, a field is not allowed, or what it searches cannot be flown.
    """
    path, data = tuning_path(name), read_campaign(name, tuning_path)
    data |= {key: value for key, value in (("trials", trials), ("seed", seed)) if value is not None}
    try:
        spec = TuningSpec.model_validate(data)
    except ValidationError as error:
        raise ScenarioError(path.name, describe_all(error, data, TuningSpec, file="tuning")) from error
    try:
        campaign = _campaign(spec, source=f"{path.name}: campaign")
        check_fields(spec.search, "search", {each: entry.name for entry in campaign.vary for each in entry.fields})
        plan = TuningPlan(spec, Plan(campaign, flown_scenario(campaign, path)))
        plan.check()
    except ScenarioError:
        raise
    except ValueError as error:
        raise InputError(f"{path.name}: {error}") from error
    return plan


def _campaign(spec: TuningSpec, *, source: str) -> CampaignSpec:
    """The tables of `[campaign]` over those of its base, with what the tuning has itself."""
    base = spec.campaign.get("base")
    if not isinstance(base, str | None):
        raise ParameterError("campaign", "base", base, "a campaign's name or a path ending in .toml")
    if given := [name for name in OWN if name in spec.campaign]:
        raise ParameterError("campaign", given[0], spec.campaign[given[0]], "absent: a tuning has its own")
    own = {"name": spec.name, "description": spec.description, "flights": spec.flights[-1], "seed": spec.seed}
    tables = {key: value for key, value in spec.campaign.items() if key != "base"}
    return parse_campaign(merge(read_campaign(base) if base else {}, tables | own), source=source)
