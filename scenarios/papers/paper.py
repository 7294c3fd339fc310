"""A paper's file: what it publishes, which scenario reproduces each number, and how near is near enough."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from annotated_types import MaxLen, MinLen
from pydantic import Field, ValidationError, model_validator

from quadsim.assets import read_toml
from quadsim.fields import NonNegative, Number, Positive
from scenarios.assembly import Assembly
from scenarios.catalogue import paper_path, scenario_path
from scenarios.loading import parse_scenario
from scenarios.schema.base import MOST_ENTRIES, Pair, Spec
from scenarios.schema.bases import merge, read_scenario
from scenarios.schema.problems import ScenarioError, describe_all
from scenarios.schema.scenario import Scenario

Text = Annotated[str, Field(min_length=1, max_length=300)]


class NumberSpec(Spec):
    """One published number, and the flight that gives ours."""

    name: Text = Field(description="what it is, for tables")
    scenario: str = Field(description="a library name, or a path ending in .toml, relative to the paper's file")
    set: dict[str, Any] = Field(default={}, description="tables that are merged over the scenario, as over a base")
    measure: str = Field(
        default="tracking.position_error.mean",
        description="dotted path into the flight's summary.json; an entry of a list by its name",
    )
    unit: Annotated[str, Field(max_length=20)] = Field(default="m", description="of the number, for tables")
    published: Number | Pair = Field(description="[unit] the number, or the lowest and the highest of several")
    relation: Literal["equal", "at most", "at least"] = Field(
        default="equal", description="what ours is to be to the published one"
    )
    absolute: NonNegative | None = Field(default=None, description="[unit] tolerance; either absolute or relative")
    relative: Positive | None = Field(default=None, description="[-] tolerance as a share of the published number")
    source: Text = Field(description="where the published number is from")

    @model_validator(mode="after")
    def _check(self) -> NumberSpec:
        if (self.absolute is None) == (self.relative is None):
            raise ValueError("absolute must be given, or relative, but not both")
        if self.relative is not None and not any(self.span):
            raise ValueError("absolute must be given where the published number is 0")
        if isinstance(self.published, list):
            low, high = self.published
            if self.relation != "equal" or not low < high:
                raise ValueError(f"published must be a lower and a higher number of relation equal; got {[low, high]}")
        return self

    @property
    def span(self) -> tuple[float, float]:
        """The lowest and the highest published number."""
        low, high = self.published if isinstance(self.published, list) else (self.published, self.published)
        return low, high

    @property
    def tolerance(self) -> float:
        """How far off ours may be [unit]."""
        return self.absolute if self.absolute is not None else (self.relative or 0.0) * max(map(abs, self.span))


class PaperSpec(Spec):
    """A paper, with the numbers of it that are reproduced."""

    title: Text = Field(description="of the paper")
    authors: Text | None = Field(default=None, description="of the paper; absent where it names none")
    publication: Text | None = Field(default=None, description="where and when it was published")
    about: Text = Field(description="what is reproduced, and what it is written from")
    numbers: Annotated[list[NumberSpec], MinLen(1), MaxLen(MOST_ENTRIES)] = Field(description="its numbers, in order")


class Paper(PaperSpec):
    """A paper with the file that it was read from."""

    path: Path

    @property
    def name(self) -> str:
        """Short name of the paper."""
        return self.path.stem


def load_paper(name: str) -> Paper:
    """Read and check a paper.

    Args:
        name: of one that ships, or a path ending in `.toml`.

    Raises:
        InputError: the file is missing or malformed, or a field is not allowed.
    """
    path = paper_path(name)
    data = read_toml(path)
    try:
        spec = PaperSpec.model_validate(data)
    except ValidationError as error:
        problems = describe_all(error, data, PaperSpec, file="paper")
        raise ScenarioError(path.name, problems) from error
    return Paper(path=path, **{field: getattr(spec, field) for field in PaperSpec.model_fields})


def scenario_of(paper: Paper, number: NumberSpec) -> Scenario:
    """What is flown for a number.

    Raises:
        InputError: there is no such scenario, or it cannot be flown so.
    """
    beside = paper.path.parent / number.scenario
    found = str(beside) if number.scenario.endswith(".toml") and beside.is_file() else number.scenario
    path = scenario_path(found)
    data = merge(read_scenario(path, scenario_path), number.set)
    scenario = parse_scenario(data, source=f"{number.name}: {path.name}", directory=path.parent)
    Assembly(scenario).check()
    return scenario
