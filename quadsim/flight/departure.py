"""Departure: a flight that ends off its course and still leaves it.

A vehicle may be far from its reference and fly well: after a step, or behind a fast course, it lags.  What counts is
therefore the distance from the course flown so far, and how it grows at the end of a flight (`departure_numbers`).
`quadsim.rollout.flown` takes its verdict from it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from quadsim.controller import Phase
from quadsim.flight.log import ControlLog
from quadsim.state import POSITION, Array

END_SPAN: Final = 5.0  # time at the end of a flight over which the growth is taken [s]
LEAST_IN_AIR: Final = 1.0  # shortest time in the air for which there are numbers [s]
COURSE_SPAN: Final = 60.0  # time for which the course flown so far counts [s]: no vehicle lags by more
SAMPLING: Final = 0.1  # time between the instants at which the distance is taken, or a control period [s]
LEAVING_FROM: Final = 1.0  # distance above which a growing one is reported [m]
LEAVING_GROWTH: Final = 0.02  # growth above which a distance grows [1/s]: that of a constant one is rounding's
DEPARTURE: Final = "departure"
"""The criterion's name in `[lost]`; unlike `quadsim.flight.phase.CRITERIA` it does not end a flight, but judges one."""
_RESOLUTION: Final = 1e-3  # distances below it count as this one [m]


@dataclass(frozen=True, kw_only=True)
class Departure:
    """How a flight ended beside its course.

    Attributes:
        distance: largest distance from the course in the last half of the span [m].
        growth: of this distance, from half to half [1/s].
        limit: `lost.departure`, the distance beyond which a flight that leaves its course is lost [m]; None: none.
    """

    distance: float
    growth: float
    limit: float | None = None

    @property
    def leaving(self) -> bool:
        """Whether the flight ended off its course and still left it."""
        return self.lost or (self.distance > LEAVING_FROM and self._grows)

    @property
    def lost(self) -> bool:
        """Whether it left its course by more than the limit."""
        return self.limit is not None and self.distance > self.limit and self._grows

    @property
    def sentence(self) -> str:
        """What a reader is told of a flight that left its course."""
        text = f"at its end {self.distance:.3g} m off its course and leaving it (growth {self.growth:.2g} 1/s)"
        if self.lost:
            return f"{text}, beyond lost.{DEPARTURE} = {self.limit:g} m"
        return text

    @property
    def _grows(self) -> bool:
        return self.growth > LEAVING_GROWTH


def departure_numbers(log: ControlLog) -> dict[str, float] | None:
    """Return `distance` [m] and `growth` [1/s] at the end of a flight; None where it ends on the ground, or too early.

    The course flown so far is the polyline through the vehicle's start and the references of the last `COURSE_SPAN`
    seconds.  Of the distances from it,

        d(t) = min over the polyline of |p(t) - q|,   D_1, D_2 = the largest d in the halves of the last `END_SPAN`,

    and with halves of T seconds

        distance = D_2,   growth = ln(D_2 / D_1) / T.

    A vehicle that lags stays near this course, one that a disturbance displaced comes back to it; an unstable loop does
    neither.  Only the flight itself counts: the span begins after the last period on the ground.  Too early is before
    `LEAST_IN_AIR` in the air, or before two control periods.
    """
    rows = log.t.size
    in_air = _periods_in_air(log)
    if in_air < 2:
        return None
    period = float(log.t[1] - log.t[0])
    count = min(in_air, max(round(END_SPAN / period), 2))
    positions = log.truth[:, POSITION]
    if count * period < LEAST_IN_AIR - 1e-9 or not np.isfinite(positions[rows - count :]).all():
        return None
    stride = max(round(SAMPLING / period), 1)
    instants = np.arange(rows - 1, rows - 1 - count, -stride)[::-1]
    distances = _distances(positions[instants], _course(log, period))
    half = instants.size // 2
    before = max(float(distances[:half].max()), _RESOLUTION)
    distance = float(distances[half:].max())
    growth = math.log(max(distance, _RESOLUTION) / before) / (0.5 * count * period)
    return {"distance": distance, "growth": growth}


def departure_of(numbers: Mapping[str, Any] | None, limit: float | None) -> Departure | None:
    """Return the departure with these numbers; None where there are none, as in a run of an earlier version."""
    if numbers is None:
        return None
    return Departure(**numbers, limit=limit)


def _periods_in_air(log: ControlLog) -> int:
    """Return how many periods at the end of a flight it was in the air."""
    count = 0
    for phase in reversed(log.phase):
        if phase != Phase.FLYING:
            break
        count += 1
    return count


def _course(log: ControlLog, period: float) -> Array:
    """Return the corners (M, 3) of the course of the last `COURSE_SPAN` seconds, from the vehicle's start on."""
    references = log.reference[:, :3]
    recent = round(COURSE_SPAN / period)
    if references.shape[0] > recent:
        return references[-recent - 1 :]
    return np.vstack([log.truth[:1, POSITION], references])


def _distances(points: Array, corners: Array) -> Array:
    """Return the distance (P,) of points (P, 3) from a polyline through corners (M, 3)."""
    starts = corners[:-1]
    sides = np.diff(corners, axis=0)
    squares = np.sum(sides**2, axis=1)
    lengths = np.where(squares > 0.0, squares, 1.0)
    distances = np.empty(len(points))
    for i, point in enumerate(points):
        offsets = point - starts
        shares = np.clip(np.sum(offsets * sides, axis=1) / lengths, 0.0, 1.0)
        gaps = offsets - shares[:, None] * sides
        distances[i] = math.sqrt(float(np.sum(gaps**2, axis=1).min()))
    return distances
