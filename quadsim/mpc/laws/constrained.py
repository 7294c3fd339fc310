"""`[controller] type = "constrained"`: the MPC of Eqs. (27)-(29).

In every period it minimises the cost of Eq. (5) over N steps of the linear model, with hard bounds on outputs, rotor
speeds and their steps, and flies the first input.  The table of settings builds the controller, which is
`quadsim.mpc.laws.parts.linear.LinearMPC` with the paper's query (`NominalPreparation`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

from annotated_types import doc

from quadsim.mpc.guard.settings import FallbackSettings
from quadsim.mpc.laws import register
from quadsim.mpc.space import Shape
from quadsim.mpc.tables.bounded import Bounded
from quadsim.vehicle import Vehicle

if TYPE_CHECKING:
    from quadsim.mpc.laws.parts.linear import LinearMPC


@register(
    title="constrained MPC",
    description="the paper's Sec. 5: a QP's optimum in every period, tilt, rotor speeds and their steps bounded",
    place=2,
)
@dataclass(frozen=True, kw_only=True)
class Constrained(Bounded):
    """The paper's constrained MPC, the optimum of a QP in every period (Sec. 5)."""

    holds_plans: ClassVar = True

    type: Annotated[Literal["constrained"], doc("the controller, by its name in `quadsim list`")] = "constrained"
    fallback: Annotated[
        FallbackSettings | None,
        doc("absent: the last plan is held, shifted, and then the flight ends"),
    ] = None

    def law(self, vehicle: Vehicle, period: float, shapes: Sequence[Shape] = ()) -> LinearMPC:
        """See `quadsim.mpc.tables.controller.ControllerTable.law`."""
        # Imported here, so that reading a scenario does not load the controller.
        from quadsim.mpc.laws.parts.linear import NominalPreparation, linear_law

        problem = self.problem(vehicle, period)
        preparation = NominalPreparation(problem)
        space = self.space(shapes, vehicle, period)
        solver = self.make_solver(problem, space)
        return linear_law(self, preparation, solver, space)
