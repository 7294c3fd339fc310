"""`[[vary]]` of a campaign file: what varies, and how it is distributed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated, Literal

from annotated_types import MaxLen, MinLen
from pydantic import Field, model_validator

from quadsim.fields import Number, Positive
from scenarios.schema.base import LARGEST_SEED, MOST_ENTRIES, Spec

Whole = Annotated[int, Field(ge=-LARGEST_SEED, le=LARGEST_SEED)]
Value = bool | Whole | Number | str | list[Number]
"""What can be drawn from a list: whatever a field of a scenario may be, but for tables."""
Values = Annotated[list[Value], MinLen(1), MaxLen(MOST_ENTRIES)]


class _VarySpec(Spec):
    """What every entry of `[[vary]]` has."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]*$", max_length=60)] = Field(
        description="letters, digits, _ and -; the column `draw.NAME` of the results"
    )
    fields: Annotated[list[str], MinLen(1), MaxLen(MOST_ENTRIES)] = Field(
        description="dotted paths into the scenario that all get the drawn value, as for --set; an entry of a list by "
        "its name or index"
    )
    unit: Annotated[str, Field(max_length=20)] = Field(default="-", description="of the values, for tables and plots")
    relative: bool = Field(default=False, description="whether the drawn number multiplies what the scenario has")


class UniformSpec(_VarySpec):
    """Every value between two bounds is equally likely."""

    distribution: Literal["uniform"]
    low: Number
    high: Number

    @model_validator(mode="after")
    def _check(self) -> UniformSpec:
        _require_range(self.low, self.high)
        return self


class LogUniformSpec(_VarySpec):
    """The logarithm is uniform: every factor is equally likely."""

    distribution: Literal["log_uniform"]
    low: Positive
    high: Positive

    @model_validator(mode="after")
    def _check(self) -> LogUniformSpec:
        _require_range(self.low, self.high)
        return self


class NormalSpec(_VarySpec):
    """A normal distribution, cut off where `low` or `high` say so."""

    distribution: Literal["normal"]
    mean: Number
    deviation: Positive = Field(description="standard deviation, before it is cut off")
    low: Number | None = Field(default=None, description="absent: no lower end")
    high: Number | None = Field(default=None, description="absent: no upper end")

    @model_validator(mode="after")
    def _check(self) -> NormalSpec:
        low, high = self.ends
        _require_range(low, high)
        if low > self.mean + 8.0 * self.deviation or high < self.mean - 8.0 * self.deviation:
            raise ValueError(
                f"mean must be within 8 standard deviations of the range {low:g} to {high:g}, or nothing is ever drawn "
                f"from there; got {self.mean:g} with deviation {self.deviation:g}"
            )
        return self

    @property
    def ends(self) -> tuple[float, float]:
        """Where it is cut off; infinite for nowhere."""
        return -math.inf if self.low is None else self.low, math.inf if self.high is None else self.high


class ChoiceSpec(_VarySpec):
    """One of several values, each with its own weight."""

    distribution: Literal["choice"]
    values: Values
    weights: Annotated[list[Annotated[float, Field(ge=0.0, le=1e6)]], MaxLen(MOST_ENTRIES)] | None = Field(
        default=None, description="one per value, of any sum; absent: all the same"
    )

    @model_validator(mode="after")
    def _check(self) -> ChoiceSpec:
        _require_alike(self.values)
        if self.weights is not None and len(self.weights) != len(self.values):
            raise ValueError(f"weights must be as many as values, {len(self.values)}; got {len(self.weights)}")
        if self.weights is not None and not sum(self.weights) > 0.0:
            raise ValueError(f"weights must not all be 0; got {self.weights}")
        return self


class GridSpec(_VarySpec):
    """Every value in turn; several grids make every combination, the last one changing fastest."""

    distribution: Literal["grid"]
    values: Values

    @model_validator(mode="after")
    def _check(self) -> GridSpec:
        _require_alike(self.values)
        return self


VarySpec = Annotated[
    UniformSpec | LogUniformSpec | NormalSpec | ChoiceSpec | GridSpec, Field(discriminator="distribution")
]


def _require_range(low: float, high: float) -> None:
    if not low < high:
        raise ValueError(f"low must be below high; got {low:g} and {high:g}")


def _require_alike(values: Sequence[Value]) -> None:
    """Refuse values of different kinds, which cannot stand in one column."""
    kinds = {
        "a number" if isinstance(each, int | float) and not isinstance(each, bool) else type(each) for each in values
    }
    if len(kinds) > 1:
        raise ValueError(f"values must all be of one kind; got {values}")
    if len({str(each) for each in values}) < len(values):
        raise ValueError(f"values must be distinct; got {values}")
