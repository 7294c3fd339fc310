"""Incremental nonlinear dynamic inversion (INDI) of the angular acceleration, an inner loop around any controller.

The controller's rotor speeds define a wrench, and so the angular acceleration that its model demands. At its own rate,
above the control rate, the inner loop demands the torque

    tau_c = tau_f + J (alpha_c - alpha_f),

the filtered torque of the measured rotor speeds plus an increment from the measured angular acceleration. Both pass the
same low-pass filter, so that they stay synchronised: Smeur, Chu, de Croon, "Adaptive incremental nonlinear dynamic
inversion for attitude control of micro air vehicles", 2016; Tal and Karaman (2021); around a nonlinear MPC, Sun,
Romero, Foehn, Kaufmann, Scaramuzza, "A comparative study of nonlinear MPC and differential-flatness-based control for
quadrotor agile flight", 2022. Torques that the model omits (drag of the body, a worn rotor, an offset centre of mass)
appear in alpha_f and are compensated; collective thrust is passed through.

With the gyroscopic torque outside the filter, tau_c = tau(u) + filtered(tau - J alpha - omega x J omega), so that a
vehicle that matches its model flies the controller's speeds unchanged.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

from annotated_types import doc

from quadsim.core.inner import CompiledLoop
from quadsim.core.mirror import fill
from quadsim.core.structs import LoopKind
from quadsim.fields import Hertz
from quadsim.mpc.pilot.allocation import allocation_struct, make_allocation
from quadsim.vehicle import Vehicle

if TYPE_CHECKING:
    from quadsim.mpc.estimate.disturbance import RampSettings
    from quadsim.mpc.guard.answer import ActuatorBounds


@dataclass(frozen=True, kw_only=True)
class INDISettings:
    """INDI of the angular acceleration in an inner loop."""

    rate: Annotated[Hertz, doc("[Hz] inner loop; its period is a whole number of physics steps")] = 500.0
    cutoff: Annotated[Hertz, doc("[Hz] cutoff of the filter on measured angular accelerations and torques")] = 30.0


def require_one_scale(indi: INDISettings | None, disturbance: RampSettings | None) -> None:
    """Refuse INDI with a disturbance observer's thrust scale.

    Raises:
        ValueError: both are given.
    """
    if indi is not None and disturbance is not None and disturbance.thrust_scale:
        raise ValueError("disturbance.thrust_scale must be false where indi is given: both make up for torque lost")


class TorqueIncrement(CompiledLoop):
    """The inner loop: corrects the commanded rotor speeds so that the vehicle turns as the controller's model predicts.

    See `quadsim.controller.InnerLoop`.  The core computes it: the filter y'' = omega^2 (value - y) - 2 zeta omega y',
    Butterworth's damping as in Tal and Karaman, implicit, so that it is stable at any rate; and the allocation.
    """

    def __init__(self, vehicle: Vehicle, settings: INDISettings, bounds: ActuatorBounds) -> None:
        self.rate = settings.rate
        struct = allocation_struct(make_allocation(vehicle), bounds.u_min, bounds.u_max)
        struct.kind = LoopKind.INDI
        struct.inertia[:] = vehicle.inertia
        struct.omega = 2.0 * math.pi * settings.cutoff
        struct.products[:] = vehicle.products_of_inertia or (0.0, 0.0, 0.0)
        super().__init__(struct)

    def reset(self) -> None:
        """Clear the filter; no unmodelled torque."""
        self._struct.started = 0
        fill(self._struct.filtered, 0.0)
        fill(self._struct.slope, 0.0)

    def adopt(self, other: TorqueIncrement) -> None:
        """Take over the state of another inner loop."""
        for name in ("started", "last_time", "last_rates", "filtered", "slope"):
            setattr(self._struct, name, getattr(other._struct, name))
