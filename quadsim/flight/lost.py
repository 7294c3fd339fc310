"""When a flight is lost: the largest tilt, deviation, sink and speed that still count as flight."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Final

from quadsim.errors import LostError
from quadsim.state import Array

CRITERIA: Final = {
    "tilt": ("the thrust axis is tilted by", "deg"),
    "distance": ("the distance from the reference is", "m"),
    "depth": ("the depth below the lowest of start and reference is", "m"),
    "speed": ("the speed is", "m/s"),
}
"""Each criterion by its name in `[lost]`, with its unit; the first that is met is the reason."""


def check_loss(limits: Mapping[str, float], time: float, state: Array, reference: Array, lowest: float) -> None:
    """End the flight where its vehicle is lost.

    Args:
        limits: the largest value of each of `CRITERIA`; one that is left out is not checked.
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
    values = (tilt, distance, lowest - z, math.hypot(vx, vy, vz))
    for (name, (quantity, unit)), value in zip(CRITERIA.items(), values, strict=True):
        limit = limits.get(name, math.inf)
        if value > limit:
            raise LostError(name, quantity, unit, value=value, limit=limit, time=time)
