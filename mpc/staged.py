"""The QP with a structure: the horizon in stages of a few steps each, for matrices that change and for fixed ones.

A condensed QP is dense; one with all states as variables is large.  In between, the horizon is cut into stages of M
steps.  The variables, in stage order, are

    v_0, e_0 | s_1, v_1, e_1 | s_2, v_2, e_2 | ... | s_J, e_J

with s_j the state at the start of stage j (s_0 = x(k) is known, s_J = x(k+N)), v_j the inputs of its steps and e_j the
slacks of soft rows.  States inside a stage are condensed; between stages s_{j+1} = Phi_M s_j + Psi_M v_j + c is an
equality row.  All matrices are block banded, which a multistage factorisation exploits: its cost grows linearly with
the horizon.  The model may differ from step to step,

    x(k+i+1) = A_i x(k+i) + B_i u(k+i) + c_i.

The pattern of the matrices is fixed when a `Staged` is built; where they change, only their values do.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Final

import numpy as np

from mpc.ocp import Problem, Rest
from mpc.qp import QP, QPRows, Solution, Vectors
from mpc.stages import Layout, Matrices, MatrixBuilder, condense
from quadsim.errors import ParameterError
from quadsim.state import Array

STEPS_OF_ONE_INPUT: Final = 10
"""M for one input; for more it falls with the root of their number.  Of stages of 1 to 25 steps, the resulting five of
four rotors are the fastest for the paper's case; see docs/performance.md."""


def usual_steps(inputs: int) -> int:
    """M for a problem of so many inputs."""
    return max(round(STEPS_OF_ONE_INPUT / math.sqrt(inputs)), 1)


class Staged:
    """The partially condensed QP of a problem.

    Args:
        problem: with constraints.
        steps_per_stage: M; None for `usual_steps`.  The first stage, which has no state among its variables, takes what
            is left of the horizon, and where M > 1 as many more steps as there is room for in blocks of the others'
            size.
        changing: whether the model's matrices will be others; then no entry is left out that might be needed.

    Attributes:
        fixed: the matrices of the problem's model.
        qp: these, with vectors for xi(k) and y_d zero and u(k-1) = u_bar.

    Raises:
        ValueError: the problem has no constraints; it needs no QP.
        ParameterError: the number of steps is not possible.
    """

    def __init__(self, problem: Problem, *, steps_per_stage: int | None = None, changing: bool = False) -> None:
        model, N = problem.model, problem.horizon
        steps = usual_steps(model.nu) if steps_per_stage is None else steps_per_stage
        if not isinstance(steps, int) or steps < 1:
            raise ParameterError("controller", "steps_per_stage", steps, "a whole number >= 1")
        self._problem, self._rows, soft = problem, QPRows(problem), problem.rows.soft
        self._at = at = Layout(N, model.n, model.nu, soft.size, steps)
        self._builder = MatrixBuilder(problem, self._rows, at, changing=changing)
        self._linear = np.zeros(at.size)
        self._linear[at.slacks] = problem.rows.l1[soft]
        A, B = np.broadcast_to(model.A, (N, *model.A.shape)), np.broadcast_to(model.B, (N, *model.B.shape))
        self.fixed = self._builder.build(A, B)
        x_l, x_u = np.full(at.size, -math.inf), np.full(at.size, math.inf)
        x_l[at.inputs], x_u[at.inputs], x_l[at.slacks] = self._rows.u_min, self._rows.u_max, 0.0
        nothing = np.zeros((N, len(problem.objective.C_r)))
        start = self.vectors(np.zeros(model.n), nothing, model.u_bar)
        held = self.fixed
        self.qp = QP(
            P=held.P, c=start.c, A=held.dynamics, b=start.b, G=held.rows, h_l=start.h_l, h_u=start.h_u, x_l=x_l, x_u=x_u
        )

    def prepare(self, A: Array, B: Array) -> Matrices:
        """The QP's matrices for a model A (N, n, n), B (N, n, nu) that changes."""
        return self._builder.build(A, B)

    def vectors(self, state: Array, desired: Array, u_before: Array, rest: Rest | None = None) -> Vectors:
        """See `mpc.qp.Formulation.vectors`."""
        model, (x_s, u_s) = self._problem.model, self._problem.rest if rest is None else rest
        c = x_s - model.A @ x_s - model.B @ u_s
        every = np.broadcast_to(c, (self._at.N, c.size))
        return self.changed_vectors(self.fixed, every, state, desired, u_before, Rest(x_s, u_s))

    def changed_vectors(
        self, matrices: Matrices, c: Array, state: Array, desired: Array, u_before: Array, rest: Rest
    ) -> Vectors:
        """The QP's vectors for a model that changes, of c_i (N, n), x(k) (n,), y_d (N, n_r) and u(k-1) (nu,) [rad/s].

        At `rest` is what the cost pulls inputs to, and where the terminal weight is about.
        """
        at, rows, objective = self._at, self._rows, self._problem.objective
        head, tail = (part[..., 0] for part in self._offsets(matrices, c, state))
        (Q, W), (Q_end, W_end) = objective.weights, objective.terminal_weights
        # Entry i is for x(k+i), i = 0 .. N-1; x(k) itself is past changing, and its slopes are zero.
        wanted = np.concatenate([np.zeros((1, at.n)), desired[:-1] @ W.T])
        known = np.concatenate([head[0, :-1], tail[:, :-1].reshape(-1, at.n)])
        pull = 2.0 * (known @ Q - wanted)
        gradient = self._linear.copy()
        gradient[at.head] = np.tensordot(matrices.head[0, :-1], pull[: at.L], ([0, 1], [0, 1]))
        later = pull[at.L :].reshape(len(at.tail), at.M, at.n)
        gradient[at.tail] = np.einsum("jtnm,jtn->jm", matrices.tail[:, :-1], later)
        # The last state's target, C_r^+ (y_d - C_r x_s) from x_s; where Q_y weighs it, x_s has no part in it.
        gradient[at.starts[-1]] = -2.0 * (W_end @ (desired[-1] - objective.C_r @ rest.x) + Q_end @ rest.x)
        gradient[at.inputs] -= 2.0 * objective.Q_u @ rest.u
        gradient[at.inputs[0]] -= 2.0 * objective.move_weight @ u_before
        values = known @ rows.C.T * ~rows.of_states
        values[:-1] += known[1:] @ rows.C.T * rows.of_states
        values[0] -= rows.E @ u_before
        return Vectors(
            c=gradient,
            b=np.concatenate([head[:, -1], tail[:, -1]]).ravel(),
            h_l=(rows.lower - values).ravel(),
            h_u=(rows.upper - values).ravel(),
        )

    def changed(self, matrices: Matrices, vectors: Vectors) -> QP:
        """The QP with other matrices and vectors."""
        return replace(self.qp.with_vectors(vectors), P=matrices.P, A=matrices.dynamics, G=matrices.rows)

    def inputs(self, x: Array) -> Array:
        """See `mpc.qp.Formulation.inputs`."""
        return x[self._at.inputs]

    def slacks(self, x: Array) -> Array:
        """See `mpc.qp.Formulation.slacks`."""
        return x[self._at.slacks]

    def states(self, matrices: Matrices, c: Array, state: Array, x: Array) -> Array:
        """(N, n) the predicted states in a primal point; other arguments as for `changed_vectors`."""
        at = self._at
        head, tail = (part[..., 0] for part in self._offsets(matrices, c, state))
        first = (matrices.head @ x[at.head] + head)[0, 1:-1]
        later = (matrices.tail[:, :-1] @ x[at.tail][:, None, :, None])[..., 0] + tail[:, :-1]
        return np.concatenate([first, later.reshape(-1, at.n), x[at.starts[-1:]]])

    def multipliers(self, solution: Solution) -> Array:
        """See `mpc.qp.Formulation.multipliers`."""
        return self._rows.multipliers(solution.z, solution.z_box[self._at.inputs].ravel())

    def _offsets(self, matrices: Matrices, c: Array, state: Array) -> tuple[Array, Array]:
        """(1, L + 1, n, 1) and (J - 1, M + 1, n, 1): the states of all stages where v_j and s_1 .. s_J are zero."""
        zero = np.zeros((len(self._at.tail), self._at.n, 1))
        return condense(self._at, state[None, :, None], zero, matrices.A, matrices.B[:, :, :0], c)
