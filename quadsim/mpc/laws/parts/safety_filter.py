"""A predictive safety filter: it passes a requested command if the robust MPC's constraints can still hold after it.

Wabersich and Zeilinger (2021), "A predictive safety filter for learning-based control of constrained nonlinear
dynamical systems", with the model, the disturbance observer and the tightened bounds of
`quadsim.mpc.laws.parts.preparation`. It solves one QP per period,

        min_u  |u(k) - u_requested|^2 + epsilon sum_i |u(k+i) - u_s|^2,    i = 0 .. N-1,

subject to the robust MPC's constraints and a terminal condition: the part of the state that the bounds involve is
steady,

    V' (A - I) (x(k+N) - x_s) = 0,    V a basis of the row space of [C; C A; ...],

so that holding u_s from then on keeps every bound on states.  The plan of one period, shifted, is then feasible in the
next: while the disturbances stay within the bounds stated for the tightening, the problem stays feasible.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np
import scipy.linalg

from quadsim.controller import ACCEPTED, GROUNDED, UNCONSTRAINED, Command, StepInputs, stopped
from quadsim.errors import ParameterError
from quadsim.mpc.forms.staged import Staged
from quadsim.mpc.guard.answer import ActuatorBounds, AnswerCheck, command_of, refused, rejection
from quadsim.mpc.laws.parts.preparation import RobustPreparation
from quadsim.mpc.laws.robust import Robust
from quadsim.mpc.problem.constraints import Constraint, Penalty
from quadsim.mpc.problem.equilibrium import Trim
from quadsim.mpc.problem.ocp import Objective, Problem, Query
from quadsim.mpc.problem.qp import KKT_EVERY, QPRows
from quadsim.mpc.problem.regulator import observed
from quadsim.mpc.solvers import INVALID_DATA, Answer
from quadsim.mpc.solvers.piqp import Piqp
from quadsim.state import Array
from quadsim.vehicle import Vehicle

LATER: Final = 1e-6
"""epsilon: weight of the later inputs' distance from trim, relative to the first input's from the request."""
PENALTY: Final = 1e4
"""l1 of violating a soft row by half its band, for a unit weight of the first input."""
TERMINAL_TOLERANCE: Final = 1e-4
"""Largest change per period of the steady part of the state at the plan's end [unit of the state]."""
LOOSE: Final = 1e4
"""Stands for an infinite bound that changes or is on both sides of a row, which PIQP does not take."""
END: Final = "terminal condition"  # with a space, as no polytope is named
"""Name of the terminal constraint."""
PASS_TOLERANCE: Final = 1e-2
"""Difference from the request [rad/s] attributed to rounding of the QP: the request is then passed unchanged."""


class SafetyFilter:
    """A controller that sends the requested command as far as it is safe; see the module.

    If the constraints cannot hold, for example after a disturbance larger than stated, the filter softens those on
    states and solves the QP once more.  If that fails too, the status reports it, and
    `quadsim.mpc.guard.contract.Guard` flies the last good plan.

    The robust MPC's preparation provides model, observer and constraints.  Set `requested` (4,) to the command of the
    next period [rad/s].
    """

    name: Final = "safety-filter"
    solver: Final = "piqp-multistage"
    iterates: Final = frozenset({solver})

    def __init__(self, preparation: RobustPreparation) -> None:
        self._preparation = preparation
        self.horizon = preparation.problem.horizon
        steady_rows = _steady_rows(preparation.problem)
        self.problem = _feasibility(preparation.problem, steady_rows)
        self._actuators = ActuatorBounds.of_problem(self.problem)
        softened = []  # constraints on states, except for the terminal one
        for part in self.problem.constraints:
            if part.C is not None and part.name != END:
                part = _soft(part)
            softened.append(part)
        soft = replace(self.problem, constraints=tuple(softened))
        self._nearest = _Nearest(self.problem)
        self._softened = _Nearest(soft)
        self._acting = self.requested = self.problem.model.u_bar.copy()

    @property
    def trim(self) -> Trim:
        """The equilibrium under the estimated disturbance."""
        return self._preparation.trim

    def reset(self, speeds: Array) -> None:
        """See `quadsim.controller.Controller.reset`."""
        self._acting = self.requested = np.array(speeds, float)
        self._preparation.reset(speeds)

    def step(self, now: StepInputs, state: Array, reference: Array) -> Command:
        """The command closest to `requested` that keeps the constraints feasible; `unconstrained` if unchanged."""
        if now.acting is not None:
            self._acting = np.array(now.acting, float)
        if now.phase in GROUNDED:
            self._preparation.stand(now, self._acting)
            self._acting = self._actuators.lowest(self._acting)
            return stopped(self._acting.copy(), self.horizon, now.phase)
        query = self._preparation.prepare(now, state, reference, self._acting)
        if query is None:
            return refused(self._acting, self.horizon, INVALID_DATA)
        if not np.isfinite(self.requested).all():  # which would stay in the QP solver
            return refused(query.u_before, self.horizon, INVALID_DATA)
        answer, reason = self._checked(self._nearest, query)
        if answer.status not in ACCEPTED:
            answer, reason = self._checked(self._softened, query)
        if reason is not None:
            return refused(query.u_before, self.horizon, reason, answer)
        plan = answer.plan.copy()
        command = plan[0]
        status = answer.status
        if np.abs(command - self.requested).max() <= PASS_TOLERANCE:
            command = self.requested
            status = UNCONSTRAINED
        plan[0] = self._actuators.clip(command, query.u_before)
        return command_of(plan[0], plan, status, answer)

    def _checked(self, nearest: _Nearest, query: Query) -> tuple[Answer, str | None]:
        """Return the answer of one QP and the reason to reject it, None for none; see `answer.AnswerCheck`."""
        answer = nearest.solve(query, self.requested)
        reason = rejection(answer.status, answer.plan[0], answer.plan, self._actuators, query.u_before)
        return nearest.check(nearest.problem_at(query), query, answer, reason)

    def predict(self, states: Array, plans: Array) -> Array:
        """See `quadsim.controller.Controller.predict`."""
        return self._preparation.predict(states, plans)


def safety_filter(table: Robust, vehicle: Vehicle, period: float) -> SafetyFilter:
    """Return the safety filter with a table's constraints; it flies within that table's fallback contract.

    Raises:
        InputError: no filter can be built from these numbers.
    """
    if table.avoidance is not None:
        rule = "absent for a safety filter, which keeps no half-spaces"
        raise ParameterError("controller", "avoidance", "given", rule)
    return SafetyFilter(RobustPreparation(vehicle, table.problem(vehicle, period), table))


class _Nearest:
    """The QP of a problem whose first input should be close to a request."""

    def __init__(self, problem: Problem) -> None:
        self._problem = problem
        self._form = Staged(problem)
        self.check = AnswerCheck(problem, KKT_EVERY)
        form = self._form
        self._first = form.inputs(np.arange(form.qp.c.size, dtype=np.float64))[0].astype(np.intp)
        self._P = form.qp.P.copy()
        self._P[self._first, self._first] += 2.0
        self._backend = Piqp()
        self._backend.setup(replace(form.qp, P=self._P))
        rows = problem.rows
        origin = QPRows(problem).origin
        ends = [rows.names[row] == END for row in origin]
        self._ends = np.array(ends, bool)  # the terminal constraint's rows
        self._steady_rows = rows.C[origin[self._ends]]

    def problem_at(self, query: Query) -> Problem:
        """Return the problem with the terminal constraint about the equilibrium of a query."""
        if query.equilibrium is None:
            return self._problem
        constraints = []
        for part in self._problem.constraints:
            if part.name == END and part.C is not None:
                moved = part.C @ query.equilibrium.x
                part = replace(part, lower=part.lower + moved, upper=part.upper + moved)
            constraints.append(part)
        return replace(self._problem, constraints=tuple(constraints))

    def solve(self, query: Query, requested: Array) -> Answer:
        """Return the plan whose first input is closest to `requested` (4,) [rad/s]."""
        qp = replace(self._form.assemble(query), P=self._P)
        qp.c[self._first] -= 2.0 * requested
        if query.equilibrium is not None:  # a state of predicted rotors is far from zero there, so all rows move
            for side in (qp.h_l, qp.h_u):
                side.reshape(self._problem.horizon, -1)[:, self._ends] += self._steady_rows @ query.equilibrium.x
        return Answer.of(self._form, qp, self._backend.solve(qp), SafetyFilter.solver)


def _feasibility(problem: Problem, steady_rows: Array) -> Problem:
    """Return a problem's constraints, all hard, with the terminal condition (m, n) and a cost of inputs alone."""
    C_r = problem.objective.C_r
    nu = problem.model.nu
    objective = Objective(C_r=C_r, Q_y=LATER**2 * np.eye(len(C_r)), Q_u=LATER * np.eye(nu))
    constraints = [replace(part, penalty=None) for part in problem.every_constraint]
    if len(steady_rows):
        bound = np.full((problem.horizon, len(steady_rows)), LOOSE)
        bound[-1] = TERMINAL_TOLERANCE
        constraints.append(Constraint(name=END, lower=-bound, upper=bound, C=steady_rows))
    return replace(problem, objective=objective, bounds=None, constraints=tuple(constraints))


def _soft(part: Constraint) -> Constraint:
    lower = np.atleast_2d(part.lower)[-1]
    upper = np.atleast_2d(part.upper)[-1]
    both = np.isfinite(lower) & np.isfinite(upper)
    one = np.abs(np.where(np.isfinite(lower), lower, upper))
    half_band = np.where(both, 0.5 * (upper - lower), np.where(one > 0.0, one, 1.0))
    return replace(part, penalty=Penalty(l1=PENALTY / half_band, l2=np.zeros(half_band.size)))


def _steady_rows(problem: Problem) -> Array:
    """(m, n) orthonormal rows, zero times x - x_s where the part of the state that the bounds involve is steady."""
    rows = problem.rows
    A = problem.model.A
    bounded = rows.C[rows.on_states]
    if not len(bounded):
        return np.empty((0, len(A)))
    change = A - np.eye(len(A))
    seen = observed(change, bounded).T @ change
    return np.asarray(scipy.linalg.orth(seen.T, rcond=1e-9).T)
