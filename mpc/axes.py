"""The axes of a problem: parts that meet only in what the inputs can do.

A hovering quadrotor is four systems: x with pitch, y with roll, z, and yaw.  Four rotors drive them all, so that bounds
on rotors tie them together; but no prediction, no weight and no output bound does.  Take as axes the connected
components of the states under

    A,  |C_r|' |Q_y| |C_r|,  |C_c|' |C_c|,  B Q_u^-1 B',

the last for what it costs to move two states at once, and for each axis g inputs w_g with T_g spanning Q_u^-1 B_g'.
Then u = u_bar + sum T_g w_g, each w_g moves its own axis alone since B_h T_g = 0, and the cost falls apart since
T_g' Q_u T_h = 0: without bounds on inputs the problem is one small problem per axis.  What of u lies in none of the T_g
moves nothing, and is u_bar's at the optimum.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components

from mpc.condensed import require_bounds
from mpc.model import LinearModel
from mpc.problem import Bounds, Objective, Problem
from quadsim.state import Array, Indices

ROUNDING: Final = 1e-12
"""Relative size below which what ties two states is taken for a product of rounding."""


@dataclass(frozen=True, kw_only=True)
class Axis:
    """One axis, as a problem of its own.

    Attributes:
        problem: in w (N, m), with the axis's output bounds, if any, and no others; its u_bar is zero.
        states: (n_g,) its states among those of the whole.
        regulated: its rows of C_r.
        outputs: its rows of C_c that have a bound.
        T: (nu, m) the axis's part of u - u_bar is T w; columns of unit length.
    """

    problem: Problem
    states: Indices
    regulated: Indices
    outputs: Indices
    T: Array


def axes(problem: Problem) -> list[Axis]:
    """The axes of a problem, which together are all of it but its bounds on inputs.

    Pieces that nothing moves or asks anything of are left out: they want u_bar.  Where such a piece has a bound, or a
    bound or a row of C_r is on nothing, or the problem is all of one piece, the one axis is the whole problem.

    Raises:
        ValueError: the problem has no bounds.
    """
    bounds, model, objective = require_bounds(problem), problem.model, problem.objective
    C_r, C_c = np.abs(objective.C_r), np.abs(bounds.C_c)
    root = np.linalg.cholesky(objective.Q_u)
    reach = _normalised(np.linalg.solve(root, model.B.T))
    tied = (C_r.T @ np.abs(objective.Q_y) @ C_r + C_c.T @ C_c) > 0.0
    tied |= np.abs(model.A) > ROUNDING * np.abs(model.A).max()
    tied |= np.abs(reach.T @ reach) > ROUNDING
    count, label = connected_components(csr_matrix(tied), directed=False)
    bounded = np.isfinite(bounds.y_min) | np.isfinite(bounds.y_max)
    whole = _axis(problem, np.eye(model.nu), np.arange(model.n), np.arange(len(C_r)), np.flatnonzero(bounded))
    if count == 1 or not (C_r.any(axis=1).all() and C_c[bounded].any(axis=1).all()):
        return [whole]
    found = []
    for states in (np.flatnonzero(label == g) for g in range(count)):
        regulated, outputs = C_r[:, states].any(axis=1), bounded & C_c[:, states].any(axis=1)
        if reach[:, states].any() and regulated.any():
            directions, sizes, _ = np.linalg.svd(reach[:, states], full_matrices=False)
            T = _normalised(np.linalg.solve(root.T, directions[:, sizes > ROUNDING]))
            found.append(_axis(problem, T, states, np.flatnonzero(regulated), np.flatnonzero(outputs)))
        elif outputs.any():
            return [whole]
    return found


def _axis(problem: Problem, T: Array, states: Indices, regulated: Indices, outputs: Indices) -> Axis:
    model, objective, bounds = problem.model, problem.objective, require_bounds(problem)
    weight: Array = T.T @ objective.Q_u @ T
    free = np.full(T.shape[1], np.inf)
    return Axis(
        problem=Problem(
            model=LinearModel(
                A=model.A[np.ix_(states, states)],
                B=model.B[states] @ T,
                u_bar=np.zeros(T.shape[1]),
                period=model.period,
            ),
            horizon=problem.horizon,
            objective=Objective(
                C_r=objective.C_r[np.ix_(regulated, states)],
                Q_y=objective.Q_y[np.ix_(regulated, regulated)],
                Q_u=0.5 * (weight + weight.T),
            ),
            bounds=Bounds(
                C_c=bounds.C_c[np.ix_(outputs, states)],
                y_min=bounds.y_min[outputs],
                y_max=bounds.y_max[outputs],
                delta_min=-free,
                delta_max=free,
                u_min=-free,
                u_max=free,
            ),
        ),
        states=states,
        regulated=regulated,
        outputs=outputs,
        T=T,
    )


def _normalised(matrix: Array) -> Array:
    """The matrix with columns of unit length; those of zeros stay."""
    size = np.linalg.norm(matrix, axis=0)
    return np.asarray(matrix / np.where(size > 0.0, size, 1.0), dtype=np.float64)
