"""The equilibrium of a vehicle under a constant disturbance: the target of offset-free tracking and of every fallback.

At rest, thrust balances gravity less the disturbance's acceleration a, and torque balances its angular acceleration
alpha:

    U / m R(eta) e_z = g e_z - a,    I^-1 tau = -alpha,    omega = 0.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Final, Protocol, runtime_checkable

import numpy as np

from quadsim.errors import ParameterError
from quadsim.state import INDEX, N_STATES, Array, all_true
from quadsim.vehicle import N_ROTORS

LEAST_LIFT: Final = 0.1  # least thrust at rest as a share of the weight, so that no equilibrium is upside down
_ROLL = INDEX["roll"]
_PITCH = INDEX["pitch"]


@dataclass(frozen=True, kw_only=True)
class Trim:
    """The estimated equilibrium of a vehicle."""

    speeds: Array  # (4,) rotor speeds [rad/s]
    lift: Array  # (3,) direction of thrust, world frame, upwards, any length
    # (3,) angular acceleration, body frame, that thrust causes, per acceleration by thrust [1/m]
    twist: Array = field(default_factory=lambda: np.zeros(3))

    def __post_init__(self) -> None:
        for name, count in (("speeds", N_ROTORS), ("lift", 3), ("twist", 3)):
            value = getattr(self, name)
            if np.shape(value) != (count,) or not all_true(np.isfinite(value)):
                raise ParameterError("trim", name, value, f"{count} finite numbers")
        if not self.lift[2] > 0.0:
            raise ParameterError("trim", "lift", self.lift, "upwards")

    def lean(self, yaw: float) -> tuple[float, float]:
        """Roll and pitch at rest for a yaw [rad]."""
        x, y, up = self.lift.tolist()
        cosine = math.cos(yaw)
        sine = math.sin(yaw)
        forward = cosine * x + sine * y
        left = cosine * y - sine * x
        return -math.atan2(left, math.hypot(forward, up)), math.atan2(forward, up)

    def state(self, yaw: float = 0.0, n: int = N_STATES) -> Array:
        """(n,) the equilibrium at the origin and zero yaw, in axes turned by the yaw [rad]; rotor speeds last."""
        state = np.zeros(n)
        state[_ROLL], state[_PITCH] = self.lean(yaw)
        state[N_STATES:] = self.speeds[: n - N_STATES]
        return state


@runtime_checkable
class Trimmed(Protocol):
    """A controller that estimates the equilibrium of its vehicle."""

    @property
    def trim(self) -> Trim | None:
        """The estimate; None where there is none."""
        ...
