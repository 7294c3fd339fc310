"""`[controller] type = "robust"`: the law of the table `quadsim.mpc.tables.robust.Robust`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from quadsim.mpc.laws import register
from quadsim.mpc.space import Shape
from quadsim.mpc.tables.robust import Robust
from quadsim.vehicle import Vehicle

if TYPE_CHECKING:
    from quadsim.mpc.laws.parts.linear import LinearMPC


@register(
    Robust,
    title="robust MPC",
    description=(
        "constrained, with soft bounds, rotor lag, delay, disturbances, heading and more, each switched on alone"
    ),
    place=3,
)
def _law(table: Robust, vehicle: Vehicle, period: float, shapes: Sequence[Shape] = ()) -> LinearMPC:
    from quadsim.mpc.laws.parts.linear import linear_law
    from quadsim.mpc.laws.parts.preparation import RobustPreparation

    problem = table.problem(vehicle, period)
    space = table.space(shapes, vehicle, period)
    solver = table.make_solver(problem, space)
    return linear_law(table, RobustPreparation(vehicle, problem, table), solver, space)
