"""When a flight is lost: how far the vehicle may tilt, stray, sink and race before nobody would call it flight."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

from quadsim.errors import LostError
from quadsim.state import Array

CRITERIA: Final = {
    "tilt": ("the thrust axis is tilted by", "deg"),
    "distance": ("the distance from the reference is", "m"),
    "depth": ("the depth below the lowest of start and reference is", "m"),
    "speed": ("the speed is", "m/s"),
}
"""Name of each criterion of `LossCriteria`, and its unit; the first that is met is the reason."""


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
        state: (12,) true state, as `quadsim.state` orders it.
        reference: (4,) x, y, z [m], yaw [rad] at the same time.
        lowest: height of the lowest of the start and the reference so far [m].

    Raises:
        LostError: a criterion is met.
    """
    x, vx, y, vy, z, vz, roll, _, pitch, *_ = state.tolist()  # of so few numbers floats are quicker than arrays
    tilt = math.degrees(math.acos(math.cos(roll) * math.cos(pitch)))
    distance = math.dist((x, y, z), reference[:3].tolist())
    depth = lowest - z
    speed = math.hypot(vx, vy, vz)
    within = tilt <= criteria.tilt and distance <= criteria.distance
    if within and depth <= criteria.depth and speed <= criteria.speed:
        return
    for (name, (quantity, unit)), value in zip(CRITERIA.items(), (tilt, distance, depth, speed), strict=True):
        limit = getattr(criteria, name)
        if value > limit:
            raise LostError(name, quantity, unit, value=value, limit=limit, time=time)
