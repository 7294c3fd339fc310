"""The same optimisation with a structure: partially condensed into stages of a few steps each.

A condensed QP is dense; one with all states as variables is large.  In between, the horizon is cut into stages of M
steps.  The variables, in stage order, are

    v_0 | s_1, v_1 | s_2, v_2 | ...

with s_j the state at the start of stage j (s_0 = xi(k) is known) and v_j = u - u_bar for its steps.  Within a stage
the states are condensed as in Eq. (2); between stages s_{j+1} = Phi_M s_j + Psi_M v_j is an equality row.  All
matrices are block banded, which a multistage factorisation exploits: its cost grows linearly with the horizon.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from scipy import sparse
from scipy.sparse import csc_matrix

from mpc.condensed import require_bounds
from mpc.constraints import slew_matrix
from mpc.prediction import Prediction, prediction
from mpc.problem import Bounds, Objective, Problem
from mpc.qp import QP, Solution, Vectors
from quadsim.state import Array

STEPS_OF_ONE_INPUT: Final = 10
"""M for one input; for more it falls with the root of their number.  Of stages of 1 to 25 steps, the resulting five of
four rotors are the fastest for the paper's case, ten of one axis by itself nearly so; see docs/performance.md."""
SLEWS_BOUND_AT_ONCE: Final = 32
"""Steps from the start of the plan whose slews may well bind.  Later ones never did in the paper's flight, whatever its
tilt bound and its horizon up to 200, and with 50 steps a QP without them is solved an eighth sooner."""
ROUNDING: Final = 1e-14
"""Entries below this fraction of the largest of their row and of their column are products of rounding: left out."""


@dataclass(frozen=True, kw_only=True)
class Multistage:
    """The partially condensed QP; see the module.

    Attributes:
        qp: block-banded sparse matrices, vectors for xi(k) = 0, y_d = 0, u(k-1) = u_bar.
        u_bar: (nu,) the equilibrium input [rad/s].
        input_index: (N nu,) where the inputs are in x, in time order.
        c_state, c_desired: gradient's slopes in xi(k) and y_d.
        b_state: equality right side's slope in xi(k).
        h_state: output rows' shift by the free response of the first stage, for xi(k).
        slewing: (n_s,) the inputs whose steps are bounded.
        first_slews: rows of G that hold their u(k) - u(k-1).
    """

    qp: QP
    u_bar: Array
    input_index: np.ndarray[tuple[int], np.dtype[np.int64]]
    c_state: Array
    c_desired: csc_matrix
    b_state: Array
    h_state: Array
    slewing: np.ndarray[tuple[int], np.dtype[np.int64]]
    first_slews: slice

    def vectors(self, state: Array, desired: Array, u_before: Array) -> Vectors:
        """See `mpc.qp.Formulation.vectors`."""
        c = self.c_desired @ desired.ravel()
        c[: self.c_state.shape[0]] += self.c_state @ state
        b = np.zeros_like(self.qp.b)
        b[: self.b_state.shape[0]] = self.b_state @ state
        h_l, h_u = self.qp.h_l.copy(), self.qp.h_u.copy()
        rows = self.h_state.shape[0]
        free = self.h_state @ state
        h_l[:rows] -= free
        h_u[:rows] -= free
        before = (u_before - self.u_bar)[self.slewing]
        h_l[self.first_slews] += before
        h_u[self.first_slews] += before
        return Vectors(c=c, b=b, h_l=h_l, h_u=h_u)

    def inputs(self, x: Array) -> Array:
        """See `mpc.qp.Formulation.inputs`."""
        return x[self.input_index].reshape(-1, self.u_bar.size) + self.u_bar

    def condensed(self, solution: Solution) -> Solution:
        """See `mpc.qp.Formulation.condensed`: the rows of G are the same, in the same order."""
        x, z_box = self.inputs(solution.x).ravel(), solution.z_box[self.input_index]
        return replace(solution, x=x, y=np.zeros(0), z_box=z_box)


@dataclass(frozen=True, kw_only=True)
class _Stage:
    """One stage's dense blocks over [s_j, v_j]; the first stage has no s_0 and keeps its columns for xi(k) apart."""

    hessian: Array
    gradient_desired: Array
    end: Array
    outputs: Array


def usual_steps(inputs: int) -> int:
    """M for a problem of so many inputs."""
    return max(round(STEPS_OF_ONE_INPUT / math.sqrt(inputs)), 1)


def multistage(problem: Problem, *, steps_per_stage: int | None = None) -> Multistage:
    """Build the structured QP of a constrained problem.

    Args:
        problem: a problem with bounds.
        steps_per_stage: M; None for `usual_steps`.  The first stage has no state among its
            variables and, where M > 1, takes as many more steps as there is room for in blocks of the others' size; the
            last stage takes what is left.

    Raises:
        ValueError: the problem has no bounds.
    """
    bounds = require_bounds(problem)
    model, N = problem.model, problem.horizon
    n, nu = model.n, model.nu
    steps = usual_steps(nu) if steps_per_stage is None else steps_per_stage
    lengths = _stage_lengths(N, steps, more_at_first=n // nu)
    built = {length: _stage(prediction(model, length), problem.objective, bounds, length) for length in set(lengths)}
    stages = [built[length] for length in lengths]

    first = stages[0]
    hessians = [first.hessian[n:, n:], *(stage.hessian for stage in stages[1:])]
    gradients = [first.gradient_desired[n:], *(stage.gradient_desired for stage in stages[1:])]
    outputs = [first.outputs[:, n:], *(stage.outputs for stage in stages[1:])]
    variables = _variable_index(lengths, n, nu)
    input_index = np.concatenate(variables.inputs)
    slewing = bounds.slewing
    slews = csc_matrix(slew_matrix(N, nu))[(np.arange(N)[:, None] * nu + slewing).ravel()]
    size = variables.size
    output_rows = sparse.block_diag(outputs, format="csc")
    slew_rows = slews @ _selection(input_index, size)
    return Multistage(
        qp=QP(
            P=_without_rounding(csc_matrix(sparse.block_diag(hessians))),
            c=np.zeros(size),
            A=_without_rounding(_dynamics(stages, variables, n)),
            b=np.zeros(n * (len(stages) - 1)),
            G=_without_rounding(csc_matrix(sparse.vstack([output_rows, slew_rows]))),
            h_l=np.concatenate([np.tile(bounds.y_min, N), np.tile(bounds.delta_min[slewing], N)]),
            h_u=np.concatenate([np.tile(bounds.y_max, N), np.tile(bounds.delta_max[slewing], N)]),
            x_l=_box(bounds.u_min - model.u_bar, input_index, N, size, -np.inf),
            x_u=_box(bounds.u_max - model.u_bar, input_index, N, size, np.inf),
            seldom=slewing.size * max(N - SLEWS_BOUND_AT_ONCE, 0),
        ),
        u_bar=model.u_bar,
        input_index=input_index,
        c_state=first.hessian[n:, :n],
        c_desired=csc_matrix(sparse.block_diag(gradients)),
        b_state=first.end[:, :n] if len(stages) > 1 else np.zeros((0, n)),
        h_state=first.outputs[:, :n],
        slewing=slewing,
        first_slews=slice(output_rows.shape[0], output_rows.shape[0] + slewing.size),
    )


def _stage_lengths(horizon: int, steps: int, *, more_at_first: int) -> list[int]:
    first = min(steps + more_at_first, horizon) if steps > 1 else 1
    return [first, *(min(steps, horizon - start) for start in range(first, horizon, steps))]


def _without_rounding(matrix: csc_matrix) -> csc_matrix:
    """The matrix without entries that would be zero in exact arithmetic: axes that do not meet, say, or cos(90 deg)."""
    size = abs(matrix).tocoo()
    if not size.nnz:
        return matrix
    largest = np.minimum(size.max(axis=1).toarray()[size.row, 0], size.max(axis=0).toarray()[0, size.col])
    kept = size.data > ROUNDING * largest
    entries = matrix.tocoo()
    return csc_matrix((entries.data[kept], (entries.row[kept], entries.col[kept])), shape=matrix.shape)


@dataclass(frozen=True, kw_only=True)
class _VariableIndex:
    """Where each stage's state and inputs are in x."""

    states: list[np.ndarray[tuple[int], np.dtype[np.int64]]]
    inputs: list[np.ndarray[tuple[int], np.dtype[np.int64]]]
    size: int


def _variable_index(lengths: list[int], n: int, nu: int) -> _VariableIndex:
    states, inputs, at = [], [], 0
    for j, length in enumerate(lengths):
        states.append(np.arange(at, at + n) if j else np.arange(0))
        at += states[-1].size
        inputs.append(np.arange(at, at + length * nu))
        at += length * nu
    return _VariableIndex(states=states, inputs=inputs, size=at)


def _stage(maps: Prediction, objective: Objective, bounds: Bounds, length: int) -> _Stage:
    """Blocks of a stage of `length` steps: cost, end state and outputs as functions of [s_j, v_j]."""
    states = np.hstack([maps.Phi, maps.Psi])
    n = maps.Phi.shape[1]
    regulated = np.kron(np.eye(length), objective.C_r) @ states
    weighted = np.kron(np.eye(length), objective.Q_y) @ regulated
    hessian = 2.0 * regulated.T @ weighted
    hessian[n:, n:] += 2.0 * np.kron(np.eye(length), objective.Q_u)
    return _Stage(
        hessian=0.5 * (hessian + hessian.T),
        gradient_desired=-2.0 * weighted.T,
        end=states[-n:],
        outputs=np.kron(np.eye(length), bounds.C_c) @ states,
    )


def _dynamics(stages: list[_Stage], variables: _VariableIndex, n: int) -> csc_matrix:
    """Rows s_{j+1} - Phi_M s_j - Psi_M v_j = 0, the known s_0 moved to the right side."""
    rows = sparse.lil_matrix((n * (len(stages) - 1), variables.size))
    for j, stage in enumerate(stages[:-1]):
        row = slice(j * n, (j + 1) * n)
        if j:
            rows[row, variables.states[j]] = -stage.end[:, :n]
        rows[row, variables.inputs[j]] = -stage.end[:, n:]
        rows[row, variables.states[j + 1]] = np.eye(n)
    return csc_matrix(rows)


def _selection(index: np.ndarray[tuple[int], np.dtype[np.int64]], size: int) -> csc_matrix:
    ones = np.ones(index.size)
    return csc_matrix((ones, (np.arange(index.size), index)), shape=(index.size, size))


def _box(
    bound: Array, index: np.ndarray[tuple[int], np.dtype[np.int64]], horizon: int, size: int, free: float
) -> Array:
    box = np.full(size, free)
    box[index] = np.tile(bound, horizon)
    return box
