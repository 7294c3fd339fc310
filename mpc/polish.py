"""The exact optimum of a QP from an approximate one: a reference that believes no solver."""

from __future__ import annotations

import warnings
from dataclasses import replace
from typing import Final

import numpy as np
import scipy.linalg
from scipy import sparse

from mpc.qp import QP, Matrix, Solution
from quadsim.state import Array

FEASIBLE: Final = 1e-9
"""Violation of a bound, and size of a multiplier of the wrong sign, that are taken for rounding."""
MOST_ROUNDS: Final = 50


def polish(qp: QP, solution: Solution) -> Solution:
    """Solve the KKT conditions in closed form on the constraints that a solution suggests as active.

    With the active constraints as equations M x = d, what remains is one linear system,

        [P  M'] [x     ]   [-c]
        [M  0 ] [lambda] = [ d].

    The constraint that its solution violates most is then added, or if there is none the one whose multiplier has the
    wrong sign most is dropped, and so on.  A close start takes a few rounds; `kkt_residuals` tells whether they reached
    the optimum.

    Args:
        qp: strictly convex; solved with dense matrices.
        solution: any approximation; only where its multipliers outweigh the distance to their bound is looked at.

    Returns:
        The solution with x and all multipliers replaced.
    """
    n, rows = qp.c.size, qp.h_l.size
    P = _dense(qp.P)
    block = np.vstack([np.eye(n), _dense(qp.G), _dense(qp.A)])
    lower, upper = np.concatenate([qp.x_l, qp.h_l, qp.b]), np.concatenate([qp.x_u, qp.h_u, qp.b])
    equality = np.arange(lower.size) >= n + rows
    multipliers = np.concatenate([solution.z_box, solution.z, solution.y])
    values = block @ solution.x
    side = np.where(multipliers > upper - values, 1, np.where(-multipliers > values - lower, -1, 0))
    side[equality] = 1
    for _ in range(MOST_ROUNDS):
        active = np.flatnonzero(side)
        x, found = _solve(P, block[active], qp.c, np.where(side > 0, upper, lower)[active])
        values, multipliers = block @ x, np.zeros(lower.size)
        multipliers[active] = found
        beyond = np.maximum(values - upper, lower - values)
        beyond[active] = 0.0
        against = np.where(equality, 0.0, -multipliers * side)
        if beyond.max() > FEASIBLE:
            worst = int(np.argmax(beyond))
            side[worst] = 1 if values[worst] > upper[worst] else -1
        elif against.max() > FEASIBLE:
            side[np.argmax(against)] = 0
        else:
            break
    z_box, z, y = np.split(multipliers, [n, n + rows])
    return replace(solution, x=x, y=y, z=z, z_box=z_box, active=int(np.count_nonzero(side[~equality])))


def _solve(P: Array, M: Array, c: Array, d: Array) -> tuple[Array, Array]:
    """X and lambda; of the multipliers of dependent rows, the smallest."""
    n, m = c.size, d.size
    system = np.block([[P, M.T], [M, np.zeros((m, m))]])
    right_side = np.concatenate([-c, d])
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", scipy.linalg.LinAlgWarning)
            answer = scipy.linalg.solve(system, right_side, assume_a="sym")
    except (scipy.linalg.LinAlgError, scipy.linalg.LinAlgWarning):
        answer = scipy.linalg.lstsq(system, right_side, lapack_driver="gelsy")[0]
    return answer[:n], answer[n:]


def _dense(matrix: Matrix) -> Array:
    return np.asarray(matrix.toarray() if isinstance(matrix, sparse.csc_matrix) else matrix)
