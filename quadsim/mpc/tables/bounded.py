"""The fields that the tables `[controller]` of linear MPCs share: weights, bounds, polytopes, avoidance and solver.

Fields are in file units, angles in degrees; `problem`, `bounds` and other methods convert them to SI units.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, ClassVar, Final, Literal

import numpy as np
from annotated_types import Len, MaxLen, doc

from quadsim.controller import CORE, ROTORS
from quadsim.errors import ParameterError, UnknownNameError
from quadsim.fields import Pair, Weight
from quadsim.input_limits import MOST_ENTRIES
from quadsim.mpc.guard.answer import ActuatorBounds
from quadsim.mpc.problem.constraints import Bounds, Constraint, selection
from quadsim.mpc.problem.model import hover_model
from quadsim.mpc.problem.ocp import Objective, Problem, lqr_terminal_weight, objective_of
from quadsim.mpc.problem.polytope import IN_DEGREES, Polytope, rows_of
from quadsim.mpc.problem.qp import KKT_EVERY
from quadsim.mpc.solvers import ALIASES, SOLVERS, Solver, find_solver
from quadsim.mpc.solvers.by_name import make_solver
from quadsim.mpc.space import Avoidance, Shape, Space
from quadsim.mpc.tables.climb import CLIMB, ClimbBounds, climb_of_rotors, require_climb
from quadsim.mpc.tables.commands import InputBounds, InputWeights
from quadsim.mpc.tables.controller import ControllerTable, Horizon, KktEvery, Law, Range, ranges, require_ordered
from quadsim.state import REFERENCE_RATES, STATE_NAMES, Array
from quadsim.vehicle import N_ROTORS, Vehicle

USUAL_SOLVER: Final = "piqp"
"""The QP solver of a controller whose table states none; that of `robust` is the core, where it takes the problem."""


@dataclass(frozen=True, kw_only=True)
class Weighted(ControllerTable):
    """An MPC with constant matrices, which minimises a weighted sum of squares over a horizon."""

    type: Law
    horizon: Annotated[Horizon, doc("[periods] N, the prediction horizon")]
    output_weights: Annotated[
        dict[str, Weight],
        Len(1),
        doc(
            "diagonal of Q_y [1/unit of the state^2, rad for angles]; the states named here are C_r; desired are the "
            "filtered reference's position, yaw, velocity and yaw rate, and 0 for roll, pitch and their rates"
        ),
    ]
    desired_rates: Annotated[
        Literal["reference", "zero"],
        doc(
            "desired velocities and yaw rate where output_weights name them: the filtered reference's, by differences "
            "over the horizon, or zero, which brakes what moves"
        ),
    ] = "reference"
    input_weights: InputWeights
    terminal: Annotated[
        Literal["lqr"] | None,
        doc("weight of the last predicted state: lqr: from the Riccati equation; absent: the weight of all others"),
    ] = None

    def __post_init__(self) -> None:
        require_states(self.output_weights, "output_weights")
        rate_names = [STATE_NAMES[i] for i in REFERENCE_RATES]
        rates = [name for name in rate_names if name in self.output_weights]
        needs_differences = bool(rates) and self.desired_rates == "reference"
        if needs_differences and self.horizon < 2:
            raise ValueError(
                f"horizon must be at least 2 where output_weights have {', '.join(rates)}, whose desired values are "
                f"differences of the reference; got {self.horizon}"
            )

    def problem(self, vehicle: Vehicle, period: float) -> Problem:
        """Return the optimal control problem of each period.

        Raises:
            InputError: no problem can be built from these numbers.
        """
        model = hover_model(vehicle, period)
        objective = self.objective()
        if self.terminal == "lqr":
            objective = replace(objective, P=lqr_terminal_weight(model, objective))
        return Problem(model=model, horizon=self.horizon, objective=objective)

    def objective(self) -> Objective:
        """Return the weights on the 12 states, without a terminal weight."""
        weights = objective_of(self.output_weights, self.input_weights.speed)
        return replace(weights, follows_rates=self.desired_rates == "reference")


@dataclass(frozen=True, kw_only=True)
class Bounded(Weighted):
    """A weighted MPC with bounds on outputs and inputs, further rows, and a QP solver."""

    holds_plans: ClassVar = False  # whether the last plan is flown on where the solver finds no optimum

    output_bounds: Annotated[
        dict[str, Pair], doc("[deg, deg/s, m, m/s] y_c_min, y_c_max; the states named here are C_c")
    ] = field(default_factory=dict)
    input_bounds: InputBounds
    climb_acceleration: ClimbBounds = None
    polytopes: Annotated[
        tuple[Polytope, ...],
        MaxLen(MOST_ENTRIES),
        doc("further linear constraints on states and rotor speeds; audited as well"),
    ] = ()
    avoidance: Annotated[
        Avoidance | None,
        doc("absent: the controller ignores obstacles, corridors and fence; the audit does not"),
    ] = None
    solver: Annotated[
        str | None,
        doc(
            "QP solver used where the unconstrained optimum violates a constraint, by its name in `quadsim list`; "
            f"absent: {CORE} for robust where it takes the problem, else {USUAL_SOLVER}"
        ),
    ] = field(default=None, metadata={"json_schema_extra": {"examples": [*ALIASES, *SOLVERS, CORE]}})
    kkt_every: KktEvery = KKT_EVERY

    def __post_init__(self) -> None:
        super().__post_init__()
        require_states(self.output_bounds, "output_bounds")
        for name, pair in self.output_bounds.items():
            require_ordered(f"output_bounds.{name}", pair)
        require_climb(self.climb_acceleration)
        if self.solver is not None:
            require_solver(self.solver)

    def audited(self, vehicle: Vehicle) -> dict[str, Range]:
        """See `quadsim.mpc.tables.controller.ControllerTable.audited`."""
        return self.audited_motion() | self.input_bounds.audited(vehicle)

    def audited_motion(self) -> dict[str, Range]:
        """Return the audited bounds except those on commands, in file units."""
        bounds = dict(self.output_bounds)
        if self.climb_acceleration is not None:
            bounds[CLIMB] = self.climb_acceleration
        return ranges(bounds)

    def actuators(self, vehicle: Vehicle) -> ActuatorBounds:
        """See `quadsim.mpc.tables.controller.ControllerTable.actuators`."""
        return self.input_bounds.actuators(vehicle)

    def output_limits(self) -> tuple[Array, Array, Array]:
        """Return C_c (n_c, 12), y_min and y_max (n_c,) of the bounds on outputs, in SI units."""
        names = [name for name in STATE_NAMES if name in self.output_bounds]
        lower = np.empty(len(names))
        upper = np.empty(len(names))
        for i, name in enumerate(names):
            unit = 1.0
            if name in IN_DEGREES:
                unit = math.radians(1.0)
            least, most = self.output_bounds[name]
            lower[i] = unit * least
            upper[i] = unit * most
        return selection(names), lower, upper

    def bounds(self) -> Bounds:
        """Return the bounds in SI units."""
        slowest, fastest = self.input_bounds.speed
        down, up = self.input_bounds.slew
        C_c, lower, upper = self.output_limits()
        return Bounds(
            C_c=C_c,
            y_min=lower,
            y_max=upper,
            delta_min=np.full(N_ROTORS, down),
            delta_max=np.full(N_ROTORS, up),
            u_min=np.full(N_ROTORS, slowest),
            u_max=np.full(N_ROTORS, fastest),
        )

    def constraints(self, vehicle: Vehicle) -> tuple[Constraint, ...]:
        """Return the constraints in addition to `bounds`: on the climb acceleration of rotors, and the polytopes."""
        polytopes = rows_of(self.polytopes)
        if self.climb_acceleration is None or self.commands != ROTORS:
            return polytopes
        climb = climb_of_rotors(vehicle, self.climb_acceleration)
        return climb, *polytopes

    def problem(self, vehicle: Vehicle, period: float) -> Problem:
        """See `Weighted.problem`."""
        problem = super().problem(vehicle, period)
        return replace(problem, bounds=self.bounds(), constraints=self.constraints(vehicle))

    def space(self, shapes: Sequence[Shape], vehicle: Vehicle, period: float) -> Space | None:
        """Return the half-spaces that avoid obstacles and keep within regions; None without avoidance."""
        if self.avoidance is None:
            return None
        margins = self.position_margins(vehicle, period)
        return self.avoidance.space(shapes, vehicle, period=period, horizon=self.horizon, margins=margins)

    def position_margins(self, vehicle: Vehicle, period: float) -> Array | None:
        """Return (N, 3) by how much half-spaces are tightened along x, y, z at each predicted state [m], or None."""
        return None

    def make_solver(self, problem: Problem, space: Space | None) -> Solver:
        """Return the problem's solver."""
        if space is not None and self.solver == CORE:
            rule = "a QP solver such as 'piqp' with controller.avoidance, whose half-spaces differ from step to step"
            raise ParameterError("controller", "solver", CORE, rule)
        return make_solver(self.solver_name(problem, space), problem)

    def solver_name(self, problem: Problem, space: Space | None) -> str:
        """Return the name of the problem's solver: the stated one, or the usual one."""
        if self.solver is None:
            return USUAL_SOLVER
        return self.solver


def require_solver(name: str) -> None:
    """Reject an unknown solver."""
    try:
        find_solver(name)
    except UnknownNameError as error:
        raise ValueError(f"solver: {error}") from None


def require_states(values: Mapping[str, object], name: str) -> None:
    """Reject a table with an entry that is not a state."""
    for key in values:
        if key not in STATE_NAMES:
            guess = ""
            near = difflib.get_close_matches(key, STATE_NAMES, n=1)
            if near:
                guess = f"; did you mean {near[0]!r}?"
            raise ValueError(f"{name}.{key} is not a state{guess} (there are: {', '.join(STATE_NAMES)})")
