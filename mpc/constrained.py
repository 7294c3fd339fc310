"""`[controller] type = "constrained"`: the MPC of Eqs. (27)-(29)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

from annotated_types import doc

from mpc.bounded import Bounded
from mpc.fallback.contract import FallbackSettings
from mpc.linear import LinearMPC, NominalPreparation
from mpc.obstacles import Shape
from quadsim.controller import Controller
from quadsim.vehicle import Vehicle


@dataclass(frozen=True, kw_only=True)
class Constrained(Bounded):
    """The paper's constrained MPC, the optimum of a QP in every period (Sec. 5)."""

    type: Annotated[Literal["constrained"], doc("the control law, by its name in `quadsim list`")] = "constrained"
    fallback: Annotated[
        FallbackSettings | None,
        doc("absent: the last plan is held, shifted, and then the flight ends"),
    ] = None

    def law(self, vehicle: Vehicle, period: float, shapes: Sequence[Shape] = ()) -> Controller:
        """See `mpc.bounded.ControllerTable.law`."""
        compiled = self.in_c(vehicle, period, shapes)
        if compiled is not None:
            return compiled
        problem, space = self.problem(vehicle, period), self.space(shapes, vehicle, period, None)
        preparation, solver = NominalPreparation(problem), self.make_solver(problem, space)
        return LinearMPC(preparation, solver, name=self.type, holds=True, space=space, kkt_every=self.kkt_every)
