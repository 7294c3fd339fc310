"""A scenario's course, space and windows of time at another size and pace, with the units that each field declares.

A length scales with `length`, a time with `time`, a speed with their ratio, and so on: the numbers of a field scale by
the unit that its `doc` begins with.  Angles and whole numbers stay.  Positions are scaled about the world's origin, at
z = 0, and raised by `lift`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

from quadsim.flight.audit import Limit
from quadsim.scenarios.courses.course import Headed
from quadsim.scenarios.courses.csv_course import Csv
from quadsim.scenarios.courses.steps import Steps, Window
from quadsim.scenarios.schema.base import fields_of, is_table
from quadsim.scenarios.schema.writing import is_absent
from quadsim.space import Region

SIGNIFICANT_DIGITS: Final = 6  # significant, of what is scaled: a file is read by people
_POWERS: Final[Mapping[str, tuple[int, int]]] = {
    "m": (1, 0),
    "m, times the length of a": (1, 0),
    "s": (0, 1),
    "m/s": (1, -1),
    "m/s^2": (1, -2),
    "deg/s": (0, -1),
    "deg": (0, 0),
    "-": (0, 0),
}
"""Powers of length and time in a unit."""
_PLACE: Final = "[m] x, y, z"
"""What the description of a position begins with."""
_HEIGHT: Final = "[m] z "
"""What the description of a height above the world's origin begins with."""


@dataclass(frozen=True, kw_only=True)
class Scale:
    """Another size, pace and height of a course."""

    length: float = 1.0  # factor of lengths
    time: float = 1.0  # factor of times; above 1 is slower
    lift: float = 0.0  # raises every position [m], after the lengths are scaled

    def number(self, value: float, unit: str) -> float:
        """Return a number of a unit at the scale.

        Raises:
            KeyError: the unit is not known here.
        """
        of_length, of_time = _POWERS[unit]
        factor = self.length**of_length * self.time**of_time
        if factor == 1.0:
            return value
        return significant(factor * value)

    def height(self, value: float) -> float:
        """Return a height above the world's origin [m] at the scale."""
        if self.lift:
            return significant(self.number(value, "m") + self.lift)
        return self.number(value, "m")


def significant(value: float) -> float:
    """Return a number without the rounding of a product or sum."""
    return float(f"{value:.{SIGNIFICANT_DIGITS}g}")


def leading_unit(description: str | None) -> str:
    """Return the unit that a field's description begins with; `-` where it has none."""
    text = description or ""
    if text.startswith("["):
        return text[1 : text.index("]")]
    return "-"


def scaled_table(table: Any, scale: Scale) -> Any:
    """Return a table of a course, an obstacle or a region at another scale.

    Args:
        table: a dataclass whose fields declare their units.
        scale: the factors.
    """
    if isinstance(table, Steps):
        return _scaled_steps(table, scale)
    if isinstance(table, Csv):
        return table.rescaled(length=scale.length, time=scale.time, lift=scale.lift)
    changed: dict[str, Any] = {}
    for name, field in fields_of(type(table)).items():
        value = getattr(table, name)
        if not is_absent(value):
            changed[name] = _scaled_value(value, field.description or "", scale)
    if isinstance(table, Headed) and not table.looks_ahead:
        changed["yaw_rate"] = table.yaw_rate  # without effect
    if isinstance(table, Region) and table.rows is not None:
        raised = []
        for upper, row in zip(changed["upper"], table.rows, strict=True):
            raised.append(significant(upper + row[2] * scale.lift))
        changed["upper"] = tuple(raised)
    return replace(table, **changed)


def _scaled_value(value: Any, description: str, scale: Scale) -> Any:
    """Return the value of a field with a description."""
    if is_table(type(value)):
        return scaled_table(value, scale)
    if isinstance(value, tuple):
        entries = tuple(_scaled_value(entry, description, scale) for entry in value)
        if description.startswith(_PLACE):
            return (*entries[:2], scale.height(value[2]))
        return entries
    if isinstance(value, bool | str | int):
        return value
    if description.startswith(_HEIGHT):
        return scale.height(value)
    return scale.number(value, leading_unit(description))


def scaled_limit(limit: Limit, scale: Scale) -> Limit:
    """Return a limit of one signal at another scale, with the default tolerances of its bounds."""

    def bound(value: float) -> float:
        if math.isinf(value):
            return value
        if limit.signal == "z":
            return scale.height(value)
        return scale.number(value, limit.unit)

    lower = bound(limit.lower)
    upper = bound(limit.upper)
    start = scale.number(limit.start, "s")
    if math.isinf(limit.stop):
        stop = limit.stop
    else:
        stop = scale.number(limit.stop, "s")
    return replace(limit, lower=lower, upper=upper, start=start, stop=stop, tolerance=None, tolerance_sampled=None)


def _scaled_steps(table: Steps, scale: Scale) -> Steps:
    """Return steps at another scale: the values of windows are lengths, those of yaw angles."""

    def windows(axis: str) -> tuple[Window, ...]:
        result = []
        for window in getattr(table, axis):
            value = window.value
            if axis == "z":
                value = scale.height(value)
            elif axis != "yaw":
                value = scale.number(value, "m")
            start = scale.number(window.start, "s")
            stop = scale.number(window.stop, "s")
            result.append(Window(start=start, stop=stop, value=value))
        return tuple(result)

    changed: dict[str, Any] = {"x": windows("x"), "y": windows("y"), "z": windows("z")}
    changed["response_time"] = scale.number(table.response_time, "s")
    if table.repeat is not None:
        changed["repeat"] = scale.number(table.repeat, "s")
    if not isinstance(table.yaw, str):
        changed["yaw"] = windows("yaw")
    if table.looks_ahead:
        changed["yaw_rate"] = scale.number(table.yaw_rate, "deg/s")
    return replace(table, **changed)
