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

from quadsim.controller import (
    ACCEPTED,
    CORE,
    GAIN,
    GROUNDED,
    NOT_CONVERGED,
    OPTIMAL,
    ROTORS,
    SOLVED,
    UNCONSTRAINED,
    Command,
    Phase,
    Statistics,
    StepInputs,
    stopped,
)
from quadsim.core.mirror import Struct, set_members
from quadsim.errors import ParameterError
from quadsim.mpc.estimate.disturbance import RampObserver
from quadsim.mpc.estimate.observer import DisturbanceObserver, disturbance_of
from quadsim.mpc.forms.staged import Staged
from quadsim.mpc.guard.answer import ActuatorBounds, AnswerCheck, command_of, refused, resized
from quadsim.mpc.guard.structs import STATUSES
from quadsim.mpc.laws.nonlinear import Nonlinear
from quadsim.mpc.laws.parts.body import Body
from quadsim.mpc.laws.parts.nonlinear_law import NonlinearLaw, NumbersStruct
from quadsim.mpc.laws.parts.sqp import OWN_NAMES, SQP, SQPStatus, slack_groups
from quadsim.mpc.problem.constraints import Constraint, Penalty
from quadsim.mpc.problem.equilibrium import LEAST_LIFT, Trim
from quadsim.mpc.problem.model import LinearModel
from quadsim.mpc.problem.ocp import Equilibrium, InfeasiblePeriod, Objective, Problem, Query, lqr_terminal_weight
from quadsim.mpc.problem.qp import KKT_EVERY, QP, Solution
from quadsim.mpc.problem.rigidbody import (
    N_BODY,
    Inputs,
    P,
    Q,
    V,
    W,
    rigid_body,
    thrust_axis,
)
from quadsim.mpc.solvers import INVALID_DATA, Answer, Method
from quadsim.mpc.space import HALF_SPACE_ROUNDING, SETTLED, Space, distances
from quadsim.mpc.tables.lags import resolved_lag
from quadsim.rotation import (
    body_to_euler_rates,
    euler_to_body_rates,
    euler_to_quaternion,
    quaternion_to_euler,
)
from quadsim.state import (
    ANGLE_RATES,
    ANGLES,
    EULER,
    EULER_RATE,
    N_STATES,
    POSITIONS,
    VELOCITIES,
    Array,
)
from quadsim.vehicle import N_ROTORS, Vehicle

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
_HOVER_STATES: Final = (
    *("x", "y", "z", "attitude x", "attitude y", "attitude z", "vx", "vy", "vz"),
    *("body rate x", "body rate y", "body rate z", "rotor 1", "rotor 2", "rotor 3", "rotor 4"),
)
"""States of the model near hover: the quaternion's vector part is the attitude."""
_OPTIMA: Final = {SQPStatus.FREE, SQPStatus.BOUNDED, SQPStatus.UNCONVERGED}


class NonlinearMPC:
    """One step of sequential quadratic programming per period, or more; see the module.

    Attributes:
        settings: its table.
        infeasible_period: the first period whose QP had no answer or, if there is none, whose SQP did not converge.
    """

    name: Final = "nonlinear"
    iterates: Final = frozenset({name})

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
            time_limit=settings.time_limit,
        )
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
        # The same body over a control period: from measurement to measurement, and for other plans, without rotor lag.
        period_model = replace(self._model, step=period)
        self._of_period = Body(period_model)
        without_lag = replace(period_model, rotor_lag=None, lag=(0.0, *lags[1:]), substeps=1)
        self._without_lag = Body(without_lag)
        bodies = self._of_period.struct, self._without_lag.struct
        self._law = NonlinearLaw(self._law_numbers(), self._sqp, *bodies, self._ramp)
        self._without_lag.world = self._law.world
        self.reset(self._level)

    @property
    def motion_rows(self) -> int:
        """Samples that it takes of a course's motion."""
        return self.horizon + 1

    def _shares(self, speeds: Array) -> Array:
        """Return the inputs for commands (..., 4): rotor speeds [rad/s] or targets [N], [rad/s]."""
        if self._targets:
            return speeds / self._model.scale
        return self._model.shares(self._vehicle.mean_coefficient * np.square(speeds))

    def _law_numbers(self) -> Struct:
        vehicle, model, observer = self._vehicle, self._model, self._observer
        numbers = NumbersStruct(
            stride=self._stride,
            observes=observer is not None,
            control_period=self._period,
            mass=vehicle.mass,
            coefficient=vehicle.mean_coefficient,
            left=math.exp(-self._period / self._lag) if self._lag else 0.0,
            least_lift=LEAST_LIFT,
            converged=CONVERGED,
        )
        lifts = vehicle.mass * vehicle.gravity * vehicle.thrust_shares
        set_members(
            numbers,
            scale=model.scale,
            level=self._level,
            lifts=lifts * (vehicle.mean_coefficient / vehicle.coefficients),  # of rotors with the mean coefficient
            inverse=np.linalg.inv(model.effectiveness),
            drag=model.drag / vehicle.mass,
            square_drag=model.quadratic_drag / vehicle.mass,
        )
        if observer is not None:
            set_members(numbers, gain=observer.gain, largest=observer.largest)
        return numbers

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
        if constraint.name in OWN_NAMES:
            rule = f"named otherwise than {', '.join(OWN_NAMES)}, the law's own bounds"
            raise ParameterError("controller", constraint.name, "further rows of that name", rule)
        if constraint.E is not None and constraint.E.any():
            rule = "without steps of rotor speeds, which input_bounds.slew bounds"
            raise ParameterError("controller", constraint.name, "of those", rule)
        if constraint.C is not None:
            if constraint.C.ndim == 3:
                rule = "with the same rows at all steps: only the half-spaces of obstacles differ from step to step"
                raise ParameterError("controller", constraint.name, "of others", rule)
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
        P[np.ix_(others, others)] = lqr_terminal_weight(part, reduced, _HOVER_STATES)
        return P

    def reset(self, speeds: Array) -> None:
        """Restart after the command u(-1) (4,) [rad/s], with rotors at that speed; or after a target that acts."""
        self._acting, self._called_at = np.array(speeds, float), math.nan
        self._law.reset(self._acting)
        self._check.reset()
        self.infeasible_period: InfeasiblePeriod | None = None

    def adopt(self, previous: object) -> None:
        """Take over disturbance, rotor speeds and plan of the previous law, these only from one with like commands."""
        law = previous if isinstance(previous, NonlinearMPC) else None
        if law is not None:
            alike, rotors = self._inputs is law._inputs, None
            if self._targets is law._targets:
                its = (np.array(law._law.struct.rotors), np.array(law._law.struct.rotors_before))
                rotors = its if alike else (self._shares(law._speeds(its[0])), self._shares(law._speeds(its[1])))
            self._called_at = law._called_at
            self._law.adopt(law._law, rotors)
            alike = alike and self._model.n == law._model.n and self._model.step == law._model.step
            plan = law._sqp.plan
            if plan is not None and alike:
                self._sqp.plan = resized(plan[0], self._nodes + 1), resized(plan[1], self._nodes)
            if self._ramp is not None and law._ramp is not None:
                self._ramp.adopt(law._ramp)
        estimate = disturbance_of(previous)
        if law is not None and law._observer is not None:
            estimate = np.array(law._law.struct.estimate)
        if estimate is not None:
            self._law.learn(estimate)

    def step(self, now: StepInputs, state: Array, reference: Array) -> Command:
        """See `quadsim.controller.Controller.step`; numbers out of range give the status `invalid_data`."""
        if now.acting is not None:
            self._acting = np.array(now.acting, float)
        since, self._called_at = now.time - self._called_at, now.time
        periods = round(since / self._period) if math.isfinite(since) else 0
        if now.phase in GROUNDED:
            self._law.stand(periods, self._acting)
            self._acting = self._bounds.lowest(self._acting)
            return stopped(self._acting.copy(), self.horizon, now.phase)
        if not self._law.begin(periods, now.phase is Phase.FLYING, now, state, reference, self._acting):
            return refused(self._acting, self.horizon, INVALID_DATA)
        if self._ramp is not None and now.phase is Phase.FLYING:
            self._ramp.log(now)
        last_plan = self._sqp.plan
        answer, found = self._iterate(now.time)
        status = STATUSES[found]
        answer, reason = self._checked(answer, None if status in ACCEPTED else status)
        first = self.infeasible_period
        if reason is not None:
            if reason != INVALID_DATA and (first is None or first.converges is not None):
                self.infeasible_period = self._kept_period(now.time, reason)
            return replace(refused(self._acting, self.horizon, reason, answer), iterations_by=self.name)
        if status == NOT_CONVERGED and first is None:
            start = _Start(last_plan, self._law.world.numbers.copy(), now.time, self._law.query)
            converges = partial(_converges, self._again, self.settings, start)
            self.infeasible_period = replace(self._kept_period(now.time, status), converges=converges)
        speeds = self._law.plan.copy()
        self._acting = speeds[0] = self._bounds.clip(speeds[0], self._acting)
        return replace(command_of(speeds[0], speeds, status, answer), iterations_by=self.name)

    def predict(self, states: Array, plans: Array) -> Array:
        """See `quadsim.controller.Controller.predict`; with the latest disturbance estimate, without rotor lag."""
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
        return self._law.world.numbers[:6].copy()

    @property
    def trim(self) -> Trim | None:
        """The target at rest under the estimated force and thrust scale, for the fallback; None for rotor speeds."""
        trim = self._law.struct.trim
        return Trim(speeds=np.array(trim.commands), lift=np.array(trim.lift)) if self._targets else None

    def _iterate(self, time: float) -> tuple[Answer, int]:
        """Take SQP steps from the stored plan; return the last program's optimum and the plan's status in the core."""
        sqp, started = self._sqp, clock.perf_counter()
        status = sqp.step() if self._space is None else self._among(self._space, time)
        found = self._law.end(status)
        spent_s = clock.perf_counter() - started
        if status not in _OPTIMA:
            nowhere = np.full((self._nodes, N_ROTORS), math.nan)
            stats = Statistics(iterations=sqp.iterations, solve_s=spent_s)
            return Answer(nowhere, np.zeros((self._nodes, 0)), STATUSES[found], CORE, stats=stats), found
        free, active = status is SQPStatus.FREE, sqp.active
        stats = Statistics(
            iterations=sqp.iterations,
            active=active,
            sqp_defect=sqp.defect,
            sqp_step=sqp.moved,
            solve_s=spent_s,
        )
        answer = Answer(
            sqp.inputs,
            sqp.slacks(self._groups),
            UNCONSTRAINED if free else SOLVED,
            GAIN if free else CORE,
            method=Method.FREE if free else Method.WHOLE,
            stats=stats,
            certificate=self._certificate,
        )
        return answer, found

    def _checked(self, answer: Answer, refused: str | None) -> tuple[Answer, str | None]:
        """Check the last program's optimum; see `quadsim.mpc.guard.answer.AnswerCheck`."""
        if answer.certificate is None:
            return answer, refused
        return self._check(self._rows(), self._query(), answer, refused)

    def _among(self, space: Space, time: float) -> SQPStatus:
        """Take SQP steps among half-spaces: those of a program follow its optimum, a few times at most."""
        sqp, t = self._sqp, time + space.period * np.arange(1.0, self._nodes + 1.0)
        if not sqp.begin():
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
        qp = form.assemble(query)
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
    world: Array  # see `quadsim.mpc.laws.parts.body.World`
    time: float
    query: tuple[Array, ...]  # see `quadsim.mpc.laws.parts.sqp.SQP.begin`


def _converges(make: Callable[..., NonlinearMPC], settings: Nonlinear, start: _Start, iterations: int) -> bool:
    """Return whether a period's plan converges within `iterations`."""
    law = make(settings=replace(settings, iterations=iterations, time_limit=None))
    law._law.ask(start.world, start.query)
    law._sqp.plan = start.plan
    _, status = law._iterate(start.time)
    return STATUSES[status] in OPTIMAL
