"""Incremental nonlinear dynamic inversion (INDI) of the angular acceleration, an inner loop around any law.

The law's rotor speeds define a wrench, and so the angular acceleration that its model demands. At its own rate, above
the control rate, the inner loop demands the torque

    tau_c = tau_f + J (alpha_c - alpha_f),

the filtered torque of the measured rotor speeds plus an increment from the measured angular acceleration. Both pass the
same low-pass filter, so that they stay synchronised: Smeur, Chu, de Croon, "Adaptive incremental nonlinear dynamic
inversion for attitude control of micro air vehicles", 2016; Tal and Karaman (2021); around a nonlinear MPC, Sun,
Romero, Foehn, Kaufmann, Scaramuzza, "A comparative study of nonlinear MPC and differential-flatness-based control for
quadrotor agile flight", 2022. Torques that the model omits (drag of the body, a worn rotor, an offset centre of mass)
appear in alpha_f and are compensated; collective thrust is passed through.

With the gyroscopic torque outside the filter, tau_c = tau(u) + filtered(tau - J alpha - omega x J omega), so that a
vehicle that matches its model flies the law's speeds unchanged.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Final

import numpy as np
from annotated_types import doc

from mpc.allocation import allocate, make_allocation
from quadsim.fields import Positive
from quadsim.state import Array
from quadsim.vehicle import Vehicle

if TYPE_CHECKING:
    from mpc.answer import ActuatorBounds
    from mpc.disturbance import RampSettings

DAMPING: Final = math.sqrt(0.5)
"""Damping of the second-order Butterworth low-pass filter, as in Tal and Karaman."""


@dataclass(frozen=True, kw_only=True)
class INDISettings:
    """INDI of the angular acceleration in an inner loop."""

    rate: Annotated[Positive, doc("[Hz] inner loop; its period is a whole number of physics steps")] = 500.0
    cutoff: Annotated[Positive, doc("[Hz] cutoff of the filter on measured angular accelerations and torques")] = 30.0


def require_one_scale(indi: INDISettings | None, disturbance: RampSettings | None) -> None:
    """Refuse INDI with a disturbance observer's thrust scale.

    Raises:
        ValueError: both are given.
    """
    if indi is not None and disturbance is not None and disturbance.thrust_scale:
        raise ValueError("disturbance.thrust_scale must be false where indi is given: both make up for torque lost")


class TorqueIncrement:
    """The inner loop: corrects the commanded rotor speeds so that the vehicle turns as the law's model predicts.

    See `quadsim.controller.InnerLoop`.
    """

    def __init__(self, vehicle: Vehicle, settings: INDISettings, bounds: ActuatorBounds) -> None:
        self.rate = settings.rate
        self._allocation, self._inertia, self._bounds = make_allocation(vehicle), np.array(vehicle.inertia), bounds
        self._omega = 2.0 * math.pi * settings.cutoff
        self.reset()

    def reset(self) -> None:
        """Clear the filter; no unmodelled torque."""
        self._last: tuple[float, Array] | None = None
        self._filtered, self._slope = np.zeros(3), np.zeros(3)

    def adopt(self, other: TorqueIncrement) -> None:
        """Take over the state of another inner loop."""
        self._last, self._filtered, self._slope = other._last, other._filtered, other._slope

    def speeds(self, time: float, commanded: Array, rates: Array, rotors: Array, attitude: Array) -> Array:
        """Return the rotor speeds (4,) to hold until the next call, from the demanded and the measured ones."""
        M, J = self._allocation.M, self._inertia
        last, self._last = self._last, (time, rates.copy())
        if last is not None and time > last[0]:
            step = time - last[0]
            middle = 0.5 * (rates + last[1])
            missed = (M @ rotors**2)[1:] - J * (rates - last[1]) / step - np.cross(middle, J * middle)
            self._filter(missed, step)
        wrench = M @ commanded**2
        wrench[1:] += self._filtered
        return allocate(self._allocation, wrench, self._bounds.u_min, self._bounds.u_max)

    def _filter(self, value: Array, step: float) -> None:
        """One step of y'' = omega^2 (value - y) - 2 zeta omega y', implicit, so that it is stable at any rate."""
        omega = self._omega
        slope = (self._slope + step * omega**2 * (value - self._filtered)) / (
            1.0 + 2.0 * DAMPING * omega * step + (omega * step) ** 2
        )
        self._filtered, self._slope = self._filtered + step * slope, slope
