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
from quadsim.mpc.problem.constraints import Constraint, Origin, Soft, origin_of_state
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

TURNED: Final = frozenset({"x", "vx", "y", "vy", "yaw"})  # states that depend on the yaw of the axes


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
        """Refuse fields of the other space of commands.

        Raises:
            ValueError: a field is missing, or is given and does not act.
        """
        require_targets(self)
        of_rotors: dict[str, object] = {"input_weights": self.input_weights, "input_bounds": self.input_bounds}
        if self.commands == ROTORS:
            missing = [name for name, value in of_rotors.items() if value is None]
            if missing:
                raise ValueError(f"{' and '.join(missing)} must be given where rotors are commanded")
            if self.target_weights is not None:
                raise ValueError('target_weights must be absent where commands = "rotors": these pass no autopilot')
            return
        if self.target_weights is None:
            raise ValueError(f'target_weights must be given where commands = "{self.commands}"')
        of_rotors |= {
            "rotor_lag": self.rotor_lag or None,
            "tightening": self.tightening,
            "move_weight": self.move_weight,
            "moment": self.moment or None,
        }
        for name, value in of_rotors.items():
            if value is not None:
                reason = "the autopilot turns the rotors; inner_lag, target_weights and target_bounds describe it"
                raise ValueError(f'{name} must be absent where commands = "{self.commands}": {reason}')
        self._require_polytopes_without_speeds()

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
        """Return the optimisation of the hover model, with rotor speeds as states if they lag.

        Raises:
            InputError: no problem can be built from these numbers.
        """
        if self.delay > self.horizon * period:
            rule = f"at most the horizon of {self.horizon} periods, {self.horizon * period:g} s"
            raise ParameterError("controller", "delay", self.delay, rule)
        model = self._model(vehicle, period)
        objective = self.objective()
        n = model.n
        moves = None
        if self.move_weight is not None:
            moves = self.move_weight * np.eye(N_ROTORS)
        objective = replace(objective, C_r=_widened(objective.C_r, n), Q_d=moves)
        if self.terminal == "lqr":
            objective = replace(objective, P=lqr_terminal_weight(model, objective))
        if self.commands != ROTORS:
            constraints = (*self._target_constraints(vehicle), *self.constraints(vehicle))
            return Problem(model=model, horizon=self.horizon, objective=objective, constraints=constraints)
        penalty = None
        if self.soft is not None:
            penalty = self.soft.penalty(len(self.output_bounds))
        bounds = self.bounds()
        C_c = _widened(bounds.C_c, n)
        bounds = replace(bounds, C_c=C_c, penalty=penalty, margins=self.margins(vehicle, period))
        parts = []
        for part in self.constraints(vehicle):
            if part.C is not None:
                part = replace(part, C=_widened(part.C, n))
            parts.append(part)
        return Problem(model=model, horizon=self.horizon, objective=objective, bounds=bounds, constraints=tuple(parts))

    def _model(self, vehicle: Vehicle, period: float) -> LinearModel:
        """Return the prediction model: with rotor speeds as states if they lag, or above an autopilot."""
        if self.commands != ROTORS:
            if self.turns_by_attitude:
                require_attitude_lag(self.attitude_lag)
            return self.level_hover(vehicle, period)
        if self.moment:
            vehicle.require_moment("controller")
        lag = resolved_lag(self.rotor_lag, vehicle)
        A, B = discretise(*continuous_model(vehicle, lag, moment=self.moment), period)
        return LinearModel(A=A, B=B, u_bar=hover_model(vehicle, period).u_bar, period=period)

    def _target_constraints(self, vehicle: Vehicle) -> tuple[Constraint, Constraint]:
        """Return the bounds on outputs and on an autopilot's targets as constraints."""
        C_c, lower, upper = self.output_limits()
        names = [name for name in STATE_NAMES if name in self.output_bounds]
        penalty = None
        if self.soft is not None:
            penalty = self.soft.penalty(len(names))
        origins = tuple(origin_of_state(INDEX[name]) for name in names)
        outputs = Constraint(name="outputs", lower=lower, upper=upper, C=C_c, penalty=penalty, origins=origins)
        bounds = self.actuators(vehicle)
        rates = tuple(Origin(f"target of body rate {axis}", "deg/s", math.degrees(1.0)) for axis in "xyz")
        targets = Constraint(
            name="targets",
            lower=bounds.u_min,
            upper=bounds.u_max,
            D=np.eye(N_ROTORS),
            origins=(Origin("target of thrust", "N"), *rates),
        )
        return outputs, targets

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
        if self.tightening is None:
            return None
        return position_margins(**self._tightened(vehicle, period))

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


def _require_unturned(name: str, states: Sequence[str]) -> None:
    """Refuse bounds on states that depend on the yaw of the axes, where these are turned by the measured yaw."""
    turned = [state for state in states if state in TURNED]
    if turned:
        raise ValueError(
            f"{name} must not be of {', '.join(turned)} where heading turns the model: "
            'heading = false, or type = "nonlinear"'
        )


def _widened(matrix: Array, n: int) -> Array:
    """Extend rows over 12 states to n states."""
    return np.hstack([matrix, np.zeros((len(matrix), n - matrix.shape[1]))])
