"""The reference motion of a vehicle along a course, for controllers with preview."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from quadsim.state import Array


@dataclass(frozen=True, kw_only=True)
class Motion:
    """A reference motion, K samples one control period apart, from an instant to the end of the course."""

    position: Array  # (K, 3) world [m]
    velocity: Array  # (K, 3) world [m/s]
    acceleration: Array  # (K, 3) world [m/s^2]
    attitude: Array  # (K, 4) unit quaternions wxyz, body to world, sign continuous from sample to sample
    body_rates: Array  # (K, 3) body frame [rad/s]
    thrusts: Array  # (K, 4) rotor thrusts [N], not clipped to the rotors' range

    def __len__(self) -> int:
        """K, the number of samples."""
        return len(self.position)

    def after(self, k: int) -> Motion:
        """Return the motion from sample k on, as views; beyond the end, its last sample."""
        first = min(k, len(self) - 1)
        rest = {name: samples[first:] for name, samples in vars(self).items()}
        return Motion(**rest)

    def read_only(self) -> Motion:
        """Return it as views that user code cannot write to."""
        views = {name: samples.view() for name, samples in vars(self).items()}
        for view in views.values():
            view.flags.writeable = False
        return Motion(**views)

    def raised(self, height: float) -> Motion:
        """Return the same motion, higher by a height [m]."""
        return replace(self, position=self.position + np.array([0.0, 0.0, height]))
