"""An MPC for vehicles as they are: soft output bounds, rotors that lag, known delays, disturbances, any heading.

Each part is a setting of its own and absent unless it is given; without any it is the paper's optimisation.

The hover model is anchored where the vehicle rests against the estimated disturbance, (x_s, u_s) of `mpc.equilibrium`,

    x(k+1) = x_s + A (x(k) - x_s) + B (u(k) - u_s),

and u_s is the input that the cost pulls to.  Rest there is then predicted exactly, and tracking has no steady error,
whatever A and B are worth.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Final

import numpy as np

from mpc.actuators import BOUND_TOLERANCE, ActuatorBounds
from mpc.equilibrium import equilibrium
from mpc.heading import predict_in_heading_frame, turn_horizontally
from mpc.linearise import linearise
from mpc.model import continuous_model, discretise, hover_model
from mpc.nonlinear import NonlinearModel, advance, nonlinear_model
from mpc.observer import DisturbanceObserver
from mpc.observer import ObserverSettings as ObserverSettings
from mpc.problem import Bounds, Objective
from mpc.qp import Solution
from mpc.reckoning import PLAUSIBLE
from mpc.robust_settings import Linearisation as Linearisation
from mpc.robust_settings import RobustSettings as RobustSettings
from mpc.stagewise import StagewiseAnswer, StagewiseQP
from quadsim.controller import GROUNDED, SOLVED, Command, Moment, Phase, stopped
from quadsim.errors import ParameterError
from quadsim.state import INDEX, N_STATES, REFERENCE_STATES, Array
from quadsim.vehicle import N_ROTORS, Vehicle

TOLERANCE: Final = 1e-8
"""PIQP's own.  A tenth of it, as for the paper's QP, takes three of twenty iterations more where tilt is at its bound,
and on the paper's course changes no command by more than 1e-4 rad/s."""
_YAW: Final = INDEX["yaw"]
_REFERENCE: Final = list(REFERENCE_STATES)


class RobustMPC:
    """One stagewise QP per period; see the module.

    It keeps no plan for bad times: what is not solved is said so by the status, with the command in force, for
    `mpc.fallback.Guarded` to act on.

    Args:
        vehicle: what is believed to fly.
        period: control period tau_s [s].
        horizon: N.
        objective: for the paper's 12 states.
        bounds: likewise.
        settings: the parts.

    Raises:
        ParameterError: a number or a shape is not possible.
    """

    name: Final = "robust"
    solver: Final = "piqp-stagewise"

    def __init__(
        self,
        vehicle: Vehicle,
        *,
        period: float,
        horizon: int,
        objective: Objective,
        bounds: Bounds,
        settings: RobustSettings,
    ) -> None:
        if settings.delay > period:
            raise ParameterError("controller", "delay", settings.delay, f"at most the control period of {period} s")
        self.settings, self.horizon, self._period = settings, horizon, period
        self._nominal = hover_model(vehicle, period)
        self._model = nonlinear_model(vehicle, period, rotor_lag=settings.rotor_lag or None)
        self._objective = objective
        self._actuators = ActuatorBounds(
            u_min=bounds.u_min, u_max=bounds.u_max, delta_min=bounds.delta_min, delta_max=bounds.delta_max
        )
        n = self._model.n
        self._qp = StagewiseQP(
            horizon,
            n,
            N_ROTORS,
            replace(objective, C_r=_widened(objective.C_r, n)),
            replace(bounds, C_c=_widened(bounds.C_c, n)),
            settings.penalty,
            move_weight=settings.move_weight,
            margins=settings.margins,
            tolerance=TOLERANCE,
        )
        A, B = _hover_matrices(vehicle, self._model)
        self._hover = self._qp.prepare(np.tile(A, (horizon, 1, 1)), np.tile(B, (horizon, 1, 1)))
        self._observer = None if settings.observer is None else DisturbanceObserver(settings.observer, period)
        self.reset(np.full(N_ROTORS, vehicle.hover_speed))

    def reset(self, speeds: Array) -> None:
        """Start anew after the command u(-1) (4,) [rad/s], with rotors at that speed."""
        self._acting = np.array(speeds, float)
        # Rotor speeds and state at the instant from which this period's command acts, the delay after its beginning.
        self._rotors = self._acting.copy()
        self._ahead: Array | None = None
        self._plan: tuple[Array, Array] | None = None
        if self._observer is not None:
            self._observer.reset()

    @np.errstate(over="ignore", invalid="ignore", divide="ignore")  # numbers out of hand are refused, not warned of
    def step(self, now: Moment, state: Array, reference: Array) -> Command:
        """See `quadsim.controller.Controller.step`.

        Numbers that are not finite, not `mpc.reckoning.PLAUSIBLE`, or lead to such are answered with the status
        `invalid_data`, and nothing is learned from them.
        """
        if now.acting is not None:
            self._acting = np.array(now.acting, float)
        rest = self._period - self.settings.delay
        ahead, before = self._ahead, self._rotors
        rotors = _spun(self._model, before, self._acting, rest)
        self._rotors = _spun(self._model, rotors, self._acting, self.settings.delay)
        self._ahead = None
        if now.phase in GROUNDED:
            return self._stop(now.phase)
        if not ((np.abs(state) <= PLAUSIBLE).all() and (np.abs(reference) <= PLAUSIBLE[_REFERENCE]).all()):
            return self._refuse("invalid_data")
        if self._observer is not None and ahead is not None and now.phase is Phase.FLYING:
            expected = self._after(rest, ahead, before)
            if np.isfinite(expected).all():
                self._observer.update(state, expected)
        x0 = self._after(self.settings.delay, state, rotors)
        if not np.isfinite(x0).all():
            return self._refuse("invalid_data")
        if now.phase is Phase.FLYING:  # before, the ground holds the vehicle, which is nothing to learn from
            self._ahead = x0
        answer = self._solve(np.concatenate([x0, self._rotors])[: self._model.n], self._later(reference))
        status = self._verdict(answer)
        if status != SOLVED:
            return self._refuse(status, answer.solution)
        self._plan = answer.states, answer.plan
        plan = answer.plan.copy()
        self._acting = plan[0] = self._actuators.clip(plan[0], self._acting)
        return _command(plan, SOLVED, answer.solution, float(np.max(answer.slack, initial=0.0)))

    def predict(self, states: Array, plans: Array) -> Array:
        """See `quadsim.controller.Controller.predict`.

        It is always the hover model that predicts, turned by each yaw: a plan flown without feedback may take the
        nonlinear one past a pitch of 90 deg, where its Euler angles end.
        """
        return predict_in_heading_frame(self._nominal, states, plans)

    @property
    def disturbance(self) -> Array:
        """(6,) estimated acceleration, world [m/s^2], and angular acceleration, body [rad/s^2]."""
        return np.zeros(6) if self._observer is None else self._observer.estimate.copy()

    def _stop(self, phase: Phase) -> Command:
        self._acting, _ = self._actuators.reach(self._acting)
        self._plan = None
        if self._observer is not None:
            self._observer.reset()
        return stopped(self._acting.copy(), self.horizon, phase)

    def _refuse(self, status: str, solution: Solution | None = None) -> Command:
        """The command in force, with what speaks against another."""
        self._plan = None
        plan = np.tile(self._acting, (self.horizon, 1))
        if solution is None:
            return Command(speeds=plan[0].copy(), plan=plan, status=status)
        return _command(plan, status, solution)

    def _verdict(self, answer: StagewiseAnswer) -> str:
        """`solved`, or why the answer must not be used."""
        if answer.solution.status != SOLVED:
            return answer.solution.status
        if not np.isfinite(answer.plan).all():
            return "not_finite"
        lower, upper = self._actuators.reach(self._acting)
        first = answer.plan[0]
        return SOLVED if np.maximum(lower - first, first - upper).max() <= BOUND_TOLERANCE else "out_of_bounds"

    def _after(self, time: float, state: Array, rotors: Array) -> Array:
        """State (12,) some time [s] after a state (12,) with such rotor speeds (4,), under the command in force."""
        if time <= 1e-9:
            return state
        model = replace(self._disturbed(self._model), period=time)
        end = advance(model, np.concatenate([state, rotors])[: model.n], self._acting)
        return end[:N_STATES]

    def _disturbed(self, model: NonlinearModel) -> NonlinearModel:
        estimate = self.disturbance
        return replace(model, acceleration=estimate[:3], angular_acceleration=estimate[3:])

    def _later(self, reference: Array) -> Array:
        """The reference (N, 4) at the instants that the prediction is for, the delay later."""
        later = np.concatenate([reference[1:], reference[-1:]])
        return reference + self.settings.delay / self._period * (later - reference)

    def _solve(self, x0: Array, reference: Array) -> StagewiseAnswer:
        model, yaw = self._disturbed(self._model), float(x0[_YAW])
        if self.settings.linearisation is not Linearisation.HOVER:
            _, u_s = equilibrium(model)
            desired = self._objective.desired(_turning(reference, yaw, self.settings.largest_turn))
            return self._qp.solve(*self._relinearised(model, x0), x0, desired, self._acting, u_s)
        if not self.settings.heading:
            yaw = 0.0
        else:
            reference = _turning(reference, yaw, self.settings.largest_turn)
            x0 = turn_horizontally(x0, np.array(-yaw))
            x0[_YAW] = 0.0
        x_s, u_s = equilibrium(model, yaw)
        held, N = self._hover, self.horizon
        c = np.broadcast_to(x_s - held.A[0] @ x_s - held.B[0] @ u_s, (N, x_s.size))
        desired = self._objective.desired(_seen_from(reference, yaw))
        return self._qp.solve_prepared(held, c, x0, desired, self._acting, u_s)

    def _relinearised(self, model: NonlinearModel, x0: Array) -> tuple[Array, Array, Array]:
        """A (N, n, n), B (N, n, 4), c (N, n) of the predicted steps."""
        if self.settings.linearisation is Linearisation.STATE or self._plan is None:
            A, B, c = linearise(model, x0[None], self._acting[None])
            return np.repeat(A, self.horizon, 0), np.repeat(B, self.horizon, 0), np.repeat(c, self.horizon, 0)
        states, plan = self._plan
        # A period later, what was predicted for the end of the first step is now; the last input is held for one more.
        along, inputs = states.copy(), np.concatenate([plan[1:], plan[-1:]])
        along[:, _YAW] += math.tau * round((x0[_YAW] - along[0, _YAW]) / math.tau)
        along[0] = x0
        return linearise(model, along, inputs)


def _command(plan: Array, status: str, solution: Solution, slack: float = 0.0) -> Command:
    return Command(
        speeds=plan[0].copy(),
        plan=plan,
        status=status,
        iterations=solution.iterations,
        active=solution.active if status == SOLVED else 0,
        slack=slack,
        primal_residual=solution.primal_residual,
        dual_residual=solution.dual_residual,
        solve_s=solution.solve_s,
    )


def _hover_matrices(vehicle: Vehicle, model: NonlinearModel) -> tuple[Array, Array]:
    """A (n, n), B (n, 4) at hover with zero yaw: Eq. (1), or with d(w)/dt = (u - w) / tau_r between."""
    A_c, B_c = continuous_model(vehicle)
    if model.rotor_lag is not None:
        follow = np.eye(N_ROTORS) / model.rotor_lag
        A_c = np.block([[A_c, B_c], [np.zeros((N_ROTORS, N_STATES)), -follow]])
        B_c = np.concatenate([np.zeros((N_STATES, N_ROTORS)), follow])
    return discretise(A_c, B_c, model.period)


def _spun(model: NonlinearModel, rotors: Array, command: Array, time: float) -> Array:
    """Rotor speeds (4,) some time [s] after speeds (4,) under a command (4,) [rad/s]."""
    if model.rotor_lag is None:
        return command
    return command + math.exp(-time / model.rotor_lag) * (rotors - command)


def _turning(reference: Array, yaw: float, largest: float) -> Array:
    """The reference (N, 4) with a yaw that starts from the present one and has no larger jumps [rad]."""
    turned = reference.copy()
    turned[:, 3] = yaw + np.cumsum(np.clip(np.diff(reference[:, 3], prepend=yaw), -largest, largest))
    return turned


def _seen_from(reference: Array, yaw: float) -> Array:
    """The reference (N, 4) in axes turned by a yaw [rad]."""
    cosine, sine = math.cos(yaw), math.sin(yaw)
    seen = reference.copy()
    seen[:, :2] = reference[:, :2] @ np.array([[cosine, -sine], [sine, cosine]])
    seen[:, 3] -= yaw
    return seen


def _widened(matrix: Array, n: int) -> Array:
    """Rows over 12 states as rows over n."""
    return np.hstack([matrix, np.zeros((len(matrix), n - matrix.shape[1]))])
