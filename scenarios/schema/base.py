"""What all tables of the scenario file share: strictness, kinds of numbers, and how their fields are declared.

A table is a `Spec`, or a settings dataclass of the core, which is then its only declaration; see `quadsim.fields`.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from typing import Annotated, Any, Final, Literal, TypeGuard, get_type_hints

from annotated_types import DocInfo, Len
from pydantic import BaseModel, ConfigDict, Field
from pydantic.fields import FieldInfo

from quadsim.fields import Number

MOST_ENTRIES: Final = 1000  # of a list of tables
Triple = Annotated[list[Number], Len(3, 3)]
Pair = Annotated[list[Number], Len(2, 2)]
LARGEST_HORIZON: Final = 1000
Horizon = Annotated[int, Field(ge=1, le=LARGEST_HORIZON)]
LARGEST_SEED: Final = 2**63 - 1  # the largest whole number that every reader of TOML takes
Seconds = Annotated[float, Field(ge=0.0, le=10.0)]
Lag = Seconds | Literal["vehicle"]  # A time constant, or that of the vehicle file

STRICT: Final = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)

_FIRST: Final = {"at": 0, "type": 1}
"""Fields that stand first in a table, which may have been added to those of a dataclass."""


class Spec(BaseModel):
    """A table of the file.

    What a validator raises starts with the name of the field, for `scenarios.schema.problems.describe` to complete.
    """

    model_config = ConfigDict(frozen=True, **STRICT)


def is_table(kind: object) -> TypeGuard[type[Any]]:
    """Whether a type is one of tables."""
    return isinstance(kind, type) and (issubclass(kind, BaseModel) or dataclasses.is_dataclass(kind))


def fields_of(table: type[Any]) -> dict[str, FieldInfo]:
    """The fields of a table by their names, with types, limits, defaults and descriptions."""
    return table.model_fields if issubclass(table, BaseModel) else _declared(table)  # type: ignore[arg-type]


@functools.cache
def _declared(table: Any) -> dict[str, FieldInfo]:
    """The fields of a dataclass."""
    hints = get_type_hints(table, include_extras=True)
    found = {}
    for field in sorted(dataclasses.fields(table), key=lambda field: _FIRST.get(field.name, len(_FIRST))):
        found[field.name] = info = FieldInfo.from_annotated_attribute(hints[field.name], field)
        info.description = next((note.documentation for note in info.metadata if isinstance(note, DocInfo)), None)
    return found


def require_ordered(name: str, pair: Sequence[float]) -> None:
    """Refuse a pair of bounds whose lower is not below its upper."""
    if not pair[0] < pair[1]:
        raise ValueError(f"{name} must have its lower bound below its upper; got {list(pair)}")
