"""The types of settings fields, in Python and in files: numbers with their limits.

A settings dataclass is the only declaration of its fields: type and limits by `annotated_types`, unit and meaning by
`annotated_types.doc`, default value.  `quadsim.scenarios.schema` reads tables of scenario files into these dataclasses,
and derives messages, the JSON Schema and commented files from them.  Numbers stay in the units of the file, angles in
degrees; the code that computes with them converts them.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Annotated, Any, Final, TypeVar

from annotated_types import Ge, Le, Len, doc

from quadsim.errors import ParameterError

Declaration = TypeVar("Declaration")

FLOORS: Final = {"s": 1e-6, "m": 1e-6, "kg": 1e-6, "Hz": 1e-6}
"""Least positive number of a unit: a smaller one has no meaning for a quadrotor, and its inverse may overflow."""
SMALLEST: Final = 1e-12
"""Least positive number of every other unit."""

Number = Annotated[float, Ge(-1e6), Le(1e6)]
NonNegative = Annotated[float, Ge(0.0), Le(1e6)]
Positive = Annotated[float, Ge(SMALLEST), Le(1e6)]
Seconds = Annotated[float, Ge(FLOORS["s"]), Le(1e6)]
Metres = Annotated[float, Ge(FLOORS["m"]), Le(1e6)]
Kilograms = Annotated[float, Ge(FLOORS["kg"]), Le(1e6)]
Hertz = Annotated[float, Ge(FLOORS["Hz"]), Le(1e6)]
Fraction = Annotated[float, Ge(0.0), Le(1.0)]
Weight = Annotated[float, Ge(SMALLEST), Le(1e12)]  # weight in a cost function
Vector = Annotated[tuple[Number, ...], Len(3, 3)]  # x, y, z
Pair = Annotated[tuple[Number, ...], Len(2, 2)]
Instant = Annotated[float, Ge(0.0), Le(1e6), doc("[s] when it happens")]  # of an event


def floor_of(unit: str) -> float:
    """Return the least positive number of a unit."""
    return FLOORS.get(unit, SMALLEST)


def require_floor(settings: object, *names: str, unit: str) -> None:
    """Refuse positive numbers below the floor of a unit in fields that may also be 0 or None.

    Raises:
        ParameterError: one is between 0 and the unit's floor.
    """
    least = floor_of(unit)
    for name in names:
        value = getattr(settings, name)
        if value is not None and 0.0 < value < least:
            raise ParameterError("", name, value, f"0, or at least {least:g} {unit}")


def filled(settings: Declaration, **values: object) -> Declaration:
    """Return settings with those of the named fields that are None set to the given values."""
    absent: dict[str, Any] = {}
    for name, value in values.items():
        if getattr(settings, name) is None:
            absent[name] = value
    return replace(settings, **absent)  # type: ignore[type-var]


def is_plain(value: object) -> bool:
    """Return whether TOML and JSON can both hold a value; dates do not qualify."""
    if isinstance(value, dict):
        return all(map(is_plain, value.values()))
    if isinstance(value, list):
        return all(map(is_plain, value))
    return isinstance(value, bool | int | str) or (isinstance(value, float) and math.isfinite(value))
