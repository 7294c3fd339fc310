"""When which level of the fallback takes over."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Annotated, Final

import numpy as np
from annotated_types import Gt, Lt, doc

from quadsim.errors import ParameterError
from quadsim.fields import Positive
from quadsim.state import EULER, EULER_RATE, N_STATES, POSITION, VELOCITY, Array, read_only

USUAL_TILT: Final = 10.0
"""Largest tilt [deg] of the fallback where none is given."""


def by_group(position: float, velocity: float, angle: float, rate: float) -> Array:
    """(12,) one value for positions, velocities, Euler angles and their rates each."""
    channels = np.empty(N_STATES)
    for group, value in ((POSITION, position), (VELOCITY, velocity), (EULER, angle), (EULER_RATE, rate)):
        channels[list(group)] = value
    return read_only(channels)


@dataclass(frozen=True, kw_only=True)
class FallbackSettings:
    """The fallback contract: the shifted plan with an LQR correction, then level hover, then descent.

    A plan is held no longer than its horizon; the tilt of the plan comes on top of `tilt`.
    """

    enabled: Annotated[bool, doc("false: what the controller does without an answer is its own")] = True
    unseen: Annotated[Positive, doc("[s] longest time that predictions replace a missing measurement")] = 1.5
    plan_age: Annotated[Positive, doc("[s] longest time on one shifted plan")] = 1.0
    position: Annotated[Positive, doc("[m] largest distance from that plan")] = 0.5
    velocity: Annotated[Positive, doc("[m/s] the same of a velocity")] = 1.0
    angle: Annotated[Positive, doc("[deg] the same of roll, pitch and yaw")] = 11.5
    rate: Annotated[Positive, doc("[deg/s] the same of their rates")] = 57.3
    hover: Annotated[Positive, doc("[s] longest time in level hover, before the descent")] = 5.0
    sink: Annotated[Positive, doc("[m/s] speed of the descent")] = 0.5
    tilt: Annotated[
        Annotated[float, Gt(0.0), Lt(90.0)] | None,
        doc(
            "[deg] largest tilt commanded; absent: 0.8 of the tightest bound on roll or pitch, so that the controller "
            f"takes over again within its bounds, or {USUAL_TILT:g} where there is none"
        ),
    ] = None
    settled: Annotated[Positive, doc("[m/s] above this horizontal speed it brakes without going back to a place")] = 0.3

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            if item.name != "enabled" and value is not None and not 0.0 < value < math.inf:
                raise ParameterError("controller.fallback", item.name, value, "positive and finite")

    @property
    def distance(self) -> Array:
        """(12,) largest distance from a plan's states [m], [m/s], [rad], [rad/s]."""
        return by_group(self.position, self.velocity, math.radians(self.angle), math.radians(self.rate))
