"""The infinite-horizon linear-quadratic regulator, which follows a moving reference.

u = u_bar - K (xi - xi_r) with K from the Riccati equation of the hover model (`quadsim.mpc.problem.regulator`), in axes
turned by the measured yaw, and errors of position limited to what a stated tilt corrects.  Default weights follow
Bryson's rule.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Final, Literal

import numpy as np
from annotated_types import Ge, Le, Len, doc

from quadsim.controller import Command, StepInputs
from quadsim.errors import ParameterError
from quadsim.fields import Weight
from quadsim.mpc.laws import register
from quadsim.mpc.laws.parts.feedback import Baseline, FeedbackLaw
from quadsim.mpc.pilot.allocation import allocate, make_allocation
from quadsim.mpc.problem.heading import turn_horizontally
from quadsim.mpc.problem.model import (
    ACCELERATED,
    LinearModel,
    air_slopes,
    continuous_model,
    discretise,
    hover_model,
)
from quadsim.mpc.problem.ocp import Objective, objective_of
from quadsim.mpc.problem.regulator import stabilising
from quadsim.mpc.space import Shape
from quadsim.mpc.tables.bounded import require_states
from quadsim.mpc.tables.commands import InputWeights
from quadsim.state import (
    EULER_RATE,
    INDEX,
    N_STATES,
    REFERENCE_RATES,
    REFERENCE_STATES,
    STATE_NAMES,
    VELOCITY,
    Array,
    read_only,
)
from quadsim.ties import first_smallest
from quadsim.vehicle import N_ROTORS, Vehicle

LARGEST_DEVIATIONS: Final = {
    "x": 0.5, "vx": 2.0, "y": 0.5, "vy": 2.0, "z": 0.1, "vz": 1.0,
    "roll": 0.3, "roll_rate": 1.5, "pitch": 0.3, "pitch_rate": 1.5, "yaw": 0.5, "yaw_rate": 3.0,
}  # fmt: skip
"""Deviations of equal cost, in each state's unit; `LQR_SPEED_SHARE` is that of the inputs; see `bryson_objective`."""
HORIZONTAL: Final = [INDEX[name] for name in ("x", "vx", "y", "vy")]
TILT: Final = [INDEX[name] for name in ("roll", "pitch")]
_MOVING: Final = [*VELOCITY, *EULER_RATE]
LQR_SPEED_SHARE: Final = 0.05  # deviation of a rotor's speed of the same cost, as a share of the hover speed
LAG_MARGIN: Final = 1.5  # multiple of the vehicle's rotor lag that the loop with default weights must tolerate
_HALVINGS: Final = 12
_SHORTEST_LAG: Final = 1e-4  # [s]


def bryson_objective(vehicle: Vehicle, period: float | None = None, *, moment: bool = False) -> Objective:
    """Weights 1 / (largest deviation)^2 of every state and input: Bryson's rule (Bryson and Ho, 1975).

    The model has no lag.  If the loop with these weights would be unstable with `LAG_MARGIN` times the vehicle's rotor
    lag, the deviation of the rotor speeds is halved until the loop is stable.  Without a period [s] the lag is ignored.

    With the air's `moment` in the models (`continuous_model`), hover is unstable, and a slow loop tolerates no more lag
    than a fast one: where no deviation gives that margin, it is the one whose loop settles fastest with the lag itself.
    """
    deviations = np.array([LARGEST_DEVIATIONS[name] for name in STATE_NAMES])
    share = LQR_SPEED_SHARE
    lag = max(vehicle.rotor_rise or 0.0, vehicle.rotor_fall or 0.0)
    candidates: list[Objective] = []
    for _ in range(_HALVINGS):
        speed = share * vehicle.hover_speed
        objective = Objective(C_r=np.eye(N_STATES), Q_y=np.diag(deviations**-2.0), Q_u=np.eye(N_ROTORS) / speed**2)
        if period is None or LAG_MARGIN * lag < _SHORTEST_LAG:
            return objective
        if _spectral_radius(vehicle, period, objective, LAG_MARGIN * lag, moment) < 1.0:
            return objective
        candidates.append(objective)
        share *= 0.5
    if not moment or period is None:
        return objective
    radii = [_spectral_radius(vehicle, period, candidate, lag, moment) for candidate in candidates]
    return candidates[first_smallest(radii)]


def _spectral_radius(vehicle: Vehicle, period: float, objective: Objective, lag: float, moment: bool) -> float:
    """Return by what factor deviations of an LQR's loop change per period, in the long run, with a rotor lag [s]."""
    A, B = discretise(*continuous_model(vehicle, lag, moment=moment), period)
    K = np.zeros((N_ROTORS, len(A)))
    K[:, :N_STATES] = lqr_gain(hover_model(vehicle, period, moment=moment), objective)
    return float(np.abs(np.linalg.eigvals(A - B @ K)).max())


def lqr_gain(model: LinearModel, objective: Objective) -> Array:
    """K (nu, n) of u = u_bar - K (xi - xi_r), which minimises the infinite sum of xi' C_r' Q_y C_r xi + u' Q_u u.

    K = (Q_u + B' P B)^-1 B' P A, with P the solution of the discrete algebraic Riccati equation.

    Raises:
        ParameterError: no such gain exists, for example because an unstable state has no weight.
    """
    try:
        _, K = stabilising(model.A, model.B, objective.C_r, objective.Q_y, objective.Q_u)
    except ValueError as error:
        rule = f"such that every unweighted state comes to rest: weigh x, y, z and yaw; {error}"
        Q = objective.C_r.T @ objective.Q_y @ objective.C_r
        weights = {}
        for name, weight in zip(STATE_NAMES, Q.diagonal(), strict=True):
            if weight:
                weights[name] = float(weight)
        raise ParameterError("controller", "output_weights", weights, rule) from error
    return read_only(K)


class LQR(FeedbackLaw):
    """u = u_bar - K (xi - xi_r), where the reference state xi_r has the reference's pose and velocity, upright.

    With `moment`, the rotors also balance what the air does at the reference's velocity: u has -S^-1 F (v_r, omega_r)
    more, S the accelerations per rotor speed at hover and F those per velocity and rate (`air_slopes`).

    Speeds beyond the bounds are limited as by `allocate`: thrust, roll and pitch torque take precedence over yaw.  The
    controller is linear up to the largest tilt that errors of x, y and their rates may demand: without that limit, a
    large error demands more tilt than the model, or the vehicle, tolerates.

    Attributes:
        objective: the weights of one period.
        gain: (4, 12) K.

    Examples:
        >>> import numpy as np
        >>> import quadsim
        >>> vehicle = quadsim.load_vehicle("lopes2011")
        >>> controller = quadsim.load("hover", {"controller": "lqr"}).controller.law(vehicle, 0.05)
        >>> A, B = controller.model.A, controller.model.B
        >>> bool(np.abs(np.linalg.eigvals(A - B @ controller.gain)).max() < 1.0)  # the loop is stable
        True
    """

    name: Final = "lqr"

    def __init__(self, vehicle: Vehicle, period: float, settings: LQRTable) -> None:
        if settings.moment:
            vehicle.require_moment("controller")
        super().__init__(vehicle, period, settings, hover_model(vehicle, period, moment=settings.moment))
        self._heading = settings.heading
        self._largest_tilt = math.radians(settings.tilt)
        self.objective = settings.objective(vehicle, period)
        self.gain = lqr_gain(self.model, self.objective)
        self._allocation = make_allocation(vehicle)
        self._balance: Array = np.zeros((N_ROTORS, len(_MOVING)))
        if settings.moment:
            _, B = continuous_model(vehicle)
            self._balance = np.asarray(np.linalg.solve(B[ACCELERATED], air_slopes(vehicle)), np.float64)
        self._tilt_demand = np.linalg.pinv(self.gain[:, TILT]) @ self.gain[:, HORIZONTAL]

    def _command(self, now: StepInputs, state: Array, reference: Array, before: Array) -> Command:
        """Return the bounded command, and a plan from the closed loop of the model."""
        targets = self._targets(reference)
        xi = state
        if self._heading:
            turn = -float(state[INDEX["yaw"]])
            xi = turn_horizontally(state, np.array(turn))
            targets = turn_horizontally(targets, np.full(len(targets), turn))
        plan = np.empty((self.horizon, N_ROTORS))
        for i in range(self.horizon):
            balanced = self.model.u_bar - self._balance @ targets[i, _MOVING]
            speeds = balanced - self.gain @ self._limited(xi - targets[i])
            lower, upper = self.bounds.reach(before)
            # The mixer's priorities matter for the command; the forecast is limited rotor by rotor.
            if i == 0:
                plan[i] = self._held(speeds, lower, upper)
            else:
                plan[i] = np.clip(speeds, lower, upper)
            before = plan[i]
            xi = self.model.A @ xi + self.model.B @ (plan[i] - self.model.u_bar)
        return Command(speeds=plan[0].copy(), plan=plan)

    def _targets(self, reference: Array) -> Array:
        """(N, 12) reference states at t_k .. t_{k+N-1}."""
        value, rate, acceleration = self._operator @ reference
        period = self._period
        poses = np.concatenate([value[None], reference[:-1]])
        rates = rate + period * np.arange(self.horizon)[:, None] * acceleration
        targets = np.zeros((self.horizon, N_STATES))
        targets[:, REFERENCE_STATES] = poses
        targets[:, REFERENCE_RATES] = rates
        return targets

    def _limited(self, error: Array) -> Array:
        """Scale down the horizontal part of the error (12,) where it demands more tilt than allowed.

        K e = K_tilt (tilt + G e_horizontal) + ..., so -G e_horizontal is the tilt that the controller demands.
        """
        demanded = float(np.linalg.norm(self._tilt_demand @ error[HORIZONTAL]))
        if demanded <= self._largest_tilt:
            return error
        limited = error.copy()
        limited[HORIZONTAL] *= self._largest_tilt / demanded
        return limited

    def _held(self, speeds: Array, lower: Array, upper: Array) -> Array:
        """Return speeds (4,) between `lower` and `upper` (4,) [rad/s] whose wrench is closest to that of `speeds`."""
        if ((lower <= speeds) & (speeds <= upper)).all():
            return speeds
        # Thrust is quadratic in speed; a negative speed demands an impossible thrust, and counts with its sign.
        return allocate(self._allocation, self._allocation.wrench(speeds), lower, upper)


@register(
    title="LQR",
    description="infinite-horizon LQR on the hover model, following the reference's velocity",
    place=5,
)
@dataclass(frozen=True, kw_only=True)
class LQRTable(Baseline):
    """LQR over an infinite horizon on the hover model."""

    type: Annotated[Literal["lqr"], doc("the controller, by its name in `quadsim list`")] = "lqr"
    output_weights: Annotated[
        Annotated[dict[str, Weight], Len(1)] | None,
        doc(
            "diagonal of Q_y [1/unit of the state^2, rad for angles], by state name; desired are the filtered "
            "reference's position, yaw, velocity and yaw rate, and 0 for roll, pitch and their rates; absent: "
            "Bryson's rule for all twelve and the inputs"
        ),
    ] = None
    input_weights: Annotated[
        InputWeights | None, doc("[1/(rad/s)^2] diagonal of Q_u; required with output_weights")
    ] = None
    moment: Annotated[
        bool,
        doc(
            "whether the hover model has the vehicle's rotor_moment, rate_damping and inflow, in still air, and the "
            "rotors balance them at the reference's velocity"
        ),
    ] = False
    heading: Annotated[bool, doc("whether errors are turned into axes along the measured yaw")] = True
    tilt: Annotated[float, Ge(0.1), Le(80.0), doc("[deg] largest tilt commanded for position errors")] = 30.0

    def __post_init__(self) -> None:
        if (self.output_weights is None) != (self.input_weights is None):
            raise ValueError("input_weights must be given where output_weights are, and nowhere else")
        require_states(self.output_weights or {}, "output_weights")

    def objective(self, vehicle: Vehicle, period: float) -> Objective:
        """Return the weights of one period."""
        if self.output_weights is None or self.input_weights is None:
            return bryson_objective(vehicle, period, moment=self.moment)
        return objective_of(self.output_weights, self.input_weights.speed)

    def law(self, vehicle: Vehicle, period: float, shapes: Sequence[Shape] = ()) -> LQR:
        """See `quadsim.mpc.tables.controller.ControllerTable.law`."""
        return LQR(vehicle, period, self)
