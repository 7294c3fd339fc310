"""Thrust that is lost and fluctuates, drawn in each physics step."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from annotated_types import doc

from quadsim.errors import ParameterError
from quadsim.fields import NonNegative
from quadsim.state import Array


@dataclass(frozen=True, kw_only=True)
class ThrustNoise:
    """Each rotor gives clip(u - n, 0, 1) of its largest thrust instead of u, n normal, independent.

    The mean of n is `loss` u^2 and its standard deviation is `deviation` sqrt(u), as in the simplified simulation of
    Torrente et al. 2021, "Data-Driven MPC for Quadrotors".  The reaction torque changes with the thrust.
    """

    loss: Annotated[NonNegative, doc("[-] mean of the share of thrust lost at full thrust; grows as u^2")] = 0.0
    deviation: Annotated[
        NonNegative, doc("[-] its standard deviation in each physics step at full thrust; as sqrt(u)")
    ] = 0.0

    def __post_init__(self) -> None:
        for name in ("loss", "deviation"):
            if not 0.0 <= getattr(self, name) < math.inf:
                raise ParameterError("effects.thrust_noise", name, getattr(self, name), "at least 0 and finite")

    def applied(self, thrusts: Array, largest: float, rng: np.random.Generator) -> Array:
        """The thrusts (M, 4) [N] over M steps that result where these are commanded, of `largest` [N] at most."""
        share = thrusts / largest
        lost = self.loss * np.square(share) + self.deviation * np.sqrt(share) * rng.standard_normal(share.shape)
        given: Array = largest * np.clip(share - lost, 0.0, 1.0)
        return given
