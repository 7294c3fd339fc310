"""A tuning ready to be flown: its file, its campaign, and from these the scenario and the flights of each candidate."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import pyarrow as pa
from pydantic import ValidationError

from quadsim.errors import FileError, InputError, ParameterError
from scenarios.campaign.plan import Plan, cell, changed, check_ends, column_type, flown_scenario, locate, read_campaign
from scenarios.campaign.results.events import Event, parse_event
from scenarios.campaign.spec import Value, VaryBase
from scenarios.campaign.statistics.requirement import Requirement, parse_requirement
from scenarios.limits import build_limits
from scenarios.loading import check_parts, parse_scenario
from scenarios.schema.bases import merge, read_scenario
from scenarios.schema.problems import ScenarioError, describe_all
from scenarios.schema.scenario import Scenario
from scenarios.schema.settings import get_field
from scenarios.shipped import tuning_path
from scenarios.tuning.objective import Expression, parse_expression
from scenarios.tuning.spec import OWN, TuningSpec

START: Final = 0  # the candidate that is the scenario as it is
Values = Mapping[str, Value]
"""Of a candidate, by the names of the entries of `[[search]]`; empty of the start."""


@dataclass(frozen=True)
class TuningPlan:
    """A tuning's file and the scenario that its candidates differ from."""

    spec: TuningSpec  # the file
    scenario: Scenario  # the start: the campaign's, with every number of its vehicle in it

    @property
    def most(self) -> int:
        """Flights of a candidate that goes on to the end."""
        return self.spec.flights[-1]

    @cached_property
    def start(self) -> Plan:
        """The campaign of the start, on the draws of the search."""
        return self.of({})

    @cached_property
    def schema(self) -> pa.Schema:
        """The columns of all flights of the search: a campaign's, and the candidate with its values."""
        own = [("candidate", "-", pa.int64())]
        own += [(f"search.{entry.name}", entry.unit, column_type(entry)) for entry in self.spec.search]
        fields = [pa.field(name, kind, metadata={"unit": unit}) for name, unit, kind in own]
        first, *others = self.start.schema
        return pa.schema([first, *fields, *others])

    @cached_property
    def requirement(self) -> Requirement:
        """The bound on the probability of an event."""
        return parse_requirement(self.spec.require)

    @cached_property
    def guard(self) -> Event:
        """The event that counts in the search."""
        return parse_event(self.spec.guard or self.requirement.event.text, self.start.columns)

    @cached_property
    def expressions(self) -> tuple[Expression, ...]:
        """Of the objectives, in their order."""
        return tuple(parse_expression(each.expression, self.start.columns) for each in self.spec.objectives)

    @cached_property
    def _data(self) -> dict[str, Any]:
        return tomllib.loads(self.scenario.to_toml())

    def candidate(self, values: Values, name: str) -> Scenario:
        """The scenario of a candidate.

        Raises:
            InputError: its values make none.
        """
        changes = [(entry, values[entry.name]) for entry in self.spec.search if entry.name in values]
        return changed(
            self._data, changes, lambda data: parse_scenario({**data, "name": name}, source=name), table="search"
        )

    def of(self, values: Values, *, name: str | None = None, fresh: bool = False) -> Plan:
        """The campaign of a candidate, on the draws of the search or on fresh ones; errors: `candidate`."""
        name = name or self.spec.name
        flights, seed = (self.spec.fresh.flights, self.spec.fresh.seed) if fresh else (self.most, self.spec.seed)
        changes = {"name": name, "description": self.spec.description, "flights": flights, "seed": seed}
        return Plan(self.spec.campaign.model_copy(update=changes), self.candidate(values, name))

    def shown(self, values: Values) -> dict[str, Value | str | None]:
        """The searched values of a candidate as tables have them; None where the start has no single one."""
        own = values or self.start_values
        return {entry.name: cell(own[entry.name]) if entry.name in own else None for entry in self.spec.search}

    @cached_property
    def start_values(self) -> Values:
        """The start's values of what is searched; without entries for which it has no single one."""
        values: dict[str, Value] = {}
        for entry in self.spec.search:
            given = [1.0 if entry.relative else get_field(merge(self._data, {}), field) for field in entry.fields]
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
                parse_expression(objective.expression, columns)
        check_ends(self.spec.search, self._check_at, table="search")

    def _check_at(self, entry: VaryBase, value: Value) -> None:
        scenario = self.candidate({entry.name: value}, self.spec.name)
        if build_limits(scenario) != build_limits(self.scenario):
            rule = (
                "of fields that leave alone what flights are audited against: constraints, obstacles, regions, and the "
                "controller's bounds and polytopes"
            )
            raise ParameterError(f"search.{entry.name}", "fields", entry.fields, rule)
        check_parts(scenario)


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
    path = tuning_path(name)
    try:
        data = read_scenario(path, tuning_path, locate=_locate)
    except OSError as error:
        raise FileError(path, f"cannot be read ({error.strerror})") from error
    _locate(data, path.parent)
    data |= {key: value for key, value in (("trials", trials), ("seed", seed)) if value is not None}
    if isinstance(campaign := data.get("campaign"), dict):
        match data.get("flights"):
            case [*_, int(most)]:
                data["campaign"] = _whole_campaign(campaign, most)
            case _:
                data["campaign"] = _whole_campaign(campaign, TuningSpec.model_fields["flights"].default[-1])
    try:
        spec = TuningSpec.model_validate(data)
    except ValidationError as error:
        raise ScenarioError(path.name, describe_all(error, data, TuningSpec, file="tuning")) from error
    try:
        plan = TuningPlan(spec, flown_scenario(spec.campaign, path))
        plan.check()
    except ScenarioError:
        raise
    except InputError as error:
        raise InputError(f"{path.name}: {error}") from error
    return plan


def _whole_campaign(campaign: Mapping[str, Any], flights: int) -> dict[str, Any]:
    """The tables of `[campaign]` over those of its base, with a name and a number of flights."""
    if given := [name for name in OWN if name in campaign]:
        raise InputError(f"campaign must not have {given[0]}: a tuning has its own")
    own = dict(campaign)
    base = own.pop("base", None)
    if base is not None and not isinstance(base, str):
        raise ParameterError("campaign", "base", base, "a campaign's name or a path ending in .toml")
    others = {} if base is None else {name: value for name, value in read_campaign(base).items() if name not in OWN}
    return {"name": "tuned", "flights": flights, **merge(others, own)}


def _locate(data: dict[str, Any], directory: Path) -> None:
    """Make the paths in a tuning's tables independent of its folder, in place."""
    if isinstance(campaign := data.get("campaign"), dict):
        locate(campaign, directory)
        base = campaign.get("base")
        if isinstance(base, str) and base.endswith(".toml") and (directory / base).is_file():
            campaign["base"] = str((directory / base).resolve())
