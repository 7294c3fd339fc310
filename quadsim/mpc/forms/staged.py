"""The QP with all states as variables: of any model, sparse, for certificates and diagnosis.

The variables, in the order of steps, are u(k), e_0, x(k+1) | u(k+1), e_1, x(k+2) | ..., with the slacks e of soft
rows.  Its equality rows are x(k+i+1) = A_i x(k+i) + B_i u(k+i) + c_i.  It is slow to assemble, and states what is
solved without algebra of its own: controllers solve other forms.
"""

from __future__ import annotations

import math
from functools import partial

import numpy as np
from scipy.sparse import coo_matrix, csc_matrix

from quadsim.mpc.problem.ocp import Problem, Query, predicted
from quadsim.mpc.problem.qp import QP, PeriodQP, QPRows, Solution
from quadsim.state import Array, Indices


def steps_of(problem: Problem, query: Query) -> tuple[Array, Array, Array]:
    """A (N, n, n), B (N, n, nu), c (N, n) of the predicted steps."""
    if query.steps is not None:
        return query.steps
    model, N, (x_s, u_s) = problem.model, problem.horizon, query.equilibrium or problem.equilibrium
    A, B, c = model.A, model.B, x_s - model.A @ x_s - model.B @ u_s
    return np.tile(A, (N, 1, 1)), np.tile(B, (N, 1, 1)), np.tile(c, (N, 1))


class Staged:
    """The QP of a problem with constraints, in the variables of the module."""

    def __init__(self, problem: Problem) -> None:
        self._problem, self._rows = problem, QPRows(problem)
        N, n, nu, slacks = problem.horizon, problem.model.n, problem.model.nu, self._rows.slack.shape[1]
        at = np.arange(N)[:, None] * (nu + slacks + n)
        self._u, self._e, self._x = at + np.arange(nu), at + nu + np.arange(slacks), at + nu + slacks + np.arange(n)
        self._size = N * (nu + slacks + n)

    def assemble(self, query: Query) -> PeriodQP:
        """Return the QP of a period."""
        problem, rows, size = self._problem, self._rows, self._size
        N, objective, soft = problem.horizon, problem.objective, problem.rows.slacks
        (A, B, c), (x_s, u_s) = steps_of(problem, query), query.equilibrium or problem.equilibrium
        (Q, W), (Q_end, W_end), move = objective.weights, objective.terminal_weights, objective.move_weight
        blocks = [
            (self._x[:-1], self._x[:-1], 2.0 * Q),
            (self._x[-1:], self._x[-1:], 2.0 * Q_end),
            (self._u[:-1], self._u[:-1], 2.0 * (objective.Q_u + 2.0 * move)),
            (self._u[-1:], self._u[-1:], 2.0 * (objective.Q_u + move)),
            (self._u[:-1], self._u[1:], -2.0 * move),
            (self._u[1:], self._u[:-1], -2.0 * move),
            (self._e, self._e, 2.0 * np.diag(problem.rows.l2[soft])),
        ]
        gradient = np.zeros(size)
        gradient[self._x[:-1]] = -2.0 * query.desired[:-1] @ W.T
        gradient[self._x[-1]] = -2.0 * (W_end @ (query.desired[-1] - objective.C_r @ x_s) + Q_end @ x_s)
        gradient[self._u] = -2.0 * u_s @ objective.Q_u
        gradient[self._u[0]] -= 2.0 * move @ query.u_before
        gradient[self._e] = problem.rows.l1[soft]
        ends = np.arange(N * problem.model.n).reshape(N, -1)
        dynamics = [(ends, self._x, np.eye(problem.model.n)), (ends[1:], self._x[:-1], -A[1:]), (ends, self._u, -B)]
        b = c.copy()
        b[0] += A[0] @ query.state
        numbers = np.arange(rows.lower.size).reshape(N, -1)
        of_ends, of_starts = rows.C * rows.of_states[:, None], rows.C * ~rows.of_states[:, None]
        later = of_starts if of_starts.ndim == 2 else of_starts[1:]
        inequalities = [
            (numbers, self._x, of_ends),
            (numbers[1:], self._x[:-1], later),
            (numbers, self._u, rows.D + rows.E),
            (numbers[1:], self._u[:-1], -rows.E),
            (numbers, self._e, rows.slack),
        ]
        known = np.zeros(rows.lower.shape)
        known[0] = (of_starts if of_starts.ndim == 2 else of_starts[0]) @ query.state - rows.E @ query.u_before
        x_l, x_u = np.full(size, -math.inf), np.full(size, math.inf)
        x_l[self._u], x_u[self._u], x_l[self._e] = rows.u_min, rows.u_max, 0.0
        qp = QP(
            P=_sparse(blocks, (size, size)),
            c=gradient,
            A=_sparse(dynamics, (ends.size, size)),
            b=b.ravel(),
            G=_sparse(inequalities, (numbers.size, size)),
            h_l=(rows.lower - known).ravel(),
            h_u=(rows.upper - known).ravel(),
            x_l=x_l,
            x_u=x_u,
        )
        return PeriodQP(qp, partial(np.take, indices=self._x))

    def inputs(self, x: Array) -> Array:
        """Return (N, nu) the planned inputs of a primal point."""
        return x[self._u]

    def slacks(self, x: Array) -> Array:
        """Return (N, m_s) the slacks of a primal point, in the constraints' units."""
        return x[self._e] / self.slack_scale

    @property
    def slack_scale(self) -> Array:
        """(m_s,) what a slack variable is per unit of the constraint's."""
        return self._problem.rows.slack_scale

    @property
    def slack_columns(self) -> Indices:
        """(N, m_s) indices of the slacks among the variables."""
        return self._e

    def multipliers(self, solution: Solution) -> Array:
        """Return (N, m) the multipliers of the problem's rows (`constraints.Rows`), signed as in `Solution`."""
        return self._rows.multipliers(solution.z, solution.z_box[self._u].ravel())

    def solution(self, query: Query, qp: QP, plan: Array, slacks: Array, multipliers: Array) -> Solution:
        """Return a QP's solution for a plan (N, nu), slacks (N, m_s) and row multipliers (N, m).

        States follow the plan, and their multipliers are those for which the Lagrangian is stationary in them.
        """
        x, z_box = np.zeros(self._size), np.zeros(self._size)
        x[self._u], x[self._x] = plan, predicted(self._problem, query, plan)
        x[self._e] = slacks * self.slack_scale
        z, z_inputs = self._rows.split(multipliers)
        z_box[self._u] = z_inputs.reshape(plan.shape)
        gradient = qp.P @ x + qp.c + qp.G.T @ z
        z_box[self._e] = -np.maximum(gradient[self._e], 0.0)
        (A, _, _), y = steps_of(self._problem, query), -gradient[self._x]
        for i in range(len(y) - 2, -1, -1):
            y[i] += A[i + 1].T @ y[i + 1]
        return Solution(x, y.ravel(), z, z_box)


def _sparse(blocks: list[tuple[Indices, Indices, Array]], shape: tuple[int, int]) -> csc_matrix:
    """Return the sum of blocks (N, rows, columns), or one for all, at rows (N, rows) and columns (N, columns)."""
    entries = [(np.broadcast_to(block, (len(i), i.shape[1], j.shape[1])), i, j) for i, j, block in blocks]
    values = np.concatenate([block.ravel() for block, _, _ in entries])
    rows = np.concatenate([np.broadcast_to(i[:, :, None], block.shape).ravel() for block, i, _ in entries])
    columns = np.concatenate([np.broadcast_to(j[:, None, :], block.shape).ravel() for block, _, j in entries])
    return coo_matrix((values, (rows, columns)), shape=shape).tocsc()
