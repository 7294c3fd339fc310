"""An MPC for imperfect vehicles: soft output bounds, rotor lag, known delays, disturbances, any heading.

Each part has its own setting and is off by default; without any part it solves the paper's optimisation.

The hover model is linearised at the vehicle's equilibrium under the estimated disturbance, (x_s, u_s) of
`mpc.equilibrium`,

    x(k+1) = x_s + A (x(k) - x_s) + B (u(k) - u_s),

and u_s is the target of the inputs.  The equilibrium is then predicted exactly, and tracking has no steady-state error,
whatever the errors of A and B.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import replace
from typing import Final

import numpy as np

from mpc.answer import ActuatorBounds, AnswerCheck, command_of, refused, rejection
from mpc.constraints import Bounds, Constraint
from mpc.equilibrium import Trim, equilibrium, twisted
from mpc.fallback.completion import PLAUSIBLE, PLAUSIBLE_REFERENCE, CompletedInputs
from mpc.handover import observed, within
from mpc.heading import predict_in_heading_frame, seen_from, slope, turn_horizontally, with_limited_yaw
from mpc.model import LinearModel, continuous_model, discretise, hover_model
from mpc.nonlinear.model import Triple, advance_disturbed, nonlinear_model, spun
from mpc.observer import DisturbanceObserver, thrust_axis
from mpc.observer import ObserverSettings as ObserverSettings
from mpc.obstacles import ObstacleQP, Space
from mpc.ocp import Equilibrium, InfeasiblePeriod, Objective, Problem, Query, lqr_terminal_weight
from mpc.qp import KKT_EVERY
from mpc.robust.settings import LONGEST_SPAN, split_delay
from mpc.robust.settings import RobustSettings as RobustSettings
from mpc.solvers import INVALID_DATA, Answer, Solver
from quadsim.controller import GROUNDED, Command, Phase, StepInputs, stopped
from quadsim.errors import ParameterError
from quadsim.state import EULER, EULER_RATE, INDEX, N_STATES, VELOCITY, Array, ReferenceTurns, all_true
from quadsim.vehicle import N_ROTORS, Vehicle

_SAME_TIME: Final = 1e-6  # [s]
_YAW: Final = INDEX["yaw"]
_MOVING: Final = [*VELOCITY, *EULER, *EULER_RATE]


def robust_problem(
    vehicle: Vehicle,
    *,
    period: float,
    horizon: int,
    objective: Objective,
    bounds: Bounds,
    settings: RobustSettings,
    constraints: tuple[Constraint, ...] = (),
) -> Problem:
    """Return the optimisation of the hover model, with rotor speeds as states if they lag; see `RobustMPC`.

    Objective, bounds and constraints refer to the paper's 12 states.
    """
    if settings.delay > horizon * period:
        rule = f"at most the horizon of {horizon} periods, {horizon * period:g} s"
        raise ParameterError("controller", "delay", settings.delay, rule)
    A, B = discretise(*continuous_model(vehicle, settings.rotor_lag), period)
    model = LinearModel(A=A, B=B, u_bar=hover_model(vehicle, period).u_bar, period=period)
    objective = replace(objective, C_r=_widened(objective.C_r, model.n), Q_d=settings.move_weight)
    if settings.terminal:
        objective = replace(objective, P=lqr_terminal_weight(model, objective))
    return Problem(
        model=model,
        horizon=horizon,
        objective=objective,
        bounds=replace(bounds, C_c=_widened(bounds.C_c, model.n), penalty=settings.penalty, margins=settings.margins),
        constraints=tuple(
            part if part.C is None else replace(part, C=_widened(part.C, model.n)) for part in constraints
        ),
    )


class RobustMPC:
    """One optimum per period of a `robust_problem`; see the module.

    It keeps no earlier plan: without a solution, it reports the status with the command in force, and
    `mpc.fallback.contract.Guarded` acts on it.

    Attributes:
        trim: the equilibrium under the estimated disturbance.
        infeasible_period: the first period since `reset` whose QP had no answer; None if there was none.
        answer: the answer of the last period that solved a QP; None before the first.
    """

    name: Final = "robust"
    answer: Answer | None = None

    def __init__(
        self,
        vehicle: Vehicle,
        problem: Problem,
        settings: RobustSettings,
        solver: Solver,
        *,
        space: Space | None = None,
        kkt_every: int = KKT_EVERY,
    ) -> None:
        self.problem, self.settings, self.horizon = problem, settings, problem.horizon
        self._period = period = problem.model.period
        whole, self._late = split_delay(settings.delay, period)
        self._sent: deque[Array] = deque(maxlen=whole + 1)  # u(k-1-n) .. u(k-1): the command in force, and under way
        self._nominal = hover_model(vehicle, period)
        self._model = nonlinear_model(vehicle, period, rotor_lag=settings.rotor_lag or None)
        self._of_twist = np.ascontiguousarray(np.linalg.inv(slope(self._nominal))[:, 1:])
        self._actuators, self._check = ActuatorBounds.of_problem(problem), AnswerCheck(problem, kkt_every)
        self._solver, self.solver = solver, solver.name
        self._obstacles = None if space is None else ObstacleQP(problem, self._solver, space)
        self._observer = None if settings.observer is None else DisturbanceObserver(settings.observer, period)
        self._turns = ReferenceTurns()
        self.reset(np.full(N_ROTORS, vehicle.hover_speed))

    def reset(self, speeds: Array) -> None:
        """Restart after the command u(-1) (4,) [rad/s], with rotors at that speed."""
        self._acting = np.array(speeds, float)
        self._sent.extend([self._acting] * (self._sent.maxlen or 1))
        # Rotor speeds and state when the next command takes over in this period, and speeds when this period's does.
        self._rotors = self._turning = self._acting.copy()
        self._ahead: Array | None = None
        self._called_at = self._measured = -math.inf
        self._turns.reset()
        self.infeasible_period: InfeasiblePeriod | None = None
        self._check.reset()
        self._solver.reset()
        if self._obstacles is not None:
            self._obstacles.reset()
        self._forget()

    def adopt(self, previous: object) -> None:
        """Take over the rotor speeds, the commands under way and the disturbance of the previous law."""
        law = within(previous, RobustMPC)
        if law is not None:
            self._rotors, self._turning = law._rotors.copy(), law._turning.copy()
            self._sent.extend(law._sent)
            self._called_at, self._measured = law._called_at, law._measured
            if self.settings.delay == law.settings.delay:
                self._ahead = law._ahead
        observer = None if law is None else law._observer
        estimate = observed(previous) if observer is None else observer.estimate
        if self._observer is not None and estimate is not None:
            self._observer.adopt(estimate)
            self._update_trim()

    @np.errstate(over="ignore", invalid="ignore", divide="ignore")  # values out of range are rejected, not warned of
    def step(self, now: StepInputs, state: Array, reference: Array) -> Command:
        """See `quadsim.controller.Controller.step`; what is answered without a QP: `query`."""
        query = self.query(now, state, reference)
        if isinstance(query, Command):
            return query
        problem = self.problem
        if self._obstacles is None:
            answer = self._solver.solve(query)
        else:
            answer, problem = self._obstacles.solve(now.time + self.settings.delay, query, self._yaw)
        reason = rejection(answer.status, answer.plan[0], answer.plan, self._actuators, self._acting)
        answer, reason = self._check(problem, query, answer, reason)
        self.answer = answer
        if reason is not None:
            if reason != INVALID_DATA and self.infeasible_period is None:
                self.infeasible_period = InfeasiblePeriod(
                    problem=problem, query=query, status=reason, time=now.time, delay=self.settings.delay
                )
            return refused(self._acting, self.horizon, reason, answer)
        plan = answer.plan.copy()
        self._acting = plan[0] = self._actuators.clip(plan[0], self._acting)
        return command_of(plan[0], plan, answer.status, answer)

    @np.errstate(over="ignore", invalid="ignore", divide="ignore")  # values out of range are rejected, not warned of
    def query(self, now: StepInputs, state: Array, reference: Array) -> Query | Command:
        """Return the query of this period, to call once per period; or a command, if there is nothing to solve.

        Numbers that are not finite, exceed `mpc.fallback.completion.PLAUSIBLE`, or lead to such numbers give a command
        with the status `invalid_data` and do not update the observer.  Nor does a state that is predicted in part
        (`mpc.fallback.completion.CompletedInputs`), the first measured state after more than `LONGEST_SPAN` of such
        states, or a state after a pause: `now.time` must be one period later than last time.
        """
        if now.acting is not None:
            self._acting = np.array(now.acting, float)
        self._sent.append(self._acting)
        in_force, *under_way = self._sent
        rest = self._period - self._late
        ahead, before, called_at = self._ahead, self._rotors, self._called_at
        rotors = spun(self._model, before, in_force, rest)
        self._rotors = spun(self._model, rotors, in_force, self._late)
        turning = [self._rotors]
        for command in under_way:
            turning.append(spun(self._model, turning[-1], command, self._period))
        self._ahead, self._called_at, self._turning = None, now.time, turning[-1]
        if now.phase in GROUNDED:
            self._acting, _ = self._actuators.reach(self._acting)
            self._forget()
            return stopped(self._acting.copy(), self.horizon, now.phase)
        if not (all_true(np.abs(state) <= PLAUSIBLE) and all_true(np.abs(reference) <= PLAUSIBLE_REFERENCE)):
            return refused(self._acting, self.horizon, INVALID_DATA)
        if ahead is None or abs(now.time - called_at - self._period) > _SAME_TIME:
            self._measured = -math.inf
        span = self._span(now)
        if self._observer is not None and ahead is not None and span <= LONGEST_SPAN and now.phase is Phase.FLYING:
            expected = self._after(rest, ahead, before, in_force)
            if all_true(np.isfinite(expected)):
                self._observer.update(state, expected)
                self._update_trim()
        x0 = following = self._after(self._late, state, rotors, in_force)
        for command, speeds in zip(under_way, turning, strict=False):
            x0 = self._after(self._period, x0, speeds, command)
        if not all_true(np.isfinite(x0)):
            return refused(self._acting, self.horizon, INVALID_DATA)
        self._yaw = float(x0[_YAW]) if self.settings.heading else 0.0  # rotation of the problem's axes
        if now.phase is Phase.FLYING:  # before, the ground holds the vehicle, so its motion shows no disturbance
            self._ahead = following
        reference = self._turns.follow(reference, float(state[_YAW]))
        if self.settings.delay:  # the reference at the predicted instants, later by the delay
            reference = np.concatenate([reference[len(under_way) :], np.repeat(reference[-1:], len(under_way), axis=0)])
            later = np.concatenate([reference[1:], reference[-1:]])
            reference = reference + self._late / self._period * (later - reference)
        x0 = np.concatenate([x0, self._turning])[: self._model.n]
        if self.settings.heading:
            reference = with_limited_yaw(reference, self._yaw, self.settings.largest_turn)
            x0 = turn_horizontally(x0, -self._yaw)
            x0[_YAW] = 0.0
        u_s = self._balanced()
        x_s = self.trim.state(self._yaw, self._model.n)
        x_s[N_STATES:] = u_s[: self._model.n - N_STATES]
        desired = self.problem.objective.desired(seen_from(reference, self._yaw))
        return Query(x0, desired, self._acting, Equilibrium(x_s, u_s))

    def predict(self, states: Array, plans: Array) -> Array:
        """See `quadsim.controller.Controller.predict`; by the hover model, with the latest disturbance estimate."""
        return predict_in_heading_frame(self._nominal, states, plans, replace(self.trim, speeds=self._balanced()))

    @property
    def disturbance(self) -> Array:
        """(6,) estimated acceleration at rest, world [m/s^2], and angular acceleration, body [rad/s^2]."""
        thrust = self._model.effectiveness[0] @ np.square(self.trim.speeds)
        return np.concatenate([self._resting, thrust * self.trim.twist])

    def _forget(self) -> None:
        """Assume no disturbance."""
        if self._observer is not None:
            self._observer.reset()
        self._update_trim()

    def _update_trim(self) -> None:
        """Update the equilibrium from the disturbance estimate."""
        self._estimate = np.zeros(6) if self._observer is None else self._observer.estimate
        estimate, gravity = self._estimate, self._model.gravity
        (x, y), twist = estimate[:2].tolist(), estimate[3:] / gravity
        lift = math.hypot(x, y, gravity)
        self._effectiveness = twisted(self._model.effectiveness, twist)
        self._resting = self._acceleration((-x / lift, -y / lift, gravity / lift))
        self.trim: Trim = equilibrium(self._model, acceleration=self._resting, twist=twist)

    def _acceleration(self, axis: Triple) -> Triple:
        """Return the estimated disturbance in the world frame [m/s^2], for thrust along a world-frame axis."""
        x, y, along = self._estimate[:3].tolist()
        return along * axis[0] + x, along * axis[1] + y, along * axis[2]

    def _span(self, now: StepInputs) -> float:
        """Time since the last measured state [s]; infinite after a pause, or if the present one is not measured."""
        if isinstance(now, CompletedInputs) and now.unseen[_MOVING].any():
            return math.inf
        span, self._measured = now.time - self._measured, now.time
        return span - _SAME_TIME

    def _after(self, time: float, state: Array, rotors: Array, command: Array) -> Array:
        """Predict the state (12,) a time [s] after a state (12,) with rotor speeds (4,), under a command (4,)."""
        if time <= 1e-9:
            return state
        start = np.concatenate((state, rotors))[: self._model.n]
        acceleration = self._acceleration(thrust_axis(state.tolist()))
        return advance_disturbed(self._model, start, command, time, self._effectiveness, acceleration)[:N_STATES]

    def _balanced(self) -> Array:
        """(4,) speeds at rest [rad/s] that also balance the torque caused by thrust, which the hover matrices omit."""
        thrust = self._model.effectiveness[0]
        excess = np.dot(thrust, np.square(self._turning) - np.square(self.trim.speeds))
        return np.asarray(self.trim.speeds - np.dot(self._of_twist, excess * self.trim.twist))


def _widened(matrix: Array, n: int) -> Array:
    """Extend rows over 12 states to n states."""
    return np.hstack([matrix, np.zeros((len(matrix), n - matrix.shape[1]))])
