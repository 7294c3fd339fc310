"""A tuning ready to be flown: its file, its campaign, and from these the scenario of each candidate."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import pyarrow as pa
from pydantic import ValidationError

from quadsim.errors import FileError, InputError, ParameterError, UnknownNameError
from scenarios.campaign.plan import (
    Plan,
    cell,
    changed,
    check_ends,
    column_type,
    flown_scenario,
    locate,
    read_campaign,
)
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
from scenarios.tuning.objective import Expression, parse_expression, require_columns
from scenarios.tuning.spec import OWN, TuningSpec

SEARCHED: Final = "search."  # how the columns of searched values begin
Values = Mapping[str, Value]  # of a candidate, by the names of the entries of `[[search]]`; empty of the start


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
        first, *others = self.start.schema
        own = [("candidate", "-", pa.int64())]
        own += [(SEARCHED + entry.name, entry.unit, column_type(entry)) for entry in self.spec.search]
        return pa.schema([first, *(pa.field(name, kind, metadata={"unit": unit}) for name, unit, kind in own), *others])

    @cached_property
    def requirement(self) -> Requirement:
        """The bound on the probability of an event."""
        return parse_requirement(self.spec.require)

    @cached_property
    def guard(self) -> Event:
        """The event that counts in the search."""
        return self.requirement.event if self.spec.guard is None else parse_event(self.spec.guard)

    @cached_property
    def expressions(self) -> tuple[Expression, ...]:
        """Of the objectives, in their order."""
        return tuple(parse_expression(objective.expression) for objective in self.spec.objectives)

    @cached_property
    def _data(self) -> dict[str, Any]:
        return tomllib.loads(self.scenario.to_toml())

    def candidate(self, values: Values, name: str) -> Scenario:
        """The scenario of a candidate.

        Raises:
            InputError: it is none.
        """
        changes = [(entry, values[entry.name]) for entry in self.spec.search if entry.name in values]
        return changed(
            self._data, changes, lambda data: parse_scenario({**data, "name": name}, source=name), table="search"
        )

    def of(self, values: Values, *, name: str | None = None, fresh: bool = False) -> Plan:
        """The campaign of a candidate: on the draws of the search, or on fresh ones.

        Raises:
            InputError: what comes of its values is no scenario.
        """
        name = name or self.spec.name
        flights, seed = (self.spec.fresh.flights, self.spec.fresh.seed) if fresh else (self.most, self.spec.seed)
        changes = {"name": name, "description": self.spec.description, "flights": flights, "seed": seed}
        return Plan(self.spec.campaign.model_copy(update=changes), self.candidate(values, name))

    def identity(self, candidate: int, values: Values) -> dict[str, Any]:
        """The columns that identify a candidate."""
        shown = values or self.start_values
        searched = {SEARCHED + entry.name: shown.get(entry.name) for entry in self.spec.search}
        return {
            "candidate": candidate,
            **{name: None if value is None else cell(value) for name, value in searched.items()},
        }

    @cached_property
    def start_values(self) -> Values:
        """What the start has where it is searched; without entries for which it has no single such value."""
        found: dict[str, Value] = {}
        for entry in self.spec.search:
            given = [1.0 if entry.relative else get_field(merge(self._data, {}), field) for field in entry.fields]
            if given[0] is not None and all(value == given[0] for value in given):
                found[entry.name] = given[0]
        return found

    def check(self) -> None:
        """Refuse, before anything is flown, what cannot be.

        Raises:
            InputError: an entry of `[[search]]`, at an end of its range, cannot be flown, or changes what flights are
                held against; an objective or the requirement names no column of the results; or the campaign cannot
                be flown.
        """
        self.start.check()
        for i, expression in enumerate(self.expressions):
            try:
                require_columns(expression, self.start.columns)
            except UnknownNameError as error:
                raise InputError(f"objectives.{self.spec.objectives[i].name}.expression: {error}") from error
        for field, event in (("require", self.requirement.event), ("guard", self.guard)):
            try:
                parse_event(event.text, self.start.columns)
            except InputError as error:
                raise InputError(f"{field}: {error}") from error
        check_ends(self.spec.search, self._check_at, table="search")

    def _check_at(self, entry: VaryBase, value: Value) -> None:
        found = self.candidate({entry.name: value}, self.spec.name)
        if build_limits(found) != build_limits(self.scenario):
            rule = (
                "of fields that leave alone what flights are held against: constraints, obstacles, regions, and the "
                "controller's bounds and polytopes"
            )
            raise ParameterError(f"search.{entry.name}", "fields", entry.fields, rule)
        check_parts(found)


def load_tuning(name: str, *, trials: int | None = None, seed: int | None = None) -> TuningPlan:
    """Read and check a tuning, with the campaign and the scenario it names.

    Args:
        name: of one that ships, or a path ending in `.toml`.
        trials: instead of the file's.
        seed: instead of the file's.

    Raises:
        InputError: the file is missing or malformed, a field is not allowed, or what it searches cannot be flown.
    """
    path = tuning_path(name)
    try:
        data = read_scenario(path, tuning_path, locate=_locate)
        _locate(data, path.parent)
        if isinstance(campaign := data.get("campaign"), dict):
            data["campaign"] = _whole_campaign(campaign)
    except OSError as error:
        raise FileError(path, f"cannot be read ({error.strerror})") from error
    data |= {key: value for key, value in (("trials", trials), ("seed", seed)) if value is not None}
    return make_tuning(data, path)


def make_tuning(data: Mapping[str, Any], path: Path) -> TuningPlan:
    """A tuning from the tables of its file, whose campaign is whole.

    Raises:
        InputError: a field is not allowed, or what is searched cannot be flown.
    """
    filled = dict(data)
    if isinstance(campaign := data.get("campaign"), dict):
        flights = data.get("flights") or TuningSpec.model_fields["flights"].default
        most = flights[-1] if isinstance(flights, list) else flights  # errors name the tuning's
        filled["campaign"] = {"name": "tuned", "flights": most if isinstance(most, int) else 1, **campaign}
    try:
        spec = TuningSpec.model_validate(filled)
    except ValidationError as error:
        problems = describe_all(error, filled, TuningSpec, file="tuning")
        raise ScenarioError(path.name, problems) from error
    try:
        plan = TuningPlan(spec, flown_scenario(spec.campaign, path))
        plan.check()
    except ScenarioError:
        raise
    except InputError as error:
        raise InputError(f"{path.name}: {error}") from error
    return plan


def _whole_campaign(campaign: Mapping[str, Any]) -> dict[str, Any]:
    """The tables of `[campaign]`, merged over its base's.

    Raises:
        InputError: its base is none, or it has a field that is the tuning's.
    """
    given = [name for name in OWN if name in campaign]
    if given:
        raise InputError(f"campaign must not have {given[0]}: a tuning has its own")
    own = dict(campaign)
    base = own.pop("base", None)
    if base is None:
        return own
    if not isinstance(base, str):
        raise ParameterError("campaign", "base", base, "a campaign's name or a path ending in .toml")
    return merge({name: value for name, value in read_campaign(base).items() if name not in OWN}, own)


def _locate(data: dict[str, Any], directory: Path) -> None:
    """Make the paths in a tuning's tables independent of its folder, in place."""
    if isinstance(campaign := data.get("campaign"), dict):
        locate(campaign, directory)
        base = campaign.get("base")
        if isinstance(base, str) and base.endswith(".toml") and (directory / base).is_file():
            campaign["base"] = str((directory / base).resolve())
