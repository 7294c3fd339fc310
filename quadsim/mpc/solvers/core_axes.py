"""The axes of a problem: parts that are coupled only through the bounds on inputs.

A hovering quadrotor is four systems: x with pitch, y with roll, z, and yaw.  Four rotors drive all of them, so bounds
on rotors couple them; no prediction, weight or output bound does.  The axes are the connected components of the states
under
    A,  |C_r|' |Q_y| |C_r|,  P,  |C|' |C|,  B Q_u^-1 B',

with C of all rows, and the last matrix for the cost of moving two states at once.  For each axis g there are inputs
w_g, with T_g spanning Q_u^-1 B_g'. Then u = u_s + sum T_g w_g.  Each w_g moves only its own axis since B_h T_g = 0, and
the cost separates since T_g' Q_u T_h = 0: without rows on inputs, the problem is one small problem per axis.  The part
of u outside all T_g has no effect, and stays at u_s at the optimum.  With a weight on input changes, axes are used only
if they span all of u and Q_d separates too.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components

from quadsim.mpc.problem.model import LinearModel
from quadsim.mpc.problem.ocp import Objective, Problem
from quadsim.state import Array, Indices

COUPLING_ROUNDING: Final = 1e-12
"""Relative size below which a coupling of two states counts as rounding."""


@dataclass(frozen=True, kw_only=True)
class Axis:
    """One axis, as a separate problem."""

    problem: Problem  # in w (N, m), without constraints; u_bar = 0
    states: Indices  # (n_g,) indices of its states
    regulated: Indices  # indices of its rows of C_r
    outputs: Indices  # indices of its rows (`quadsim.mpc.problem.constraints.Rows`)
    T: Array  # (nu, m) the axis's part of u - u_s is T w; columns of unit length


def axes(problem: Problem) -> list[Axis]:
    """Return the axes of a problem, which together contain all of it except its rows on inputs.

    Inputs without effect on cost or constraints stay at u_s: their axes are left out.  If such an axis has a row, or a
    row of constraints or of C_r involves no state, or the problem does not separate, the whole problem is the only
    axis.
    """
    rows = problem.rows
    model = problem.model
    objective = problem.objective
    bounded: NDArray[np.bool_] = np.asarray(rows.C.any(axis=1))
    C_r = np.abs(objective.C_r)
    C = np.abs(rows.C)
    root = np.linalg.cholesky(objective.Q_u)
    reach = _normalised(np.linalg.solve(root, model.B.T))
    tied = (C_r.T @ np.abs(objective.Q_y) @ C_r + C.T @ C) > 0.0
    tied |= np.abs(model.A) > COUPLING_ROUNDING * np.abs(model.A).max()
    tied |= np.abs(reach.T @ reach) > COUPLING_ROUNDING
    if objective.P is not None:
        size = np.sqrt(np.abs(objective.P.diagonal()))
        tied |= np.abs(objective.P) > COUPLING_ROUNDING * np.outer(size, size)
    count, label = connected_components(csr_matrix(tied), directed=False)
    whole = axis_of(problem, np.eye(model.nu), np.arange(model.n), np.arange(len(C_r)), np.flatnonzero(bounded))
    on_nothing = not (C_r.any(axis=1).all() and bounded[rows.of_states].all())
    if count == 1 or on_nothing:
        return [whole]
    parts = []
    for g in range(count):
        states = np.flatnonzero(label == g)
        regulated = C_r[:, states].any(axis=1)
        outputs = bounded & C[:, states].any(axis=1)
        if reach[:, states].any() and regulated.any():
            directions, sizes, _ = np.linalg.svd(reach[:, states], full_matrices=False)
            T = _normalised(np.linalg.solve(root.T, directions[:, sizes > COUPLING_ROUNDING]))
            parts.append(axis_of(problem, T, states, np.flatnonzero(regulated), np.flatnonzero(outputs)))
        elif outputs.any():
            return [whole]
    if objective.Q_d is not None:
        inputs = [axis.T for axis in parts]
        T = np.hstack(inputs)
        axis_of_input = np.repeat(range(len(parts)), [part.shape[1] for part in inputs])
        moves = np.abs(T.T @ objective.Q_d @ T)
        across = moves[axis_of_input[:, None] != axis_of_input]
        if T.shape[0] != T.shape[1] or (across > COUPLING_ROUNDING * moves.max()).any():
            return [whole]
    return parts


def axis_of(problem: Problem, T: Array, states: Indices, regulated: Indices, outputs: Indices) -> Axis:
    """Return the axis of inputs along T, with these states, rows of C_r and rows."""
    model = LinearModel(
        A=problem.model.A[np.ix_(states, states)],
        B=problem.model.B[states] @ T,
        u_bar=np.zeros(T.shape[1]),
        period=problem.model.period,
    )
    whole = problem.objective
    Q_d = None
    P = None
    if whole.Q_d is not None:
        Q_d = symmetric(T.T @ whole.Q_d @ T)
    if whole.P is not None:
        P = whole.P[np.ix_(states, states)]
    objective = Objective(
        C_r=whole.C_r[np.ix_(regulated, states)],
        Q_y=whole.Q_y[np.ix_(regulated, regulated)],
        Q_u=symmetric(T.T @ whole.Q_u @ T),
        Q_d=Q_d,
        P=P,
    )
    return Axis(
        problem=Problem(model=model, horizon=problem.horizon, objective=objective),
        states=states,
        regulated=regulated,
        outputs=outputs,
        T=T,
    )


def symmetric(matrix: Array) -> Array:
    """Return the symmetric part of a matrix that is symmetric up to rounding."""
    return np.asarray(0.5 * (matrix + matrix.T))


def _normalised(matrix: Array) -> Array:
    """Return the matrix with columns of unit length; zero columns stay."""
    size = np.linalg.norm(matrix, axis=0)
    return np.asarray(matrix / np.where(size > 0.0, size, 1.0), dtype=np.float64)
