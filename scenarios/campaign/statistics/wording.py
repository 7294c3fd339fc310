"""How shares and counts of flights are put into words."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from typing import Final

from quadsim.report.table import ABSENT

_MOST_DECIMALS: Final = 8
_SHORTEST: Final = 5  # characters that a line of every name may have


def percent(share: float | None, digits: int = 2) -> str:
    """A share in percent, e.g. `3.7 %`: enough digits that its distance to 0 or 100 % shows, and at least tenths."""
    return ABSENT if share is None else f"{_percent(share, digits)} %"


def interval(lower: float, upper: float) -> str:
    """An interval of a share, e.g. `2.6 to 5.1 %`: two digits of its width, or more where an end looked certain."""
    decimals = _decimals(100.0 * (upper - lower))
    return f"{_end(lower, decimals)} to {_end(upper, decimals)} %"


def signed_points(difference: float) -> str:
    """A difference of shares in percentage points, with its sign, e.g. `-2.5`."""
    return f"{100.0 * difference:+.{_decimals(100.0 * abs(difference))}f}" if difference else "0"


def signed_interval(lower: float, upper: float) -> str:
    """An interval of a difference of shares in percentage points, e.g. `-3.7 to -1.4`."""
    return f"{signed_points(lower)} to {signed_points(upper)}"


def label(name: str, unit: str) -> str:
    """A name with its unit, where it has one."""
    return name if unit == "-" else f"{name} [{unit}]"


def count_of(count: int, thing: str) -> str:
    """A count with its noun: `1 flight`, `12 flights`."""
    return f"{count} {thing}{'' if count == 1 else 's'}"


def side_by_side(names: Sequence[str], room: int) -> list[str]:
    """Names for ticks of an axis with room for `room` characters, in two lines each; what is too long ends in `…`."""
    each = max(_SHORTEST, room // max(len(names), 1) - 1)
    found = []
    for name in names:
        text = name if len(name) <= 2 * each else f"{name[: 2 * each - 1]}…"
        lines = textwrap.wrap(text, each)
        found.append("\n".join(lines if len(lines) < 3 else (text[:each], text[each:])))
    return found


def p_value(p: float) -> str:
    """A p-value, e.g. `p = 0.012`, or `p < 0.001`."""
    return "p < 0.001" if p < 0.001 else f"p = {p:.2g}"


def _end(share: float, decimals: int) -> str:
    """An end of an interval: 0 and 100 are what they seem."""
    value = 100.0 * share
    if value in (0.0, 100.0):
        return f"{value:.0f}"
    while decimals < _MOST_DECIMALS and round(value, decimals) in (0.0, 100.0):
        decimals += 1
    return f"{value:.{decimals}f}"


def _percent(share: float, digits: int = 2) -> str:
    value = 100.0 * share
    size = min(abs(value), abs(100.0 - value))
    return f"{value:.{_decimals(size, digits)}f}" if size > 1e-9 else f"{value:.0f}"


def _decimals(size: float, digits: int = 2) -> int:
    """Decimals that show this many digits of a size, at least one."""
    return max(1, digits - 1 - math.floor(math.log10(size))) if size > 0.0 else 1
