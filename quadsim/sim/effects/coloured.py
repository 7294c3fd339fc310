"""A random force and torque that last: each axis an Ornstein-Uhlenbeck process, as flights show them.

    dx/dt = -x / T + sqrt(2 / T) s n,    n white noise of unit intensity,

with the standard deviation s and the correlation s^2 exp(-|t| / T) (Gillespie 1996, "Exact numerical simulation of the
Ornstein-Uhlenbeck process and its integral", Eq. (1.9a)).  It is exact at the physics steps, and held over each.
"""

from __future__ import annotations

import copy
import math

import numpy as np

from quadsim.sim.effects.turbulence import first_order
from quadsim.state import Array


class ColouredNoise:
    """Processes side by side, an evolving state; stationary from the first sample on.

    It draws from a child of `rng`, so that others may draw from that at any time.

    Args:
        deviations: (n,) standard deviations s.
        times: (n,) time constants T [s].
        timestep: between samples [s].
        rng: whose child it draws from.
    """

    def __init__(self, deviations: Array, times: Array, *, timestep: float, rng: np.random.Generator) -> None:
        self._deviations = deviations
        self._kept = np.exp(-timestep / times)
        (self._source,) = rng.spawn(1)
        self.reset()

    def reset(self) -> None:
        """Rewind: the same noise again."""
        self._rng = copy.deepcopy(self._source)
        self._last = self._rng.standard_normal(len(self._kept))

    def advance(self, steps: int) -> Array:
        """(steps, n) the next samples."""
        drives = self._rng.standard_normal((steps, len(self._kept)))
        samples = np.empty(drives.shape)
        for i, kept in enumerate(self._kept.tolist()):
            samples[:, i] = first_order(kept, math.sqrt(1.0 - kept * kept) * drives[:, i], self._last[i])
        self._last = samples[-1]
        return self._deviations * samples
