"""The course of an outcome over a drawn number: a smooth curve through medians, and where it turns."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from quadsim.state import Array

_GROUPS: Final = (5, 25)
"""The fewest and the most groups that a curve is drawn through."""
_GROUPS_PER_ROOT: Final = 0.8
"""Groups, as a share of the square root of the flights."""
_POINTS: Final = 80
_TURN: Final = 0.3
"""Share of a curve's height by which both of its ends have to lie on one side of what is between them."""


@dataclass(frozen=True, kw_only=True)
class Trend:
    """A smooth curve over a drawn number.

    Attributes:
        x: (G,) values of the drawn number, rising.
        y: (G,) what half of the flights near there exceed.
    """

    x: Array
    y: Array

    @property
    def turn(self) -> tuple[str, float] | None:
        """`highest` or `lowest`, and where, for a curve whose two ends lie both below that or both above it."""
        height = float(np.ptp(self.y))
        ends = self.y[[0, -1]]
        drop, rise = float(self.y.max() - ends.max()), float(ends.min() - self.y.min())
        if height == 0.0 or max(drop, rise) < _TURN * height:
            return None
        kind, extreme = ("highest", self.y.max()) if drop >= rise else ("lowest", self.y.min())
        return kind, float(np.median(self.x[np.abs(self.y - extreme) < 0.01 * height]))


def trend(x: Array, y: Array) -> Trend | None:
    """A cubic smoothing spline through the medians of groups of flights that are next to one another.

    Flights are sorted by x and parted into 5 to 25 groups of about equal size, 0.8 times as many as the square root of
    the flights.  Medians are taken since no outlier moves them; generalised cross-validation chooses how smooth the
    spline is, and it is cut off at the highest and the lowest median.
    Source: scipy.interpolate.make_smoothing_spline, after Woltring, Advances in Engineering Software 8 (1986).

    Args:
        x: (K,) values of the drawn number; finite.
        y: (K,) the outcome; finite.

    Returns:
        None of fewer than 40 flights, or where x has too few values for five groups.
    """
    from scipy.interpolate import make_smoothing_spline

    fewest, most = _GROUPS
    groups = min(most, int(_GROUPS_PER_ROOT * np.sqrt(x.size)))
    if groups < fewest:
        return None
    order = np.argsort(x, kind="stable")
    parts = np.array_split(order, groups)
    centres = np.array([np.median(x[part]) for part in parts])
    told, first = np.unique(centres, return_index=True)
    if told.size < fewest:
        return None
    medians = np.array([np.median(y[parts[i]]) for i in first])
    span = float(told[-1] - told[0])
    unit = (told - told[0]) / span
    at = np.linspace(0.0, 1.0, _POINTS)
    smooth = np.clip(make_smoothing_spline(unit, medians)(at), medians.min(), medians.max())
    return Trend(x=told[0] + span * at, y=np.asarray(smooth, float))
