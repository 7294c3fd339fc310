"""The table `fallback` of a controller."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Final

from annotated_types import Gt, Lt, doc

from quadsim.fields import Metres, Positive, Seconds
from quadsim.state import Array, by_group

USUAL_TILT: Final = 10.0
"""Default limit of the tilt [deg], for a controller without a bound on tilt."""
_SHARE: Final = 0.8
"""Tilt as a share of the tightest bound on it, so that the controller resumes within its bounds."""
_SMALLEST_TILT: Final = 0.5  # [deg] whatever the bounds; below it there is no lateral authority


@dataclass(frozen=True, kw_only=True)
class FallbackSettings:
    """The fallback contract: the shifted plan with an LQR correction, then level hover, then descent.

    A plan lasts at most its horizon; its own tilt adds to `tilt`.
    """

    enabled: Annotated[bool, doc("false: the controller handles missing answers itself")] = True
    unseen: Annotated[Seconds, doc("[s] longest time that predictions may replace a missing measurement")] = 1.5
    plan_age: Annotated[Seconds, doc("[s] longest time that one shifted plan is flown")] = 1.0
    position: Annotated[Metres, doc("[m] largest distance from the plan")] = 0.5
    velocity: Annotated[Positive, doc("[m/s] largest velocity deviation from the plan")] = 1.0
    angle: Annotated[Positive, doc("[deg] largest deviation of roll, pitch and yaw from the plan")] = 11.5
    rate: Annotated[Positive, doc("[deg/s] largest deviation of their rates from the plan")] = 57.3
    hover: Annotated[Seconds, doc("[s] longest time in level hover, before the descent")] = 5.0
    sink: Annotated[Positive, doc("[m/s] speed of the descent")] = 0.5
    tilt: Annotated[
        Annotated[float, Gt(0.0), Lt(90.0)] | None,
        doc(
            "[deg] largest tilt commanded; absent: 0.8 of the tightest bound on roll or pitch, so that the controller "
            f"takes over again within its bounds, or {USUAL_TILT:g} where there is none"
        ),
    ] = None
    settled: Annotated[Positive, doc("[m/s] above this horizontal speed it brakes without going back to a place")] = 0.3

    @property
    def distance(self) -> Array:
        """Return (12,) the largest deviations from a plan's states [m], [m/s], [rad], [rad/s]."""
        return by_group(self.position, self.velocity, math.radians(self.angle), math.radians(self.rate))

    def within(self, output_bounds: Mapping[str, Sequence[float]]) -> FallbackSettings:
        """Return the same with the tilt that `output_bounds` [deg] leave it, unless it has one."""
        if self.tilt is not None:
            return self
        tightest = USUAL_TILT
        for name in ("roll", "pitch"):
            if name in output_bounds:
                lower, upper = output_bounds[name]
                tightest = min(tightest, _SHARE * min(-lower, upper))
        return replace(self, tilt=max(tightest, _SMALLEST_TILT))


USUAL_FALLBACK: Final = FallbackSettings()
