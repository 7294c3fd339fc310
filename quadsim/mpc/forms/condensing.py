"""The paper's condensed QP in the inputs alone, for any optimal control problem.  Eqs. (27)-(29).

For the paper's problem the matrices are those of Eqs. (7)-(20), except that a lower and an upper bound on the same
quantity, two rows in the paper, are one row with two bounds.  Further cost terms add to the matrices, further
constraints add rows, and soft rows add slacks after the inputs.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import scipy.linalg
from scipy.linalg import lapack

from quadsim.controller import UNCONSTRAINED
from quadsim.mpc.problem.constraints import Bounds, RowFlags
from quadsim.mpc.problem.ocp import CondensedQP, Equilibrium, Problem, Query, check_shape
from quadsim.mpc.problem.paper import Prediction, cost, prediction, slew_matrix
from quadsim.mpc.problem.qp import QP, QPRows, Solution
from quadsim.state import N_STATES, REFERENCE_STATES, Array

LARGEST_QP: Final = 2**20
"""Largest size of the QP's matrices [entries] for which trying the unconstrained optimum first saves time."""
LARGEST_CONDITION: Final = 1e10
"""Largest condition number of a Hessian, in the 1-norm, for which the unconstrained optimum is tried: rounding then
moves it by some 1e-6 of its size at most.  The condition numbers of the library's scenarios are below 1e7.  They are so
far from this limit that the optimum is tried, or not, alike on every machine."""


@dataclass(frozen=True, kw_only=True)
class CondensedCost:
    """J = 1/2 v' H v + [F_x dx + F_y dy + F_d du]' v + const, for deviations from an equilibrium (x_s, u_s).

    The deviations are v = u - u_s of the inputs of all steps, dx = x(k) - x_s of the state, dy = y_d - C_r x_s of the
    desired outputs of all steps, and du = u(k-1) - u_s of the input before.
    """

    H: Array  # (N nu, N nu) symmetric positive definite. Eq. (7)
    F_x: Array  # (N nu, n). Eq. (8)
    F_y: Array  # (N nu, N n_r). Eq. (9)
    F_d: Array  # (N nu, nu), zero without a weight on input changes


def condensed_cost(problem: Problem, maps: Prediction) -> CondensedCost:
    """Return the cost of a problem from its prediction map."""
    objective = problem.objective
    N = problem.horizon
    n = problem.model.n
    nu = problem.model.nu
    terms = cost(maps, objective)
    H = terms.H
    F_x = terms.F1
    F_y = terms.F2
    F_d = np.zeros((N * nu, nu))
    if objective.Q_d is not None:
        steps = slew_matrix(N, nu)
        H = H + 2.0 * steps.T @ np.kron(np.eye(N), objective.Q_d) @ steps
        F_d[:nu] = -2.0 * objective.Q_d  # the first step is u(k) - u(k-1)
    if objective.P is not None:
        # So far the last state has the weights Q and W of all others: the difference to its own weights is added.
        Q, W = objective.weights
        Q_end, W_end = objective.terminal_weights
        added_Q = Q_end - Q
        added_W = W_end - W
        Psi_N = maps.Psi[-n:]
        Phi_N = maps.Phi[-n:]
        H = H + 2.0 * Psi_N.T @ added_Q @ Psi_N
        F_x = F_x + 2.0 * Psi_N.T @ added_Q @ Phi_N
        F_y = F_y.copy()
        F_y[:, -W.shape[1] :] -= 2.0 * Psi_N.T @ added_W
    return CondensedCost(H=0.5 * (H + H.T), F_x=F_x, F_y=F_y, F_d=F_d)


@dataclass(frozen=True, kw_only=True)
class RowMaps:
    """Slopes of the values (N, m) of rows: a deviation from the equilibrium changes them by of_inputs v + of_state dx.

    The input before, u(k-1), is no part of this map: it changes the values of the first step alone, by -E du.
    """

    of_inputs: Array  # (N, m, N nu) in v = u - u_s
    of_state: Array  # (N, m, n) in dx = x(k) - x_s


def states_rows(C: Array, of_states: RowFlags, maps: Prediction, N: int) -> RowMaps:
    """Return the map of the part C x of rows, with C (m, n); their direct terms in inputs are not in it.

    Rows on states alone (`of_states`, (m,)) are at x(k+1) .. x(k+N), all others at x(k) .. x(k+N-1).
    """
    n = C.shape[1]
    columns = maps.Psi.shape[1]
    # (N + 1, n, ...) slopes of x(k) .. x(k+N); no input acts on x(k).
    Psi = np.concatenate([np.zeros((1, n, columns)), maps.Psi.reshape(N, n, columns)])
    Phi = np.concatenate([np.eye(n)[None], maps.Phi.reshape(N, n, n)])
    return RowMaps(of_inputs=_on_states(C, of_states, Psi), of_state=_on_states(C, of_states, Phi))


def row_maps(rows: QPRows, maps: Prediction) -> RowMaps:
    """Return the rows' values as functions of inputs and state.  Eqs. (14), (16)-(19), for any rows."""
    if rows.C.ndim == 3:
        raise ValueError("a condensed QP needs rows that are the same at all steps; the staged one takes any")
    of_states = states_rows(rows.C, rows.of_states, maps, len(rows.lower))
    return replace(of_states, of_inputs=_with_inputs(of_states.of_inputs, rows))


def _on_states(C: Array, of_states: RowFlags, slopes: Array) -> Array:
    """Return (N, m, columns) the slopes of rows C, from those of x(k) .. x(k+N), (N + 1, n, columns)."""
    at_ends = C * of_states[:, None]
    at_starts = C * ~of_states[:, None]
    return np.asarray(at_ends @ slopes[1:] + at_starts @ slopes[:-1])


def _with_inputs(slopes: Array, rows: QPRows) -> Array:
    """Add the direct terms D u(k+i) + E (u(k+i) - u(k+i-1)) to the rows' slopes (N, m, N nu), in place; return them."""
    N = len(slopes)
    nu = rows.D.shape[1]
    by_step = slopes.reshape(N, len(rows.D), N, nu)
    for i in range(N):
        by_step[i, :, i] += rows.D + rows.E
        if i > 0:
            by_step[i, :, i - 1] -= rows.E
    return by_step.reshape(slopes.shape)


class Condensed:
    """min 1/2 x' P x + c' x over x = [u(k); ...; u(k+N-1); e], with e (N, m_s) the slacks of soft rows.

    The matrices of the QP are the same in every period; `assemble` makes its vectors from a query.

    Attributes:
        cost: the cost of the inputs, without that of the slacks.
        qp: the QP for xi(k) = 0, y_d = 0 and u(k-1) = u_bar, its rows ordered by time.

    Examples:
        >>> import numpy as np
        >>> import quadsim
        >>> from quadsim import mpc
        >>> problem = quadsim.problem("paper-constrained")
        >>> form = mpc.Condensed(problem)
        >>> query = mpc.Query(np.zeros(12), np.zeros((50, 4)), problem.model.u_bar)
        >>> qp = form.assemble(query)
        >>> qp.P.shape, bool(qp.P is form.qp.P)
        ((200, 200), True)
    """

    def __init__(self, problem: Problem) -> None:
        self._problem = problem
        self._rows = QPRows(problem)
        N = problem.horizon
        nu = problem.model.nu
        maps = prediction(problem.model, N)
        self.cost = condensed_cost(problem, maps)
        self._values = row_maps(self._rows, maps)
        self._n_inputs = N * nu
        # What an input that is held over the horizon adds, per unit, to the rows' values (N, m, nu) and to the cost's
        # gradient (N nu, nu).
        self._values_of_held = self._values.of_inputs.reshape(N, len(self._rows.C), N, nu).sum(axis=2)
        self._gradient_of_held = self.cost.H.reshape(N * nu, N, nu).sum(axis=1)
        l1 = problem.rows.l1[problem.rows.slacks]
        self._linear = np.concatenate([np.zeros(self._n_inputs), np.tile(l1, N)])
        self._template = self._qp_without_query()
        nothing_desired = np.zeros((N, problem.objective.C_r.shape[0]))
        self.qp = self.assemble(Query(np.zeros(problem.model.n), nothing_desired, problem.model.u_bar))

    def _qp_without_query(self) -> QP:
        """Return the QP's matrices and box, with zeros for the vectors that depend on the query."""
        N = self._problem.horizon
        rows = self._rows
        inputs = self._n_inputs
        m_s = rows.slack.shape[1]
        size = inputs + N * m_s
        hessian = self.cost.H
        G = np.zeros((N, len(rows.C), size))
        G[:, :, :inputs] = self._values.of_inputs
        if m_s:
            l2 = self._problem.rows.l2[self._problem.rows.slacks]
            hessian = scipy.linalg.block_diag(hessian, 2.0 * np.diag(np.tile(l2, N)))
            for i in range(N):
                first = inputs + i * m_s
                G[i, :, first : first + m_s] = rows.slack
        return QP(
            P=np.asfortranarray(hessian),
            c=np.zeros(size),
            A=np.zeros((0, size)),
            b=np.zeros(0),
            G=np.asfortranarray(G.reshape(-1, size)),
            h_l=np.zeros(rows.lower.size),
            h_u=np.zeros(rows.lower.size),
            x_l=np.concatenate([rows.u_min.ravel(), np.zeros(N * m_s)]),
            x_u=np.concatenate([rows.u_max.ravel(), np.full(N * m_s, np.inf)]),
        )

    @classmethod
    def of(cls, problem: Problem) -> Condensed:
        """Return the condensed QP of any problem; one without constraints has infinite bounds on its inputs."""
        if problem.every_constraint:
            return cls(problem)
        no_outputs = np.zeros(0)
        infinite = np.full(problem.model.nu, math.inf)
        bounds = Bounds(
            C_c=np.zeros((0, problem.model.n)),
            y_min=no_outputs,
            y_max=no_outputs,
            delta_min=-infinite,
            delta_max=infinite,
            u_min=-infinite,
            u_max=infinite,
        )
        return cls(replace(problem, bounds=bounds))

    def period(
        self, state: Array, reference: Array, u_before: Array, equilibrium: Equilibrium | None = None
    ) -> CondensedQP:
        """Return the QP of one period as new arrays; see `quadsim.mpc.problem.ocp.Problem.qp`.

        Raises:
            ParameterError: an array has another shape.
        """
        problem = self._problem
        state = np.asarray(state, float)
        reference = np.asarray(reference, float)
        u_before = np.asarray(u_before, float)
        n = problem.model.n
        u_bar = problem.model.u_bar
        check_shape("u_before", u_before, u_bar.shape)
        # A model with rotor lag has the rotor speeds as its last states; the cut removes them for one without.
        if state.shape == (N_STATES,):
            state = np.concatenate([state, u_before])[:n]
        check_shape("state", state, (n,))
        check_shape("reference", reference, (problem.horizon, len(REFERENCE_STATES)))
        if equilibrium is None:
            hover = np.concatenate([np.zeros(N_STATES), u_bar])[:n]
            equilibrium = Equilibrium(hover, u_bar)
        qp = self.assemble(Query(state, problem.desired(reference), u_before, equilibrium))
        return CondensedQP(
            H=np.array(qp.P),
            f=np.array(qp.c),
            A=np.array(qp.G),
            lower=np.array(qp.h_l),
            upper=np.array(qp.h_u),
            x_min=np.array(qp.x_l),
            x_max=np.array(qp.x_u),
        )

    def assemble(self, query: Query) -> QP:
        """Return the QP of a period; its matrices are those of `qp` itself."""
        h_l, h_u = self.row_bounds(query)
        return replace(self._template, c=self.gradient(query), h_l=h_l, h_u=h_u)

    def gradient(self, query: Query) -> Array:
        """Return the linear term c of the cost, in absolute inputs u = u_s + v.

        The cost's gradient in v is H v + F_x dx + F_y dy + F_d du, and H v = H u - H [u_s; ...; u_s].
        """
        terms = self.cost
        C_r = self._problem.objective.C_r
        x_s, u_s = query.equilibrium or self._problem.equilibrium
        of_state = terms.F_x @ (query.state - x_s)
        of_desired = terms.F_y @ (query.desired - C_r @ x_s).ravel()
        of_before = terms.F_d @ (query.u_before - u_s)
        c = self._linear.copy()
        c[: self._n_inputs] += of_state + of_desired + of_before - self._gradient_of_held @ u_s
        return c

    def row_bounds(self, query: Query) -> tuple[Array, Array]:
        """Return h_l and h_u: the rows' bounds less the part of their values that no input changes.

        That part is the value at absolute inputs u = u_s + v = 0: the value at the equilibrium, plus the changes by
        dx, by v = -u_s, and at the first step by the input before.
        """
        rows = self._rows
        x_s, u_s = query.equilibrium or self._problem.equilibrium
        at_equilibrium = rows.C @ x_s + rows.D @ u_s
        of_state = self._values.of_state @ (query.state - x_s)
        fixed = at_equilibrium + of_state - self._values_of_held @ u_s
        fixed[0] += rows.E @ (u_s - query.u_before)
        return (rows.lower - fixed).ravel(), (rows.upper - fixed).ravel()

    def inputs(self, x: Array) -> Array:
        """Return (N, nu) the planned inputs [rad/s] of a primal point."""
        return x[: self._n_inputs].reshape(self._problem.horizon, -1)

    def slacks(self, x: Array) -> Array:
        """Return (N, m_s) the slacks of a primal point, in the constraints' units."""
        return x[self._n_inputs :].reshape(self._problem.horizon, -1) / self._problem.rows.slack_scale

    def multipliers(self, solution: Solution) -> Array:
        """Return (N, m) the multipliers of the problem's rows (`constraints.Rows`), signed as in `Solution`."""
        return self._rows.multipliers(solution.z, solution.z_box[: self._n_inputs])

    def solution(self, plan: Array, slacks: Array, multipliers: Array) -> Solution:
        """Return this QP's solution for a plan (N, nu), slacks (N, m_s) and row multipliers (N, m).

        Multipliers are positive at upper bounds and negative at lower ones.
        """
        z, z_box = self._rows.split(multipliers)
        x = plan.ravel()
        rows = self._problem.rows
        if rows.soft.size:
            normalised_slacks = slacks * rows.slack_scale
            z_slacks = self._slack_multipliers(normalised_slacks, multipliers)
            x = np.concatenate((x, normalised_slacks.ravel()))
            z_box = np.concatenate((z_box, z_slacks.ravel()))
        no_equalities = self._template.b
        return Solution(x, no_equalities, z, z_box)

    def _slack_multipliers(self, slacks: Array, multipliers: Array) -> Array:
        """Return (N, m_s) the multipliers of e >= 0, not positive, for normalised slacks and row multipliers (N, m).

        A slack e is stationary where l1 + 2 l2 e - sum |z| + z_e = 0, with the sum over the rows that have this slack.
        """
        rows = self._problem.rows
        l1 = rows.l1[rows.slacks]
        l2 = rows.l2[rows.slacks]
        of_soft_rows = multipliers[:, rows.soft] / rows.scale[rows.soft]
        has_slack = rows.slack[rows.soft][:, None] == np.arange(l1.size)  # (soft rows, m_s)
        sums = np.abs(of_soft_rows) @ has_slack
        return np.minimum(sums - l1 - 2.0 * l2 * slacks, 0.0)


class FreeOptimum:
    """The unconstrained optimum, which is the optimum if it satisfies every constraint.  Eq. (22).

    The Hessian is factorised once, and no QP is assembled to try it.

    Attributes:
        form: the condensed QP.
        condition: the condition number of its Hessian in the 1-norm; infinite if it has no Cholesky factor.
    """

    def __init__(self, form: Condensed) -> None:
        self.form = form
        self._factor, failed = lapack.dpotrf(form.cost.H)
        if failed:
            self.condition = math.inf
        else:
            self.condition = self._condition()

    @classmethod
    def of(cls, problem: Problem, form: Condensed | None = None) -> FreeOptimum | None:
        """Return a problem's unconstrained optimum; None where it saves no time, or rounding would move it.

        `form` is the problem's condensed QP, if there is one already.
        """
        rows = QPRows(problem)
        variables = problem.horizon * (problem.model.nu + rows.slack.shape[1])
        entries = variables * (variables + rows.lower.size)  # of P and G
        if entries > LARGEST_QP:
            return None
        optimum = cls(form or Condensed(problem))
        if optimum.condition <= LARGEST_CONDITION:
            return optimum
        return None

    def _condition(self) -> float:
        """Return the condition number of the Hessian in the 1-norm, estimated from its factor (LAPACK's dpocon)."""
        norm = float(np.abs(self.form.cost.H).sum(axis=0).max())
        reciprocal, _ = lapack.dpocon(self._factor, norm)
        if reciprocal > 0.0:
            return 1.0 / reciprocal
        return math.inf

    def solve(self, query: Query) -> Solution | None:
        """Return the condensed QP's solution without constraints; None if it violates one.  All slacks are zero."""
        qp = self.form.qp
        c = self.form.gradient(query)
        inputs = len(self._factor)
        x = np.zeros(c.size)
        x[:inputs], failed = lapack.dpotrs(self._factor, -c[:inputs])
        in_box = (qp.x_l <= x) & (x <= qp.x_u)
        if failed or not in_box.all():
            return None
        values = qp.G @ x
        h_l, h_u = self.form.row_bounds(query)
        satisfied = (h_l <= values) & (values <= h_u)
        if not satisfied.all():
            return None
        z_slacks = -c[inputs:]  # the bound e >= 0 balances the slacks' linear cost
        z_box = np.concatenate([np.zeros(inputs), z_slacks])
        return Solution(x, np.zeros(0), np.zeros(values.size), z_box, status=UNCONSTRAINED)
