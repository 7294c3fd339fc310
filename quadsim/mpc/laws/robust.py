"""`[controller] type = "robust"`: the MPC for imperfect vehicles, one field per part.

The constrained MPC with soft bounds, rotor lag, a known delay, disturbance estimates, tightened bounds and any heading,
each switched on alone.  The table states problem and parts; `quadsim.mpc.laws.parts.preparation` makes the query of a
period, in C.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal

import numpy as np
from annotated_types import Gt, Le, doc

from quadsim import shorthands
from quadsim.controller import CORE, ROTORS
from quadsim.errors import ParameterError
from quadsim.fields import Weight
from quadsim.mpc.estimate.observer import ObserverSettings
from quadsim.mpc.guard.answer import ActuatorBounds
from quadsim.mpc.guard.settings import USUAL_FALLBACK, FallbackSettings
from quadsim.mpc.laws import register
from quadsim.mpc.problem.constraints import Bounds, Constraint, Origin, Penalty, Soft, origin_of_state
from quadsim.mpc.problem.model import LinearModel, continuous_model, discretise, hover_model
from quadsim.mpc.problem.ocp import Objective, Problem, lqr_terminal_weight, objective_of
from quadsim.mpc.problem.tightening import TighteningSettings, margins, position_margins
from quadsim.mpc.space import Shape, Space
from quadsim.mpc.tables.bounded import USUAL_SOLVER, Bounded
from quadsim.mpc.tables.climb import climbing_targets
from quadsim.mpc.tables.commands import (
    COMMANDS,
    TARGET_BOUNDS,
    USUAL_TARGETS,
    InputBounds,
    InputWeights,
    TargetBounds,
    TargetWeights,
    require_targets,
)
from quadsim.mpc.tables.controller import Range
from quadsim.mpc.tables.lags import (
    ATTITUDE_LAG,
    INNER_LAG,
    AttitudeLag,
    InnerLag,
    Lag,
    LagSeconds,
    require_attitude_lag,
    require_lag,
    resolved_lag,
)
from quadsim.mpc.tables.targets import TargetTable
from quadsim.state import INDEX, STATE_NAMES, Array
from quadsim.vehicle import N_ROTORS, Vehicle

if TYPE_CHECKING:
    from quadsim.mpc.laws.parts.linear import LinearMPC

TURNED: Final = frozenset({"x", "vx", "y", "vy", "yaw"})
"""States whose values change as the axes are turned about world z."""


@register(
    title="robust MPC",
    description=(
        "constrained, with soft bounds, rotor lag, delay, disturbances, heading and more, each switched on alone"
    ),
    place=3,
)
@dataclass(frozen=True, kw_only=True)
class Robust(TargetTable, Bounded):
    """The robust MPC: soft bounds, rotor lag, delay, disturbances, heading and more, each switched on separately.

    Examples:
        >>> import quadsim
        >>> from quadsim import mpc
        >>> table = quadsim.load("robust", {"controller.rotor_lag": 0.02}).controller
        >>> isinstance(table, mpc.Robust)
        True
        >>> table.problem(quadsim.load_vehicle("lopes2011"), 0.05).model.n  # 12 states and 4 rotors
        16
    """

    type: Annotated[Literal["robust"], doc("the controller, by its name in `quadsim list`")] = "robust"
    commands: Annotated[Literal["rotors", "rates", "attitude"], doc(COMMANDS)] = "rotors"
    inner_lag: Annotated[InnerLag | None, doc(INNER_LAG)] = None
    attitude_lag: Annotated[AttitudeLag | None, doc(ATTITUDE_LAG)] = None
    target_bounds: Annotated[TargetBounds, doc(TARGET_BOUNDS)] = USUAL_TARGETS
    target_weights: Annotated[TargetWeights | None, doc("only where an autopilot flies")] = None
    input_weights: Annotated[InputWeights | None, doc("only where rotors are commanded")] = None  # type: ignore[assignment]
    input_bounds: Annotated[InputBounds | None, doc("only where rotors are commanded")] = None  # type: ignore[assignment]
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
        self._check_commands()
        if self.tightening is not None and not self.output_bounds:
            raise ValueError("tightening must be absent where there are no output_bounds to tighten")
        if self.heading:
            _require_unturned("output_bounds", [*self.output_bounds])
            for polytope in self.polytopes:
                _require_unturned(polytope.name, polytope.of)

    def _check_commands(self) -> None:
        """Require the fields that the commands need, and refuse those that only other commands have.

        Raises:
            ValueError: a field is missing, or is given and does not act.
        """
        require_targets(self)
        if self.commands == ROTORS:
            self._check_rotor_commands()
        else:
            self._check_target_commands()
            self._require_polytopes_without_speeds()

    def _check_rotor_commands(self) -> None:
        required = {"input_weights": self.input_weights, "input_bounds": self.input_bounds}
        missing = [name for name, value in required.items() if value is None]
        if missing:
            raise ValueError(f"{' and '.join(missing)} must be given where rotors are commanded")
        if self.target_weights is not None:
            raise ValueError('target_weights must be absent where commands = "rotors": these pass no autopilot')

    def _check_target_commands(self) -> None:
        if self.target_weights is None:
            raise ValueError(f'target_weights must be given where commands = "{self.commands}"')
        is_given = {
            "input_weights": self.input_weights is not None,
            "input_bounds": self.input_bounds is not None,
            "rotor_lag": self.rotor_lag != 0.0,
            "tightening": self.tightening is not None,
            "move_weight": self.move_weight is not None,
            "moment": self.moment,
        }
        reason = "the autopilot turns the rotors; inner_lag, target_weights and target_bounds describe it"
        for name, given in is_given.items():
            if given:
                raise ValueError(f'{name} must be absent where commands = "{self.commands}": {reason}')

    def audited(self, vehicle: Vehicle) -> dict[str, Range]:
        """See `quadsim.mpc.tables.controller.ControllerTable.audited`."""
        if self.commands == ROTORS:
            return super().audited(vehicle)
        return self.audited_motion() | self.target_bounds.audited(vehicle)

    def actuators(self, vehicle: Vehicle) -> ActuatorBounds:
        """See `quadsim.mpc.tables.controller.ControllerTable.actuators`."""
        if self.commands == ROTORS:
            return super().actuators(vehicle)
        return climbing_targets(self.target_bounds.actuators(vehicle), vehicle, self.climb_acceleration)

    def objective(self) -> Objective:
        """See `quadsim.mpc.tables.bounded.Weighted.objective`."""
        if self.target_weights is None:
            return super().objective()
        weights = objective_of(self.output_weights, self.target_weights.of_inputs)
        return replace(weights, follows_rates=self.desired_rates == "reference")

    def law(self, vehicle: Vehicle, period: float, shapes: Sequence[Shape] = ()) -> LinearMPC:
        """See `quadsim.mpc.tables.controller.ControllerTable.law`."""
        from quadsim.mpc.laws.parts.linear import linear_law

        problem = self.problem(vehicle, period)
        space = self.space(shapes, vehicle, period)
        solver = self.make_solver(problem, space)
        preparation = shorthands.robust_preparation(vehicle, problem, self)
        return linear_law(self, preparation, solver, space)

    def problem(self, vehicle: Vehicle, period: float) -> Problem:
        """Return the optimal control problem on the hover model, with rotor speeds as states if they lag.

        Raises:
            InputError: no problem can be built from these numbers.
        """
        longest_delay = self.horizon * period
        if self.delay > longest_delay:
            rule = f"at most the horizon of {self.horizon} periods, {longest_delay:g} s"
            raise ParameterError("controller", "delay", self.delay, rule)
        model = self._model(vehicle, period)
        objective = self._objective_on(model)
        bounds = None
        if self.commands == ROTORS:
            bounds = self._tightened_bounds(vehicle, period, model.n)
            constraints = self._widened_constraints(vehicle, model.n)
        else:
            constraints = (*self._target_constraints(vehicle), *self.constraints(vehicle))
        return Problem(
            model=model,
            horizon=self.horizon,
            objective=objective,
            bounds=bounds,
            constraints=constraints,
        )

    def _objective_on(self, model: LinearModel) -> Objective:
        """Return the weights on the model's states, with those of command changes and of the last state."""
        objective = self.objective()
        moves = None
        if self.move_weight is not None:
            moves = self.move_weight * np.eye(N_ROTORS)
        objective = replace(objective, C_r=_widened(objective.C_r, model.n), Q_d=moves)
        if self.terminal == "lqr":
            objective = replace(objective, P=lqr_terminal_weight(model, objective))
        return objective

    def _tightened_bounds(self, vehicle: Vehicle, period: float, n: int) -> Bounds:
        """Return the bounds on a model of n states, soft and tightened as the table says."""
        bounds = self.bounds()
        return replace(
            bounds,
            C_c=_widened(bounds.C_c, n),
            penalty=self._penalty(),
            margins=self.margins(vehicle, period),
        )

    def _widened_constraints(self, vehicle: Vehicle, n: int) -> tuple[Constraint, ...]:
        """Return the rows in addition to the bounds, on a model of n states."""
        constraints = []
        for constraint in self.constraints(vehicle):
            if constraint.C is not None:
                constraint = replace(constraint, C=_widened(constraint.C, n))
            constraints.append(constraint)
        return tuple(constraints)

    def _penalty(self) -> Penalty | None:
        """Return the penalty of the output bounds; None where they are hard."""
        if self.soft is None:
            return None
        return self.soft.penalty(len(self.output_bounds))

    def _model(self, vehicle: Vehicle, period: float) -> LinearModel:
        """Return the prediction model: with rotor speeds as states if they lag, or above an autopilot."""
        if self.commands != ROTORS:
            if self.turns_by_attitude:
                require_attitude_lag(self.attitude_lag)
            return self.level_hover(vehicle, period)
        if self.moment:
            vehicle.require_moment("controller")
        lag = resolved_lag(self.rotor_lag, vehicle)
        A_c, B_c = continuous_model(vehicle, lag, moment=self.moment)
        A, B = discretise(A_c, B_c, period)
        return LinearModel(A=A, B=B, u_bar=hover_model(vehicle, period).u_bar, period=period)

    def _target_constraints(self, vehicle: Vehicle) -> tuple[Constraint, Constraint]:
        """Return the bounds on outputs and on an autopilot's targets as constraints."""
        C_c, lower, upper = self.output_limits()
        names = [name for name in STATE_NAMES if name in self.output_bounds]
        outputs = Constraint(
            name="outputs",
            lower=lower,
            upper=upper,
            C=C_c,
            penalty=self._penalty(),
            origins=tuple(origin_of_state(INDEX[name]) for name in names),
        )
        bounds = self.actuators(vehicle)
        thrust = Origin("target of thrust", "N")
        rates = [Origin(f"target of body rate {axis}", "deg/s", math.degrees(1.0)) for axis in "xyz"]
        targets = Constraint(
            name="targets",
            lower=bounds.u_min,
            upper=bounds.u_max,
            D=np.eye(N_ROTORS),
            origins=(thrust, *rates),
        )
        return outputs, targets

    def solver_name(self, problem: Problem, space: Space | None) -> str:
        """See `quadsim.mpc.tables.bounded.Bounded.solver_name`: if none is stated, the core where it takes the problem.

        It does not take half-spaces, which differ from step to step.
        """
        from quadsim.mpc.solvers.core import core_problem

        if self.solver is not None or space is not None:
            return super().solver_name(problem, space)
        try:
            core_problem(problem)
        except ParameterError:
            return USUAL_SOLVER
        return CORE

    def margins(self, vehicle: Vehicle, period: float) -> Array | None:
        """Return by how much the output bounds are tightened at each predicted state, (N, n_c); None if they are not.

        Raises:
            ParameterError: the bounds are too narrow for that.
        """
        if self.tightening is None:
            return None
        return margins(bounds=self.bounds(), **self._tightening_inputs(vehicle, period))

    def position_margins(self, vehicle: Vehicle, period: float) -> Array | None:
        """See `quadsim.mpc.tables.bounded.Bounded.position_margins`."""
        if self.tightening is None:
            return None
        return position_margins(**self._tightening_inputs(vehicle, period))

    def _tightening_inputs(self, vehicle: Vehicle, period: float) -> dict[str, Any]:
        """Return the arguments that `margins` and `position_margins` of `quadsim.mpc.problem.tightening` share."""
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


def _require_unturned(name: str, states: Sequence[str]) -> None:
    """Refuse bounds on states that depend on the yaw of the axes, where these are turned by the measured yaw."""
    turned = [state for state in states if state in TURNED]
    if turned:
        raise ValueError(
            f"{name} must not be of {', '.join(turned)} where heading turns the model: "
            'heading = false, or type = "nonlinear"'
        )


def _widened(matrix: Array, n: int) -> Array:
    """Extend rows on 12 states by zeros to rows on n states."""
    zeros = np.zeros((len(matrix), n - matrix.shape[1]))
    return np.hstack([matrix, zeros])
