"""Where axes end, so that a few flights far out do not squash all others into a line: quartile fences."""

from __future__ import annotations

from typing import Final

import numpy as np

from quadsim.state import Array

LOWEST_MARGIN: Final = -2.0
"""Margins below this are drawn at the foot, so that a lost flight does not flatten all others."""
_LEAST_DEPTH: Final = 0.25  # share of the height above 0 that is shown below it, however far from it the margins are
_FENCE: Final = 5.0  # quartile ranges beyond the quartiles up to which values are drawn where they are


def robust_ends(values: Array) -> tuple[float, float]:
    """The smallest and the largest of some values, some of them finite, without those far out."""
    finite = values[np.isfinite(values)]
    low, high = _fences(finite)
    inside = finite[(finite >= low) & (finite <= high)]
    return float(inside.min()), float(inside.max())


def lowest_shown(values: Array) -> float:
    """The lowest of such margins that may be shown where it is: `LOWEST_MARGIN`, but where most are lower still."""
    finite = values[np.isfinite(values)]
    return LOWEST_MARGIN if np.median(finite) > LOWEST_MARGIN else float(np.percentile(finite, 5))


def _fences(finite: Array) -> tuple[float, float]:
    """Five quartile ranges beyond the quartiles."""
    p5, q1, q3, p95 = np.percentile(finite, [5, 25, 75, 95])
    reach = _FENCE * ((q3 - q1) or (p95 - p5)) or np.inf
    return q1 - reach, q3 + reach


def margin_ends(values: Array) -> tuple[float, float]:
    """The ends between which worst margins are drawn where they are; 0, the end of what is allowed, is among them."""
    finite = values[np.isfinite(values)]
    fence, above = _fences(finite)
    high = max(0.0, float(finite[finite <= above].max()))
    below = max(min(fence, -_LEAST_DEPTH * high), lowest_shown(finite))
    return min(0.0, float(finite[finite >= below].min())), high
