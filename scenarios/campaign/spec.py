"""The campaign file: a scenario, what varies, how many flights, and what counts as failure."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated, Any, Final, Literal, Self

import numpy as np
import scipy  # whose `stats` takes half a second to load, where it is first used
from annotated_types import MaxLen, MinLen
from pydantic import Field, model_validator

from quadsim.errors import InputError
from quadsim.fields import Number, Positive
from scenarios.campaign.results.events import parse_event
from scenarios.schema.base import LARGEST_SEED, MOST_ENTRIES, Spec
from scenarios.schema.writing import to_toml

Whole = Annotated[int, Field(ge=-LARGEST_SEED, le=LARGEST_SEED)]
Value = bool | Whole | Number | str | list[Number]
"""What can be drawn from a list: whatever a field of a scenario may be, but for tables."""
Values = Annotated[list[Value], MinLen(1), MaxLen(MOST_ENTRIES)]
MOST_FLIGHTS: Final = 1_000_000
_TAIL: Final = 1e-3  # share of a distribution beyond the values taken as its ends
Sampling = Literal["random", "latin_hypercube", "sobol", "halton"]


class VaryBase(Spec):
    """What every entry of `[[vary]]` has, and of `[[search]]`."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]*$", max_length=60)] = Field(
        description="letters, digits, _ and -; the column `draw.NAME` of the results"
    )
    fields: Annotated[list[str], MinLen(1), MaxLen(MOST_ENTRIES)] = Field(
        description="dotted paths into the scenario that all get the drawn value, as for --set; an entry of a list by "
        "its name or index"
    )
    unit: Annotated[str, Field(max_length=20)] = Field(default="-", description="of the values, for tables and plots")
    relative: bool = Field(default=False, description="whether the sampled value multiplies the scenario's own")
    distribution: str

    def quantile(self, share: float) -> Value:
        """The value below which a share, from 0 to less than 1, of the distribution lies; of a list, in its order."""
        raise NotImplementedError

    def extremes(self) -> list[Value]:
        """The values at the ends, or all of a list: if these can be flown, the others can."""
        raise NotImplementedError


class _Ranged(VaryBase):
    """Numbers between two bounds."""

    low: Number
    high: Number

    @model_validator(mode="after")
    def _check(self) -> Self:
        require_range(self.low, self.high)
        return self

    def extremes(self) -> list[Value]:
        """See `VaryBase`."""
        return [self.low, self.high]


class UniformSpec(_Ranged):
    """Every value between two bounds is equally likely."""

    distribution: Literal["uniform"]

    def quantile(self, share: float) -> Value:
        """See `VaryBase`."""
        return self.low + (self.high - self.low) * share


class LogUniformSpec(_Ranged):
    """The logarithm is uniform: every factor is equally likely."""

    distribution: Literal["log_uniform"]
    low: Positive
    high: Positive

    def quantile(self, share: float) -> Value:
        """See `VaryBase`."""
        return float(self.low * (self.high / self.low) ** share)


class IntegerSpec(_Ranged):
    """Every whole number between two bounds, both included, is equally likely."""

    distribution: Literal["integer"]
    low: Whole
    high: Whole

    def quantile(self, share: float) -> Value:
        """See `VaryBase`."""
        return self.low + int((self.high - self.low + 1) * share)


class NormalSpec(VaryBase):
    """A normal distribution, truncated at `low` and `high`."""

    distribution: Literal["normal"]
    mean: Number
    deviation: Positive = Field(description="standard deviation, before it is cut off")
    low: Number | None = Field(default=None, description="absent: no lower end")
    high: Number | None = Field(default=None, description="absent: no upper end")

    @model_validator(mode="after")
    def _check(self) -> Self:
        low, high = self._ends
        require_range(low, high)
        if low > self.mean + 8.0 * self.deviation or high < self.mean - 8.0 * self.deviation:
            raise ValueError(
                f"mean must be within 8 standard deviations of the range {low:g} to {high:g}, or nothing is ever drawn "
                f"from there; got {self.mean:g} with deviation {self.deviation:g}"
            )
        return self

    @property
    def _ends(self) -> tuple[float, float]:
        return -math.inf if self.low is None else self.low, math.inf if self.high is None else self.high

    def quantile(self, share: float) -> Value:
        """See `VaryBase`."""
        low, high = ((end - self.mean) / self.deviation for end in self._ends)
        return float(scipy.stats.truncnorm.ppf(share, low, high, loc=self.mean, scale=self.deviation))

    def extremes(self) -> list[Value]:
        """See `VaryBase`."""
        low, high = self._ends
        return [
            low if math.isfinite(low) else self.quantile(_TAIL),
            high if math.isfinite(high) else self.quantile(1.0 - _TAIL),
        ]


class _Listed(VaryBase):
    """One of several values."""

    values: Values

    @model_validator(mode="after")
    def _check(self) -> Self:
        numbers = [isinstance(each, int | float) and not isinstance(each, bool) for each in self.values]
        if len({"a number" if number else type(each) for number, each in zip(numbers, self.values, strict=True)}) > 1:
            raise ValueError(f"values must all be of one kind; got {self.values}")
        if len(set(map(str, self.values))) < len(self.values):
            raise ValueError(f"values must be distinct; got {self.values}")
        return self

    def extremes(self) -> list[Value]:
        """See `VaryBase`."""
        return list(self.values)


class ChoiceSpec(_Listed):
    """One of several values, each with its own weight."""

    distribution: Literal["choice"]
    weights: Annotated[list[Annotated[float, Field(ge=0.0, le=1e6)]], MaxLen(MOST_ENTRIES)] | None = Field(
        default=None, description="one per value, of any sum; absent: all the same"
    )

    @model_validator(mode="after")
    def _check_weights(self) -> Self:
        if self.weights is not None and len(self.weights) != len(self.values):
            raise ValueError(f"weights must be as many as values, {len(self.values)}; got {len(self.weights)}")
        if self.weights is not None and not sum(self.weights) > 0.0:
            raise ValueError(f"weights must not all be 0; got {self.weights}")
        return self

    def quantile(self, share: float) -> Value:
        """See `VaryBase`."""
        edges = np.cumsum(self.weights or [1.0] * len(self.values))
        return self.values[int(np.searchsorted(edges, share * edges[-1], side="right"))]


class GridSpec(_Listed):
    """Every value in turn; several grids make every combination, the last one changing fastest."""

    distribution: Literal["grid"]


VarySpec = Annotated[
    UniformSpec | LogUniformSpec | NormalSpec | IntegerSpec | ChoiceSpec | GridSpec, Field(discriminator="distribution")
]


def require_range(low: float, high: float) -> None:
    """Refuse a range without a width."""
    if not low < high:
        raise ValueError(f"low must be below high; got {low:g} and {high:g}")


class LimitsSpec(Spec):
    """What one flight may take before it is ended, as a result with the verdict `timeout` or `memory`."""

    flight: Positive = Field(default=600.0, description="[s] wall clock of a flight")
    memory: Annotated[float, Field(ge=100.0, le=1e9)] = Field(
        default=2000.0, description="[MB] of the flight's process, beyond what it starts with"
    )


class CampaignSpec(Spec):
    """Many flights of one scenario."""

    name: Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9._-]*$", max_length=80)] = Field(
        description="letters a-z, digits and . _ -; names the campaign's directory"
    )
    description: str = Field(default="", description="one line")
    scenario: str = Field(description="a library name, or a path ending in .toml")
    set: dict[str, Any] = Field(
        default={}, description="a part of a scenario file, merged over the scenario field by field"
    )
    flights: Annotated[int, Field(ge=1, le=MOST_FLIGHTS)] = Field(description="how many")
    seed: Annotated[int, Field(ge=0, le=LARGEST_SEED)] = Field(
        default=0, description="of all draws, and of the seed of each flight"
    )
    sampling: Sampling = Field(
        default="random",
        description="how numbers are drawn: random (each flight by itself), or spread evenly over all that varies: "
        "latin_hypercube, sobol, halton",
    )
    failure: Annotated[list[str], MinLen(1), MaxLen(MOST_ENTRIES)] = Field(
        default=["violated"],
        description="a flight fails when any of these events happens: lost, violated, crashed, error, died, timeout, "
        "memory, or a column of the results compared with a number, e.g. rmse.z > 0.5",
    )
    limits: LimitsSpec = LimitsSpec()
    vary: Annotated[list[VarySpec], MaxLen(MOST_ENTRIES)] = Field(default=[], description="what varies")

    @model_validator(mode="after")
    def _check(self) -> CampaignSpec:
        names = [entry.name for entry in self.vary]
        if len(set(names)) < len(names):
            raise ValueError(f"vary must have distinct names; got {names}")
        check_fields(self.vary, "vary", {})
        grids = ", ".join(entry.name for entry in self.vary if isinstance(entry, GridSpec))
        if grids and self.sampling in ("sobol", "halton"):
            rule = f"random or latin_hypercube where there are grids ({grids}), whose turns go with its points"
            raise ValueError(f"sampling must be {rule}; got {self.sampling!r}")
        if self.flights % self.cells:
            rule = f"a multiple of the {self.cells} combinations of its grids"
            raise ValueError(f"flights must be {rule}; got {self.flights}")
        for text in self.failure:
            try:
                if parse_event(text).text == "failure":
                    raise InputError("failure is what this list defines")
            except InputError as error:
                raise ValueError(f"failure has an entry {text!r} that is no event: {error}") from error
        return self

    @property
    def cells(self) -> int:
        """Combinations that the grids make; 1 without any."""
        return math.prod(len(entry.values) for entry in self.vary if isinstance(entry, GridSpec))

    def to_toml(self) -> str:
        """The file with every field, defaults included; reading it gives this campaign again."""
        return to_toml(self)


def check_fields(entries: Sequence[VaryBase], table: str, owners: dict[str, str]) -> None:
    """Refuse fields that two entries replace, and those that are not to be replaced.

    `table` names the entries; `owners` has who replaces a field, and gets the entries' own.
    """
    for entry in entries:
        for field in entry.fields:
            if field == "seed":
                raise ValueError(f"{table}.{entry.name}.fields must not have seed: every flight has one of its own")
            if field.split(".")[-1] == "name":
                raise ValueError(f"{table}.{entry.name}.fields must not have {field}: results are identified by names")
            if field in owners:
                raise ValueError(f"{table}.{entry.name}.fields must not have {field}, which {owners[field]} draws")
            owners[field] = entry.name
