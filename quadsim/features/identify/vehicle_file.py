"""The identified vehicle as a file: the start's tables and comments with the identified numbers in their place.

Each number's source says its interval, its start and the logs, or why it is the start's; `report` writes the file.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import tomlkit

from quadsim.features.identify.estimate import (
    DisturbanceEstimate,
    Identification,
    ParameterEstimate,
    field_of,
    number_in,
)
from quadsim.vehicle import VEHICLE_DISTURBANCE, VEHICLE_UNITS, Vehicle

_DIGITS: Final = 100.0  # the last digit is no more than this part of an interval


def verdict(estimate: ParameterEstimate, vehicle: Vehicle) -> str:
    """Return whether a number is identified, or else why it is not, and what the vehicle has."""
    if not estimate.refused:
        return "identified"
    number = number_in(vehicle, estimate.name)
    if number is None or not estimate.in_file:
        return f"left out: {estimate.refused}"
    if number == estimate.start:
        return f"kept: {estimate.refused}"
    return f"set to {number:.4g}: {estimate.refused}"


def rounded(value: float, estimate: ParameterEstimate) -> float:
    """Round a value to the digits that an estimate's interval supports, and its own two first ones."""
    width = estimate.high - estimate.low
    if not (width > 0.0 and math.isfinite(width)):
        return value
    last = min(width / _DIGITS, 0.1 * abs(value or 1.0))
    return round(value, math.ceil(-math.log10(last))) + 0.0  # never -0


def interval_text(estimate: ParameterEstimate) -> str:
    """Return the 95 % interval as text."""
    return f"{rounded(estimate.low, estimate):.7g} to {rounded(estimate.high, estimate):.7g}"


def vehicle_text(identification: Identification, start: Path, logs: Sequence[str]) -> str:
    """Return the text of the vehicle file: values with intervals and logs as their sources, in the start's file.

    A value that a gate refuses is the start's, and its source says why; of a vector this is said axis by axis.
    """
    document = tomlkit.parse(start.read_text(encoding="utf-8-sig"))
    by_field: dict[str, list[ParameterEstimate]] = {}
    for estimate in identification.estimates:
        if estimate.in_file:
            by_field.setdefault(field_of(estimate.name), []).append(estimate)
    for name in VEHICLE_UNITS:
        if getattr(identification.vehicle, name) is None:  # a map that an identified coefficient replaces
            document.pop(name, None)
    for name, estimates in by_field.items():
        value = getattr(identification.vehicle, name)
        if value is None:  # neither the start has it, nor is it identified
            continue
        if name not in document:
            document.add(tomlkit.nl())
            document[name] = {"value": value, "unit": VEHICLE_UNITS[name], "source": ""}
        table: Any = document[name]
        table["value"] = _value(value, estimates)
        table["source"] = _source(identification.vehicle, estimates, str(table["source"]), logs)
    known = [estimate for estimate in identification.disturbance if not estimate.refused]
    if known:
        document.pop(VEHICLE_DISTURBANCE, None)
        document.add(tomlkit.nl())
        document[VEHICLE_DISTURBANCE] = _disturbance(known, logs)
    return tomlkit.dumps(document)


def _disturbance(known: Sequence[DisturbanceEstimate], logs: Sequence[str]) -> dict[str, Any]:
    """Return the table `[disturbance]` of a vehicle file; an axis of which nothing is known has none."""
    table: dict[str, Any] = {}
    parts = []
    for estimate in known:
        deviations = table.setdefault(f"{estimate.kind}_deviation", [0.0, 0.0, 0.0])
        times = table.setdefault(f"{estimate.kind}_time", [1.0, 1.0, 1.0])
        place = "xyz".index(estimate.axis)
        deviations[place] = float(f"{estimate.deviation:.3g}")
        times[place] = float(f"{estimate.time:.3g}")
        parts.append(
            f"{estimate.kind} {estimate.axis} 95 % within {factor_text(estimate.deviation_interval)} {estimate.unit}, "
            f"{factor_text(estimate.time_interval)} s"
        )
    table["source"] = f"identified: {'; '.join(parts)}; logs {', '.join(logs)}"
    return table


def factor_text(interval: tuple[float, float]) -> str:
    """Return an interval that is known to a factor as text."""
    low, high = interval
    return f"{low:.2g} to {high:.2g}"


def _value(value: Any, estimates: Sequence[ParameterEstimate]) -> Any:
    """Return a number, or the numbers of a vector, rounded where they are identified."""
    by_number = [*estimates]
    numbers = np.atleast_1d(value).tolist()
    if len(estimates) < len(numbers):
        by_number = [*estimates] * len(numbers)
    for i, estimate in enumerate(by_number):
        if not estimate.refused:
            numbers[i] = rounded(numbers[i], estimate)
    if isinstance(value, tuple):
        return numbers
    return numbers[0]


def _source(vehicle: Vehicle, estimates: Sequence[ParameterEstimate], before: str, logs: Sequence[str]) -> str:
    """Return where each number is from; `before` is what the start's file says."""
    parts = []
    for estimate in estimates:
        part = verdict(estimate, vehicle)
        if len(estimates) > 1:
            part = f"{estimate.name[-1]} {part}"
        if not estimate.refused:
            part += f": 95 % within {interval_text(estimate)}"
            if estimate.start is not None:
                part += f"; start {estimate.start:.4g}"
        parts.append(part)
    refused = [bool(estimate.refused) for estimate in estimates]
    if not all(refused):
        parts.append(f"logs {', '.join(logs)}")
    if any(refused) and before:
        parts.append(before)
    return "; ".join(parts)
