"""When which level of the fallback takes over."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np

from quadsim.errors import ParameterError
from quadsim.state import EULER, EULER_RATE, N_STATES, POSITION, VELOCITY, Array


@dataclass(frozen=True, kw_only=True)
class FallbackSettings:
    """When the next level takes over; validated when made.

    Attributes:
        unseen: longest time that predictions stand in for a missing measurement before level 2 [s].
        plan_age: longest time on one shifted plan [s]; its horizon, where that is shorter.
        position, velocity, angle, rate: largest distance from that plan in any channel [m], [m/s], [rad], [rad/s].
        hover: longest time on level 2 before the descent [s].
        sink: speed of the descent [m/s].
        tilt: largest tilt that levels 1 to 3 ask for [rad]; beside the plan's own on level 1.
        settled: horizontal speed above which level 2 brakes without a place to go back to [m/s].
    """

    unseen: float = 1.5
    plan_age: float = 1.0
    position: float = 0.5
    velocity: float = 1.0
    angle: float = 0.2
    rate: float = 1.0
    hover: float = 5.0
    sink: float = 0.5
    tilt: float = math.radians(10.0)
    settled: float = 0.3

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            if not 0.0 < value < math.inf:
                raise ParameterError("controller", f"fallback.{item.name}", value, "positive and finite")

    @property
    def distance(self) -> Array:
        """(12,) largest distance from a plan's states."""
        distance = np.empty(N_STATES)
        for rows, size in (
            (POSITION, self.position),
            (VELOCITY, self.velocity),
            (EULER, self.angle),
            (EULER_RATE, self.rate),
        ):
            distance[list(rows)] = size
        return distance
