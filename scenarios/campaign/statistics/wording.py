"""How shares and counts of flights are put into words."""

from __future__ import annotations

import math

from quadsim.report.table import ABSENT


def percent(share: float | None, digits: int = 2) -> str:
    """A share in percent, e.g. `3.7 %`: enough digits that its distance to 0 or 100 % shows, and at least tenths."""
    return ABSENT if share is None else f"{_percent(share, digits)} %"


def interval(lower: float, upper: float) -> str:
    """An interval of a share, e.g. `2.6 to 5.1 %`."""
    return f"{_percent(lower)} to {_percent(upper)} %"


def label(name: str, unit: str) -> str:
    """A name with its unit, where it has one."""
    return name if unit == "-" else f"{name} [{unit}]"


def count_of(count: int, thing: str) -> str:
    """A count with its noun: `1 flight`, `12 flights`."""
    return f"{count} {thing}{'' if count == 1 else 's'}"


def p_value(p: float) -> str:
    """A p-value, e.g. `p = 0.012`, or `p < 0.001`."""
    return "p < 0.001" if p < 0.001 else f"p = {p:.2g}"


def _percent(share: float, digits: int = 2) -> str:
    value = 100.0 * share
    size = min(abs(value), abs(100.0 - value))
    decimals = max(1, digits - 1 - math.floor(math.log10(size))) if size > 1e-9 else 0
    return f"{value:.{decimals}f}"
