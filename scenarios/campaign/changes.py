"""Fields of a scenario replaced by values that are drawn, or searched for."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from quadsim.errors import InputError, ParameterError
from scenarios.campaign.draws import extremes
from scenarios.campaign.spec import Value, VaryBase
from scenarios.loading import check_parts, parse_scenario
from scenarios.schema.bases import merge
from scenarios.schema.problems import ScenarioError
from scenarios.schema.scenario import Scenario
from scenarios.schema.settings import get_field, set_field

Change = tuple[VaryBase, Value]


def changed(data: Mapping[str, Any], changes: Sequence[Change], *, table: str, name: str, seed: int) -> Scenario:
    """A scenario with the fields of some entries replaced.

    Args:
        data: the scenario's tables.
        changes: entries with the value of each.
        table: of the file that has the entries, e.g. `vary`, for messages.
        name: of the new scenario.
        seed: of the new scenario.

    Raises:
        InputError: what comes of it is no scenario.
    """
    after: dict[str, Any] = merge(data, {})
    for entry, value in changes:
        for field in entry.fields:
            set_field(after, field, _scaled(data, entry, field, value, table), asked=f"{table}.{entry.name}.fields")
    return parse_scenario({**after, "name": name, "seed": seed}, source=name)


def check_ends(entries: Iterable[VaryBase], make: Callable[[VaryBase, Value], Scenario], *, table: str) -> None:
    """Refuse entries that cannot be flown at an end of their range.

    Args:
        entries: of the file.
        make: the scenario with one entry at a value.
        table: of the file that has the entries, for messages.

    Raises:
        InputError: naming the entry and the value.
    """
    for entry in entries:
        for value in extremes(entry):
            try:
                check_parts(make(entry, value))
            except ScenarioError as error:
                raise ScenarioError(f"{table}.{entry.name} at {value!r}", error.problems) from error
            except InputError as error:
                message = str(error)
                where = "" if message.startswith(f"{table}.") else f"{table}.{entry.name} at {value!r}: "
                raise InputError(where + message) from error


def _scaled(data: Mapping[str, Any], entry: VaryBase, field: str, value: Value, table: str) -> Value:
    if not entry.relative:
        return value
    given = get_field(merge(data, {}), field)
    if isinstance(given, bool) or not isinstance(given, int | float):
        if given is None:  # refused with its own message where there is no such field
            changed(data, [(entry.model_copy(update={"relative": False}), value)], table=table, name="relative", seed=0)
        rule = f"false where the scenario has no number at {field}"
        raise ParameterError(f"{table}.{entry.name}", "relative", True, rule)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ParameterError(f"{table}.{entry.name}", "relative", True, "false where what is drawn is no number")
    return value * given
