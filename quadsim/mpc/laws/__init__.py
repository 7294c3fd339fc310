"""The control laws by name: a file each, with the table `[controller]`, whose method `law` builds the law.

`register` says what else is known of a law; a module of this folder needs no line elsewhere.  The law itself is in the
same file, or in `parts`, as all that laws are made of.
"""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from types import MappingProxyType
from typing import Final, TypeVar

from quadsim.mpc.tables.controller import ControllerTable

TableClass = TypeVar("TableClass", bound=type[ControllerTable])
_LAST: Final = 100


@dataclass(frozen=True, kw_only=True)
class LawEntry:
    """What is known of a control law without building it."""

    table: type[ControllerTable]  # a dataclass, whose field `type` is the law's name
    title: str  # its display name
    description: str  # its line in `quadsim list`
    place: int  # in lists; laws of one place are in the order of their names

    @property
    def name(self) -> str:
        """Its name, as files state and flights record it."""
        return self.table.type


_registered: Final[dict[str, LawEntry]] = {}


def register(*, title: str, description: str, place: int = _LAST) -> Callable[[TableClass], TableClass]:
    """Register the table of a law, a class that this decorates; the arguments are the fields of `LawEntry`.

    Raises:
        ValueError: another table has that name.
    """

    def registered(table: TableClass) -> TableClass:
        law = LawEntry(table=table, title=title, description=description, place=place)
        known = _registered.setdefault(law.name, law)
        if known.table is not table:
            raise ValueError(f"two laws have the name {law.name!r}: {known.table.__module__} and {table.__module__}")
        return table

    return registered


@cache
def laws() -> Mapping[str, LawEntry]:
    """Return the laws by name; the first call imports every module of this folder."""
    for module in pkgutil.iter_modules(__path__):
        importlib.import_module(f"{__name__}.{module.name}")
    ordered = sorted(_registered.values(), key=lambda law: (law.place, law.name))
    return MappingProxyType({law.name: law for law in ordered})


def law_name(recorded: str) -> str:
    """Return the display name of a controller from the name in a run's summary; a user's is shown by that name."""
    law = laws().get(recorded)
    if law is None:
        return recorded
    return law.title
