"""Inner loop for collective thrust and body rates: proportional control with the exact rotor map.

The torque tau = J k (omega_c - omega) + omega x J omega makes each rate follow its command with a first-order lag of
1/k while the rotors are not saturated.  Allocation limits yaw before thrust (`mpc.allocation`).
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
"""Status of a command that no controller computed."""


class BodyRateLoop:
    """The inner loop (`quadsim.controller.InnerLoop`) with its own set-point in place of the commanded rotor speeds.

    Set `thrust` [N], collective, and the body `rates` (3,) [rad/s].
    """

    def __init__(self, vehicle: Vehicle, *, rate: float, bandwidth: float, bounds: ActuatorBounds) -> None:
        self.rate, self._bandwidth, self._bounds = rate, bandwidth, bounds
        self._allocation, self._inertia = make_allocation(vehicle), np.array(vehicle.inertia)
        self.thrust, self.rates = vehicle.mass * vehicle.gravity, np.zeros(3)

    def speeds(self, time: float, commanded: Array, rates: Array, rotors: Array) -> Array:
        """See `quadsim.controller.InnerLoop`."""
        return self.commanded(rates)

    def commanded(self, rates: Array) -> Array:
        """Return the rotor speeds (4,) [rad/s] for measured body rates (3,) [rad/s]."""
        J = self._inertia
        torque = J * self._bandwidth * (self.rates - rates) + np.cross(rates, J * rates)
        return allocate(self._allocation, np.append(self.thrust, torque), self._bounds.u_min, self._bounds.u_max)

    def command(self, rates: Array, horizon: int) -> Command:
        """Return the command of a period that starts with body rates (3,) [rad/s]; `speeds` holds the first speeds."""
        speeds = self.commanded(rates)
        return Command(speeds=speeds, plan=np.broadcast_to(speeds, (horizon, N_ROTORS)), status=STATUS, inner=self)
