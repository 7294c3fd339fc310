"""A push: a force at a point of the body for a while, as of a hand or a rope."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from annotated_types import doc

from quadsim.errors import ParameterError
from quadsim.fields import Instant, Positive, Vector


@dataclass(frozen=True, kw_only=True)
class Push:
    """A constant force in the world frame that acts at a point of the body, with the torque r x R' F that follows.

    Raises:
        ParameterError: a value is not finite, the start is negative or the duration is not positive.
    """

    at: Instant
    duration: Annotated[Positive, doc("[s] how long")]
    force: Annotated[Vector, doc("[N] world frame")]
    point: Annotated[Vector, doc("[m] where it acts, body frame")] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        if not 0.0 <= self.at < math.inf:
            raise ParameterError("push", "at", self.at, "a finite time >= 0 s")
        if not 0.0 < self.duration < math.inf:
            raise ParameterError("push", "duration", self.duration, "a finite time > 0 s")
        for name in ("force", "point"):
            value = getattr(self, name)
            if np.shape(value) != (3,) or not np.all(np.isfinite(value)):
                raise ParameterError("push", name, value, "three finite numbers")
