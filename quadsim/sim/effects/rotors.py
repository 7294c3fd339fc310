"""Rotors that take time: lag, limited acceleration, and the angular momentum they carry."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from quadsim.errors import ParameterError
from quadsim.state import Array


@dataclass(frozen=True, kw_only=True)
class RotorDynamics:
    """How rotor speeds follow their commands, and what their inertia does to the body.

    Speeds follow as a first-order lag whose slope is limited, dw/dt = clip((w_cmd - w) / tau, -a, a): the model of
    RotorS (Furrer et al. 2016, "RotorS - A Modular Gazebo MAV Simulator Framework", Eq. (18)) with its separate time
    constants for speeding up and slowing down.  A rotor pushes w_cmd from one side and never passes it, so that the
    answer to a held command is a straight line followed by an exponential: no integration, no step size.

    Attributes:
        rise: tau while a rotor speeds up [s]; 0 for at once.
        fall: tau while it slows down [s]; 0 for at once.
        acceleration: a, largest change of a rotor's speed [rad/s^2]; inf for no limit.
        inertia: J_r of each rotor about its axis [kg m^2]; 0 for massless rotors.
    """

    rise: float = 0.0
    fall: float = 0.0
    acceleration: float = math.inf
    inertia: float = 0.0

    def __post_init__(self) -> None:
        for name in ("rise", "fall", "inertia"):
            if not 0.0 <= getattr(self, name) < math.inf:
                raise ParameterError("effects.rotors", name, getattr(self, name), "at least 0 and finite")
        if not self.acceleration > 0.0:
            raise ParameterError("effects.rotors", "acceleration", self.acceleration, "positive")
        if self.inertia and math.isinf(self.acceleration) and not (self.rise and self.fall):
            rule = "0 where rotors change their speed at once: that would take an infinite torque"
            raise ParameterError("effects.rotors", "inertia", self.inertia, rule)

    def respond(self, speeds: Array, target: Array, elapsed: Array) -> tuple[Array, Array]:
        """Speeds and accelerations some time after a command.

        Args:
            speeds: (4,) rotor speeds when the command came [rad/s].
            target: (4,) the command, within what the rotors can hold [rad/s].
            elapsed: (M,) times since then [s].

        Returns:
            (M, 4) speeds [rad/s] and (M, 4) accelerations [rad/s^2].
        """
        gap = target - speeds
        sign, distance = np.sign(gap), np.abs(gap)
        lag = np.where(gap >= 0.0, self.rise, self.fall)
        eased = distance if math.isinf(self.acceleration) else np.minimum(distance, self.acceleration * lag)
        ramp_end = (distance - eased) / self.acceleration  # until then the slope is at its limit; 0 without one
        t = elapsed[:, None]
        ramping = t < ramp_end
        rate = np.divide(1.0, lag, out=np.zeros_like(lag), where=lag > 0.0)
        decay = np.where(lag > 0.0, np.exp(-rate * np.maximum(t - ramp_end, 0.0)), 0.0)
        limit = self.acceleration if math.isfinite(self.acceleration) else 0.0
        after = np.where(ramping, speeds + sign * limit * t, target - sign * eased * decay)
        slope = np.where(ramping, sign * limit, sign * eased * rate * decay)
        return after, slope
