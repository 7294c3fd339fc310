"""Events of a flight as text: `lost`, `violation`, `rmse.z > 0.5`; and the verdicts that a flight can have.

One rule for what is not known: where a flight has no value, the event holds, since the flight did not show otherwise.
`plan` decides by events which flights failed; `statistics` and `paired` count them.
"""

from __future__ import annotations

import contextlib
import math
import operator
import re
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from quadsim.errors import InputError, ParameterError, UnknownNameError
from quadsim.palette import COLOUR, CYCLE
from quadsim.rollout.many import DIED, ERROR, MEMORY, TIMEOUT

if TYPE_CHECKING:
    import pyarrow as pa


FlightFlags = np.ndarray[Any, np.dtype[np.bool_]]
ALL_SATISFIED: Final = "satisfied"
INCOMPLETE: Final = "incomplete"  # of a flight that ended before it reached a required constraint: neither good nor bad
UNAUDITED: Final = "unaudited"  # of a flight without any constraint: it shows no violation, and not that there is none


class VerdictMeaning(NamedTuple):
    """Properties of a verdict."""

    badness: int  # its place among the worst flights: the larger, the worse
    colour: str
    symbol: str


VERDICTS: Final = {
    ALL_SATISFIED: VerdictMeaning(0, COLOUR.satisfied, "circle"),
    INCOMPLETE: VerdictMeaning(1, COLOUR.warning, "cross"),
    UNAUDITED: VerdictMeaning(1, COLOUR.measured, "circle-open"),
    "violated": VerdictMeaning(2, COLOUR.violated, "diamond"),
    "lost": VerdictMeaning(6, COLOUR.lost, "x"),
    ERROR: VerdictMeaning(5, COLOUR.measured, "square"),
    DIED: VerdictMeaning(5, CYCLE[2], "pentagon"),
    TIMEOUT: VerdictMeaning(4, CYCLE[3], "triangle-up"),
    MEMORY: VerdictMeaning(3, CYCLE[4], "triangle-down"),
}
"""In the order in which they are drawn and counted."""

_VERDICT_EVENTS: Final = [verdict for verdict in VERDICTS if verdict not in (ALL_SATISFIED, "violated")]
"""Verdicts that are events; `violated` has a column of its own, which counts lost flights too."""
_NAMED: Final[dict[str, tuple[str, bool | str]]] = {
    "failure": ("failed", True),
    "violation": ("violated", True),
    "lost": ("verdict", "lost"),
    "crash": ("crashed", True),
    **{verdict: ("verdict", verdict) for verdict in _VERDICT_EVENTS},
}
"""Column of each event that has a name, and its value there where the event holds."""
_SPELLINGS: Final = {"failed": "failure", "violated": "violation", "crashed": "crash"}
OPERATIONS: Final = {"<": operator.lt, "<=": operator.le, ">": operator.gt, ">=": operator.ge}
_NEVER_COMPARED: Final = ("flight", "seed", "failed")
"""Columns that identify flights, or are covered by other events."""
_COMPARISON: Final = re.compile(r"(?P<column>[^<>=]*?)\s*(?P<operation><=|>=|<|>)\s*(?P<number>[^<>=]*)")

EVENT_NAMES: Final = tuple(_NAMED)


class CountedEvent(NamedTuple):
    """An event, whose occurrence a flight's row shows."""

    text: str  # in its standard form: a name of `EVENT_NAMES`, or `COLUMN OP NUMBER`
    column_name: str
    operation: str  # `==`, `<`, `<=`, `>` or `>=`
    value: bool | str | float

    def holds(self, row: Mapping[str, Any]) -> bool:
        """Whether it happened in one flight, given its values by column; so it did where the flight has no value.

        Raises:
            UnknownNameError: there is no such column.
            InputError: a number is required, and the column holds text.
        """
        if self.column_name not in row:
            raise UnknownNameError("column", self.column_name, row)
        value = row[self.column_name]
        if value is None:
            return True
        if self.operation == "==":
            return bool(value == self.value)
        if isinstance(value, str):
            raise _no_number(self.text, self.column_name)
        return math.isnan(value) or bool(OPERATIONS[self.operation](value, self.value))

    def column(self, table: pa.Table) -> FlightFlags:
        """(K,) whether it happened, flight by flight; the same as `holds` of every row, with the same refusals."""
        if self.operation != "==":
            types = {field.name: field.type for field in table.schema}
            _require_number(self.text, self.column_name, types)
        rows = table.select([self.column_name]).to_pylist()
        return np.array([self.holds(row) for row in rows], bool)


def parse_event(text: str, columns: Mapping[str, pa.DataType] | None = None) -> CountedEvent:
    """Parse an event from its text.

    Args:
        text: a name of `EVENT_NAMES`, e.g. `failure` or `lost`, where `failed`, `violated` and `crashed` mean the same
            as their nouns; or `COLUMN OP NUMBER` with one of `< <= > >=`, e.g. `rmse.z > 0.5`.
        columns: those that a comparison may name, with their types; None for any.

    Raises:
        UnknownNameError: no event has that name, or there is no such column.
        InputError: a comparison is with a column that holds text, or with `flight`, `seed` or `failed`.
        ParameterError: what is compared with is not a finite number.
    """
    text = " ".join(text.split())
    name = _SPELLINGS.get(text, text)
    if name in _NAMED:
        column, value = _NAMED[name]
        return CountedEvent(name, column, "==", value)
    comparison = _COMPARISON.fullmatch(text)
    if comparison is None:
        hint = "or a comparison, COLUMN OP NUMBER with < <= > or >=, such as 'rmse.z > 0.5'"
        raise UnknownNameError("event", text, {*_NAMED, *_SPELLINGS}, hint=hint)
    column, operation, threshold = comparison.groups()
    if column in _NEVER_COMPARED:
        raise InputError(
            f"event {text!r} must compare a column that measures a flight, such as rmse.z; {column!r} does not"
        )
    if columns is not None:
        _require_number(text, column, columns)
    number = math.nan
    with contextlib.suppress(ValueError):
        number = float(threshold)
    if not math.isfinite(number):
        raise ParameterError(f"event {text!r}", "number", threshold, "a finite number")
    return CountedEvent(f"{column} {operation} {number:.15g}", column, operation, number)


def standard_forms(texts: Iterable[str]) -> list[str]:
    """Events in their standard form, see `CountedEvent.text`."""
    return [parse_event(text).text for text in texts]


def is_comparable(kind: pa.DataType) -> bool:
    """Whether a column's values, numbers or truth values, can be compared with a number."""
    from pyarrow import types

    return bool(types.is_boolean(kind) or types.is_integer(kind) or types.is_floating(kind))


def _require_number(event: str, column: str, columns: Mapping[str, pa.DataType]) -> None:
    if column not in columns:
        comparable = [name for name, kind in columns.items() if is_comparable(kind)]
        raise UnknownNameError("column", column, comparable)
    if not is_comparable(columns[column]):
        raise _no_number(event, column)


def _no_number(event: str, column: str) -> InputError:
    return InputError(f"event {event!r} compares with a number; the column {column!r} holds text")
