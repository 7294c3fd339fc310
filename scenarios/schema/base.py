"""What all tables of the scenario file share: strictness, and the kinds of numbers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Final

from annotated_types import Len
from pydantic import BaseModel, ConfigDict, Field

MOST_ENTRIES: Final = 1000
"""Of a list of tables."""
Number = Annotated[float, Field(ge=-1e6, le=1e6)]
NonNegative = Annotated[float, Field(ge=0.0, le=1e6)]
Positive = Annotated[float, Field(gt=0.0, le=1e6)]
Fraction = Annotated[float, Field(ge=0.0, le=1.0)]
Triple = Annotated[list[Number], Len(3, 3)]
Quadruple = Annotated[list[Number], Len(4, 4)]
Pair = Annotated[list[Number], Len(2, 2)]
LARGEST_SEED: Final = 2**63 - 1
"""The largest whole number that every reader of TOML takes."""


class Spec(BaseModel):
    """A table of the file.

    What a validator raises starts with the name of the field, for `scenarios.schema.problems.describe` to complete.
    """

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)


def require_ordered(name: str, pair: Sequence[float]) -> None:
    """Refuse a pair of bounds whose lower is not below its upper."""
    if not pair[0] < pair[1]:
        raise ValueError(f"{name} must have its lower bound below its upper; got {list(pair)}")
