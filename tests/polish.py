"""The exact optimum of a QP from an approximate one.

An interior-point method stops short of the optimum: next to a constraint that is hardly active its point is off by as
much as the square root of the duality gap it was allowed.  But it shows which constraints are active, and with those as
equalities the KKT conditions are linear.  Where their solution violates a constraint that was left out, that one is
active; where a multiplier has the wrong sign, its constraint is not.  To solve again with what was learnt is the
primal-dual active set method (Hintermueller, Ito and Kunisch, SIAM J. Optim. 13(3), 2003), a Newton method for the KKT
conditions: from a close start it takes a few rounds, and ends at the optimum itself.  It may go in circles; then one
constraint at a time is learnt, the worst first.
"""

from __future__ import annotations

import warnings
from typing import Any, Final

import numpy as np
import scipy.linalg
from scipy import sparse

from quadsim.mpc.problem.qp import QP, Matrix, Solution
from quadsim.state import Array

FEASIBLE: Final = 1e-9
"""Violation of a bound, and size of a multiplier of the wrong sign, that are taken for rounding; the latter as a share
of the largest where that is above 1."""
ROUNDS_AT_ONCE: Final = 12
"""Rounds that learn from all constraints at once; the whole QP takes 1 to 4 over the paper's flight, mostly 1."""
MOST_ROUNDS: Final = 60


def polish(qp: QP, solution: Solution) -> Solution:
    """The exact optimum of a whole QP, by dense matrices: slow, and a reference independent of the solver.

    With the active constraints as equalities M x = d, what remains is one linear system,

        [P  M'] [x     ]   [-c]
        [M  0 ] [lambda] = [ d].

    Args:
        qp: strictly convex.
        solution: any approximation; only where its multipliers outweigh the distance to their bound is looked at.

    Returns:
        The solution with x and all multipliers replaced.  Of a poor start it may not be the optimum:
        `quadsim.mpc.problem.qp.kkt_residuals` shows.
    """
    n = qp.c.size
    rows = qp.h_l.size
    P = _dense(qp.P)
    block = np.vstack([np.eye(n), _dense(qp.G), _dense(qp.A)])
    lower = np.concatenate([qp.x_l, qp.h_l, qp.b])
    upper = np.concatenate([qp.x_u, qp.h_u, qp.b])
    equal = np.flatnonzero(lower == upper)
    values = block @ solution.x
    multipliers = np.concatenate([solution.z_box, solution.z, solution.y])
    side = (multipliers > upper - values).astype(np.int8) - (-multipliers > values - lower)
    side[equal] = 1
    start = side
    for turn in range(MOST_ROUNDS):
        active = side.nonzero()[0]
        x, held = _solve_kkt(P, block[active], qp.c, np.where(side > 0, upper, lower)[active])
        values = block @ x
        above = values - upper
        below = lower - values
        against = np.maximum(above, below)
        against[active] = -held * side[active] / max(1.0, np.abs(held).max(initial=0.0))
        against[equal] = 0.0
        learnt = against > FEASIBLE
        if not learnt.any():
            break
        if turn == ROUNDS_AT_ONCE:
            side = start
            continue
        if turn > ROUNDS_AT_ONCE:
            learnt = _worst(against, learnt & (side == 0) if learnt[side == 0].any() else learnt)
        side = np.where(learnt, (side == 0) * np.where(above > below, np.int8(1), np.int8(-1)), side)
    multipliers = np.zeros_like(lower)
    multipliers[active] = held
    z_box, z, y = np.split(multipliers, [n, n + rows])
    return solution._replace(
        x=x, y=y, z=z, z_box=z_box, stats=solution.stats._replace(active=int(np.count_nonzero(active < n + rows)))
    )


def _worst(against: Array, among: Any) -> Any:
    """The one row among some that is against the conditions most."""
    chosen = np.zeros_like(among)
    chosen[np.argmax(np.where(among, against, -np.inf))] = True
    return chosen


def _solve_kkt(P: Array, M: Array, c: Array, d: Array) -> tuple[Array, Array]:
    """The optimum x and lambda; of the multipliers of dependent rows, the smallest."""
    n = c.size
    m = d.size
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
