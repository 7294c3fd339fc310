"""Common parts of all tables of the scenario file: how strictly they are parsed, and which fields they declare.

A table is a frozen dataclass, its only declaration; see `quadsim.fields`.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Annotated, Any, Final, TypeGuard, get_type_hints

from annotated_types import DocInfo, Len
from pydantic import ConfigDict
from pydantic.fields import FieldInfo

from quadsim.fields import Number

PairList = Annotated[list[Number], Len(2, 2)]
LARGEST_WHOLE: Final = 2**63 - 1  # that every reader of TOML takes

STRICT: Final = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)

_FIRST: Final = {"at": 0, "type": 1}
"""Fields that come first in a table, even where a subclass adds them."""


def is_table(kind: object) -> TypeGuard[type[Any]]:
    """Return whether a type is a table."""
    return isinstance(kind, type) and dataclasses.is_dataclass(kind)


def fields_of(table: type[Any]) -> dict[str, FieldInfo]:
    """Return the fields of a table by name, with types, limits, defaults and descriptions."""
    return _declared(table)  # type: ignore[arg-type]


@functools.cache
def _declared(table: Any) -> dict[str, FieldInfo]:
    """The fields of a dataclass."""
    hints = get_type_hints(table, include_extras=True)
    declared = {}
    for field in sorted(dataclasses.fields(table), key=lambda field: _FIRST.get(field.name, len(_FIRST))):
        info = FieldInfo.from_annotated_attribute(hints[field.name], field)
        info.description = _documentation(info)
        declared[field.name] = info
    return declared


def _documentation(info: FieldInfo) -> str | None:
    """Return the text of a field's `doc`; None where it has none."""
    for note in info.metadata:
        if isinstance(note, DocInfo):
            return note.documentation
    return None
