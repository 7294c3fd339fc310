"""When a flight is lost: how far the vehicle may tilt, stray, sink and race before nobody would call it flight."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

from quadsim.errors import LostError
from quadsim.state import INDEX, POSITION, VELOCITY, Array

CRITERIA: Final = {
    "tilt": ("the thrust axis is tilted by", "deg"),
    "distance": ("the distance from the reference is", "m"),
    "depth": ("the depth below the lowest of start and reference is", "m"),
    "speed": ("the speed is", "m/s"),
}
"""What is said of each criterion of `LossCriteria`, and its unit; the first that is met is the reason."""


@dataclass(frozen=True, kw_only=True)
class LossCriteria:
    """What ends a flight as lost, once a true state at a control sample is beyond it; infinite: never.

    Attributes:
        tilt: between the thrust axis and the vertical [deg].
        distance: from the reference of the same instant [m].
        depth: below the lowest that the start and the reference so far have been [m].
        speed: in any direction, in the world frame [m/s].
    """

    tilt: float = math.inf
    distance: float = math.inf
    depth: float = math.inf
    speed: float = math.inf


def check_loss(criteria: LossCriteria, time: float, state: Array, reference: Array, lowest: float) -> None:
    """End the flight where its vehicle is lost.

    Args:
        criteria: what counts as such.
        time: of the sample [s].
        state: (12,) true state.
        reference: (4,) x, y, z [m], yaw [rad] at the same time.
        lowest: height of the lowest of the start and the reference so far [m].

    Raises:
        LostError: a criterion is met.
    """
    now, target = state.tolist(), reference.tolist()  # of so few numbers floats are quicker than arrays
    up = math.cos(now[INDEX["roll"]]) * math.cos(now[INDEX["pitch"]])
    values = (
        math.degrees(math.acos(min(max(up, -1.0), 1.0))),
        math.dist([now[i] for i in POSITION], target[:3]),
        lowest - now[INDEX["z"]],
        math.hypot(*(now[i] for i in VELOCITY)),
    )
    limits = (criteria.tilt, criteria.distance, criteria.depth, criteria.speed)
    for (name, (said, unit)), value, limit in zip(CRITERIA.items(), values, limits, strict=True):
        if value > limit:
            raise LostError(name, said, unit, value=value, limit=limit, time=time)
