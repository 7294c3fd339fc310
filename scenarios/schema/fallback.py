"""`[controller.fallback]`: what is flown when the controller has no good answer."""

from __future__ import annotations

from typing import Annotated, Final

from pydantic import Field

from mpc.fallback.settings import FallbackSettings
from scenarios.schema.base import Positive, Spec

_USUAL: Final = FallbackSettings()
Tilt = Annotated[float, Field(gt=0.0, lt=90.0)]


class FallbackSpec(Spec):
    """The fallback contract: the shifted plan with an LQR correction, then level hover, then descent."""

    enabled: bool = Field(default=True, description="false: what the controller does without an answer is its own")
    unseen: Positive = Field(
        default=_USUAL.unseen, description="[s] longest time that predictions stand in for a missing measurement"
    )
    plan_age: Positive = Field(default=_USUAL.plan_age, description="[s] longest time on one shifted plan")
    position: Positive = Field(default=_USUAL.position, description="[m] largest distance from that plan")
    velocity: Positive = Field(default=_USUAL.velocity, description="[m/s] the same of a velocity")
    angle: Positive = Field(default=11.5, description="[deg] the same of roll, pitch and yaw")
    rate: Positive = Field(default=57.3, description="[deg/s] the same of their rates")
    hover: Positive = Field(default=_USUAL.hover, description="[s] longest time in level hover, before the descent")
    sink: Positive = Field(default=_USUAL.sink, description="[m/s] speed of the descent")
    tilt: Tilt | None = Field(
        default=None,
        description="[deg] largest tilt commanded; absent: 0.8 of the tightest bound on roll or pitch, so that the "
        "controller takes over again within its bounds, or 10 where there is none",
    )
    settled: Positive = Field(
        default=_USUAL.settled, description="[m/s] above this horizontal speed it brakes without going back to a place"
    )
