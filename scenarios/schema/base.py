"""What all tables of the scenario file share: strictness, kinds of numbers, and how their fields are declared.

A table is a `Spec`, or a settings dataclass of the core, which is then its only declaration; see `quadsim.fields`.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Annotated, Any, Final, TypeGuard, get_type_hints

from annotated_types import DocInfo, Len
from pydantic import BaseModel, ConfigDict
from pydantic.fields import FieldInfo

from quadsim.fields import Number

MOST_ENTRIES: Final = 1000  # of a list of tables
Pair = Annotated[list[Number], Len(2, 2)]
LARGEST_SEED: Final = 2**63 - 1  # the largest whole number that every reader of TOML takes

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
