"""What the tables `[controller]` of MPCs have in common: weights, bounds, polytopes, avoidance and the fallback.

They are in the units of scenario files, angles in degrees; `build`, `bounds` and the like convert them.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Annotated, ClassVar, Final, Literal

import numpy as np
from annotated_types import Ge, Gt, Le, Len, Lt, MaxLen, doc

from mpc.constraints import Bounds, Constraint, Penalty
from mpc.obstacles import AvoidanceSettings, Shape, Space
from mpc.ocp import Objective, Problem, lqr_terminal_weight
from mpc.qp import KKT_EVERY
from mpc.solvers import ALIASES, CORE_OR_PIQP, SOLVERS, Solver, find_solver, make_solver
from quadsim.controller import CORE, Controller
from quadsim.errors import ExportError, MissingCoreError, ParameterError, UnknownNameError
from quadsim.fields import NonNegative, Number, Pair, Positive, Weight
from quadsim.state import (
    EULER,
    EULER_RATE,
    INDEX,
    N_STATES,
    POSITION,
    STATE_NAMES,
    STATE_UNITS,
    VELOCITY,
    Array,
    read_only,
)
from quadsim.vehicle import N_ROTORS, Vehicle

if TYPE_CHECKING:
    from mpc.answer import ActuatorBounds
    from mpc.core.numbers import Exportable

IN_DEGREES: Final = frozenset(
    name for name, unit in zip(STATE_NAMES, STATE_UNITS, strict=True) if unit.startswith("rad")
)
"""States that scenario files give in degrees (per second)."""
TERMS: Final = (*STATE_NAMES, *(f"speed_{i + 1}" for i in range(N_ROTORS)))
"""What the rows of a polytope are over."""
SHORTEST_LAG: Final = 1e-4  # time constant of rotors [s] below which gains cannot be computed; far below any period
LARGEST_HORIZON: Final = 1000
MOST_ENTRIES: Final = 1000  # of a list of tables
USUAL_TILT: Final = 10.0
"""Largest tilt [deg] of the fallback where none is given."""
_FALLBACK_SHARE: Final = 0.8
"""Tilt of the fallback over the tightest bound on it: the controller finds a vehicle that it can take over."""
_SMALLEST_TILT: Final = 0.5  # with less the fallback cannot hold against anything, whatever the bounds are [deg]

Range = tuple[float, float]
Horizon = Annotated[int, Ge(1), Le(LARGEST_HORIZON)]
KktEvery = Annotated[
    int, Ge(1), doc("[periods] from one whose KKT residuals are computed and logged to the next; 1: all")
]
Seconds = Annotated[float, Ge(0.0), Le(10.0)]
Lag = Seconds | Literal["vehicle"]  # a time constant, or that of the vehicle file
RotorWeights = Weight | Annotated[tuple[Weight, ...], Len(N_ROTORS, N_ROTORS)]
"""One weight for all rotors, or one each."""
Price = Annotated[float, Ge(0.0), Le(1e12)]
Law = Annotated[str, doc("the control law, by its name in `quadsim list`")]


class ControllerTable:
    """A table `[controller]`, which builds the controller that it describes."""

    any_attitude: ClassVar = False  # whether it takes attitudes as quaternions
    polytopes: tuple[Polytope, ...] = ()

    def audited(self, vehicle: Vehicle) -> dict[str, Range]:
        """The bounds that it has on signals of the audit, hard or soft, in the units of the file."""
        return {}

    def build(self, vehicle: Vehicle, period: float, shapes: Sequence[Shape] = ()) -> Controller:
        """The controller, ready to be flown every `period` [s] among obstacles and regions.

        Raises:
            InputError: it cannot be made from these numbers.
        """
        raise NotImplementedError


@dataclass(frozen=True, kw_only=True)
class InputWeights:
    """What it costs to move the rotor speeds away from hover."""

    speed: Annotated[RotorWeights, doc("[1/(rad/s)^2] diagonal of Q_u: one weight for all rotors, or a list of four")]


@dataclass(frozen=True, kw_only=True)
class RotorBounds:
    """Hard bounds on the rotor speeds and their steps, for every rotor."""

    speed: Annotated[Pair | None, doc("[rad/s] absent: what the vehicle's rotors hold")] = None
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
        """The bounds on each rotor's speed [rad/s] and its step [rad/s per period], as far as there are any."""
        pairs = {"speed": self.speed or (vehicle.speed_min, vehicle.speed_max), "slew": self.slew}
        return {name: (pair[0], pair[1]) for name, pair in pairs.items() if pair is not None}

    def actuators(self, vehicle: Vehicle) -> ActuatorBounds:
        """The same for every rotor."""
        from mpc.answer import ActuatorBounds

        return ActuatorBounds.alike(**self.audited(vehicle))


@dataclass(frozen=True, kw_only=True)
class InputBounds(RotorBounds):
    """Hard bounds on the rotor speeds and their steps, for every rotor."""

    speed: Annotated[Pair, doc("[rad/s] u_min, u_max of every rotor.  Eq. (20)")]
    slew: Annotated[Pair, doc("[rad/s per period] delta_min, delta_max of every rotor.  Eq. (15)")]


@dataclass(frozen=True, kw_only=True)
class Soft:
    """What violating a soft bound by e costs: l1 e + l2 e^2."""

    linear: Annotated[
        Price,
        doc(
            "[1/unit; rad for angles of output_bounds, the row's unit of a polytope] l1: exact where it is above the "
            "multipliers that hard bounds would have, as 1e8 nearly always is; but what is nearly hard fights back as "
            "hard where the model errs"
        ),
    ] = 2e5
    quadratic: Annotated[Price, doc("[1/unit^2] l2")] = 1e4

    def penalty(self, rows: int) -> Penalty:
        """The price of violating each of this many rows."""
        return Penalty(l1=np.full(rows, self.linear), l2=np.full(rows, self.quadratic))


@dataclass(frozen=True, kw_only=True)
class Polytope:
    """Rows lower <= A v <= upper.

    Over states and rotor speeds: a geofence, a polytope of velocities, total thrust.  The flight is audited against the
    same rows, at the physics rate.
    """

    name: Annotated[str, doc("what reports call it; of several rows name_1, name_2, ...")] = field(
        metadata={"pattern": "^[A-Za-z][A-Za-z0-9_-]*$"}
    )
    of: Annotated[
        tuple[str, ...], Len(1, len(TERMS)), doc("v: states [m, m/s, deg, deg/s], speed_1 to speed_4 [rad/s]")
    ]
    rows: Annotated[tuple[tuple[Number, ...], ...], Len(1, MOST_ENTRIES), doc("A: one list of numbers per row")]
    lower: Annotated[tuple[Number, ...] | None, doc("[unit of the row] one per row; absent: no bound")] = None
    upper: Annotated[tuple[Number, ...] | None, doc("[unit of the row] one per row; absent: no bound")] = None
    soft: Annotated[Soft | None, doc("absent: hard")] = None
    tolerance: Annotated[NonNegative, doc("[unit of the row] of the audit, at the physics rate")] = 0.0
    tolerance_sampled: Annotated[NonNegative, doc("[unit of the row] of the audit, at the samples")] = 0.0
    required: Annotated[bool, doc("false: measured and reported, never a failure")] = True

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
        if self.tolerance_sampled > self.tolerance:
            rule = f"at most tolerance = {self.tolerance}"
            raise ParameterError("", "tolerance_sampled", self.tolerance_sampled, rule)

    @property
    def row_names(self) -> list[str]:
        """What the rows are called."""
        return [self.name] if len(self.rows) == 1 else [f"{self.name}_{i + 1}" for i in range(len(self.rows))]

    def constraint(self) -> Constraint:
        """The rows over the 12 states and four rotor speeds, each in its own unit."""
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
        )


@dataclass(frozen=True, kw_only=True)
class Avoidance(AvoidanceSettings):
    """Half-spaces that keep clear of obstacles, and within corridors and the fence."""

    soft: Annotated[Soft | None, doc("[1/m, 1/m^2] what violating one costs; absent: hard")] = None

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
        """The half-spaces of obstacles and regions, see `mpc.obstacles.Space`; None where there are neither."""
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
class FallbackSettings:
    """The fallback contract: the shifted plan with an LQR correction, then level hover, then descent.

    A plan is held no longer than its horizon; the tilt of the plan comes on top of `tilt`.
    """

    enabled: Annotated[bool, doc("false: what the controller does without an answer is its own")] = True
    unseen: Annotated[Positive, doc("[s] longest time that predictions replace a missing measurement")] = 1.5
    plan_age: Annotated[Positive, doc("[s] longest time on one shifted plan")] = 1.0
    position: Annotated[Positive, doc("[m] largest distance from that plan")] = 0.5
    velocity: Annotated[Positive, doc("[m/s] the same of a velocity")] = 1.0
    angle: Annotated[Positive, doc("[deg] the same of roll, pitch and yaw")] = 11.5
    rate: Annotated[Positive, doc("[deg/s] the same of their rates")] = 57.3
    hover: Annotated[Positive, doc("[s] longest time in level hover, before the descent")] = 5.0
    sink: Annotated[Positive, doc("[m/s] speed of the descent")] = 0.5
    tilt: Annotated[
        Annotated[float, Gt(0.0), Lt(90.0)] | None,
        doc(
            "[deg] largest tilt commanded; absent: 0.8 of the tightest bound on roll or pitch, so that the controller "
            f"takes over again within its bounds, or {USUAL_TILT:g} where there is none"
        ),
    ] = None
    settled: Annotated[Positive, doc("[m/s] above this horizontal speed it brakes without going back to a place")] = 0.3

    @property
    def distance(self) -> Array:
        """(12,) largest distance from a plan's states [m], [m/s], [rad], [rad/s]."""
        return by_group(self.position, self.velocity, math.radians(self.angle), math.radians(self.rate))

    def around(
        self,
        law: Controller,
        bounds: ActuatorBounds,
        vehicle: Vehicle,
        period: float,
        output_bounds: Mapping[str, Sequence[float]] | None = None,
    ) -> Controller:
        """The law within the fallback contract, its tilt that of the `output_bounds`; the law itself where disabled."""
        from mpc.fallback.contract import Guarded
        from mpc.model import hover_model

        if not self.enabled:
            return law
        settings = self
        if output_bounds is not None and self.tilt is None:
            pairs = (output_bounds[name] for name in ("roll", "pitch") if name in output_bounds)
            tightest = min((_FALLBACK_SHARE * min(-lower, upper) for lower, upper in pairs), default=USUAL_TILT)
            settings = replace(self, tilt=min(max(tightest, _SMALLEST_TILT), USUAL_TILT))
        return Guarded(law, hover_model(vehicle, period), bounds=bounds, settings=settings)


USUAL_FALLBACK: Final = FallbackSettings()


@dataclass(frozen=True, kw_only=True)
class Weighted(ControllerTable):
    """An MPC with fixed matrices: it minimises a weighted sum over a horizon."""

    type: Law
    horizon: Annotated[Horizon, doc("[periods] N, how far it looks ahead")]
    output_weights: Annotated[
        dict[str, Weight],
        Len(1),
        doc("diagonal of Q_y [1/unit of the state^2, rad for angles]; the states named here are C_r"),
    ]
    input_weights: InputWeights
    terminal: Annotated[
        Literal["lqr"] | None,
        doc("weight of the last predicted state: lqr, of the Riccati equation; absent: as of all others"),
    ] = None
    compiled: Annotated[bool, doc("fly the whole law in C, by the compiled core, in place of Python's steps")] = False

    def __post_init__(self) -> None:
        require_states(self.output_weights, "output_weights")

    def problem(self, vehicle: Vehicle, period: float) -> Problem:
        """The optimisation that it solves in each period.

        Raises:
            InputError: it cannot be made from these numbers.
        """
        from mpc.model import hover_model

        model, objective = hover_model(vehicle, period), objective_of(self.output_weights, self.input_weights)
        if self.terminal == "lqr":
            objective = replace(objective, P=lqr_terminal_weight(model, objective))
        return Problem(model=model, horizon=self.horizon, objective=objective)

    def exportable(self, vehicle: Vehicle, period: float, shapes: Sequence[Shape] = ()) -> Exportable:
        """What it is made from in C.

        Raises:
            ExportError: it cannot be exported.
            InputError: it cannot be made from these numbers.
        """
        from mpc.core.numbers import Exportable

        return Exportable(name=self.type, problem=self.problem(vehicle, period), vehicle=vehicle, settings=None)

    def in_c(self, vehicle: Vehicle, period: float, shapes: Sequence[Shape] = ()) -> Controller | None:
        """The law in C; None where it is to be flown in Python.

        Raises:
            MissingCoreError: there is no library.
            ExportError: this law is not there in C.
        """
        if not self.compiled:
            return None
        from mpc.core.law import CompiledMPC
        from mpc.core.library import why_missing

        reason = why_missing()
        if reason is not None:
            raise MissingCoreError(reason, instead="leave out controller.compiled")
        return CompiledMPC(self.exportable(vehicle, period, shapes))


@dataclass(frozen=True, kw_only=True)
class Bounded(Weighted):
    """One that also keeps bounds."""

    output_bounds: Annotated[
        dict[str, Pair], doc("[deg, deg/s, m, m/s] y_c_min, y_c_max; the states named here are C_c")
    ] = field(default_factory=dict)
    input_bounds: InputBounds
    polytopes: Annotated[
        tuple[Polytope, ...],
        MaxLen(MOST_ENTRIES),
        doc("further bounds on sums of states and rotor speeds; audited as well"),
    ] = ()
    avoidance: Annotated[
        Avoidance | None,
        doc("absent: it knows of no obstacles, corridors or fence, which are audited all the same"),
    ] = None
    solver: Annotated[str, doc("who solves what the unconstrained optimum does not, by its name in `quadsim list`")] = (
        field(default="piqp", metadata={"json_schema_extra": {"examples": [*ALIASES, *SOLVERS, CORE, CORE_OR_PIQP]}})
    )
    kkt_every: KktEvery = KKT_EVERY

    def __post_init__(self) -> None:
        super().__post_init__()
        require_states(self.output_bounds, "output_bounds")
        for name, pair in self.output_bounds.items():
            require_ordered(f"output_bounds.{name}", pair)
        require_solver(self.solver)

    def audited(self, vehicle: Vehicle) -> dict[str, Range]:
        """See `ControllerTable.audited`."""
        return ranges(self.output_bounds) | self.input_bounds.audited(vehicle)

    def bounds(self) -> Bounds:
        """The bounds in SI units."""
        names = [name for name in STATE_NAMES if name in self.output_bounds]
        scale = np.array([math.radians(1.0) if name in IN_DEGREES else 1.0 for name in names])
        lower, upper = scale * np.array([self.output_bounds[name] for name in names], float).reshape(-1, 2).T
        u_min, u_max = (np.full(N_ROTORS, bound) for bound in self.input_bounds.speed)
        down, up = (np.full(N_ROTORS, bound) for bound in self.input_bounds.slew)
        C_c = selection(names)
        return Bounds(C_c=C_c, y_min=lower, y_max=upper, delta_min=down, delta_max=up, u_min=u_min, u_max=u_max)

    def constraints(self) -> tuple[Constraint, ...]:
        """The rows beside `bounds`, of every law that has them."""
        return rows_of(self.polytopes)

    def problem(self, vehicle: Vehicle, period: float) -> Problem:
        """See `Weighted.problem`."""
        posed = super().problem(vehicle, period)
        return replace(posed, bounds=self.bounds(), constraints=self.constraints())

    def exportable(self, vehicle: Vehicle, period: float, shapes: Sequence[Shape] = ()) -> Exportable:
        """See `Weighted.exportable`."""
        if self.avoidance is not None and shapes:
            rule = "its half-spaces around obstacles are others in each period: leave out controller.avoidance"
            raise ExportError(rule)
        return super().exportable(vehicle, period)

    def space(self, shapes: Sequence[Shape], vehicle: Vehicle, period: float, margins: Array | None) -> Space | None:
        """The half-spaces of obstacles and regions, with further margins (N, 3) [m]; None where it has none."""
        if self.avoidance is None:
            return None
        return self.avoidance.space(shapes, vehicle, period=period, horizon=self.horizon, margins=margins)

    def make_solver(self, problem: Problem, space: Space | None) -> Solver:
        """The problem's solver."""
        if space is not None and self.solver == CORE:
            rule = "a QP solver such as 'piqp' with controller.avoidance: half-spaces differ from step to step"
            raise ParameterError("controller", "solver", CORE, rule)
        return make_solver("piqp" if space is not None and self.solver == CORE_OR_PIQP else self.solver, problem)

    def guarded(self, law: Controller, fallback: FallbackSettings, vehicle: Vehicle, period: float) -> Controller:
        """The law within the fallback contract."""
        return fallback.around(law, self.input_bounds.actuators(vehicle), vehicle, period, self.output_bounds)


def rows_of(polytopes: Sequence[Polytope]) -> tuple[Constraint, ...]:
    """Further bounds on sums of states and rotor speeds."""
    return tuple(polytope.constraint() for polytope in polytopes)


def ranges(bounds: Mapping[str, Sequence[float]]) -> dict[str, Range]:
    """Bounds by name as pairs."""
    return {name: (pair[0], pair[1]) for name, pair in bounds.items()}


def objective_of(output_weights: Mapping[str, float], input_weights: InputWeights) -> Objective:
    """C_r, Q_y and Q_u of weights by the states' names."""
    regulated = [name for name in STATE_NAMES if name in output_weights]
    return Objective(
        C_r=selection(regulated),
        Q_y=np.diag([output_weights[name] for name in regulated]),
        Q_u=np.diag(np.broadcast_to(np.asarray(input_weights.speed, float), N_ROTORS)),
    )


def selection(names: Sequence[str]) -> Array:
    """Rows of the identity that pick states by name."""
    return np.eye(N_STATES)[[INDEX[name] for name in names]]


def by_group(position: float, velocity: float, angle: float, rate: float) -> Array:
    """(12,) one value for positions, velocities, Euler angles and their rates each."""
    channels = np.empty(N_STATES)
    for group, value in ((POSITION, position), (VELOCITY, velocity), (EULER, angle), (EULER_RATE, rate)):
        channels[list(group)] = value
    return read_only(channels)


def resolved_lag(lag: float | str, vehicle: Vehicle) -> float:
    """The time constant of the rotors that is predicted [s].

    Raises:
        ParameterError: it is to be the vehicle's, which has none, or too short a one.
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
    """Refuse a time constant with which gains cannot be computed."""
    if not isinstance(lag, str) and 0.0 < lag < SHORTEST_LAG:
        raise ValueError(f"rotor_lag must be 0, or at least {SHORTEST_LAG:g} s; got {lag:g}")


def require_ordered(name: str, pair: Sequence[float]) -> None:
    """Refuse a pair of bounds whose lower is not below its upper."""
    if not pair[0] < pair[1]:
        raise ValueError(f"{name} must have its lower bound below its upper; got {[*pair]}")


def require_solver(name: str) -> None:
    """Refuse a solver that is not there."""
    try:
        find_solver(name)
    except UnknownNameError as error:
        raise ValueError(f"solver: {error}") from error


def require_states(values: Mapping[str, object], name: str) -> None:
    """Refuse a table with an entry that is no state."""
    for key in values:
        if key not in STATE_NAMES:
            near = difflib.get_close_matches(key, STATE_NAMES, n=1)
            guess = f"; did you mean {near[0]!r}?" if near else ""
            raise ValueError(f"{name}.{key} is not a state{guess} (there are: {', '.join(STATE_NAMES)})")
