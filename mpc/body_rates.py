"""Collective thrust and body rates flown by an inner loop: proportional in the rates, on the exact rotor map.

The torque demanded is tau = J k (omega_c - omega) + omega x J omega, so that each rate follows its command as a
first-order lag of 1/k while rotors have room; thrust is limited before yaw (`mpc.allocation`).
"""

from __future__ import annotations

from typing import Final

import numpy as np

from mpc.allocation import allocate, make_allocation
from mpc.answer import ActuatorBounds
from quadsim.controller import Command
from quadsim.state import Array
from quadsim.vehicle import N_ROTORS, Vehicle

STATUS: Final = "given"
"""Of a command from no controller."""


class BodyRateLoop:
    """The inner loop, see `quadsim.controller.InnerLoop`: its target is its own, not the commanded rotor speeds.

    To be held are the collective `thrust` [N] and the body `rates` (3,) [rad/s].
    """

    def __init__(self, vehicle: Vehicle, *, rate: float, bandwidth: float, bounds: ActuatorBounds) -> None:
        self.rate, self._bandwidth, self._bounds = rate, bandwidth, bounds
        self._allocation, self._inertia = make_allocation(vehicle), np.array(vehicle.inertia)
        self.thrust, self.rates = vehicle.mass * vehicle.gravity, np.zeros(3)

    def speeds(self, time: float, commanded: Array, rates: Array, rotors: Array) -> Array:
        """See `quadsim.controller.InnerLoop`."""
        return self.commanded(rates)

    def commanded(self, rates: Array) -> Array:
        """Rotor speeds (4,) [rad/s] at body rates (3,) [rad/s]."""
        J = self._inertia
        torque = J * self._bandwidth * (self.rates - rates) + np.cross(rates, J * rates)
        return allocate(self._allocation, np.append(self.thrust, torque), self._bounds.u_min, self._bounds.u_max)

    def command(self, rates: Array, horizon: int) -> Command:
        """A period's command, from the body rates (3,) at its begin; `speeds` are those commanded first."""
        speeds = self.commanded(rates)
        return Command(speeds=speeds, plan=np.broadcast_to(speeds, (horizon, N_ROTORS)), status=STATUS, inner=self)
