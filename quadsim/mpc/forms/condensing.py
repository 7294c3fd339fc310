"""The paper's condensed QP in the inputs alone, for any optimal control problem.  Eqs. (27)-(29).

For the paper's problem the matrices are those of Eqs. (7)-(20) as printed, with pairs of rows as two-sided rows.
Further cost terms add to them, further constraints add rows, and soft rows add slacks after the inputs.
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
"""Largest condition number of a Hessian, in the 1-norm, for which its factor gives the unconstrained optimum: then
rounding moves the optimum by some 1e-6 of its size at most.  The library's are below 1e7, so that no machine's rounding
decides who answers."""


@dataclass(frozen=True, kw_only=True)
class CondensedCost:
    """J = 1/2 v' H v + [F_x dx + F_y dy + F_d du]' v + const, for deviations from an equilibrium (x_s, u_s).

    With v = u - u_s the sequence of inputs, dx = x(k) - x_s, dy = y_d - C_r x_s and du = u(k-1) - u_s.
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
        F_d[:nu] = -2.0 * objective.Q_d
    if objective.P is not None:
        Q, W = objective.weights
        Q_end, W_end = objective.terminal_weights
        last = maps.Psi[-n:]
        free = maps.Phi[-n:]
        H = H + 2.0 * last.T @ (Q_end - Q) @ last
        F_x = F_x + 2.0 * last.T @ (Q_end - Q) @ free
        F_y = F_y.copy()
        F_y[:, -W.shape[1] :] -= 2.0 * last.T @ (W_end - W)
    return CondensedCost(H=0.5 * (H + H.T), F_x=F_x, F_y=F_y, F_d=F_d)


@dataclass(frozen=True, kw_only=True)
class RowMaps:
    """Values (N, m) of rows: of_inputs v + of_state dx + of_rest, before E du is subtracted from the first."""

    of_inputs: Array  # (N, m, N nu) slopes in v = u - u_s
    of_state: Array  # (N, m, n) in dx = x(k) - x_s


def states_rows(C: Array, of_states: RowFlags, maps: Prediction, N: int) -> RowMaps:
    """Return rows C (m, n) at x(k+1) .. x(k+N) if they depend on states alone, otherwise at x(k) .. x(k+N-1)."""
    n = C.shape[1]
    columns = maps.Psi.shape[1]
    Psi = np.concatenate([np.zeros((1, n, columns)), maps.Psi.reshape(N, n, columns)])
    Phi = np.concatenate([np.eye(n)[None], maps.Phi.reshape(N, n, n)])
    return RowMaps(of_inputs=_on_states(C, of_states, Psi), of_state=_on_states(C, of_states, Phi))


def row_maps(rows: QPRows, maps: Prediction) -> RowMaps:
    """Return the rows' values as functions of inputs and state.  Eqs. (14), (16)-(19), for any rows."""
    if rows.C.ndim == 3:
        raise ValueError("a condensed QP needs rows that are the same at all steps; the staged one takes any")
    values = states_rows(rows.C, rows.of_states, maps, len(rows.lower))
    return replace(values, of_inputs=_with_inputs(values.of_inputs, rows))


def _on_states(C: Array, of_states: RowFlags, S: Array) -> Array:
    """Return (N, m, columns): rows C applied to the slopes S (N + 1, n, columns) of x(k) .. x(k+N)."""
    return np.asarray((C * of_states[:, None]) @ S[1:] + (C * ~of_states[:, None]) @ S[:-1])


def _with_inputs(values: Array, rows: QPRows) -> Array:
    """Return the rows' slopes (N, m, N nu) with the direct terms D u + E du added."""
    N = len(values)
    nu = rows.D.shape[1]
    by_step = values.reshape(N, len(rows.D), N, nu)
    by_step[range(N), :, range(N)] += rows.D + rows.E
    by_step[range(1, N), :, range(N - 1)] -= rows.E
    return by_step.reshape(values.shape)


class Condensed:
    """min 1/2 x' P x + c' x over x = [u(k); ...; u(k+N-1); e], with e (N, m_s) the slacks of soft rows.

    `qp` is the QP for xi(k) = 0, y_d = 0 and u(k-1) = u_bar, its rows ordered by time; `cost` covers the inputs alone.

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
        model = problem.model
        N = problem.horizon
        nu = problem.model.nu
        maps = prediction(model, N)
        self.cost = condensed_cost(problem, maps)
        self._values = row_maps(self._rows, maps)
        rows = self._rows
        self._inputs = N * nu
        m_s = rows.slack.shape[1]
        soft = problem.rows.slacks
        l1 = np.tile(problem.rows.l1[soft], N)
        l2 = np.tile(problem.rows.l2[soft], N)
        self._linear = np.concatenate([np.zeros(self._inputs), l1])
        G = np.zeros((N, len(rows.C), self._inputs + N * m_s))
        G[:, :, : self._inputs] = self._values.of_inputs
        hessian = self.cost.H
        if m_s:
            hessian = scipy.linalg.block_diag(self.cost.H, 2.0 * np.diag(l2))
            for i in range(N):
                first = self._inputs + i * m_s
                G[i, :, first : first + m_s] = rows.slack
        self._of_rest = self._values.of_inputs.reshape(N, len(rows.C), N, nu).sum(axis=2)  # constant input u_s
        self._pull = self.cost.H.reshape(N * nu, N, nu).sum(axis=1)  # constant input u_s
        size = self._inputs + N * m_s
        self._blank = QP(
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
        nothing = np.zeros((N, problem.objective.C_r.shape[0]))
        self.qp = self.assemble(Query(np.zeros(model.n), nothing, model.u_bar))

    @classmethod
    def of(cls, problem: Problem) -> Condensed:
        """Return the condensed QP of any problem; one without constraints has infinite bounds on its inputs."""
        if problem.every_constraint:
            return cls(problem)
        none = np.zeros(0)
        anything = np.full(problem.model.nu, math.inf)
        free = Bounds(
            C_c=np.zeros((0, problem.model.n)),
            y_min=none,
            y_max=none,
            delta_min=-anything,
            delta_max=anything,
            u_min=-anything,
            u_max=anything,
        )
        return cls(replace(problem, bounds=free))

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
        if state.shape == (N_STATES,):
            state = np.concatenate([state, u_before])[:n]
        check_shape("state", state, (n,))
        check_shape("reference", reference, (problem.horizon, len(REFERENCE_STATES)))
        hover = Equilibrium(np.concatenate([np.zeros(N_STATES), u_bar])[:n], u_bar)
        query = Query(state, problem.desired(reference), u_before, equilibrium or hover)
        qp = self.assemble(query)
        return CondensedQP(*map(np.array, (qp.P, qp.c, qp.G, qp.h_l, qp.h_u, qp.x_l, qp.x_u)))

    def assemble(self, query: Query) -> QP:
        """Return the QP of a period; its matrices are those of `qp` itself."""
        h_l, h_u = self.row_bounds(query)
        return replace(self._blank, c=self.gradient(query), h_l=h_l, h_u=h_u)

    def gradient(self, query: Query) -> Array:
        """Return the linear term c of the cost."""
        terms = self.cost
        C_r = self._problem.objective.C_r
        x_s, u_s = query.equilibrium or self._problem.equilibrium
        of_state = terms.F_x @ (query.state - x_s)
        of_desired = terms.F_y @ (query.desired - C_r @ x_s).ravel()
        of_before = terms.F_d @ (query.u_before - u_s)
        c = self._linear.copy()
        c[: self._inputs] += of_state + of_desired + of_before - self._pull @ u_s
        return c

    def row_bounds(self, query: Query) -> tuple[Array, Array]:
        """Return h_l and h_u: rows refer to absolute inputs u = u_s + v and states x_s + dx(v)."""
        values = self._values
        rows = self._rows
        x_s, u_s = query.equilibrium or self._problem.equilibrium
        shift = rows.C @ x_s + rows.D @ u_s + values.of_state @ (query.state - x_s) - self._of_rest @ u_s
        shift[0] += rows.E @ (u_s - query.u_before)
        return (rows.lower - shift).ravel(), (rows.upper - shift).ravel()

    def inputs(self, x: Array) -> Array:
        """Return (N, nu) the planned inputs [rad/s] of a primal point."""
        return x[: self._inputs].reshape(self._problem.horizon, -1)

    def slacks(self, x: Array) -> Array:
        """Return (N, m_s) the slacks of a primal point, in the constraints' units."""
        return x[self._inputs :].reshape(self._problem.horizon, -1) / self._problem.rows.slack_scale

    def multipliers(self, solution: Solution) -> Array:
        """Return (N, m) the multipliers of the problem's rows (`constraints.Rows`), signed as in `Solution`."""
        return self._rows.multipliers(solution.z, solution.z_box[: self._inputs])

    def solution(self, plan: Array, slacks: Array, multipliers: Array) -> Solution:
        """Return this QP's solution for a plan (N, nu), slacks (N, m_s) and row multipliers (N, m).

        Multipliers are positive at upper bounds and negative at lower ones.
        """
        z, z_box = self._rows.split(multipliers)
        x = plan.ravel()
        rows = self._problem.rows
        if rows.soft.size:
            l1 = rows.l1[rows.slacks]
            l2 = rows.l2[rows.slacks]
            slacks = slacks * rows.slack_scale
            normalised = multipliers[:, rows.soft] / rows.scale[rows.soft]
            prices = np.abs(normalised) @ (rows.slack[rows.soft][:, None] == np.arange(l1.size))
            # Stationarity of a slack: l1 + 2 l2 e - sum |z| + z_box = 0.
            z_slacks = np.minimum(prices - l1 - 2.0 * l2 * slacks, 0.0)
            x = np.concatenate((x, slacks.ravel()))
            z_box = np.concatenate((z_box, z_slacks.ravel()))
        return Solution(x, self._blank.b, z, z_box)


class FreeOptimum:
    """The unconstrained optimum, which is the optimum if it satisfies every constraint.  Eq. (22).

    The Hessian is factorised once, and no QP is assembled to try it.
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
        size = problem.horizon * (problem.model.nu + rows.slack.shape[1])
        if size * (size + rows.lower.size) > LARGEST_QP:
            return None
        optimum = cls(form or Condensed(problem))
        if optimum.condition <= LARGEST_CONDITION:
            return optimum
        return None

    def _condition(self) -> float:
        """Return the condition number of the Hessian in the 1-norm, estimated from its factor (LAPACK's dpocon)."""
        reciprocal, _ = lapack.dpocon(self._factor, float(np.abs(self.form.cost.H).sum(axis=0).max()))
        if reciprocal > 0.0:
            return 1.0 / reciprocal
        return math.inf

    def solve(self, query: Query) -> Solution | None:
        """Return the condensed QP's solution without constraints; None if it violates one."""
        qp = self.form.qp
        c = self.form.gradient(query)
        x = np.zeros(c.size)
        m = len(self._factor)
        x[:m], failed = lapack.dpotrs(self._factor, -c[:m])
        if failed or not ((qp.x_l <= x) & (x <= qp.x_u)).all():
            return None
        values = qp.G @ x
        h_l, h_u = self.form.row_bounds(query)
        if not ((h_l <= values) & (values <= h_u)).all():
            return None
        z_box = np.concatenate([np.zeros(m), -c[m:]])
        return Solution(x, np.zeros(0), np.zeros(values.size), z_box, status=UNCONSTRAINED)
