"""`[controller] type = "nonlinear"`: the nonlinear MPC, with fields for its model, weights, bounds and iteration.

The table states the optimal control problem of `quadsim.mpc.laws.parts.nonlinear_mpc`, which solves it by sequential
quadratic programming on the rigid body with a quaternion (`quadsim.mpc.problem.rigidbody`), at any attitude.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated, ClassVar, Final, Literal

import numpy as np
from annotated_types import Ge, Gt, Le, Len, Lt, MaxLen, doc

from quadsim import shorthands
from quadsim.controller import ROTORS, Controller
from quadsim.core.mirror import constant
from quadsim.errors import ParameterError
from quadsim.fields import NonNegative, Pair, Seconds, Weight
from quadsim.input_limits import MOST_ENTRIES
from quadsim.mpc.estimate.disturbance import RampSettings
from quadsim.mpc.estimate.observer import ObserverSettings
from quadsim.mpc.guard.answer import ActuatorBounds
from quadsim.mpc.guard.settings import USUAL_FALLBACK, FallbackSettings
from quadsim.mpc.laws import register
from quadsim.mpc.pilot.indi import INDISettings, TorqueIncrement, require_one_scale
from quadsim.mpc.problem.constraints import Constraint, Soft, origin_of_state, selection
from quadsim.mpc.problem.polytope import Polytope, rows_of
from quadsim.mpc.problem.qp import KKT_EVERY
from quadsim.mpc.problem.rigidbody import RATE_SCALE
from quadsim.mpc.space import Avoidance, Shape, Space
from quadsim.mpc.tables.climb import CLIMB, ClimbBounds, climbing_targets, require_climb, within_tilt
from quadsim.mpc.tables.commands import (
    COMMANDS,
    TARGET_BOUNDS,
    USUAL_TARGETS,
    Rates,
    RotorBounds,
    TargetBounds,
    require_space,
)
from quadsim.mpc.tables.controller import Horizon, KktEvery, Range, ranges, require_ordered
from quadsim.mpc.tables.lags import (
    ATTITUDE_LAG,
    INNER_LAG,
    AttitudeLag,
    InnerLag,
    Lag,
    LagSeconds,
    require_attitude_lag,
    require_lag,
    require_lags,
)
from quadsim.mpc.tables.targets import TargetTable
from quadsim.state import INDEX, Array
from quadsim.vehicle import Vehicle

MOST_LATE: Final = constant("QUADSIM_MOST_LATE")
"""Most control periods of a delay."""
TRANSLATION: Final = ("x", "vx", "y", "vy", "z", "vz")
"""States of the linear models that the quaternion model has as well, so that bounds on them are rows of both."""
VEHICLES_SPEEDS: Final = RotorBounds()
"""The bounds on rotor speeds of a table that states none: the vehicle's."""
Drag = Annotated[tuple[NonNegative, ...], Len(3, 3)]

AxisWeights = Weight | Annotated[Sequence[Weight], Len(3, 3)]
"""One weight for three axes, or one per axis."""


@dataclass(frozen=True, kw_only=True)
class Weights:
    """Weights of squared distances from the reference."""

    position: Annotated[AxisWeights, doc("[1/m^2] one weight, or x, y, z")] = 10.0
    attitude: Annotated[AxisWeights, doc("[1/rad^2] one weight, or about body x, y, z")] = 0.1
    velocity: Annotated[AxisWeights, doc("[1/(m/s)^2] one weight, or x, y, z")] = 0.05
    body_rates: Annotated[AxisWeights, doc("[1/(rad/s)^2] one weight, or about body x, y, z")] = 0.05
    input: Annotated[
        Weight,
        doc(
            "[-] weight of the inputs' distance from the reference, as shares of the rotors' largest; of targets, as "
            f"shares of the weight and of {RATE_SCALE:g} rad/s"
        ),
    ] = 0.1
    move: Annotated[NonNegative, doc("[-] weight of the inputs' change from node to node, as shares")] = 0.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            weights = np.asarray(value, float)
            shapes: tuple[tuple[int, ...], ...] = ((), (3,))
            rule = "positive: one number, or three"
            if name in ("input", "move"):
                shapes = ((),)
                rule = "one positive number"
            in_range = weights > 0.0
            if name == "move":
                in_range = weights >= 0.0
            if weights.shape not in shapes or not (in_range & np.isfinite(weights)).all():
                raise ParameterError("controller.weights", name, value, rule)
            if weights.ndim:
                object.__setattr__(self, name, tuple(weights.tolist()))


_USUAL = Weights()


def _three(weight: AxisWeights) -> Array:
    """Return one number per axis (3,)."""
    return np.broadcast_to(np.asarray(weight, float), 3)


@register(
    title="nonlinear MPC",
    description="nonlinear MPC at any attitude: a quaternion model, sequential quadratic programming",
    place=4,
)
@dataclass(frozen=True, kw_only=True)
class Nonlinear(TargetTable):
    """Nonlinear MPC at any attitude: steps of sequential quadratic programming in every period.

    Examples:
        >>> import quadsim
        >>> from quadsim import mpc
        >>> table = mpc.Nonlinear(horizon=30, rotor_lag=0.02)
        >>> controller = table.law(quadsim.load_vehicle("hummingbird"), 0.05)
        >>> controller.horizon, controller.model.n  # 13 of the body, 4 of the rotors
        (30, 17)
    """

    any_attitude: ClassVar = True

    type: Annotated[Literal["nonlinear"], doc("the controller, by its name in `quadsim list`")] = "nonlinear"
    horizon: Annotated[Horizon, doc("[periods] prediction horizon, a whole number of nodes")] = 20
    node: Annotated[Seconds | None, doc("[s] time between nodes, whole periods; absent: one period")] = None
    iterations: Annotated[
        int,
        Ge(1),
        Le(100),
        doc("most steps of sequential quadratic programming in a period; 1: the real-time iteration"),
    ] = 1
    time_limit: Annotated[
        Seconds | None,
        doc(
            "[s] wall-clock time after which a period takes no further step; one is always taken; absent: no limit; "
            "with one, a flight depends on the machine and is not reproducible"
        ),
    ] = None
    shift: Annotated[
        bool | None, doc("whether the last plan is shifted by a node; absent: if a node lasts one period")
    ] = None
    substeps: Annotated[int, Ge(1), Le(100), doc("Runge-Kutta steps per node")] = 1
    commands: Annotated[Literal["rotors", "rates", "attitude"], doc(COMMANDS)] = "rotors"
    inner_lag: Annotated[InnerLag | None, doc(INNER_LAG)] = None
    attitude_lag: Annotated[AttitudeLag | None, doc(ATTITUDE_LAG)] = None
    target_bounds: Annotated[TargetBounds, doc(TARGET_BOUNDS)] = USUAL_TARGETS
    inputs: Annotated[Literal["thrust", "speed"], doc("quantity of the inputs, as shares of the rotors' largest")] = (
        "thrust"
    )
    weights: Weights = _USUAL
    attitude_error: Annotated[
        Literal["error-state", "difference"],
        doc(
            "error-state: twice the vector part of q_r* q, the angle to first order; difference: the four components "
            "of q - q_r"
        ),
    ] = "error-state"
    terminal: Annotated[
        NonNegative | Literal["none", "lqr"],
        doc("weight of the last node: none, lqr, or a factor on the weight of the others"),
    ] = "none"
    rotor_lag: Annotated[
        Lag,
        doc('[s] rotor time constant in the prediction, 0 for none; "vehicle": its rotor_rise'),
    ] = 0.0
    delay: Annotated[
        LagSeconds,
        doc(
            f"[s] known delay from measurement to command, bridged by prediction; at most the horizon and {MOST_LATE} "
            "control periods; targets of an autopilot: below one"
        ),
    ] = 0.0
    drag: Annotated[Drag, doc("[N s/m] linear drag in the prediction, along body x, y, z")] = (0.0, 0.0, 0.0)
    quadratic_drag: Annotated[Drag, doc("[N s^2/m^2] drag on the square of each component")] = (
        0.0,
        0.0,
        0.0,
    )
    moment: Annotated[
        bool,
        doc("whether the prediction has the vehicle's rotor_moment, inflow_moment, inflow, in still air, rate_damping"),
    ] = False
    output_bounds: Annotated[
        dict[str, Pair], doc("[m, m/s] lower and upper bound, of positions and velocities by their states' names")
    ] = field(default_factory=dict)
    tilt: Annotated[
        Annotated[float, Gt(0.0), Lt(90.0)] | None,
        doc("[deg] largest angle between thrust axis and vertical; absent: no bound"),
    ] = None
    body_rate: Annotated[
        Rates | None, doc("[deg/s] largest magnitude, one or about body x, y, z; absent: no bound")
    ] = None
    soft: Annotated[Soft | None, doc("penalty of the three above; absent: hard")] = None
    climb_acceleration: ClimbBounds = None
    avoidance: Annotated[
        Avoidance | None,
        doc("absent: the controller ignores obstacles, corridors and fence; the audit does not"),
    ] = None
    polytopes: Annotated[
        tuple[Polytope, ...],
        MaxLen(MOST_ENTRIES),
        doc("linear constraints on positions, velocities and, as inputs, rotor speeds; audited as well"),
    ] = ()
    offset_free: ObserverSettings | None = None
    disturbance: Annotated[
        RampSettings | None,
        doc("absent: no drag is fitted, no changing force followed; not beside offset_free"),
    ] = None
    indi: Annotated[INDISettings | None, doc("absent: rotors hold each command for a period")] = None
    input_bounds: RotorBounds = VEHICLES_SPEEDS
    fallback: FallbackSettings = USUAL_FALLBACK
    kkt_every: KktEvery = KKT_EVERY

    def __post_init__(self) -> None:
        require_lag(self.rotor_lag)
        if self.attitude_error == "difference" and not isinstance(self.weights.attitude, float):
            rule = 'one number where attitude_error = "difference"'
            raise ParameterError("", "weights.attitude", self.weights.attitude, rule)
        if self.offset_free is not None and self.disturbance is not None:
            raise ValueError("disturbance must be absent where offset_free is given: both estimate the same force")
        require_one_scale(self.indi, self.disturbance)
        self._check_state_bounds()
        self._check_commands()

    def _check_state_bounds(self) -> None:
        """Check `output_bounds` and `climb_acceleration`."""
        for name, pair in self.output_bounds.items():
            if name not in TRANSLATION:
                known = ", ".join(TRANSLATION)
                raise ValueError(f"output_bounds must be of {known}; got {name!r}: tilt bounds the attitude")
            require_ordered(f"output_bounds.{name}", pair)
        require_climb(self.climb_acceleration)
        if self.climb_acceleration is not None and self.tilt is None:
            raise ValueError("tilt must be given with climb_acceleration, or the vehicle turns over to descend")

    def _check_commands(self) -> None:
        """Refuse fields that do not act with these commands and inputs."""
        usual_values_of_rotors = {
            "inputs": "thrust",
            "rotor_lag": 0.0,
            "moment": False,
            "indi": None,
            "input_bounds": VEHICLES_SPEEDS,
        }
        require_space(self, usual_values_of_rotors)
        self._require_polytopes_without_speeds()
        if self.inputs == "thrust" and self.input_bounds.slew is not None:
            raise ValueError(
                'input_bounds.slew must be absent where inputs = "thrust", in which steps of speeds are not linear: '
                f'inputs = "speed"; got {[*self.input_bounds.slew]}'
            )

    def law(self, vehicle: Vehicle, period: float, shapes: Sequence[Shape] = ()) -> Controller:
        """See `quadsim.mpc.tables.controller.ControllerTable.law`."""
        if self.commands != ROTORS:
            require_lags(self.inner_lag)
        if self.turns_by_attitude:
            require_attitude_lag(self.attitude_lag)
        law: Controller = shorthands.nonlinear_mpc(
            vehicle,
            period=period,
            settings=self,
            bounds=self.actuators(vehicle),
            constraints=self.constraints(),
            space=self.space(shapes, vehicle, period),
            kkt_every=self.kkt_every,
        )
        return law

    def audited(self, vehicle: Vehicle) -> dict[str, Range]:
        """See `quadsim.mpc.tables.controller.ControllerTable.audited`."""
        bounds = ranges(self.output_bounds)
        if self.tilt is not None:
            bounds["tilt"] = (-math.inf, self.tilt)
        if self.climb_acceleration is not None:
            bounds |= ranges({CLIMB: self.climb_acceleration})
        if self.body_rate is not None:
            rates = _three(self.body_rate).tolist()
            for axis, rate in zip("xyz", rates, strict=True):
                bounds[f"body_rate_{axis}"] = (-rate, rate)
        if self.commands == ROTORS:
            return bounds | self.input_bounds.audited(vehicle)
        for name, target in self.target_bounds.audited(vehicle).items():
            _, largest = bounds.get(name, target)
            _, largest_target = target
            if name not in bounds or largest_target < largest:  # the tighter of both counts
                bounds[name] = target
        return bounds

    def space(self, shapes: Sequence[Shape], vehicle: Vehicle, period: float) -> Space | None:
        """Return the half-spaces that avoid obstacles and keep within regions, at the nodes; None without avoidance."""
        if self.avoidance is None:
            return None
        stride = self.stride(period)
        step = stride * period
        nodes = self.horizon // stride
        return self.avoidance.space(shapes, vehicle, period=step, horizon=nodes, positions=(0, 1, 2), largest=True)

    def inner_loop(self, vehicle: Vehicle) -> TorqueIncrement | None:
        """See `quadsim.mpc.tables.controller.ControllerTable.inner_loop`."""
        if self.indi is None:
            return None
        return TorqueIncrement(vehicle, self.indi, self.actuators(vehicle))

    def actuators(self, vehicle: Vehicle) -> ActuatorBounds:
        """See `quadsim.mpc.tables.controller.ControllerTable.actuators`."""
        if self.commands == ROTORS:
            return self.input_bounds.actuators(vehicle)
        return climbing_targets(self.target_bounds.actuators(vehicle), vehicle, self.level_climb(vehicle))

    def level_climb(self, vehicle: Vehicle) -> Pair | None:
        """Return bounds on the climb acceleration in level flight; None without `climb_acceleration`.

        They are such that up to the bound on the tilt the vertical acceleration is within `climb_acceleration`.

        Raises:
            ParameterError: hover is not within them.
        """
        if self.climb_acceleration is None or self.tilt is None:
            return None
        return within_tilt(vehicle, self.climb_acceleration, self.tilt)

    def outputs(self) -> tuple[Array, Array]:
        """Return C_r (n_r, 13) and the diagonal of Q_y (n_r,), for states whose quaternion is q_r* q.

        Its vector part is half the angle between both attitudes, to first order: weights of angles count four times.
        Where `attitude_error` is `difference`, the whole quaternion has the weight of attitude as it is.
        """
        weights = self.weights
        if self.attitude_error == "difference":
            rows = np.eye(13)
            attitude = np.full(4, weights.attitude)
        else:
            rows = np.delete(np.eye(13), 3, axis=0)  # without the quaternion's scalar part
            attitude = 4.0 * _three(weights.attitude)
        parts = (_three(weights.position), attitude, _three(weights.velocity), _three(weights.body_rates))
        return rows, np.concatenate(parts)

    @property
    def largest_rates(self) -> Array:
        """(3,) bounds on body rates [rad/s], infinite for none."""
        if self.body_rate is None:
            return np.full(3, math.inf)
        return np.radians(_three(self.body_rate))

    def stride(self, period: float) -> int:
        """Return the number of periods per node."""
        if self.node is None:
            return 1
        stride = round(self.node / period)
        if stride < 1 or not math.isclose(stride * period, self.node, rel_tol=1e-9):
            rule = f"a whole multiple of the control period of {period} s"
            raise ParameterError("controller", "node", self.node, rule)
        if self.horizon % stride:
            rule = f"a whole number of nodes, {stride} periods each"
            raise ParameterError("controller", "horizon", self.horizon, rule)
        return stride

    def constraints(self) -> tuple[Constraint, ...]:
        """Return `output_bounds` and `polytopes` as rows over the 12 states and four rotor speeds."""
        polytopes = rows_of(self.polytopes)
        if not self.output_bounds:
            return polytopes
        names = list(self.output_bounds)
        lower, upper = np.array(list(self.output_bounds.values()), float).T
        penalty = None
        if self.soft is not None:
            penalty = self.soft.penalty(len(names))
        outputs = Constraint(
            name="outputs",
            lower=lower,
            upper=upper,
            C=selection(names),
            penalty=penalty,
            origins=tuple(origin_of_state(INDEX[name]) for name in names),
        )
        return outputs, *polytopes
