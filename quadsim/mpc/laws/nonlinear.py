"""`[controller] type = "nonlinear"`: the law of the table `quadsim.mpc.tables.nonlinear.Nonlinear`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from quadsim.controller import ROTORS
from quadsim.mpc.laws import register
from quadsim.mpc.space import Shape
from quadsim.mpc.tables.bounded import require_lags
from quadsim.mpc.tables.nonlinear import Nonlinear
from quadsim.vehicle import Vehicle

if TYPE_CHECKING:
    from quadsim.mpc.laws.parts.nonlinear_mpc import NonlinearMPC


@register(
    Nonlinear,
    title="nonlinear MPC",
    description="nonlinear MPC at any attitude: a quaternion model, sequential quadratic programming",
    place=4,
)
def _law(table: Nonlinear, vehicle: Vehicle, period: float, shapes: Sequence[Shape] = ()) -> NonlinearMPC:
    from quadsim.mpc.laws.parts.nonlinear_mpc import NonlinearMPC

    if table.commands != ROTORS:
        require_lags(table.inner_lag)
    return NonlinearMPC(
        vehicle,
        period=period,
        settings=table,
        bounds=table.actuators(vehicle),
        constraints=table.constraints(),
        space=table.space(shapes, vehicle, period),
        kkt_every=table.kkt_every,
    )
