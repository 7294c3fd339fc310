"""Fields of a scenario replaced by values that are drawn, or searched for."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from quadsim.errors import InputError, ParameterError
from scenarios.campaign.draws import extremes
from scenarios.campaign.spec import Value, VaryBase
from scenarios.schema.bases import merge
from scenarios.schema.problems import ScenarioError
from scenarios.schema.settings import get_field, set_field

if TYPE_CHECKING:
    from scenarios.schema.scenario import Scenario

Change = tuple[VaryBase, Value]
Parse = Callable[[dict[str, Any]], "Scenario"]


def changed(data: Mapping[str, Any], changes: Sequence[Change], parse: Parse, *, table: str) -> Scenario:
    """A scenario with the fields of some entries replaced.

    Args:
        data: the scenario's tables.
        changes: entries with the value of each.
        parse: makes a scenario of tables, or raises InputError.
        table: of the file that has the entries, e.g. `vary`, for messages.

    Raises:
        InputError: what comes of it is no scenario.
    """
    after: dict[str, Any] = merge(data, {})
    for entry, value in changes:
        for field in entry.fields:
            new = _scaled(data, entry, field, value, parse, table) if entry.relative else value
            set_field(after, field, new, source=f"{table}.{entry.name}.fields")
    return parse(after)


def check_ends(entries: Iterable[VaryBase], check: Callable[[VaryBase, Value], object], *, table: str) -> None:
    """Refuse entries that cannot be flown at an end of their range.

    Args:
        entries: of the file.
        check: raises where an entry cannot have a value.
        table: of the file that has the entries, for messages.

    Raises:
        InputError: naming the entry and the value.
    """
    for entry in entries:
        for value in extremes(entry):
            try:
                check(entry, value)
            except ScenarioError as error:
                raise ScenarioError(f"{table}.{entry.name} at {value!r}", error.problems) from error
            except InputError as error:
                message = str(error)
                where = "" if message.startswith(f"{table}.") else f"{table}.{entry.name} at {value!r}: "
                raise InputError(where + message) from error


def _scaled(data: Mapping[str, Any], entry: VaryBase, field: str, value: Value, parse: Parse, table: str) -> Value:
    given = get_field(merge(data, {}), field)
    if isinstance(given, bool) or not isinstance(given, int | float):
        if given is None:  # refused with its own message where there is no such field
            changed(data, [(entry.model_copy(update={"relative": False}), value)], parse, table=table)
        rule = f"false where the scenario has no number at {field}"
        raise ParameterError(f"{table}.{entry.name}", "relative", True, rule)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ParameterError(f"{table}.{entry.name}", "relative", True, "false where what is drawn is no number")
    return value * given
