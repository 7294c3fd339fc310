"""A tuning ready to fly: its file, its objectives, and the campaigns of its start and of each candidate."""

from __future__ import annotations

import ast
import math
import operator
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from typing import Annotated, Any, Final

import numpy as np
import pyarrow as pa
import tomlkit
from annotated_types import Ge, Le, MaxLen, MinLen, doc
from pydantic import Field

from quadsim.errors import InputError, ParameterError, UnknownNameError
from quadsim.state import Array
from scenarios.assembly import Assembly
from scenarios.campaign.campaign_file import (
    MOST_FLIGHTS,
    CampaignFile,
    Choice,
    Integer,
    LogUniform,
    Name,
    Seed,
    Uniform,
    Value,
    Varied,
    check_fields,
)
from scenarios.campaign.events import CountedEvent, is_comparable, parse_event
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
from scenarios.campaign.statistics import Requirement, parse_requirement
from scenarios.catalogue import tuning_path
from scenarios.loading import parse_scenario
from scenarios.many import Row
from scenarios.schema.bases import merge
from scenarios.schema.problems import ScenarioError, parse_table
from scenarios.schema.scenario import Scenario
from scenarios.schema.settings import get_field
from scenarios.schema.writing import to_toml

START: Final = 0  # the candidate that is the scenario as it is
Searched = Annotated[Uniform | LogUniform | Integer | Choice, Field(discriminator="distribution")]
OWN: Final = ("name", "description", "flights", "seed")  # fields of a campaign that a tuning has itself
Values = Mapping[str, Value]
"""Values of a candidate, by the names of the entries of `[[search]]`; empty for the start."""


@dataclass(frozen=True, kw_only=True)
class Objective:
    """A number to minimise."""

    name: Annotated[Name, doc("letters, digits, _ and -")]
    expression: Annotated[
        str,
        MaxLen(500),
        doc(
            "of a flight: columns of a campaign's results, numbers, + - * / **, sqrt, abs, min, max; minus it where "
            "more is better"
        ),
    ]
    unit: Annotated[str, MaxLen(20), doc("of it, for tables and plots")] = "-"


@dataclass(frozen=True, kw_only=True)
class Fresh:
    """Fresh draws, on which the result is compared with the start."""

    flights: Annotated[int, Ge(2), Le(MOST_FLIGHTS), doc("of each of the two")] = 300
    seed: Annotated[Seed, doc("of these draws; not that of the search")] = 1


@dataclass(frozen=True, kw_only=True)
class TuningFile:
    """A search for better values of a scenario's fields."""

    name: Annotated[
        str,
        Field(pattern=r"^[a-z0-9][a-z0-9._-]*$"),
        MaxLen(60),
        doc("letters a-z, digits and . _ -; names the tuning's directory"),
    ]
    description: Annotated[str, doc("one line")] = ""
    seed: Annotated[Seed, doc("of the draws that all candidates meet, and of the search")] = 0
    trials: Annotated[int, Ge(1), Le(100_000), doc("candidates besides the start; a multiple of batch")]
    batch: Annotated[int, Ge(1), Le(1000), doc("candidates that are proposed at once")] = 12
    flights: Annotated[
        list[Annotated[int, Ge(1), Le(MOST_FLIGHTS)]],
        MinLen(1),
        MaxLen(10),
        doc("rising: all candidates fly the first number of draws, those that are no worse than the best go on"),
    ] = field(default_factory=lambda: [4, 12, 36])
    require: Annotated[
        str,
        doc(
            'what no answer may fail, e.g. "P(violation) < 0.01 @ 95%": in the search by the share of flights, '
            "on fresh draws with that confidence"
        ),
    ]
    guard: Annotated[
        str | None,
        doc(
            'an event that counts instead of that of require in the search, e.g. "worst_margin < 0.01": few '
            "flights see near misses before they see failures"
        ),
    ] = None
    fresh: Fresh = Fresh()
    objectives: Annotated[list[Objective], MinLen(1), MaxLen(2), doc("one, or two for a Pareto front")]
    search: Annotated[list[Searched], MinLen(1), MaxLen(50), doc("what is searched")]
    campaign: Annotated[dict[str, Any], doc("what is flown: fields of a campaign file, or a campaign as its base")]

    def __post_init__(self) -> None:
        if self.trials % self.batch:
            raise ValueError(f"trials must be a multiple of batch, {self.batch}; got {self.trials}")
        if sorted(set(self.flights)) != self.flights:
            raise ValueError(f"flights must rise; got {self.flights}")
        if self.fresh.seed == self.seed:
            raise ValueError(f"fresh.seed must not be seed, {self.seed}, whose draws choose the answer")
        for what, names in (
            ("objectives", [objective.name for objective in self.objectives]),
            ("search", [entry.name for entry in self.search]),
        ):
            if len(set(names)) < len(names):
                raise ValueError(f"{what} must have distinct names; got {names}")
        for entry in self.search:
            if isinstance(entry, Choice) and entry.weights is not None:
                raise ValueError(f"search.{entry.name}.weights must be absent: nothing is drawn")
            if isinstance(entry, Choice) and isinstance(entry.values[0], list):
                raise ValueError(f"search.{entry.name}.values must be no lists: search their entries, by index")


@dataclass(frozen=True)
class TuningPlan:
    """A tuning's file and the campaign of its start."""

    spec: TuningFile  # the file
    start: Plan  # on the draws of the search; its scenario has every number of its vehicle in it

    @property
    def most(self) -> int:
        """Number of flights of a candidate that is not pruned."""
        return self.spec.flights[-1]

    @cached_property
    def requirement(self) -> Requirement:
        """The bound on the probability of an event."""
        return parse_requirement(self.spec.require)

    @cached_property
    def guard(self) -> CountedEvent:
        """The event that counts in the search."""
        return parse_event(self.spec.guard or self.requirement.event.text, self.start.columns)

    def objectives(self, rows: Sequence[Row]) -> Array:
        """Return the objectives (flights, objectives) of some flights; NaN for incomplete flights."""
        values = [
            [value_of(objective.expression, row) if row["status"] == "completed" else math.nan for row in rows]
            for objective in self.spec.objectives
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
        return Plan(replace(self.start.spec, name=name, **asdict(self.spec.fresh)), self.candidate(values, name))

    def shown(self, values: Values) -> dict[str, Value | str | None]:
        """The searched values of a candidate as tables have them; None where the start has no single one."""
        chosen = values or self.start_values
        return {entry.name: cell(chosen[entry.name]) if entry.name in chosen else None for entry in self.spec.search}

    @cached_property
    def start_values(self) -> Values:
        """Return the start's values of the searched entries, without entries that have no single value."""
        values: dict[str, Value] = {}
        for entry in self.spec.search:
            modelled = [1.0 if entry.relative else get_field(merge(self.start.data, {}), path) for path in entry.fields]
            if modelled[0] is not None and all(value == modelled[0] for value in modelled):
                values[entry.name] = modelled[0]
        return values

    def check(self) -> None:
        """Refuse, before the first flight, values that cannot be flown.

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
                value_of(objective.expression, {name: 1.0 for name, kind in columns.items() if is_comparable(kind)})
        check_ends(self.spec.search, self._check_at, table="search")

    def _check_at(self, entry: Varied, value: Value) -> None:
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
        campaign = replace(self.start.spec, scenario="scenario.toml", set={})
        document = tomlkit.parse(to_toml(replace(self.spec, campaign={})))
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
        columns = [("candidate", "-", pa.int64())]
        columns += [(f"search.{entry.name}", entry.unit, column_type(entry)) for entry in self.tuning.spec.search]
        first, *others = super().schema
        return pa.schema(
            [first, *(pa.field(name, kind, metadata={"unit": unit}) for name, unit, kind in columns), *others],
            metadata=super().schema.metadata,
        )

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
    """Name the field of the file in exceptions raised inside."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{name}: {error}") from error


def load_tuning(name: str, *, trials: int | None = None, seed: int | None = None) -> TuningPlan:
    """Read and check a shipped tuning, or a file, with its campaign and scenario; see `quadsim.tune`."""
    path, data = tuning_path(name), read_campaign(name, tuning_path)
    data |= {key: value for key, value in (("trials", trials), ("seed", seed)) if value is not None}
    spec = parse_table(TuningFile, data, path.name, file="tuning")
    try:
        campaign = _campaign(spec, source=f"{path.name}: campaign")
        check_fields(spec.search, "search", {path: entry.name for entry in campaign.vary for path in entry.fields})
        plan = TuningPlan(spec, Plan(campaign, flown_scenario(campaign, path)))
        plan.check()
    except ScenarioError:
        raise
    except ValueError as error:
        raise InputError(f"{path.name}: {error}") from error
    return plan


def _campaign(spec: TuningFile, *, source: str) -> CampaignFile:
    """The tables of `[campaign]` over those of its base, with what the tuning has itself."""
    base = spec.campaign.get("base")
    if not isinstance(base, str | None):
        raise ParameterError("campaign", "base", base, "a campaign's name or a path ending in .toml")
    if stated := [name for name in OWN if name in spec.campaign]:
        raise ParameterError("campaign", stated[0], spec.campaign[stated[0]], "absent: a tuning has its own")
    fields = {"name": spec.name, "description": spec.description, "flights": spec.flights[-1], "seed": spec.seed}
    tables = {key: value for key, value in spec.campaign.items() if key != "base"}
    return parse_campaign(merge(read_campaign(base) if base else {}, tables | fields), source=source)


_OPERATORS: Final[dict[type[ast.AST], Callable[..., float]]] = {
    **{ast.Add: operator.add, ast.Sub: operator.sub, ast.Mult: operator.mul},
    **{ast.Div: operator.truediv, ast.Pow: math.pow, ast.USub: operator.neg},
}
_FUNCTIONS: Final[dict[str, Callable[..., float]]] = {"sqrt": math.sqrt, "abs": abs, "min": min, "max": max}


def value_of(expression: str, row: Mapping[str, Any]) -> float:
    """The value of e.g. `sqrt(rmse.x**2 + rmse.y**2)` in a flight; NaN where it has no such number, or no finite one.

    Raises:
        InputError: it is no arithmetic on columns.
        UnknownNameError: the flight has no such column.
    """
    rule = f"with + - * / ** and {', '.join(_FUNCTIONS)}, such as 'rmse.x + rmse.y'"
    refused = InputError(f"{expression!r} must be arithmetic on columns, {rule}")
    try:
        tree = ast.parse(expression.strip(), mode="eval")
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        raise refused from error
    try:
        value = _value(tree.body, row)
    except InputError:
        raise
    except (ArithmeticError, ValueError):
        return math.nan
    except TypeError as error:
        raise refused from error
    return value if math.isfinite(value) else math.nan


def _value(node: ast.expr, row: Mapping[str, Any]) -> float:
    match node:
        case ast.Constant(value=int() | float() as number):
            return float(number)
        case ast.UnaryOp(op=op, operand=operand) if type(op) in _OPERATORS:
            return _OPERATORS[type(op)](_value(operand, row))
        case ast.BinOp(left=left, op=op, right=right) if type(op) in _OPERATORS:
            return _OPERATORS[type(op)](_value(left, row), _value(right, row))
        case ast.Call(func=ast.Name(id=name), args=args, keywords=[]) if name in _FUNCTIONS:
            return _FUNCTIONS[name](*(_value(argument, row) for argument in args))
        case ast.Name() | ast.Attribute():
            name = ast.unparse(node)
            if name not in row:
                raise UnknownNameError("column of numbers", name, row)
            if row[name] is None:
                raise ValueError(name)
            return float(row[name])
    raise TypeError(node)
