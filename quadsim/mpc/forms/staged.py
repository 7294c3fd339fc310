"""The QP with all states as variables: sparse, in stages of one step, of any model and any rows.

The variables, in the order of steps, are e_0, u(k), x(k+1) | e_1, u(k+1), x(k+2) | ..., with the slacks e of soft
rows.  Its equality rows are x(k+i+1) = A_i x(k+i) + B_i u(k+i) + c_i.  All matrices are block banded, which a
multistage factorisation exploits: its cost grows linearly with the horizon.

The matrices of a problem and its own model are made once.  Those of a query's `steps`, or of other numbers in a
problem's rows, are made for that period alone.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.sparse import csc_matrix

from quadsim.mpc.problem.ocp import Problem, Query, predicted
from quadsim.mpc.problem.qp import QP, QPRows, Solution
from quadsim.state import Array, Indices


class Block(NamedTuple):
    """Blocks of a matrix, one for each of N steps."""

    rows: Indices  # (N, r)
    columns: Indices  # (N, c)
    values: Array  # (N, r, c), or (r, c) for the same at all steps


class Pattern:
    """The places of a sparse matrix, from its first blocks; entries that are zero in these are left out for good."""

    def __init__(self, blocks: Sequence[Block], shape: tuple[int, int]) -> None:
        values = _entries(blocks)
        row_parts = []
        column_parts = []
        for block in blocks:
            row_parts.append(np.repeat(block.rows, block.columns.shape[1], axis=1).ravel())
            column_parts.append(np.tile(block.columns, block.rows.shape[1]).ravel())
        rows = np.concatenate(row_parts)
        columns = np.concatenate(column_parts)
        kept = np.flatnonzero(values)
        places = csc_matrix((kept, (rows[kept], columns[kept])), shape=shape)
        self._order = places.data
        self._rows = places.indices
        self._starts = places.indptr
        self._shape = shape

    def matrix(self, blocks: Sequence[Block]) -> csc_matrix:
        """Return the matrix with these blocks at the same places."""
        return csc_matrix((_entries(blocks)[self._order], self._rows, self._starts), shape=self._shape)


def _entries(blocks: Sequence[Block]) -> Array:
    """Return all values of some blocks."""
    parts = []
    for block in blocks:
        shape = (len(block.rows), block.rows.shape[1], block.columns.shape[1])
        parts.append(np.broadcast_to(block.values, shape).ravel())
    return np.concatenate(parts)


def steps_of(problem: Problem, query: Query) -> tuple[Array, Array, Array]:
    """A (N, n, n), B (N, n, nu), c (N, n) of the predicted steps."""
    if query.steps is not None:
        return query.steps
    model = problem.model
    N = problem.horizon
    x_s, u_s = query.equilibrium or problem.equilibrium
    A = model.A
    B = model.B
    c = x_s - model.A @ x_s - model.B @ u_s
    return np.broadcast_to(A, (N, *A.shape)), np.broadcast_to(B, (N, *B.shape)), np.broadcast_to(c, (N, *c.shape))


class Staged:
    """The QP of a problem with constraints, in the variables of the module."""

    def __init__(self, problem: Problem) -> None:
        self._problem = problem
        self._rows = rows = QPRows(problem)
        N = problem.horizon
        n = problem.model.n
        nu = problem.model.nu
        slacks = rows.slack.shape[1]
        starts = np.arange(N)[:, None] * (slacks + nu + n)
        self._e = starts + np.arange(slacks)
        self._u = starts + slacks + np.arange(nu)
        self._x = starts + slacks + nu + np.arange(n)
        self._size = N * (slacks + nu + n)
        costs = self._costs()
        self._P = Pattern(costs, (self._size, self._size)).matrix(costs)
        inequalities = self._inequalities(rows)
        self._inequality = Pattern(inequalities, (rows.lower.size, self._size))
        self._G = self._inequality.matrix(inequalities)
        self._x_l = np.full(self._size, -math.inf)
        self._x_u = np.full(self._size, math.inf)
        self._x_l[self._u] = rows.u_min
        self._x_u[self._u] = rows.u_max
        self._x_l[self._e] = 0.0

    @cached_property
    def qp(self) -> QP:
        """The QP for xi(k) = 0, y_d = 0 and u(k-1) = u_bar."""
        return self.assemble(self._at_rest)

    @property
    def _at_rest(self) -> Query:
        model = self._problem.model
        objective = self._problem.objective
        return Query(np.zeros(model.n), np.zeros((self._problem.horizon, len(objective.C_r))), model.u_bar)

    @cached_property
    def _A(self) -> csc_matrix:
        """Equality rows of the problem's own model."""
        A, B, _ = steps_of(self._problem, self._at_rest)
        return self._equalities(A, B)

    def assemble(self, query: Query, problem: Problem | None = None) -> QP:
        """Return the QP of a period; `problem` may differ in the numbers of its rows, apart from bounds on inputs."""
        rows = self._rows
        G = self._G
        if problem is not None:
            rows = QPRows(problem)
            G = self._inequality.matrix(self._inequalities(rows))
        first = rows.C
        if first.ndim == 3:
            first = first[0]
        known = np.zeros(rows.lower.shape)
        known[0] = (first * ~rows.of_states[:, None]) @ query.state - rows.E @ query.u_before
        A, B, c = steps_of(self._problem, query)
        if query.steps is None:
            equalities = self._A
        else:
            equalities = self._equalities(A, B)
        b = c.copy()
        b[0] += A[0] @ query.state
        return QP(
            P=self._P,
            c=self._gradient(query),
            A=equalities,
            b=b.ravel(),
            G=G,
            h_l=(rows.lower - known).ravel(),
            h_u=(rows.upper - known).ravel(),
            x_l=self._x_l,
            x_u=self._x_u,
        )

    def _costs(self) -> list[Block]:
        """Return the blocks of P."""
        objective = self._problem.objective
        rows = self._problem.rows
        Q, _ = objective.weights
        Q_end, _ = objective.terminal_weights
        move = objective.move_weight
        return [
            Block(self._x[:-1], self._x[:-1], 2.0 * Q),
            Block(self._x[-1:], self._x[-1:], 2.0 * Q_end),
            Block(self._u[:-1], self._u[:-1], 2.0 * (objective.Q_u + 2.0 * move)),
            Block(self._u[-1:], self._u[-1:], 2.0 * (objective.Q_u + move)),
            Block(self._u[:-1], self._u[1:], -2.0 * move),
            Block(self._u[1:], self._u[:-1], -2.0 * move),
            Block(self._e, self._e, 2.0 * np.diag(rows.l2[rows.slacks])),
        ]

    def _gradient(self, query: Query) -> Array:
        """Return the cost's linear term."""
        objective = self._problem.objective
        rows = self._problem.rows
        _, W = objective.weights
        Q_end, W_end = objective.terminal_weights
        move = objective.move_weight
        x_s, u_s = query.equilibrium or self._problem.equilibrium
        gradient = np.zeros(self._size)
        gradient[self._x[:-1]] = -2.0 * query.desired[:-1] @ W.T
        # The last state's target is C_r^+ (y_d - C_r x_s) from x_s; if Q_y weighs it, x_s drops out.
        gradient[self._x[-1]] = -2.0 * (W_end @ (query.desired[-1] - objective.C_r @ x_s) + Q_end @ x_s)
        gradient[self._u] = -2.0 * u_s @ objective.Q_u
        gradient[self._u[0]] -= 2.0 * move @ query.u_before
        gradient[self._e] = rows.l1[rows.slacks]
        return gradient

    def _equalities(self, A: Array, B: Array) -> csc_matrix:
        """Return the rows of the dynamics A (N, n, n), B (N, n, nu)."""
        n = self._problem.model.n
        ends = np.arange(self._x.size).reshape(self._x.shape)
        blocks = [
            Block(ends, self._x, np.eye(n)),
            Block(ends[1:], self._x[:-1], -A[1:]),
            Block(ends, self._u, -B),
        ]
        return Pattern(blocks, (ends.size, self._size)).matrix(blocks)

    def _inequalities(self, rows: QPRows) -> list[Block]:
        """Return the blocks of G."""
        numbers = np.arange(rows.lower.size).reshape(rows.lower.shape)
        of_ends = rows.C * rows.of_states[:, None]
        of_starts = rows.C * ~rows.of_states[:, None]
        if of_starts.ndim == 3:
            of_starts = of_starts[1:]
        return [
            Block(numbers, self._x, of_ends),
            Block(numbers[1:], self._x[:-1], of_starts),
            Block(numbers, self._u, rows.D + rows.E),
            Block(numbers[1:], self._u[:-1], -rows.E),
            Block(numbers, self._e, rows.slack),
        ]

    def inputs(self, x: Array) -> Array:
        """Return (N, nu) the planned inputs of a primal point."""
        return x[self._u]

    def states(self, x: Array) -> Array:
        """Return (N, n) the predicted states of a primal point."""
        return x[self._x]

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
        x = np.zeros(self._size)
        z_box = np.zeros(self._size)
        x[self._u] = plan
        x[self._x] = predicted(self._problem, query, plan)
        x[self._e] = slacks * self.slack_scale
        z, z_inputs = self._rows.split(multipliers)
        z_box[self._u] = z_inputs.reshape(plan.shape)
        gradient = qp.P @ x + qp.c + qp.G.T @ z
        z_box[self._e] = -np.maximum(gradient[self._e], 0.0)
        A, _, _ = steps_of(self._problem, query)
        y = -gradient[self._x]
        for i in range(len(y) - 2, -1, -1):
            y[i] += A[i + 1].T @ y[i + 1]
        return Solution(x, y.ravel(), z, z_box)
