"""`[controller] type = "robust"`: the MPC for imperfect vehicles, one field per part."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal

import numpy as np
from annotated_types import Gt, Le, doc

from quadsim import shorthands
from quadsim.controller import CORE
from quadsim.errors import ParameterError
from quadsim.fields import Weight
from quadsim.mpc.estimate.observer import ObserverSettings
from quadsim.mpc.guard.settings import USUAL_FALLBACK, FallbackSettings
from quadsim.mpc.laws import register
from quadsim.mpc.problem.constraints import Soft
from quadsim.mpc.problem.model import LinearModel, continuous_model, discretise, hover_model
from quadsim.mpc.problem.ocp import Problem, lqr_terminal_weight
from quadsim.mpc.problem.tightening import TighteningSettings, margins, position_margins
from quadsim.mpc.space import Shape, Space
from quadsim.mpc.tables.bounded import USUAL_SOLVER, Bounded
from quadsim.mpc.tables.lags import Lag, LagSeconds, require_lag, resolved_lag
from quadsim.state import Array
from quadsim.vehicle import N_ROTORS, Vehicle

if TYPE_CHECKING:
    from quadsim.mpc.laws.parts.linear import LinearMPC

TURNED: Final = frozenset({"x", "vx", "y", "vy", "yaw"})  # states that depend on the yaw of the axes


@register(
    title="robust MPC",
    description=(
        "constrained, with soft bounds, rotor lag, delay, disturbances, heading and more, each switched on alone"
    ),
    place=3,
)
@dataclass(frozen=True, kw_only=True)
class Robust(Bounded):
    """The robust MPC: soft bounds, rotor lag, delay, disturbances, heading and more, each switched on separately."""

    type: Annotated[Literal["robust"], doc("the control law, by its name in `quadsim list`")] = "robust"
    soft: Soft | None = None
    rotor_lag: Annotated[
        Lag,
        doc('[s] rotor time constant in the prediction, 0 for none; "vehicle": the rotor_rise of the vehicle'),
    ] = 0.0
    delay: Annotated[
        LagSeconds,
        doc("[s] known delay from measurement to command, bridged by prediction; at most the horizon"),
    ] = 0.0
    offset_free: ObserverSettings | None = None
    tightening: TighteningSettings | None = None
    moment: Annotated[
        bool,
        doc(
            "whether the model has the vehicle's rotor_moment, inflow_moment, rate_damping and inflow, in still air: "
            "the hover model as far as they are linear there, the observer and the prediction over a delay in full"
        ),
    ] = False
    heading: Annotated[bool, doc("whether the hover model is turned by the measured yaw")] = False
    """The weights of x and y then apply forward and to the left: if they differ, a flight depends on its heading."""
    largest_turn: Annotated[
        float,
        Gt(0.0),
        Le(180.0),
        doc("[deg] largest step of the yaw reference, from the measured yaw or from one period to the next"),
    ] = 30.0
    move_weight: Annotated[
        Weight | None, doc("[1/(rad/s)^2] diagonal of Q_d, weight of command changes from period to period")
    ] = None
    fallback: FallbackSettings = USUAL_FALLBACK

    def __post_init__(self) -> None:
        super().__post_init__()
        require_lag(self.rotor_lag)
        if self.tightening is not None and not self.output_bounds:
            raise ValueError("tightening must be absent where there are no output_bounds to tighten")
        if self.heading:
            bounded = {
                "output_bounds": [*self.output_bounds],
                **{polytope.name: polytope.of for polytope in self.polytopes},
            }
            for name, states in bounded.items():
                turned = [state for state in states if state in TURNED]
                if turned:
                    raise ValueError(
                        f"{name} must not be of {', '.join(turned)} where heading turns the model: "
                        'heading = false, or type = "nonlinear"'
                    )

    def law(self, vehicle: Vehicle, period: float, shapes: Sequence[Shape] = ()) -> LinearMPC:
        """See `quadsim.mpc.tables.controller.ControllerTable.law`."""
        from quadsim.mpc.laws.parts.linear import linear_law

        problem = self.problem(vehicle, period)
        space = self.space(shapes, vehicle, period)
        solver = self.make_solver(problem, space)
        preparation = shorthands.robust_preparation(vehicle, problem, self)
        return linear_law(self, preparation, solver, space)

    def problem(self, vehicle: Vehicle, period: float) -> Problem:
        """Return the optimisation of the hover model, with rotor speeds as states if they lag.

        Raises:
            InputError: no problem can be built from these numbers.
        """
        if self.delay > self.horizon * period:
            rule = f"at most the horizon of {self.horizon} periods, {self.horizon * period:g} s"
            raise ParameterError("controller", "delay", self.delay, rule)
        if self.moment:
            vehicle.require_moment("controller")
        lag = resolved_lag(self.rotor_lag, vehicle)
        A, B = discretise(*continuous_model(vehicle, lag, moment=self.moment), period)
        model = LinearModel(A=A, B=B, u_bar=hover_model(vehicle, period).u_bar, period=period)
        objective, bounds, n = self.objective(), self.bounds(), model.n
        moves = None if self.move_weight is None else self.move_weight * np.eye(N_ROTORS)
        objective = replace(objective, C_r=_widened(objective.C_r, n), Q_d=moves)
        if self.terminal == "lqr":
            objective = replace(objective, P=lqr_terminal_weight(model, objective))
        penalty = None if self.soft is None else self.soft.penalty(len(self.output_bounds))
        return Problem(
            model=model,
            horizon=self.horizon,
            objective=objective,
            bounds=replace(bounds, C_c=_widened(bounds.C_c, n), penalty=penalty, margins=self.margins(vehicle, period)),
            constraints=tuple(
                part if part.C is None else replace(part, C=_widened(part.C, n)) for part in self.constraints()
            ),
        )

    def solver_name(self, problem: Problem, space: Space | None) -> str:
        """See `quadsim.mpc.tables.bounded.Bounded.solver_name`: the core where it takes the problem."""
        from quadsim.mpc.solvers.core import core_problem

        if self.solver is not None or space is not None:
            return super().solver_name(problem, space)
        try:
            core_problem(problem)
        except ParameterError:
            return USUAL_SOLVER
        return CORE

    def margins(self, vehicle: Vehicle, period: float) -> Array | None:
        """Return the tightening of the output bounds at each predicted state, (N, n_c); None without tightening.

        Raises:
            ParameterError: the bounds are too narrow for it.
        """
        if self.tightening is None:
            return None
        return margins(bounds=self.bounds(), **self._tightened(vehicle, period))

    def position_margins(self, vehicle: Vehicle, period: float) -> Array | None:
        """See `quadsim.mpc.tables.bounded.Bounded.position_margins`."""
        return None if self.tightening is None else position_margins(**self._tightened(vehicle, period))

    def _tightened(self, vehicle: Vehicle, period: float) -> dict[str, Any]:
        """Return the inputs of the tightening."""
        return {
            "vehicle": vehicle,
            "period": period,
            "horizon": self.horizon,
            "settings": self.tightening,
            "rotor_lag": resolved_lag(self.rotor_lag, vehicle),
            "moment": self.moment,
            "delay": self.delay,
            "estimated": self.offset_free is not None,
        }


def _widened(matrix: Array, n: int) -> Array:
    """Extend rows over 12 states to n states."""
    return np.hstack([matrix, np.zeros((len(matrix), n - matrix.shape[1]))])
