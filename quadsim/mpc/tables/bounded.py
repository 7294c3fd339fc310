"""The fields that all MPC tables `[controller]` share: weights, bounds, polytopes, avoidance and fallback.

Fields are in file units, angles in degrees; `problem`, `bounds` and other methods convert them to SI units.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Annotated, Any, ClassVar, Final, Literal

import numpy as np
from annotated_types import Ge, Le, Len, MaxLen, doc

from quadsim.controller import CORE, ROTORS
from quadsim.errors import ParameterError, UnknownNameError
from quadsim.fields import NonNegative, Number, Pair, Positive, Weight
from quadsim.input_limits import MOST_ENTRIES
from quadsim.mpc.guard.answer import ActuatorBounds
from quadsim.mpc.guard.settings import FallbackSettings
from quadsim.mpc.pilot.allocation import thrust_to_command
from quadsim.mpc.pilot.indi import INDISettings, TorqueIncrement
from quadsim.mpc.problem.constraints import Bounds, Constraint, Origin, Penalty
from quadsim.mpc.problem.model import SHORTEST_LAG, hover_model
from quadsim.mpc.problem.ocp import Objective, Problem, lqr_terminal_weight
from quadsim.mpc.problem.qp import KKT_EVERY
from quadsim.mpc.solvers import ALIASES, SOLVERS, Solver, find_solver
from quadsim.mpc.solvers.by_name import make_solver
from quadsim.mpc.space import AvoidanceSettings, Shape, Space
from quadsim.state import (
    INDEX,
    N_STATES,
    POSITION,
    REFERENCE_RATES,
    STATE_NAMES,
    STATE_UNITS,
    Array,
    shown_unit,
)
from quadsim.vehicle import N_ROTORS, Vehicle

IN_DEGREES: Final = frozenset(
    name for name, unit in zip(STATE_NAMES, STATE_UNITS, strict=True) if unit.startswith("rad")
)
"""States that scenario files give in degrees (per second)."""
TERMS: Final = (*STATE_NAMES, *(f"speed_{i + 1}" for i in range(N_ROTORS)))
"""The quantities that the rows of a polytope may combine."""
LARGEST_HORIZON: Final = 1000
USUAL_SOLVER: Final = "piqp"
"""The QP solver of a law whose table states none; that of `robust` is the core, where it takes the problem."""
LEAST_THRUST, MOST_THRUST = 0.5, 0.9
"""Default bounds on a target of collective thrust: shares of the weight, and of the largest; see `TargetBounds`."""
Range = tuple[float, float]
Horizon = Annotated[int, Ge(1), Le(LARGEST_HORIZON)]
KktEvery = Annotated[
    int, Ge(1), doc("[periods] interval at which KKT residuals are computed and logged; 1: every period")
]
LagSeconds = Annotated[float, Ge(0.0), Le(10.0)]
Lag = LagSeconds | Literal["vehicle"]  # a time constant, or the one in the vehicle file
Rates = Positive | Annotated[tuple[Positive, ...], Len(3, 3)]
"""One largest magnitude for three body rates, or one per axis."""
RotorWeights = Weight | Annotated[tuple[Weight, ...], Len(N_ROTORS, N_ROTORS)]
"""One weight for all rotors, or one per rotor."""
Price = Annotated[float, Ge(0.0), Le(1e12)]
Law = Annotated[str, doc("the control law, by its name in `quadsim list`")]


class ControllerTable:
    """A table `[controller]`, from which `mpc.builders` builds a controller; what it has no field for is absent."""

    any_attitude: ClassVar = False  # whether the controller reads attitudes as quaternions
    type: str
    horizon: int
    polytopes: tuple[Polytope, ...] = ()
    commands: str = ROTORS
    inner_lag: tuple[float, ...] | None = None  # of what an autopilot flies: a field of each table with `commands`
    indi: INDISettings | None = None
    fallback: FallbackSettings | None = None
    iterations: int = 1
    output_bounds: Mapping[str, Sequence[float]] = MappingProxyType({})

    @property
    def holds_speeds(self) -> bool:
        """Whether rotors turn at each command for a whole period, as the audit of a saved run then checks.

        Not behind an autopilot, nor where an inner loop of the law corrects the speeds.
        """
        return self.commands == ROTORS and self.indi is None

    def audited(self, vehicle: Vehicle) -> dict[str, Range]:
        """Return its hard and soft bounds on audited signals, in file units."""
        return {}

    def inner_loop(self, vehicle: Vehicle) -> TorqueIncrement | None:
        """Return the inner loop that corrects the rotor speeds it commands; None without one."""
        return None


@dataclass(frozen=True, kw_only=True)
class InputWeights:
    """Weights on deviations of the rotor speeds from hover."""

    speed: Annotated[RotorWeights, doc("[1/(rad/s)^2] diagonal of Q_u: one weight for all rotors, or a list of four")]


@dataclass(frozen=True, kw_only=True)
class RotorBounds:
    """Hard bounds on the rotor speeds and their steps, for every rotor."""

    speed: Annotated[Pair | None, doc("[rad/s] absent: the vehicle's range")] = None
    slew: Annotated[Pair | None, doc('[rad/s per period] only where inputs = "speed"; absent: no bound')] = None

    def __post_init__(self) -> None:
        if self.speed is not None:
            require_ordered("speed", self.speed)
            if self.speed[0] < 0.0:
                raise ValueError(f"speed must have a lower bound >= 0 rad/s; got {[*self.speed]}")
        if self.slew is not None:
            require_ordered("slew", self.slew)
            if not self.slew[0] <= 0.0 <= self.slew[1]:
                raise ValueError(f"slew must allow a speed to be held, so contain 0; got {[*self.slew]}")

    def audited(self, vehicle: Vehicle) -> dict[str, Range]:
        """Return the bounds on each rotor's speed [rad/s] and step [rad/s per period], where it has any."""
        pairs = {"speed": self.speed or (vehicle.speed_min, vehicle.speed_max), "slew": self.slew}
        return {name: (pair[0], pair[1]) for name, pair in pairs.items() if pair is not None}

    def actuators(self, vehicle: Vehicle) -> ActuatorBounds:
        """Return the same bounds for the actuators."""
        return ActuatorBounds.alike(**self.audited(vehicle))


@dataclass(frozen=True, kw_only=True)
class TargetBounds:
    """Hard bounds on an inner loop's targets: collective thrust and body rates."""

    thrust: Annotated[
        Pair | None,
        doc(
            f"[N] collective, around the weight; absent: {100 * LEAST_THRUST:g} % of the weight to "
            f"{100 * MOST_THRUST:g} % of the largest, at least half way to it: the rest is for torques"
        ),
    ] = None
    body_rate: Annotated[Rates, doc("[deg/s] largest magnitude, one or about body x, y, z")] = (300.0, 300.0, 90.0)

    def __post_init__(self) -> None:
        if self.thrust is not None:
            require_ordered("thrust", self.thrust)
            if self.thrust[0] < 0.0:
                raise ValueError(f"thrust must have a lower bound >= 0 N; got {[*self.thrust]}")

    def audited(self, vehicle: Vehicle) -> dict[str, Range]:
        """Return the bounds on collective thrust [N] and on each body rate [deg/s]."""
        largest, weight = vehicle.level_thrust(vehicle.speed_max), vehicle.mass * vehicle.gravity
        lower, upper = self.thrust or (LEAST_THRUST * weight, thrust_to_command(largest, weight, MOST_THRUST))
        if not lower < weight < upper:
            rule = f"below and above the weight, {weight:.4g} N"
            raise ParameterError("controller", "target_bounds.thrust", [lower, upper], rule)
        rates = np.broadcast_to(np.asarray(self.body_rate, float), 3).tolist()
        sides = {f"body_rate_{axis}": (-rate, rate) for axis, rate in zip("xyz", rates, strict=True)}
        return {"thrust": (lower, upper), **sides}

    def actuators(self, vehicle: Vehicle) -> ActuatorBounds:
        """Return the same bounds on targets (4,) [N], [rad/s], with unbounded steps."""
        thrust, *rates = self.audited(vehicle).values()
        lower, upper = np.array([thrust, *np.radians(rates)]).T
        steps = np.full(N_ROTORS, math.inf)
        return ActuatorBounds(u_min=lower, u_max=upper, delta_min=-steps, delta_max=steps, targets=True)


USUAL_TARGETS: Final = TargetBounds()


def require_space(table: Any, of_rotors: Mapping[str, object]) -> None:
    """Refuse fields of the other space of commands: those `of_rotors` with an autopilot, of its targets without one.

    `of_rotors` has the names of fields and the values that say nothing; a lag may be 0, or at least `SHORTEST_LAG`.

    Raises:
        ValueError: a field is given that does not act.
    """
    if table.commands == ROTORS:
        others: Mapping[str, object] = {"inner_lag": None, "target_bounds": USUAL_TARGETS}
        reason = "rotor speeds pass no autopilot, whose lags and targets these are"
    else:
        others, reason = of_rotors, "the autopilot turns the rotors; inner_lag and target_bounds describe it"
        if table.disturbance is not None and table.disturbance.rotor_lag is not None:
            raise ValueError(f'disturbance.rotor_lag must be absent where commands = "{table.commands}": {reason}')
        if any(0.0 < lag < SHORTEST_LAG for lag in table.inner_lag or ()):
            raise ParameterError("", "inner_lag", table.inner_lag, f"0, or at least {SHORTEST_LAG:g} s, each")
    for name, usual in others.items():
        if getattr(table, name) != usual:
            raise ValueError(f'{name} must be absent where commands = "{table.commands}": {reason}')


def require_lags(inner_lag: tuple[float, ...] | None) -> tuple[float, ...]:
    """Return the lags of an autopilot; raises ParameterError where there are none."""
    if inner_lag is None:
        rule = "four time constants [s]: give them, or identify them on the vehicle's autopilot before it is built"
        raise ParameterError("controller", "inner_lag", None, rule)
    return inner_lag


@dataclass(frozen=True, kw_only=True)
class InputBounds(RotorBounds):
    """Hard bounds on the rotor speeds and their steps, for every rotor."""

    # `field()` makes them required: without it, they would inherit the defaults of `RotorBounds`.
    speed: Annotated[Pair, doc("[rad/s] u_min, u_max of every rotor.  Eq. (20)")] = field()
    slew: Annotated[Pair, doc("[rad/s per period] delta_min, delta_max of every rotor.  Eq. (15)")] = field()


@dataclass(frozen=True, kw_only=True)
class Soft:
    """The cost of violating a soft bound by e: l1 e + l2 e^2."""

    linear: Annotated[
        Price,
        doc(
            "[1/unit; rad for angles of output_bounds, the row's unit of a polytope] l1: exact if larger than the "
            "multipliers of hard bounds, as 1e8 nearly always is; but a nearly hard bound reacts to model errors like "
            "a hard one"
        ),
    ] = 2e5
    quadratic: Annotated[Price, doc("[1/unit^2] l2")] = 1e4

    def penalty(self, rows: int) -> Penalty:
        """Return the penalty for `rows` rows."""
        return Penalty(l1=np.full(rows, self.linear), l2=np.full(rows, self.quadratic))


@dataclass(frozen=True, kw_only=True)
class Polytope:
    """Linear constraints lower <= A v <= upper on states and rotor speeds.

    For example a geofence, a velocity polytope, a bound on total thrust.  The flight is audited against the same rows,
    at the physics rate.
    """

    name: Annotated[str, doc("name in reports; with several rows name_1, name_2, ...")] = field(
        metadata={"pattern": "^[A-Za-z][A-Za-z0-9_-]*$"}
    )
    of: Annotated[
        tuple[str, ...], Len(1, len(TERMS)), doc("v: states [m, m/s, deg, deg/s], speed_1 to speed_4 [rad/s]")
    ]
    rows: Annotated[tuple[tuple[Number, ...], ...], Len(1, MOST_ENTRIES), doc("A: one list of numbers per row")]
    lower: Annotated[tuple[Number, ...] | None, doc("[unit of the row] one per row; absent: no bound")] = None
    upper: Annotated[tuple[Number, ...] | None, doc("[unit of the row] one per row; absent: no bound")] = None
    soft: Annotated[Soft | None, doc("absent: hard")] = None
    tolerance: Annotated[
        NonNegative | None, doc("[unit of the row] of the audit, at the physics rate; absent: the default")
    ] = None
    tolerance_sampled: Annotated[
        NonNegative | None, doc("[unit of the row] of the audit, at the samples; absent: in proportion to tolerance")
    ] = None
    required: Annotated[bool, doc("false: reported only, without effect on the verdict")] = True

    def __post_init__(self) -> None:
        for name in self.of:
            if name not in TERMS:
                raise ValueError(f"of: {UnknownNameError('signal', name, TERMS)}")
        if len(set(self.of)) < len(self.of):
            raise ValueError(f"of must have distinct names; got {[*self.of]}")
        for row in self.rows:
            if len(row) != len(self.of) or not any(row):
                raise ValueError(f"rows must be lists of {len(self.of)} numbers, not all 0; got {[*row]}")
        if self.lower is None and self.upper is None:
            raise ValueError("lower must be given, or upper, or both")
        for side in ("lower", "upper"):
            bounds = getattr(self, side)
            if bounds is not None and len(bounds) != len(self.rows):
                raise ValueError(f"{side} must have one number per row, {len(self.rows)}; got {[*bounds]}")
        if self.lower is not None and self.upper is not None:
            for below, above in zip(self.lower, self.upper, strict=True):
                if below >= above:
                    raise ValueError(f"lower must be below upper = {above}; got {below}")
        if self.tolerance is not None and (self.tolerance_sampled or 0.0) > self.tolerance:
            rule = f"at most tolerance = {self.tolerance}"
            raise ParameterError("", "tolerance_sampled", self.tolerance_sampled, rule)

    @property
    def row_names(self) -> list[str]:
        """One name per row."""
        return [self.name] if len(self.rows) == 1 else [f"{self.name}_{i + 1}" for i in range(len(self.rows))]

    def constraint(self) -> Constraint:
        """Return the rows over the 12 states and four rotor speeds, in SI units."""
        rows, count = np.array(self.rows, float), len(self.rows)
        C, D = np.zeros((count, N_STATES)), np.zeros((count, N_ROTORS))
        for name, column in zip(self.of, rows.T, strict=True):
            if name in INDEX:
                C[:, INDEX[name]] = column * (math.degrees(1.0) if name in IN_DEGREES else 1.0)
            else:
                D[:, int(name.removeprefix("speed_")) - 1] = column
        return Constraint(
            name=self.name,
            lower=np.full(count, -math.inf) if self.lower is None else np.array(self.lower, float),
            upper=np.full(count, math.inf) if self.upper is None else np.array(self.upper, float),
            C=C,
            D=D,
            penalty=None if self.soft is None else self.soft.penalty(count),
            origins=tuple(map(self._origin, range(count))),
        )

    def _origin(self, row: int) -> Origin:
        units = {_unit(name) for name, factor in zip(self.of, self.rows[row], strict=True) if factor}
        field = f"controller.polytopes.{self.name}"
        unit = units.pop() if len(units) == 1 else "-"
        return Origin(self.row_names[row], unit, field=field, row=row, soft=f"{field}.soft")


def _unit(term: str) -> str:
    """Return the unit in which files state a term of a polytope."""
    return shown_unit(STATE_UNITS[INDEX[term]])[0] if term in INDEX else "rad/s"


@dataclass(frozen=True, kw_only=True)
class Avoidance(AvoidanceSettings):
    """Half-spaces that keep the vehicle clear of obstacles and inside corridors and the fence."""

    soft: Annotated[Soft | None, doc("[1/m, 1/m^2] cost of violating a constraint; absent: hard")] = None

    def space(
        self,
        shapes: Sequence[Shape],
        vehicle: Vehicle,
        *,
        period: float,
        horizon: int,
        margins: Array | None = None,
        positions: Sequence[int] = POSITION,
        largest: bool = False,
    ) -> Space | None:
        """Return the half-spaces of obstacles and regions (`quadsim.mpc.space.Space`); None without any."""
        if not shapes:
            return None
        return Space(
            shapes,
            radius=vehicle.enclosing_radius,
            period=period,
            horizon=horizon,
            settings=self,
            margins=margins,
            penalty=None if self.soft is None else (self.soft.linear, self.soft.quadratic),
            positions=positions,
            largest=largest,
        )


@dataclass(frozen=True, kw_only=True)
class Weighted(ControllerTable):
    """An MPC with constant matrices, which minimises a weighted sum over a horizon."""

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
        rates = [STATE_NAMES[i] for i in REFERENCE_RATES if STATE_NAMES[i] in self.output_weights]
        if self.horizon < 2 and rates and self.desired_rates == "reference":
            raise ValueError(
                f"horizon must be at least 2 where output_weights have {', '.join(rates)}, whose desired values are "
                f"differences of the reference; got {self.horizon}"
            )

    def problem(self, vehicle: Vehicle, period: float) -> Problem:
        """Return the optimal control problem of each period.

        Raises:
            InputError: no problem can be built from these numbers.
        """
        model, objective = hover_model(vehicle, period), self.objective()
        if self.terminal == "lqr":
            objective = replace(objective, P=lqr_terminal_weight(model, objective))
        return Problem(model=model, horizon=self.horizon, objective=objective)

    def objective(self) -> Objective:
        """Return the weights, on the 12 states and without one on the last state."""
        weights = objective_of(self.output_weights, self.input_weights)
        return replace(weights, follows_rates=self.desired_rates == "reference")


@dataclass(frozen=True, kw_only=True)
class Bounded(Weighted):
    """An MPC with bounds."""

    holds_plans: ClassVar = False  # whether the last plan is held where a QP has no answer

    output_bounds: Annotated[
        dict[str, Pair], doc("[deg, deg/s, m, m/s] y_c_min, y_c_max; the states named here are C_c")
    ] = field(default_factory=dict)
    input_bounds: InputBounds
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
        if self.solver is not None:
            require_solver(self.solver)

    def audited(self, vehicle: Vehicle) -> dict[str, Range]:
        """See `ControllerTable.audited`."""
        return ranges(self.output_bounds) | self.input_bounds.audited(vehicle)

    def bounds(self) -> Bounds:
        """Return the bounds in SI units."""
        names = [name for name in STATE_NAMES if name in self.output_bounds]
        scale = np.array([math.radians(1.0) if name in IN_DEGREES else 1.0 for name in names])
        lower, upper = scale * np.array([self.output_bounds[name] for name in names], float).reshape(-1, 2).T
        u_min, u_max = (np.full(N_ROTORS, bound) for bound in self.input_bounds.speed)
        down, up = (np.full(N_ROTORS, bound) for bound in self.input_bounds.slew)
        C_c = selection(names)
        return Bounds(C_c=C_c, y_min=lower, y_max=upper, delta_min=down, delta_max=up, u_min=u_min, u_max=u_max)

    def constraints(self) -> tuple[Constraint, ...]:
        """Return the rows in addition to `bounds`."""
        return rows_of(self.polytopes)

    def problem(self, vehicle: Vehicle, period: float) -> Problem:
        """See `Weighted.problem`."""
        problem = super().problem(vehicle, period)
        return replace(problem, bounds=self.bounds(), constraints=self.constraints())

    def space(self, shapes: Sequence[Shape], vehicle: Vehicle, period: float) -> Space | None:
        """Return the half-spaces of obstacles and regions; None without any."""
        if self.avoidance is None:
            return None
        margins = self.position_margins(vehicle, period)
        return self.avoidance.space(shapes, vehicle, period=period, horizon=self.horizon, margins=margins)

    def position_margins(self, vehicle: Vehicle, period: float) -> Array | None:
        """Return (N, 3) the tightening of half-spaces along x, y, z at each predicted state [m]; None for none."""
        return None

    def make_solver(self, problem: Problem, space: Space | None) -> Solver:
        """Return the problem's solver."""
        if space is not None and self.solver == CORE:
            rule = "a QP solver such as 'piqp' with controller.avoidance, whose half-spaces differ from step to step"
            raise ParameterError("controller", "solver", CORE, rule)
        return make_solver(self.solver_name(problem, space), problem)

    def solver_name(self, problem: Problem, space: Space | None) -> str:
        """Return the name of that solver: the stated one, or the usual one."""
        return self.solver or USUAL_SOLVER


def rows_of(polytopes: Sequence[Polytope]) -> tuple[Constraint, ...]:
    """Return the polytopes as constraints."""
    return tuple(polytope.constraint() for polytope in polytopes)


def ranges(bounds: Mapping[str, Sequence[float]]) -> dict[str, Range]:
    """Return bounds by name, as pairs."""
    return {name: (pair[0], pair[1]) for name, pair in bounds.items()}


def objective_of(output_weights: Mapping[str, float], input_weights: InputWeights) -> Objective:
    """Return C_r, Q_y and Q_u for weights by state name."""
    regulated = [name for name in STATE_NAMES if name in output_weights]
    return Objective(
        C_r=selection(regulated),
        Q_y=np.diag([output_weights[name] for name in regulated]),
        Q_u=np.diag(np.broadcast_to(np.asarray(input_weights.speed, float), N_ROTORS)),
    )


def selection(names: Sequence[str]) -> Array:
    """Return the rows of the identity that select states by name."""
    return np.eye(N_STATES)[[INDEX[name] for name in names]]


def resolved_lag(lag: float | str, vehicle: Vehicle) -> float:
    """Return the rotor time constant that the controller predicts [s].

    Raises:
        ParameterError: the vehicle's is asked for, and is missing or too short.
    """
    if not isinstance(lag, str):
        return lag
    if vehicle.rotor_rise is None:
        rule = f"a number of seconds where the vehicle has no rotor_rise, and {vehicle.name} has none"
        raise ParameterError("controller", "rotor_lag", lag, rule)
    if 0.0 < vehicle.rotor_rise < SHORTEST_LAG:
        rule = f"a number of seconds where the vehicle's rotor_rise is below {SHORTEST_LAG:g} s, as {vehicle.name}'s is"
        raise ParameterError("controller", "rotor_lag", lag, rule)
    return vehicle.rotor_rise


def require_lag(lag: float | str) -> None:
    """Reject a time constant for which gains cannot be computed."""
    if not isinstance(lag, str) and 0.0 < lag < SHORTEST_LAG:
        raise ValueError(f"rotor_lag must be 0, or at least {SHORTEST_LAG:g} s; got {lag:g}")


def require_ordered(name: str, pair: Sequence[float]) -> None:
    """Reject a pair of bounds unless the lower is below the upper."""
    if not pair[0] < pair[1]:
        raise ValueError(f"{name} must have its lower bound below its upper; got {[*pair]}")


def require_solver(name: str) -> None:
    """Reject an unknown solver."""
    try:
        find_solver(name)
    except UnknownNameError as error:
        raise ValueError(f"solver: {error}") from error


def require_states(values: Mapping[str, object], name: str) -> None:
    """Reject a table with an entry that is not a state."""
    for key in values:
        if key not in STATE_NAMES:
            near = difflib.get_close_matches(key, STATE_NAMES, n=1)
            guess = f"; did you mean {near[0]!r}?" if near else ""
            raise ValueError(f"{name}.{key} is not a state{guess} (there are: {', '.join(STATE_NAMES)})")
