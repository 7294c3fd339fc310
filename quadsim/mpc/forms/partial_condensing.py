"""The partially condensed QP: the horizon in stages of a few steps.

A condensed QP is dense; one with all states as variables is large. Partial condensing lies in between: it cuts the
horizon into stages of M steps. The variables, in stage order, are

    v_0, e_0 | s_1, v_1, e_1 | s_2, v_2, e_2 | ... | s_J, e_J

with s_j the state at the start of stage j (s_0 = x(k) is known, s_J = x(k+N)), v_j the inputs of its steps and e_j the
slacks of soft rows.  States inside a stage are condensed; between stages s_{j+1} = Phi_M s_j + Psi_M v_j + c is an
equality row.  All matrices are block banded, which a multistage factorisation exploits: its cost grows linearly with
the horizon.

The sparsity pattern is fixed when a `PartiallyCondensed` is built; where rows differ from period to period, only their
values do.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_matrix

from quadsim.mpc.problem.ocp import Problem, Query
from quadsim.mpc.problem.qp import QP, PeriodQP, QPRows, Solution
from quadsim.state import Array, Indices

BLOCK_ROUNDING: Final = 1e-14
"""Entries below this fraction of the largest of their block are rounding errors: dropped from constant matrices."""
STEPS_OF_ONE_INPUT: Final = 10
"""M for one input; for more inputs, M falls with the square root of their number. The resulting five steps for four
rotors were the fastest of 1 to 25 in the paper's case."""


class Pattern:
    """A sparse matrix assembled from blocks (..., rows, columns) at fixed positions.

    `rows` (..., rows) and `columns` (..., columns) are the positions of each block. Entries that are zero in the first
    blocks, or below the share `rounding` of the largest entry of their block's row and of its column, are dropped
    permanently.
    """

    def __init__(
        self, shape: tuple[int, int], positions: Sequence[tuple[Indices, Indices]], blocks: list[Array], rounding: float
    ) -> None:
        pairs = list(zip(positions, blocks, strict=True))
        rows = np.concatenate([np.broadcast_to(at[0][..., :, None], block.shape).ravel() for at, block in pairs])
        columns = np.concatenate([np.broadcast_to(at[1][..., None, :], block.shape).ravel() for at, block in pairs])
        order = np.lexsort((rows, columns))
        self._order = order[np.concatenate([_present(block, BLOCK_ROUNDING).ravel() for block in blocks])[order]]
        self._rows = rows[self._order].astype(np.int32)
        counts = np.bincount(columns[self._order], minlength=shape[1])
        self._starts = np.concatenate([[0], np.cumsum(counts)]).astype(np.int32)
        self._shape = shape

    def matrix(self, blocks: list[Array]) -> csc_matrix:
        """Return the matrix with these blocks; zeros inside its pattern stay stored."""
        data = np.concatenate([block.ravel() for block in blocks])[self._order]
        return csc_matrix((data, self._rows, self._starts), shape=self._shape)


def _present(block: Array, rounding: float) -> NDArray[np.bool_]:
    """Return which entries (..., rows, columns) of a block are not zero."""
    size = np.abs(block)
    if not rounding or not size.size:
        return size > 0.0
    largest = np.minimum(size.max(axis=-1, keepdims=True), size.max(axis=-2, keepdims=True))
    return np.asarray(size > rounding * largest)


class Layout:
    """Positions of the variables, for N steps of n states, nu inputs and n_s slacks, M steps per stage.

    Attributes:
        N, n, nu, L, M: horizon, states, inputs, steps in the first stage and in each other.
        head: (L nu,) v_0.
        tail: (J - 1, n + M nu) [s_j, v_j].
        starts: (J, n) s_1 .. s_J.
        inputs: (N, nu) in time order.
        slacks: (N, n_s) in time order; n_s = 0 where bounds are hard.
        ends: (J, n) equality rows.
        lasts, firsts: (J - 1, nu) the last inputs of each stage but the last, and the first inputs of the next.
        size: number of variables.
    """

    def __init__(self, N: int, n: int, nu: int, n_s: int, M: int) -> None:
        most = M + (n // nu if M > 1 else 0)
        L = N if most >= N else most - (most - N) % M
        self.N, self.n, self.nu, self.L, self.M = N, n, nu, L, M
        stages = (N - L) // M
        first, width = L * nu + (L - 1) * n_s, n + M * (nu + n_s)
        base = first + width * np.arange(stages + 1)[:, None]
        self.size = first + stages * width + n + n_s
        self.head, self.tail = np.arange(L * nu), base[:-1] + np.arange(n + M * nu)
        self.starts = base + np.arange(n)
        self.inputs = np.concatenate([self.head, self.tail[:, n:].ravel()]).reshape(N, nu)
        later = base[:-1] + n + M * nu + np.arange(M * n_s)
        slacks = [np.arange(L * nu, first), later.ravel(), np.arange(self.size - n_s, self.size)]
        self.slacks = np.concatenate(slacks).reshape(N, n_s)
        self.ends = np.arange(self.starts.size).reshape(self.starts.shape)
        cuts = L + M * np.arange(stages)
        self.lasts, self.firsts = self.inputs[cuts - 1], self.inputs[cuts]


@dataclass(frozen=True, kw_only=True)
class Matrices:
    """The parts of the QP that depend on the A_i and B_i of a horizon; valid for as many periods as these are."""

    A: Array  # (N, n, n), A_i
    B: Array  # (N, n, nu), B_i
    head: Array  # (1, L + 1, n, L nu) slopes of the first stage's states in v_0
    tail: Array  # (J - 1, M + 1, n, n + M nu) slopes of the other stages' states in [s_j, v_j]
    P: csc_matrix  # cost
    dynamics: csc_matrix  # equality rows
    G: csc_matrix  # inequality rows
    rows: QPRows  # the rows of G


def condense_stages(start: Array, A: Array, B: Array, c: Array) -> Array:
    """(J, L + 1, n, m + 1) states of J stages of L steps, as functions of the variables (inputs last) and of 1.

    They start from (J, n, m + 1) and follow A (J, L, n, n), B (J, L, n, nu) and c (J, L, n).
    """
    (count, steps, n, nu), columns = B.shape, start.shape[2]
    states = np.empty((count, steps + 1, n, columns))
    states[:, 0] = start
    for t in range(steps):
        np.matmul(A[:, t], states[:, t], out=states[:, t + 1])
        at = columns - 1 - (steps - t) * nu
        states[:, t + 1, :, at : at + nu] = B[:, t]
        states[:, t + 1, :, -1] += c[:, t]
    return states


def condense(at: Layout, start: Array, free: Array, *steps: Array) -> tuple[Array, Array]:
    """Return the states of the first stage, from `start`, and of the others, from `free`; see `condense_stages`."""
    head = condense_stages(start, *(part[None, : at.L] for part in steps))
    return head, condense_stages(free, *(part[at.L :].reshape(len(free), at.M, *part.shape[1:]) for part in steps))


class PartiallyCondensed:
    """The partially condensed QP of a problem; `qp` is the QP for xi(k) = 0, y_d = 0 and u(k-1) = u_bar.

    Args:
        problem: a problem with constraints.
        steps_per_stage: M; None for a choice by the number of inputs.  The first stage has no state among its
            variables: it takes the remainder of the horizon and, if M > 1, as many further steps as fit into blocks of
            the others' size.
    """

    def __init__(self, problem: Problem, *, steps_per_stage: int | None = None) -> None:
        model, N = problem.model, problem.horizon
        steps = steps_per_stage or max(round(STEPS_OF_ONE_INPUT / math.sqrt(model.nu)), 1)
        self._problem, self._rows, soft = problem, QPRows(problem), problem.rows.slacks
        self._at = at = Layout(N, model.n, model.nu, soft.size, steps)
        rows, objective = self._rows, problem.objective
        self._Q, self._Q_end = objective.weights[0], objective.terminal_weights[0]
        self._input_weight, self._move_weight = 2.0 * objective.Q_u, 2.0 * objective.move_weight
        self._slack_weight = 2.0 * np.tile(problem.rows.l2[soft], at.N)[:, None, None]
        self._input_costs = {steps: self._input_cost(steps) for steps in (at.L, at.M)}
        A, B = (np.broadcast_to(part, (N, *part.shape)) for part in (model.A, model.B))
        head, tail = self._slopes(A, B)
        slack, numbers = at.slacks.reshape(-1, 1), np.arange(rows.lower.size).reshape(at.N, -1)
        costs = [(at.head, at.head), (at.tail, at.tail), (at.starts[-1], at.starts[-1]), (slack, slack)]
        costs += [(at.lasts, at.firsts), (at.firsts, at.lasts)]
        self._P = Pattern((at.size, at.size), costs, self._costs(head, tail), BLOCK_ROUNDING)
        dynamics = [(at.ends[:1], at.head), (at.ends[1:], at.tail), (at.ends, at.starts)]
        self._A = Pattern((at.ends.size, at.size), dynamics, self._dynamics(head, tail), BLOCK_ROUNDING)
        self._later, self._now = later, now = np.flatnonzero(rows.of_states), np.flatnonzero(~rows.of_states)
        stages, cuts = len(at.tail), at.L + at.M * np.arange(len(at.tail))
        inequalities = [
            (numbers[: at.L - 1, later], at.head),
            (numbers[at.L - 1 : -1, later].reshape(stages, at.M, later.size), at.tail[:, None]),
            (numbers[-1, later], at.starts[-1]),
            (numbers, at.slacks),
            (numbers[: at.L, now], at.head),
            (numbers[at.L :, now].reshape(stages, at.M, now.size), at.tail[:, None]),
            (numbers[cuts][:, now], at.lasts),
        ]
        self._G = Pattern((numbers.size, at.size), inequalities, self._inequalities(head, tail, rows), BLOCK_ROUNDING)
        self._linear = np.zeros(at.size)
        self._linear[at.slacks] = problem.rows.l1[soft]
        self.fixed = self._built(A, B)
        self._x_l, self._x_u = np.full(at.size, -math.inf), np.full(at.size, math.inf)
        self._x_l[at.inputs], self._x_u[at.inputs] = self._rows.u_min, self._rows.u_max
        self._x_l[at.slacks] = 0.0
        nothing = np.zeros((N, len(problem.objective.C_r)))
        self.qp = self.assemble(Query(np.zeros(model.n), nothing, model.u_bar)).qp

    def _built(self, A: Array, B: Array) -> Matrices:
        """Return the matrices for A (N, n, n), B (N, n, nu)."""
        head, tail = self._slopes(A, B)
        return Matrices(
            A=A,
            B=B,
            head=head,
            tail=tail,
            P=self._P.matrix(self._costs(head, tail)),
            dynamics=self._A.matrix(self._dynamics(head, tail)),
            G=self._G.matrix(self._inequalities(head, tail, self._rows)),
            rows=self._rows,
        )

    def _slopes(self, A: Array, B: Array) -> tuple[Array, Array]:
        """Return `head` and `tail` of `Matrices`."""
        at = self._at
        start = np.zeros((1, at.n, at.head.size + 1))
        free = np.zeros((len(at.tail), at.n, at.tail.shape[1] + 1))
        free[:, :, : at.n] = np.eye(at.n)
        head, tail = condense(at, start, free, A, B, np.zeros((at.N, at.n)))
        return head[..., :-1], tail[..., :-1]

    def _costs(self, head: Array, tail: Array) -> list[Array]:
        """Return P's blocks."""
        at = self._at
        blocks = [self._stage_cost(head, at.L), self._stage_cost(tail, at.M)]
        (blocks[1] if len(tail) else blocks[0])[-1, -at.nu :, -at.nu :] -= self._move_weight  # none follows the last
        across = np.broadcast_to(-self._move_weight, (len(at.lasts), at.nu, at.nu))
        return [*blocks, 2.0 * self._Q_end, self._slack_weight, across, across.transpose(0, 2, 1)]

    def _stage_cost(self, slopes: Array, steps: int) -> Array:
        """Hessian (J, m, m) of the stages' cost, without that of the end state."""
        inner = slopes[:, :-1].reshape(len(slopes), steps * self._at.n, slopes.shape[3])
        weighted = (2.0 * self._Q @ slopes[:, :-1]).reshape(inner.shape)
        hessian = inner.transpose(0, 2, 1) @ weighted
        hessian = 0.5 * (hessian + hessian.transpose(0, 2, 1))
        weights = self._input_costs[steps]
        hessian[:, -len(weights) :, -len(weights) :] += weights
        return np.asarray(hessian)

    def _input_cost(self, steps: int) -> Array:
        """Hessian of the cost of a stage's inputs, with their changes from the previous and to the next stage."""
        beside = np.eye(steps, k=1) + np.eye(steps, k=-1)
        itself = np.kron(np.eye(steps), self._input_weight + 2.0 * self._move_weight)
        return np.asarray(itself - np.kron(beside, self._move_weight))

    def _dynamics(self, head: Array, tail: Array) -> list[Array]:
        """Return the equality rows' blocks: the end of each stage is the start of the next."""
        starts = np.broadcast_to(np.eye(self._at.n), (len(self._at.starts), self._at.n, self._at.n))
        return [-head[:, -1], -tail[:, -1], starts]

    def _inequalities(self, head: Array, tail: Array, rows: QPRows) -> list[Array]:
        """Return G's blocks."""
        at, later, now = self._at, self._later, self._now
        slack = np.broadcast_to(rows.slack, (at.N, *rows.slack.shape))
        before = np.broadcast_to(-rows.E[now], (len(at.lasts), now.size, at.nu))
        C = rows.C[..., later, :]
        first, middle, last, of_inputs = C, C, C, rows.C[..., now, :]
        if C.ndim == 3:  # rows on states alone hold at the next step; the others are the same at all steps
            first, middle, last = C[: at.L - 1], C[at.L - 1 : -1].reshape(len(tail), at.M, *C.shape[1:]), C[-1]
            of_inputs = of_inputs[0]
        return [
            first @ head[0, 1:-1],
            middle @ tail[:, :-1],
            last,
            slack,
            self._inputs_too(of_inputs @ head[:, :-1], at.L)[0],
            self._inputs_too(of_inputs @ tail[:, :-1], at.M),
            before,
        ]

    def _inputs_too(self, of_states: Array, steps: int) -> Array:
        """Return state rows (J, steps, k, m) with the terms of their inputs and, but in the first, of those before."""
        rows, now, nu = self._rows, self._now, self._at.nu
        by_step = of_states[..., of_states.shape[-1] - steps * nu :].reshape(*of_states.shape[:3], steps, nu)
        for t in range(steps):
            by_step[:, t, :, t] += rows.D[now] + rows.E[now]
            if t:
                by_step[:, t, :, t - 1] -= rows.E[now]
        of_states[..., of_states.shape[-1] - steps * nu :] = by_step.reshape(*of_states.shape[:3], steps * nu)
        return of_states

    def assemble(self, query: Query, problem: Problem | None = None) -> PeriodQP:
        """Return the QP of a period; `problem` may differ in the numbers of its constraints' rows."""
        rest = query.equilibrium or self._problem.equilibrium
        A, B = self._problem.model.A, self._problem.model.B
        offset = rest.x - A @ rest.x - B @ rest.u
        matrices, c = self.fixed, np.broadcast_to(offset, (self._at.N, offset.size))
        if problem is not None:
            rows = QPRows(problem)
            G = self._G.matrix(self._inequalities(matrices.head, matrices.tail, rows))
            matrices = replace(matrices, G=G, rows=rows)
        state, desired, u_before = query[:3]
        at, rows, objective = self._at, matrices.rows, self._problem.objective
        head, tail = (part[..., 0] for part in self._offsets(matrices, c, state))
        (Q, W), (Q_end, W_end) = objective.weights, objective.terminal_weights
        # Entry i is for x(k+i), i = 0 .. N-1; x(k) itself is fixed, and its slopes are zero.
        desired_linear = np.concatenate([np.zeros((1, at.n)), desired[:-1] @ W.T])
        known = np.concatenate([head[0, :-1], tail[:, :-1].reshape(-1, at.n)])
        pull = 2.0 * (known @ Q - desired_linear)
        gradient = self._linear.copy()
        gradient[at.head] = np.tensordot(matrices.head[0, :-1], pull[: at.L], ([0, 1], [0, 1]))
        later = pull[at.L :].reshape(len(at.tail), at.M, at.n)
        gradient[at.tail] = np.einsum("jtnm,jtn->jm", matrices.tail[:, :-1], later)
        # The last state's target is C_r^+ (y_d - C_r x_s) from x_s; if Q_y weighs it, x_s drops out.
        gradient[at.starts[-1]] = -2.0 * (W_end @ (desired[-1] - objective.C_r @ rest.x) + Q_end @ rest.x)
        gradient[at.inputs] -= rest.u @ (2.0 * objective.Q_u)
        gradient[at.inputs[0]] -= 2.0 * objective.move_weight @ u_before
        if rows.C.ndim == 2:
            values = known @ rows.C.T * ~rows.of_states
            values[:-1] += known[1:] @ rows.C.T * rows.of_states
        else:
            values = (rows.C @ known[:, :, None])[..., 0] * ~rows.of_states
            values[:-1] += (rows.C[:-1] @ known[1:, :, None])[..., 0] * rows.of_states
        values[0] -= rows.E @ u_before
        qp = QP(
            P=matrices.P,
            c=gradient,
            A=matrices.dynamics,
            b=np.concatenate([head[:, -1], tail[:, -1]]).ravel(),
            G=matrices.G,
            h_l=(rows.lower - values).ravel(),
            h_u=(rows.upper - values).ravel(),
            x_l=self._x_l,
            x_u=self._x_u,
        )
        return PeriodQP(qp, partial(self._states, matrices, c, state))

    def inputs(self, x: Array) -> Array:
        """Return (N, nu) the planned inputs [rad/s] of a primal point."""
        return x[self._at.inputs]

    def slacks(self, x: Array) -> Array:
        """Return (N, m_s) the slacks of a primal point, in the constraints' units."""
        return x[self._at.slacks] / self._problem.rows.slack_scale

    def _states(self, matrices: Matrices, c: Array, state: Array, x: Array) -> Array:
        """Return (N, n) the predicted states of a primal point."""
        at = self._at
        head, tail = (part[..., 0] for part in self._offsets(matrices, c, state))
        first = (matrices.head @ x[at.head] + head)[0, 1:-1]
        later = (matrices.tail[:, :-1] @ x[at.tail][:, None, :, None])[..., 0] + tail[:, :-1]
        return np.concatenate([first, later.reshape(-1, at.n), x[at.starts[-1:]]])

    def multipliers(self, solution: Solution) -> Array:
        """Return (N, m) the multipliers of the problem's rows (`constraints.Rows`), signed as in `Solution`."""
        return self._rows.multipliers(solution.z, solution.z_box[self._at.inputs].ravel())

    def _offsets(self, matrices: Matrices, c: Array, state: Array) -> tuple[Array, Array]:
        """(1, L + 1, n, 1) and (J - 1, M + 1, n, 1): the states of all stages for v_j = 0 and s_1 .. s_J = 0."""
        zero = np.zeros((len(self._at.tail), self._at.n, 1))
        return condense(self._at, state[None, :, None], zero, matrices.A, matrices.B[:, :, :0], c)
