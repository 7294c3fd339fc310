"""What may happen in a flight, as text: `lost`, `violation`, `rmse.z > 0.5`.

One rule for what is not known: where a flight has no value, the event holds, since the flight did not show otherwise.
"""

from __future__ import annotations

import math
import operator
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from quadsim.errors import InputError, ParameterError, UnknownNameError

if TYPE_CHECKING:
    import pyarrow as pa

Flags = np.ndarray[Any, np.dtype[np.bool_]]

_NAMED: Final[dict[str, tuple[str, bool | str]]] = {
    "failure": ("failed", True),
    "violation": ("violated", True),
    "lost": ("verdict", "lost"),
    "crash": ("crashed", True),
    "error": ("verdict", "error"),
}
"""Column of each event that has a name, and its value there where the event holds."""
_SPELLINGS: Final = {"failed": "failure", "violated": "violation", "crashed": "crash"}
_OPERATIONS: Final[dict[str, Callable[[Any, Any], Any]]] = {
    "<": operator.lt,
    "<=": operator.le,
    ">": operator.gt,
    ">=": operator.ge,
}
_COMPARISON: Final = re.compile(r"(?P<column>[^<>=]*?)\s*(?P<operation><=|>=|<|>)\s*(?P<number>[^<>=]*)")

EVENT_NAMES: Final = tuple(_NAMED)
"""The events that have a name; every other one is `COLUMN OP NUMBER`."""


@dataclass(frozen=True, kw_only=True)
class Event:
    """Something that a flight's row shows to have happened, or not.

    Attributes:
        text: the event as it is written in one way: a name of `EVENT_NAMES`, or `COLUMN OP NUMBER`.
        column_name: the column that shows it.
        operation: `==`, `<`, `<=`, `>` or `>=`.
        value: what the column is compared with.
    """

    text: str
    column_name: str
    operation: str
    value: bool | str | float

    def holds(self, row: Mapping[str, Any]) -> bool:
        """Whether it happened in one flight; so it did where the flight has no value.

        Args:
            row: a flight's values by column.

        Raises:
            UnknownNameError: there is no such column.
            InputError: a number is asked for, and the column holds text.
        """
        if self.column_name not in row:
            raise UnknownNameError("column", self.column_name, row)
        value = row[self.column_name]
        if value is None:
            return True
        if self.operation == "==":
            return bool(value == self.value)
        if isinstance(value, str):
            raise InputError(f"event {self.text!r} compares with a number; the column {self.column_name!r} holds text")
        return math.isnan(value) or bool(_OPERATIONS[self.operation](value, self.value))

    def column(self, table: pa.Table) -> Flags:
        """(K,) whether it happened, flight by flight; the same as `holds` of every row.

        Raises:
            UnknownNameError: there is no such column.
            InputError: a number is asked for, and the column holds text.
        """
        if self.column_name not in table.column_names:
            raise UnknownNameError("column", self.column_name, table.column_names)
        return np.array([self.holds({self.column_name: value}) for value in table[self.column_name].to_pylist()], bool)


def parse_event(text: str, columns: Iterable[str] | None = None) -> Event:
    """An event from its text.

    Args:
        text: `failure`, `violation`, `lost`, `crash` or `error`, where `failed`, `violated` and `crashed` mean the same
            as their nouns; or `COLUMN OP NUMBER` with one of `< <= > >=`, e.g. `rmse.z > 0.5`.
        columns: those that a comparison may name; None for any.

    Raises:
        UnknownNameError: no event has that name, or there is no such column.
        ParameterError: what is compared with is not a finite number.
    """
    text = " ".join(text.split())
    name = _SPELLINGS.get(text, text)
    if name in _NAMED:
        column, value = _NAMED[name]
        return Event(text=name, column_name=column, operation="==", value=value)
    found = _COMPARISON.fullmatch(text)
    if found is None:
        hint = "or a comparison, COLUMN OP NUMBER with < <= > or >=, such as 'rmse.z > 0.5'"
        raise UnknownNameError("event", text, {*_NAMED, *_SPELLINGS}, hint=hint)
    column = found["column"]
    if columns is not None and column not in (known := tuple(columns)):
        raise UnknownNameError("column", column, known)
    number = _number(found["number"], text)
    return Event(
        text=f"{column} {found['operation']} {number:.15g}",
        column_name=column,
        operation=found["operation"],
        value=number,
    )


def _number(given: str, event: str) -> float:
    try:
        number = float(given)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise ParameterError(f"event {event!r}", "number", given, "a finite number")
    return number
