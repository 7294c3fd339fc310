"""`[controller]`: the table of the controller named by its type, one of `quadsim.mpc.laws` or a user's.

Pydantic chooses the table by `type`; `changed_controller` is the table after an event that changes fields of it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, Final, TypeAlias, Union

from pydantic import Discriminator, Tag

from quadsim.mpc.laws import laws
from quadsim.mpc.tables.controller import ControllerTable
from quadsim.scenarios.plugin import FORM, Plugin, is_plugin
from quadsim.scenarios.schema.problems import parse_table
from quadsim.scenarios.schema.settings import set_field
from quadsim.scenarios.schema.writing import plain


def _tag(controller: object) -> str | None:
    """Return the tag of a controller's table in `TABLES`; an unknown type is left for the message."""
    name: object = None
    if isinstance(controller, Mapping):
        name = controller.get("type")
    elif isinstance(controller, ControllerTable):
        name = controller.type
    if not isinstance(name, str):
        return None
    if name in LAWS or not is_plugin(name):
        return name
    return FORM


class _OrName:
    """In the schema a controller's name alone stands for a table of defaults, see `Scenario.parse`."""

    def __get_pydantic_json_schema__(self, schema: Any, handler: Any) -> dict[str, Any]:
        return {"anyOf": [handler(schema), {"type": "string"}]}


LAWS: Final = tuple(laws())
"""The names of built-in controllers."""
TABLES: Final[Mapping[str, type[ControllerTable]]] = {**laws(), FORM: Plugin}
"""The tables of all controllers by name; that of users' controllers by the form of their names."""

if TYPE_CHECKING:
    AnyController: TypeAlias = ControllerTable
else:
    _Tagged = Union[*(Annotated[table, Tag(name)] for name, table in TABLES.items())]
    AnyController = Annotated[Annotated[_Tagged, Discriminator(_tag)], _OrName()]
"""Any controller, distinguished by its type; one whose fields all have defaults may be given by its name alone."""


@dataclass(frozen=True, kw_only=True)
class _Holder:
    """A table with a controller, so that messages name the field."""

    controller: AnyController


def changed_controller(controller: AnyController, fields: Mapping[str, Any]) -> AnyController:
    """Return a controller with new values of some fields, by dotted path; a `type` replaces the whole table.

    Raises:
        ScenarioError: a field is not there, or its value is not allowed.
    """
    data: dict[str, Any]
    if "type" in fields:
        data = {}
    else:
        data = plain(controller)
    for path, value in _leaves(fields):
        set_field(data, path, value, source="fields")
    return parse_table(_Holder, {"controller": data}, "controller").controller


def _leaves(fields: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the values in nested tables by dotted path; an empty table is a value, and so is a list."""
    for name, value in fields.items():
        if isinstance(value, Mapping) and value:
            yield from _leaves(value, f"{above}{name}.")
        else:
            yield above + name, value
