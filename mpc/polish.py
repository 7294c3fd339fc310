"""The exact optimum of a QP from an approximate one.

An interior-point method stops short of the optimum: next to a constraint that is hardly active its point is off by as
much as the square root of the duality gap it was allowed.  But it tells which constraints are active, and with those as
equalities the KKT conditions are linear.  Where their solution violates a constraint that was left out, that one is
active; where a multiplier has the wrong sign, its constraint is not.  To solve again with what was learnt is the
primal-dual active set method (Hintermueller, Ito and Kunisch, SIAM J. Optim. 13(3), 2003), a Newton method for the KKT
conditions: from a close start it takes a few rounds, and ends at the optimum itself.  It may go in circles; then one
constraint at a time is learnt, the worst first.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import replace
from typing import Any, Final

import numpy as np
import scipy.linalg
from scipy import sparse
from scipy.linalg import lapack

from mpc.qp import QP, Matrix, Solution
from quadsim.state import Array, Indices

FEASIBLE: Final = 1e-9
"""Violation of a bound, and size of a multiplier of the wrong sign, that are taken for rounding."""
ROUNDS_AT_ONCE: Final = 12
"""Rounds that learn from all constraints at once.  Over the paper's flight an axis takes 1 to 10, mostly 1 or 2."""
MOST_ROUNDS: Final = 60


def polish(qp: QP, solution: Solution) -> Solution:
    """The exact optimum of a whole QP, by dense matrices: slow, and a reference that believes no solver.

    With the active constraints as equalities M x = d, what remains is one linear system,

        [P  M'] [x     ]   [-c]
        [M  0 ] [lambda] = [ d].

    Args:
        qp: strictly convex.
        solution: any approximation; only where its multipliers outweigh the distance to their bound is looked at.

    Returns:
        The solution with x and all multipliers replaced.  Of a poor start it may not be the optimum:
        `mpc.qp.kkt_residuals` tells.
    """
    n, rows = qp.c.size, qp.h_l.size
    P = _dense(qp.P)
    block = np.vstack([np.eye(n), _dense(qp.G), _dense(qp.A)])
    lower, upper = np.concatenate([qp.x_l, qp.h_l, qp.b]), np.concatenate([qp.x_u, qp.h_u, qp.b])
    points = [solution.x]

    def at(active: Indices, bound: Array) -> tuple[Array, Array]:
        x, multipliers = _solve_kkt(P, block[active], qp.c, bound)
        points.append(x)
        return block @ x, multipliers

    start = np.concatenate([solution.z_box, solution.z, solution.y])
    active, multipliers, _ = _rounds(at, block @ solution.x, start, lower, upper)
    z_box, z, y = np.split(multipliers, [n, n + rows])
    return replace(solution, x=points[-1], y=y, z=z, z_box=z_box, active=int(np.count_nonzero(active < n + rows)))


class RowPolish:
    """The exact optimum of QPs that differ in their vectors alone, and whose bounds are all on rows: fast.

    Of min 1/2 x' P x + c' x over lower <= G x + h <= upper, the optimum is x = x_free - R z with R = P^-1 G', so that

        G x + h = (G x_free + h) - S z,    S = G P^-1 G':

    from what the free optimum makes of the rows, the multipliers are found without a look at x.

    Args:
        P: (n, n) symmetric positive definite.
        G: (rows, n).
        lower, upper: (rows,) lower below upper; infinite where there is no bound.

    Attributes:
        R: (n, rows).
    """

    def __init__(self, P: Array, G: Array, lower: Array, upper: Array) -> None:
        self.R = np.asarray(scipy.linalg.cho_solve(scipy.linalg.cho_factor(P), G.T), dtype=np.float64)
        S = G @ self.R
        self._S, self._lower, self._upper = 0.5 * (S + S.T), lower, upper

    def multipliers(self, free: Array, approximate: Array) -> Array | None:
        """The exact multipliers z (rows,), positive at upper bounds and negative at lower ones.

        Args:
            free: (rows,) G x_free + h.
            approximate: (rows,) multipliers near the optimum's.

        Returns:
            None where the rounds have no end, or rows that are active together depend on each other.
        """
        S = self._S

        def at(active: Indices, bound: Array) -> tuple[Array, Array]:
            if not active.size:
                return free, bound
            columns = S[active]
            _, held, failed = lapack.dposv(columns[:, active], free[active] - bound)
            if failed:
                raise np.linalg.LinAlgError("dependent rows")
            return free - held @ columns, held

        try:
            _, z, found = _rounds(at, free - approximate @ S, approximate, self._lower, self._upper)
        except np.linalg.LinAlgError:
            return None
        return z if found else None


def _rounds(
    at: Callable[[Indices, Array], tuple[Array, Array]],
    values: Array,
    multipliers: Array,
    lower: Array,
    upper: Array,
) -> tuple[Indices, Array, bool]:
    """The active rows at the optimum, the multipliers of all rows there, and whether it was found.

    Args:
        at: the values (rows,) of all rows at the optimum over some rows held at given bounds, and the multipliers of
            those rows.
        values: (rows,) at the start.
        multipliers: (rows,) at the start.
        lower: (rows,) bounds.
        upper: (rows,) likewise; the same where a row is an equality.
    """
    equal = np.flatnonzero(lower == upper)
    side = (multipliers > upper - values).astype(np.int8) - (-multipliers > values - lower)
    side[equal] = 1
    start = side
    for turn in range(MOST_ROUNDS):
        active = side.nonzero()[0]
        values, held = at(active, np.where(side > 0, upper, lower)[active])
        above, below = values - upper, lower - values
        against = np.maximum(above, below)
        against[active] = -held * side[active]
        against[equal] = 0.0
        learnt = against > FEASIBLE
        found = not learnt.any()
        if found:
            break
        if turn == ROUNDS_AT_ONCE:
            side = start
            continue
        if turn > ROUNDS_AT_ONCE:
            learnt = _worst(against, learnt & (side == 0) if learnt[side == 0].any() else learnt)
        side = np.where(learnt, (side == 0) * np.where(above > below, np.int8(1), np.int8(-1)), side)
    multipliers = np.zeros_like(lower)
    multipliers[active] = held
    return active, multipliers, found


def _worst(against: Array, among: Any) -> Any:
    """The one row among some that is against the conditions most."""
    chosen = np.zeros_like(among)
    chosen[np.argmax(np.where(among, against, -np.inf))] = True
    return chosen


def _solve_kkt(P: Array, M: Array, c: Array, d: Array) -> tuple[Array, Array]:
    """The optimum x and lambda; of the multipliers of dependent rows, the smallest."""
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
