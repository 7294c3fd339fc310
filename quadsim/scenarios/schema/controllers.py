"""`[controller]`: the table of the law named by its type, one of `quadsim.mpc.laws` or a user's."""

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


def _law(controller: object) -> str | None:
    """Return the tag of a table's law; an unknown law is left for the message."""
    if isinstance(controller, Mapping):
        law_name = controller.get("type")
    else:
        law_name = None
    if isinstance(controller, ControllerTable):
        law_name = controller.type
    if not isinstance(law_name, str):
        return None
    if law_name in LAWS or not is_plugin(law_name):
        return law_name
    return FORM


class _OrName:
    """In the schema a law's name alone stands for a table of defaults, see `Scenario.read`."""

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
    AnyController = Annotated[Annotated[_Tagged, Discriminator(_law)], _OrName()]
"""Any law, distinguished by its type; a law whose fields all have defaults may be given by name only."""


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
    for name, value in fields.items():
        if isinstance(value, Mapping) and value:
            yield from _leaves(value, f"{above}{name}.")
        else:
            yield above + name, value
