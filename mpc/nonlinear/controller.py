"""Nonlinear MPC: sequential quadratic programming on the rigid body with a quaternion.

In each period, the model is linearised along the previous plan, at the nodes' stored states and inputs, and the QP

    min  sum |C_r (s_i - s_i^r)|^2_Q + |u_i - u_i^r|^2_R    s.t.  s_{i+1} = A_i s_i + B_i u_i + c_i,  s_0 measured

is solved: a full Gauss-Newton step, the real-time iteration (Diehl, Bock and Schloeder 2005). The states s contain the
quaternion q_r* q instead of q, with the node's reference q_r: a rotation of four numbers that makes both kinds of
`Nonlinear.attitude_error` linear with constant weights.  A measured state enters only as s_0; node 0 is linearised at
the stored state.
"""

from __future__ import annotations

import math
import time as clock
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from typing import Final, NamedTuple

import numpy as np
import scipy.linalg

from mpc.answer import ActuatorBounds, AnswerCheck, command_of, refused, resized
from mpc.bounded import resolved_lag
from mpc.constraints import Constraint, Penalty
from mpc.disturbance import RampObserver
from mpc.equilibrium import LEAST_LIFT, Trim
from mpc.model import LinearModel
from mpc.nonlinear.body import Body
from mpc.nonlinear.reference import Nodes, nodes_of_motion, nodes_of_preview
from mpc.nonlinear.rigidbody import (
    N_BODY,
    Inputs,
    P,
    Q,
    RigidBody,
    V,
    W,
    drag_acceleration,
    rigid_body,
    rotation,
    thrust_axis,
    turned_by_air,
)
from mpc.nonlinear.settings import Nonlinear
from mpc.nonlinear.sqp import SQP, SQPStatus, slack_groups
from mpc.observer import DisturbanceObserver, disturbance_of
from mpc.obstacles import HALF_SPACE_ROUNDING, SETTLED, Space, distances
from mpc.ocp import Equilibrium, InfeasiblePeriod, Objective, Problem, Query, lqr_terminal_weight
from mpc.qp import KKT_EVERY, QP, Solution
from mpc.solvers import INVALID_DATA, Answer, Method
from mpc.staged import Staged
from quadsim.controller import (
    ACCEPTED,
    CORE,
    GAIN,
    GROUNDED,
    NOT_CONVERGED,
    ROTORS,
    SOLVED,
    UNCONSTRAINED,
    Command,
    Phase,
    Statistics,
    StepInputs,
    stopped,
)
from quadsim.errors import ParameterError
from quadsim.rotation import (
    body_to_euler_rates,
    cross,
    euler_to_body_rates,
    euler_to_quaternion,
    multiply,
    quaternion_to_euler,
)
from quadsim.state import (
    ANGLE_RATES,
    ANGLES,
    EULER,
    EULER_RATE,
    INDEX,
    KEPT,
    N_STATES,
    POSITIONS,
    VELOCITIES,
    Array,
    ReferenceTurns,
    all_true,
)
from quadsim.vehicle import N_ROTORS, Vehicle

OUTSIDE: Final = 1e-6
"""Tolerance of an input's bounds, as a share of the largest input; an answer outside is moved onto them."""
CONVERGED: Final = 0.1
"""Largest dynamics defect of a converged plan (`quadsim.controller.Statistics`). Library flights exceed it in at most 9
periods, after steps of the course and upside down; a tumbling vehicle exceeds it in all."""
STEP_TOLERANCE: Final = 1e-6  # largest change of a state or an input at which the SQP of a period stops
CORRECTIONS: Final = 2
"""Most further SQP steps in a period whose plan has not `CONVERGED`, where commands are targets; if it still has not,
the next period starts from the reference. A single step from far away may leave a plan with a full turn in it, which
further steps keep: that way a stiff soft bound on tilt and unfiltered steps of the reference turned a vehicle over."""
TILT_SIDES: Final = 12
"""Sides of the polygon that a tilt bound imposes on the thrust axis's horizontal part, inside the circle; it costs up
to 3.4 % of the bound's sine."""
_OPTIMA: Final = {SQPStatus.FREE, SQPStatus.BOUNDED, SQPStatus.UNCONVERGED}
SQP_FAILURES: Final = {
    SQPStatus.INFEASIBLE: "primal_infeasible",
    SQPStatus.GIVEN_UP: "max_iterations",
    SQPStatus.NO_ROOM: "no_room",
    SQPStatus.NOT_FINITE: INVALID_DATA,
}
_PLAUSIBLE: Final = 1e5
_SAME_TIME: Final = 1e-6  # [s]


class NonlinearMPC:
    """One step of sequential quadratic programming per period, or more; see the module.

    Attributes:
        settings: its table.
        infeasible_period: the first period whose QP had no answer or, if there is none, whose SQP did not converge.
    """

    name: Final = "nonlinear"

    def __init__(
        self,
        vehicle: Vehicle,
        *,
        period: float,
        settings: Nonlinear,
        bounds: ActuatorBounds | None = None,
        constraints: tuple[Constraint, ...] = (),
        space: Space | None = None,
        kkt_every: int = KKT_EVERY,
        tolerance: float = STEP_TOLERANCE,
    ) -> None:
        self.settings, self._vehicle, self._period = settings, vehicle, period
        self._again = partial(NonlinearMPC, vehicle, period=period, bounds=bounds, constraints=constraints, space=space)
        self._stride, self._targets = settings.stride(period), settings.commands != ROTORS
        self._inputs = Inputs.RATES if self._targets else Inputs(settings.inputs)
        lags, rotor_lag = settings.inner_lag or (0.0, 0.0, 0.0, 0.0), resolved_lag(settings.rotor_lag, vehicle)
        self._drag = np.array(settings.drag)
        self.commands: str = settings.commands
        self._bounds = settings.actuators(vehicle) if bounds is None else bounds
        self._nodes, self.horizon = settings.horizon // self._stride, settings.horizon
        self._model = rigid_body(
            vehicle,
            period * self._stride,
            substeps=settings.substeps,
            inputs=self._inputs,
            rotor_lag=rotor_lag or None,
            lag=lags,
            drag=self._drag,
            quadratic_drag=np.array(settings.quadratic_drag),
            moment=settings.moment,
        )
        if settings.moment:
            vehicle.require_moment("controller")
        self._inverse = np.linalg.inv(self._model.effectiveness)
        lifts = vehicle.mass * vehicle.gravity * vehicle.thrust_shares
        self._hover = lifts * (vehicle.mean_coefficient / vehicle.coefficients)  # of rotors with the mean coefficient
        self._level = vehicle.hover_speeds
        if self._targets:
            self._level = np.array([vehicle.mass * vehicle.gravity, 0.0, 0.0, 0.0])
        self._lag = lags[0] if self._targets else rotor_lag  # of actuator states [s]
        self._tilted = settings.tilt is not None
        self._lower, self._upper = self._shares(self._bounds.u_min), self._shares(self._bounds.u_max)
        self.problem = self._problem(constraints)
        self._check, self._form = AnswerCheck(self.problem, kkt_every), Staged(self.problem)
        self.solver = CORE
        self._space, self._groups = (
            space,
            slack_groups(self.problem, faces=space is not None and space.penalty is not None),
        )
        self._shift = self._stride == 1 if settings.shift is None else settings.shift
        self._sqp = SQP(
            self._model,
            self.problem,
            inputs=np.stack([self._lower, self._upper]),
            difference=settings.attitude_error == "difference",
            shift=self._shift,
            iterations=settings.iterations,
            corrections=CORRECTIONS * self._targets,
            tolerance=tolerance,
            faces=0 if space is None else space.count,
            price=None if space is None else space.penalty,
        )
        # The same body over a control period: from measurement to measurement, and for other plans, without rotor lag.
        period_model = replace(self._model, step=period)
        self._of_period = Body(period_model)
        lags = (0.0, *lags[1:])
        self._without_lag = Body(replace(period_model, rotor_lag=None, lag=lags, substeps=1))
        observing, ramp = settings.offset_free, settings.disturbance
        self._observer = None if observing is None else DisturbanceObserver(observing, period)
        self._ramp: RampObserver | None = None
        if ramp is not None:
            lag = self._lag if ramp.rotor_lag is None else ramp.rotor_lag
            self._ramp = RampObserver(
                replace(ramp, rotor_lag=lag),
                vehicle,
                period,
                drag=self._model.drag / vehicle.mass,
                quadratic_drag=self._model.quadratic_drag / vehicle.mass,
                moment=settings.moment,
                thrust_lag=self._lag if self._targets else None,
            )
        self.reset(self._level)

    def _shares(self, speeds: Array) -> Array:
        """Return the inputs for commands (..., 4): rotor speeds [rad/s] or targets [N], [rad/s]."""
        if self._targets:
            return speeds / self._model.scale
        return self._model.shares(self._vehicle.mean_coefficient * np.square(speeds))

    @property
    def _in_force(self) -> Array | float:
        """The command in force, for the observer of forces: rotor speeds (4,) [rad/s], or collective thrust [N]."""
        return float(self._acting[0]) if self._targets else self._acting

    def _clip(self, shares: Array) -> Array:
        return np.minimum(np.maximum(shares, self._lower), self._upper)

    def _speeds(self, shares: Array) -> Array:
        """Return the commands of inputs: rotor speeds [rad/s] or targets [N], [rad/s]."""
        if self._targets:
            return shares * self._model.scale
        return np.sqrt(self._model.thrusts(np.maximum(shares, 0.0)) / self._vehicle.mean_coefficient)

    def _problem(self, constraints: tuple[Constraint, ...]) -> Problem:
        settings, model = self.settings, self._model
        hover, x = self._shares(self._level), np.zeros(model.n)
        x[3] = 1.0
        x[N_BODY:] = hover[: model.n - N_BODY]
        A, B, _ = Body(model).linearise(x[None], hover[None])
        rows, weights = settings.outputs()
        objective = Objective(
            C_r=np.hstack([rows, np.zeros((len(rows), model.n - N_BODY))]),
            Q_y=np.diag(weights),
            Q_u=settings.weights.input * np.eye(N_ROTORS),
            Q_d=settings.weights.move * np.eye(N_ROTORS) if settings.weights.move else None,
        )
        linear = LinearModel(A=A[0], B=B[0], u_bar=hover, period=model.step)
        if settings.terminal == "lqr":
            P = self._riccati(linear, objective)
        else:
            P = (0.0 if settings.terminal == "none" else float(settings.terminal)) * objective.weights[0]
        if self._tilted:  # two further states: the thrust axis along world x and y
            none = np.zeros((2, 2))
            A, B = scipy.linalg.block_diag(linear.A, none), np.vstack([linear.B, np.zeros((2, N_ROTORS))])
            linear, P = replace(linear, A=A, B=B), scipy.linalg.block_diag(P, none)
            objective = replace(objective, C_r=np.hstack([objective.C_r, np.zeros((len(rows), 2))]))
        return Problem(
            model=linear,
            horizon=self._nodes,
            objective=replace(objective, P=P),
            constraints=(
                Constraint(name="inputs", lower=self._lower, upper=self._upper, D=np.eye(N_ROTORS)),
                *self._held(linear.n),
                *(self._of_states(constraint, linear.n) for constraint in constraints),
            ),
        )

    def _held(self, n: int) -> Iterator[Constraint]:
        """Yield the bounds on slew, tilt and body rates, in a problem with n states."""
        settings, bounds, largest = self.settings, self._bounds, self._vehicle.speed_max
        if np.isfinite(bounds.delta_min).any() or np.isfinite(bounds.delta_max).any():
            if self._inputs is not Inputs.SPEED:
                rule = 'left out where inputs = "thrust": a step of a speed is not linear in thrusts; inputs = "speed"'
                raise ParameterError("controller", "input_bounds.slew", bounds.delta_max.tolist(), rule)
            steps = np.full((self._nodes, 1), float(self._stride))  # periods between nodes,
            steps[0] = 1.0  # except the first node, which follows the command in force
            lower, upper = steps * bounds.delta_min / largest, steps * bounds.delta_max / largest
            yield Constraint(name="slews", lower=lower, upper=upper, E=np.eye(N_ROTORS))
        if settings.tilt is not None:
            tilt = math.radians(settings.tilt)
            angles = math.tau / TILT_SIDES * np.arange(TILT_SIDES)
            rows = np.zeros((TILT_SIDES, n))
            rows[:, -2], rows[:, -1] = np.cos(angles), np.sin(angles)
            upper = np.full(TILT_SIDES, math.sin(tilt) * math.cos(math.pi / TILT_SIDES))
            penalty = self._penalty(TILT_SIDES, 1.0 / math.cos(tilt))  # in the sine of the tilt
            yield Constraint(name="tilt", lower=np.full(TILT_SIDES, -math.inf), upper=upper, C=rows, penalty=penalty)
        rates = settings.largest_rates
        if np.isfinite(rates).any():
            rows = np.eye(n)[W]
            yield Constraint(name="body_rates", lower=-rates, upper=rates, C=rows, penalty=self._penalty(3, 1.0))

    def _penalty(self, rows: int, scale: float) -> Penalty | None:
        soft = self.settings.soft
        if soft is None:
            return None
        l1, l2 = soft.linear, soft.quadratic
        return Penalty(l1=np.full(rows, l1 * scale), l2=np.full(rows, l2 * scale**2), largest=True)

    def _of_states(self, constraint: Constraint, n: int) -> Constraint:
        """Convert rows over the 12 states and rotor speeds to the model's; refuse those not linear in its states."""
        C, D = (np.zeros((constraint.lower.shape[-1], size)) for size in (n, N_ROTORS))
        if constraint.C is not None:
            if constraint.C[:, [*EULER, *EULER_RATE]].any():
                rule = "without Euler angles and their rates; tilt and body_rate bound the attitude"
                raise ParameterError("controller", constraint.name, "of those", rule)
            C[:, P], C[:, V] = constraint.C[:, POSITIONS], constraint.C[:, VELOCITIES]
        if constraint.D is not None and constraint.D.any():
            if self._targets:
                rule = 'without rotor speeds where commands = "rates": an inner loop commands the rotors'
                raise ParameterError("controller", constraint.name, "of those", rule)
            if self._inputs is not Inputs.SPEED:
                rule = 'without rotor speeds where inputs = "thrust", in which they are not linear: inputs = "speed"'
                raise ParameterError("controller", constraint.name, "of those", rule)
            D = constraint.D * self._vehicle.speed_max
        return replace(constraint, C=C, D=D)

    def _riccati(self, linear: LinearModel, objective: Objective) -> Array:
        """Return P at hover, where the quaternion's scalar part is constant and has no cost."""
        others = np.delete(np.arange(linear.n), 3)
        reduced = replace(objective, C_r=objective.C_r[:, others], P=None)
        if self.settings.attitude_error == "difference":
            rows = np.delete(np.arange(len(objective.C_r)), 3)
            reduced = replace(reduced, C_r=reduced.C_r[rows], Q_y=objective.Q_y[np.ix_(rows, rows)])
        part = replace(linear, A=linear.A[np.ix_(others, others)], B=linear.B[others])
        P = np.zeros((linear.n, linear.n))
        P[np.ix_(others, others)] = lqr_terminal_weight(part, reduced)
        return P

    def reset(self, speeds: Array) -> None:
        """Restart after the command u(-1) (4,) [rad/s], with rotors at that speed; or after a target that acts."""
        self._acting = np.array(speeds, float)
        self._rotors = self._rotors_before = self._shares(self._acting)
        self._forget()
        self._check.reset()
        self.infeasible_period: InfeasiblePeriod | None = None

    def _forget(self) -> None:
        """Drop the plan, and assume no disturbance."""
        self._sqp.reset()
        self._quaternion: Array | None = None
        self._side = 1.0
        self._turns = ReferenceTurns()
        self._last: tuple[float, Array] | None = None  # time and state of the last period
        self._called_at = math.nan
        if self._observer is not None:
            self._observer.reset()
        if self._ramp is not None:
            self._ramp.reset(self._in_force)
            self._model = replace(self._model, drag=self._drag, thrust_scale=self._ramp.thrust_scale)
        self._update_disturbance(np.zeros(6))

    def adopt(self, previous: object) -> None:
        """Take over disturbance, rotor speeds and plan of the previous law, these only from one with like commands."""
        law = previous if isinstance(previous, NonlinearMPC) else None
        if law is not None:
            alike = self._inputs is law._inputs
            same_space = self._targets is law._targets
            if same_space:
                shares = law._rotors, law._rotors_before
                self._rotors, self._rotors_before = (
                    share if alike else self._shares(law._speeds(share)) for share in shares
                )
            self._quaternion, self._side, self._called_at = law._quaternion, law._side, law._called_at
            if law._last is not None and same_space:
                time, x = law._last
                self._last = time, np.concatenate([x[:N_BODY], self._rotors])[: self._model.n]
            alike = alike and self._model.n == law._model.n and self._model.step == law._model.step
            plan = law._sqp.plan
            if plan is not None and alike:
                self._sqp.plan = resized(plan[0], self._nodes + 1), resized(plan[1], self._nodes)
            if self._ramp is not None and law._ramp is not None:
                self._ramp.adopt(law._ramp)
        observer = None if law is None else law._observer
        estimate = disturbance_of(previous) if observer is None else observer.estimate
        if self._observer is not None and estimate is not None:
            self._observer.adopt(estimate)
            self._update_disturbance(self._observer.estimate)

    def step(self, now: StepInputs, state: Array, reference: Array) -> Command:
        """See `quadsim.controller.Controller.step`; numbers out of range give the status `invalid_data`."""
        if now.acting is not None:
            self._acting = np.array(now.acting, float)
        last, self._last = self._last, None
        before, self._called_at, self._rotors_before = self._called_at, now.time, self._rotors
        if self._lag and math.isfinite(before):  # the rotors have followed the command
            left = math.exp(-(now.time - before) / self._lag)
            commanded = self._shares(self._acting)
            self._rotors = commanded + left * (self._rotors - commanded)
        if now.phase in GROUNDED:
            self._acting = self._bounds.lowest(self._acting)
            self._forget()
            return stopped(self._acting.copy(), self.horizon, now.phase)
        measured = self._measured(now, state)
        if not (np.abs(measured) <= _PLAUSIBLE).all() or not (np.abs(reference) <= _PLAUSIBLE).all():
            return refused(self._acting, self.horizon, INVALID_DATA)
        stride = self._stride
        if now.motion is not None:
            nodes = nodes_of_motion(now.motion, self._nodes, stride)
        else:
            reference = self._turns.follow(reference, float(state[INDEX["yaw"]]))
            nodes = nodes_of_preview(reference, self._nodes, stride, self._period, self._hover)
        if self._quaternion is None:
            self._quaternion = nodes.states[0, Q]
        if measured[Q] @ self._quaternion < 0.0:
            measured[Q] *= -1.0
        self._quaternion = measured[Q].copy()
        # q and -q are one attitude, a whole turn apart: of the nodes, the nearer one counts, as by `ReferenceTurns`.
        if self._side * (measured[Q] @ nodes.states[0, Q]) < math.cos(0.5 * KEPT):
            self._side = -self._side
        nodes.states[:, Q] *= self._side
        if now.phase is Phase.FLYING:
            if self._observer is not None and last is not None:
                self._learn(last, now.time, measured)
            if self._ramp is not None:
                self._follow(self._ramp, now.time, measured)
                self._ramp.log(now)
            self._last = now.time, measured
        nodes = self._balanced(nodes)
        last_plan = self._sqp.plan
        answer = self._iterate(now.time, measured, nodes)
        answer, status = self._check(self.problem, None, answer, self._rejection(answer))
        first = self.infeasible_period
        if status is not None:
            if status != INVALID_DATA and (first is None or first.converges is not None):
                self.infeasible_period = self._kept_period(now.time, status)
            self._sqp.reset()
            return refused(self._acting, self.horizon, status, answer)
        status = answer.status
        if answer.stats.sqp_defect > CONVERGED:
            status = NOT_CONVERGED
            if first is None:
                start = _Start(last_plan, self._acting, self._model, now.time, measured, nodes)
                converges = partial(_converges, self._again, self.settings, start)
                self.infeasible_period = replace(self._kept_period(now.time, status), converges=converges)
        speeds = self._speeds(self._clip(answer.plan))
        self._acting = speeds[0] = self._bounds.clip(speeds[0], self._acting)
        return command_of(speeds[0], np.repeat(speeds, stride, axis=0), status, answer)

    def predict(self, states: Array, plans: Array) -> Array:
        """See `quadsim.controller.Controller.predict`; with the latest disturbance estimate, without rotor lag."""
        self._without_lag.set_world(self._model)
        n = N_BODY + self._targets
        x, predicted = np.zeros((len(states), n)), np.empty((*plans.shape[:2], N_STATES))
        x[:, :N_BODY] = _body(states)
        for i in range(plans.shape[1]):
            x = self._without_lag.advance(x, self._shares(plans[:, i]))
            x[:, Q] /= np.linalg.norm(x[:, Q], axis=1, keepdims=True)
            euler = quaternion_to_euler(x[:, Q])
            predicted[:, i, POSITIONS], predicted[:, i, VELOCITIES] = x[:, P], x[:, V]
            predicted[:, i, ANGLES] = euler
            predicted[:, i, ANGLE_RATES] = body_to_euler_rates(euler, x[:, W])
        return predicted

    @property
    def disturbance(self) -> Array:
        """(6,) estimated acceleration now, world [m/s^2], and angular acceleration, body [rad/s^2]."""
        return np.concatenate([self._model.acceleration, self._model.angular_acceleration])

    @property
    def trim(self) -> Trim | None:
        """The target at rest under the estimated force and thrust scale, for the fallback; None for rotor speeds."""
        if not self._targets:
            return None
        model = self._model
        lift = np.array([0.0, 0.0, model.gravity]) - model.acceleration
        lift[2] = max(lift[2], LEAST_LIFT * model.gravity)
        thrust = model.mass * float(np.linalg.norm(lift)) / model.thrust_scale
        return Trim(speeds=np.array([thrust, 0.0, 0.0, 0.0]), lift=lift)

    def _measured(self, now: StepInputs, state: Array) -> Array:
        """(n,) the model's state."""
        x = np.empty(self._model.n)
        x[P], x[V], x[N_BODY:] = state[POSITIONS], state[VELOCITIES], self._rotors[: self._model.n - N_BODY]
        q, w = now.attitude, now.body_rates
        x[Q] = q if q is not None and all_true(np.isfinite(q)) else euler_to_quaternion(state[ANGLES])
        x[W] = (
            w if w is not None and all_true(np.isfinite(w)) else euler_to_body_rates(state[ANGLES], state[ANGLE_RATES])
        )
        return x

    def _learn(self, last: tuple[float, Array], time: float, measured: Array) -> None:
        """Compare the measured state with its prediction from the last one, disturbance included."""
        before, x = last
        if not abs(time - before - self._period) <= _SAME_TIME:
            return
        assert self._observer is not None
        if x.size > N_BODY:
            x = np.concatenate([x[:N_BODY], self._rotors_before])[: self._model.n]
        self._of_period.set_world(self._model)
        expected = self._of_period.advance(x, self._shares(self._acting))
        turned = np.zeros(3) if self._targets else measured[W] - expected[W]  # an inner loop balances torques
        self._observer.learn(np.concatenate([measured[V] - expected[V], turned]))
        self._update_disturbance(self._observer.estimate)

    def _update_disturbance(self, estimate: Array) -> None:
        """Use this disturbance (6,) in predictions from now on."""
        torque = np.zeros(3) if self._targets else estimate[3:]
        self._model = replace(self._model, acceleration=estimate[:3], angular_acceleration=torque)

    def _follow(self, ramp: RampObserver, time: float, measured: Array) -> None:
        """Split the observed force into drag, as far as it follows the velocity, and a constant remainder."""
        R, velocity = rotation(measured[Q] / np.linalg.norm(measured[Q])), measured[V]
        ramp.update(time, velocity, R, measured[W], self._in_force)
        acceleration, _, angular = ramp.foreseen(0.5 * self._period)
        drag = ramp.drag
        self._model = replace(
            self._model,
            drag=self._drag + self._vehicle.mass * drag,
            acceleration=acceleration + R @ (drag * (R.T @ velocity)),
            angular_acceleration=angular,
            thrust_scale=ramp.thrust_scale,
        )

    def _balanced(self, nodes: Nodes) -> Nodes:
        """Add to the reference what balances air and disturbance: thrust turned by the least rotation, and torque."""
        model = self._model
        if not (model.drags or model.moments or model.acceleration.any() or model.angular_acceleration.any()):
            return nodes
        states, thrusts = nodes.states.copy(), nodes.thrusts
        q, mass = states[:, Q], self._vehicle.mass
        R = rotation(q)
        axis = R[:, :, 2].copy()
        total = thrusts.sum(axis=1) / mass
        force = np.append(total, total[-1])[:, None] * axis
        thrust_acceleration = force - model.acceleration - drag_acceleration(model, R, states[:, V])
        size = np.maximum(np.linalg.norm(thrust_acceleration, axis=1), 1e-9)
        # The least rotation from axis a to axis b is (1 + a . b, a x b), up to its length.
        turn = np.empty_like(q)
        turn[:, 0] = 1.0 + (axis * thrust_acceleration).sum(axis=1) / size
        turn[:, 1:] = cross(axis, thrust_acceleration) / size[:, None]
        length = np.linalg.norm(turn, axis=1)
        if (around := length < 1e-6).any():
            turn[around], length[around] = (1.0, 0.0, 0.0, 0.0), 1.0
        turn /= length[:, None]
        states[:, Q] = multiply(turn, q)
        effort = np.empty((len(total), 4))
        effort[:, 0], effort[:, 1:] = size[:-1] - total, -model.angular_acceleration
        if model.moments:
            effort[:, 1:] -= turned_by_air(model, R[:-1], states[:-1, V], states[:-1, W], thrusts)
        return Nodes(states, thrusts + effort @ self._inverse.T)

    def _iterate(self, time: float, measured: Array, nodes: Nodes) -> Answer:
        """Take SQP steps from the stored plan."""
        sqp, started = self._sqp, clock.perf_counter()
        sqp.set_world(self._model)
        asked = measured, self._shares(self._acting), nodes.states, nodes.thrusts
        status = sqp.step(*asked) if self._space is None else self._among(self._space, time, asked)
        spent_s = clock.perf_counter() - started
        if status not in _OPTIMA:
            nowhere = np.full((self._nodes, N_ROTORS), math.nan)
            stats = Statistics(iterations=sqp.iterations, solve_s=spent_s)
            return Answer(nowhere, np.zeros((self._nodes, 0)), SQP_FAILURES[status], CORE, stats=stats)
        free, active = status is SQPStatus.FREE, sqp.active
        stats = Statistics(
            iterations=sqp.iterations,
            active=active,
            infeasibility=sqp.violation,
            sqp_defect=sqp.defect,
            sqp_step=sqp.moved,
            solve_s=spent_s,
        )
        return Answer(
            sqp.planned_inputs if status is SQPStatus.UNCONVERGED else sqp.inputs,
            sqp.slacks(self._groups),
            UNCONSTRAINED if free else SOLVED,
            GAIN if free else CORE,
            method=Method.FREE if free else Method.WHOLE,
            stats=stats,
            certificate=self._certificate,
        )

    def _among(self, space: Space, time: float, asked: tuple[Array, Array, Array, Array]) -> SQPStatus:
        """Take SQP steps among half-spaces: those of a program follow its optimum, a few times at most."""
        sqp, t = self._sqp, time + space.period * np.arange(1.0, self._nodes + 1.0)
        if not sqp.begin(*asked):
            return SQPStatus.NOT_FINITE
        on = True
        while on:
            sqp.linearise()
            along = sqp.planned_positions
            for i in range(space.settings.iterations):
                normals, bounds = space.half_spaces(t, along)
                if i and (distances(normals, bounds, along) >= -HALF_SPACE_ROUNDING).all():
                    break
                sqp.half_spaces = normals, bounds
                status, before = sqp.solve(), along
                if status not in _OPTIMA:
                    break
                along = sqp.positions
                if np.abs(along - before).max() < SETTLED:
                    break
            status, on = sqp.keep(status)
        return status

    def _rows(self) -> Problem:
        """The program of the last step, with the half-spaces that it had."""
        if self._space is None:
            return self.problem
        added = self._space.constraint(*self._sqp.half_spaces, self.problem.model.n)
        return replace(self.problem, constraints=(*self.problem.constraints, added))

    def _query(self) -> Query:
        """The data of the last step's program."""
        sqp, goal, state = self._sqp, self._sqp.goal.copy(), self._sqp.start
        if self._tilted:
            goal = np.hstack([goal, np.zeros((len(goal), 2))])
            state = np.append(state, thrust_axis(sqp.measured[Q])[:2])
        desired = goal[1:] @ self.problem.objective.C_r.T
        return Query(state, desired, sqp.before, Equilibrium(goal[-1], sqp.aim.copy()), sqp.steps())

    def _certificate(self) -> tuple[QP, Solution]:
        """Return the last step's program, and its optimum with multipliers."""
        problem, query, sqp = self._rows(), self._query(), self._sqp
        form = self._form if problem is self.problem else Staged(problem)
        qp = form.assemble(query).qp
        groups = self._groups if problem is self.problem else slack_groups(problem)
        multipliers = sqp.multipliers(len(problem.rows.names), len(self.problem.rows.names))
        return qp, form.solution(query, qp, sqp.inputs, sqp.slacks(groups), multipliers)

    def _kept_period(self, time: float, status: str) -> InfeasiblePeriod:
        """Return the last program as the data of a period without an answer."""
        return InfeasiblePeriod(problem=self._named(), query=self._query(), status=status, time=time)

    def _named(self) -> Problem:
        """The last program with the half-spaces of each obstacle by its name."""
        if self._space is None:
            return self.problem
        named = self._space.constraints(*self._sqp.half_spaces, self.problem.model.n)
        return replace(self.problem, constraints=(*self.problem.constraints, *named))

    def _rejection(self, answer: Answer) -> str | None:
        status, plan = answer.status, answer.plan
        if status not in ACCEPTED:
            return status
        beyond = np.abs(plan - self._clip(plan)).max()
        if beyond <= OUTSIDE:
            return None
        return "out_of_bounds" if np.isfinite(plan).all() else "not_finite"


def _body(states: Array) -> Array:
    """(..., 13) states of the rigid body from states (..., 12)."""
    x = np.empty((*states.shape[:-1], N_BODY))
    x[..., P], x[..., V] = states[..., POSITIONS], states[..., VELOCITIES]
    x[..., Q] = euler_to_quaternion(states[..., ANGLES])
    x[..., W] = euler_to_body_rates(states[..., ANGLES], states[..., ANGLE_RATES])
    return x


class _Start(NamedTuple):
    """What a period's plan starts from: data alone, so that a flight can be pickled."""

    plan: tuple[Array, Array] | None
    acting: Array
    model: RigidBody
    time: float
    measured: Array
    nodes: Nodes


def _converges(make: Callable[..., NonlinearMPC], settings: Nonlinear, start: _Start, iterations: int) -> bool:
    """Return whether a period's plan converges within `iterations`."""
    law = make(settings=replace(settings, iterations=iterations))
    law._sqp.plan, law._acting, law._model = start.plan, start.acting, start.model
    answer = law._iterate(start.time, start.measured, start.nodes)
    return law._rejection(answer) is None and answer.stats.sqp_defect <= CONVERGED
