"""The tuning file: a campaign, the fields that are searched, what is to be small, and which failures are too many."""

from __future__ import annotations

from typing import Annotated, Any

from annotated_types import MaxLen, MinLen
from pydantic import Field, model_validator

from scenarios.campaign.spec import MOST_FLIGHTS, ChoiceSpec, IntegerSpec, LogUniformSpec, UniformSpec
from scenarios.schema.base import LARGEST_SEED, Spec

Seed = Annotated[int, Field(ge=0, le=LARGEST_SEED)]
Flights = Annotated[int, Field(ge=1, le=MOST_FLIGHTS)]
SearchSpec = Annotated[UniformSpec | LogUniformSpec | IntegerSpec | ChoiceSpec, Field(discriminator="distribution")]


class ObjectiveSpec(Spec):
    """A number that is to be small."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]*$", max_length=60)] = Field(
        description="letters, digits, _ and -"
    )
    expression: Annotated[str, Field(max_length=500)] = Field(
        description="of a flight: columns of a campaign's results, numbers, + - * / **, sqrt, abs, min, max; minus it "
        "where more is better"
    )
    unit: Annotated[str, Field(max_length=20)] = Field(default="-", description="of it, for tables and plots")


class FreshSpec(Spec):
    """The draws, new to both, on which the answer is compared with the start."""

    flights: Annotated[int, Field(ge=2, le=MOST_FLIGHTS)] = Field(default=300, description="of each of the two")
    seed: Seed = Field(default=1, description="of these draws; not that of the search")


class TuningSpec(Spec):
    """A search for better values of a scenario's fields."""

    name: Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9._-]*$", max_length=60)] = Field(
        description="letters a-z, digits and . _ -; names the tuning's directory"
    )
    description: str = Field(default="", description="one line")
    seed: Seed = Field(default=0, description="of the draws that all candidates meet, and of the search")
    trials: Annotated[int, Field(ge=1, le=100_000)] = Field(
        description="candidates besides the start; a multiple of batch"
    )
    batch: Annotated[int, Field(ge=1, le=1000)] = Field(default=12, description="candidates that are proposed at once")
    flights: Annotated[list[Flights], MinLen(1), MaxLen(10)] = Field(
        default=[4, 12, 36],
        description="rising: all candidates fly the first number of draws, those that are no worse than the best go on",
    )
    require: str = Field(
        description='what no answer may fail, e.g. "P(violation) < 0.01 @ 95%": in the search by the share of flights, '
        "on fresh draws with that confidence"
    )
    guard: str | None = Field(
        default=None,
        description='an event that counts instead of that of require in the search, e.g. "worst_margin < 0.02": few '
        "flights see near misses before they see failures",
    )
    fresh: FreshSpec = FreshSpec()
    objectives: Annotated[list[ObjectiveSpec], MinLen(1), MaxLen(2)] = Field(
        description="one, or two for a Pareto front"
    )
    search: Annotated[list[SearchSpec], MinLen(1), MaxLen(50)] = Field(description="what is searched")
    campaign: dict[str, Any] = Field(description="what is flown: fields of a campaign file, or a campaign as its base")

    @model_validator(mode="after")
    def _check(self) -> TuningSpec:
        if self.trials % self.batch:
            raise ValueError(f"trials must be a multiple of batch, {self.batch}; got {self.trials}")
        if sorted(set(self.flights)) != self.flights:
            raise ValueError(f"flights must rise; got {self.flights}")
        if self.fresh.seed == self.seed:
            raise ValueError(f"fresh.seed must not be seed, {self.seed}, whose draws choose the answer")
        for what, entries in (("objectives", self.objectives), ("search", self.search)):
            names = [entry.name for entry in entries]
            if len(set(names)) < len(names):
                raise ValueError(f"{what} must have distinct names; got {names}")
        for entry in self.search:
            if isinstance(entry, ChoiceSpec) and entry.weights is not None:
                raise ValueError(f"search.{entry.name}.weights must be absent: nothing is drawn")
            if isinstance(entry, ChoiceSpec) and isinstance(entry.values[0], list):
                raise ValueError(f"search.{entry.name}.values must be no lists: search their entries, by index")
        return self
