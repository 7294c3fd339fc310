"""The controllers by name: a file each, with the table `[controller]`, whose method `law` builds the controller.

`register` says what else is known of a controller; a module of this folder needs no line elsewhere.  The controller
itself is in the same file, or in `parts`, as all that controllers are made of.
"""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Callable, Mapping
from functools import cache
from types import MappingProxyType
from typing import Final, TypeVar

from quadsim.mpc.tables.controller import ControllerTable

TableClass = TypeVar("TableClass", bound=type[ControllerTable])
_LAST: Final = 100
_registered: Final[dict[str, type[ControllerTable]]] = {}


def register(*, title: str, description: str, place: int = _LAST) -> Callable[[TableClass], TableClass]:
    """Register the table of a controller, a dataclass that this decorates; see `ControllerTable` for the arguments.

    Raises:
        ValueError: another table has that name.
    """

    def registered(table: TableClass) -> TableClass:
        known = _registered.setdefault(table.type, table)
        if known is not table:
            raise ValueError(f"two laws have the name {table.type!r}: {known.__module__} and {table.__module__}")
        table.title = title
        table.description = description
        table.place = place
        return table

    return registered


@cache
def laws() -> Mapping[str, type[ControllerTable]]:
    """Return the tables of the controllers by name; the first call imports every module of this folder."""
    for module in pkgutil.iter_modules(__path__):
        importlib.import_module(f"{__name__}.{module.name}")
    ordered = sorted(_registered.values(), key=lambda table: (table.place, table.type))
    return MappingProxyType({table.type: table for table in ordered})


def law_name(recorded: str) -> str:
    """Return the display name of a controller from the name in a run's summary; a user's is shown by that name."""
    table = laws().get(recorded)
    if table is None:
        return recorded
    return table.title
