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

from mpc.qp import QP, Matrix, Solution, kkt_residuals
from quadsim.state import Array, Indices

FEASIBLE: Final = 1e-9
"""Violation of a bound, and size of a multiplier of the wrong sign, that are taken for rounding; the latter as a share
of the largest where that is above 1."""
DEPENDENT: Final = 1e-12
"""Share of a row's square that other active rows leave over, below which it is taken for a combination of them."""
ROUNDS_AT_ONCE: Final = 12
"""Rounds that learn from all constraints at once.  Over the paper's flight an axis takes 1 to 10, mostly 1 or 2, the
whole QP 1 to 4, mostly 1."""
MOST_ROUNDS: Final = 60
ROUNDING: Final = 1e-13
"""KKT residual that is taken for rounding, as a share of the largest entry of c."""


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
    """The multipliers of QPs that differ in their vectors alone, and whose bounds are all on rows: fast.

    Of min 1/2 x' P x + c' x over lower <= G x + h <= upper, the optimum is x = x_free - R z with R = P^-1 G', so that

        G x + h = (G x_free + h) - S z,    S = G P^-1 G':

    from what the free optimum makes of the rows, the multipliers are found without a look at x.

    Args:
        P: (n, n) symmetric positive definite.
        G: (rows, n).

    Attributes:
        R: (n, rows).
        S: (rows, rows).

    Raises:
        numpy.linalg.LinAlgError: P is not positive definite.
    """

    def __init__(self, P: Array, G: Array) -> None:
        root = np.linalg.cholesky(P)
        half = scipy.linalg.solve_triangular(root, G.T, lower=True)
        self.R = np.asarray(scipy.linalg.solve_triangular(root, half, lower=True, trans="T"), dtype=np.float64)
        self.S: Array = half.T @ half

    def multipliers(
        self, free: Array, approximate: Array, lower: Array, upper: Array, *, most: int = MOST_ROUNDS
    ) -> Array | None:
        """The exact multipliers z (rows,), positive at upper bounds and negative at lower ones.

        Args:
            free: (rows,) G x_free + h.
            approximate: (rows,) multipliers near the optimum's.
            lower: (rows,) bounds, below the upper ones; infinite where there is none.
            upper: (rows,) likewise.
            most: rounds after which the search is given up.

        Returns:
            None where it was.
        """

        def at(active: Indices, bound: Array) -> tuple[Array, Array]:
            if not active.size:
                return free, bound
            among, held = self.S[np.ix_(active, active)], approximate[active]
            held = held + _correction(among, free[active] - bound - among @ held)
            z = np.zeros_like(free)
            z[active] = held
            return free - self.S @ z, held

        moves = self.S.diagonal() * approximate  # how far each row would go without its multiplier
        _, z, found = _rounds(at, free - self.S @ approximate, moves, lower, upper, most=most)
        return z if found else None


class DensePolish:
    """The exact optimum of dense QPs without equalities that differ in their vectors alone: fast.

    Args:
        qp: with the matrices and the box.

    Raises:
        numpy.linalg.LinAlgError: P is not positive definite.
    """

    def __init__(self, qp: QP) -> None:
        self._P = _dense(qp.P)
        self._factor = scipy.linalg.cho_factor(self._P)
        self._G = _dense(qp.G)
        self._rows = RowPolish(self._P, np.vstack([np.eye(qp.c.size), self._G]))

    def optimum(self, qp: QP, near: Solution) -> Solution:
        """The exact optimum from a solution near it.

        Returns:
            The solution with x and all multipliers replaced; the one given where the active rows are not found in
            `ROUNDS_AT_ONCE` rounds, or do not lead to a point that meets the KKT conditions up to rounding.
        """
        n, rows = qp.c.size, self._rows
        lower, upper = np.concatenate([qp.x_l, qp.h_l]), np.concatenate([qp.x_u, qp.h_u])
        x = -scipy.linalg.cho_solve(self._factor, qp.c)
        approximate = np.concatenate([near.z_box, near.z])
        z = rows.multipliers(self._values(x), approximate, lower, upper, most=ROUNDS_AT_ONCE)
        if z is None:
            return near
        x -= rows.R @ z
        rounding = ROUNDING * np.abs(qp.c).max()
        for refined in (False, True):
            if refined:
                x, z = self._refined(qp, x, z, np.where(z > 0.0, upper, lower))
            found = replace(near, x=x, z_box=z[:n], z=z[n:], active=int(np.count_nonzero(z)))
            residuals = kkt_residuals(qp, found)
            if residuals.primal <= FEASIBLE and residuals.worst <= max(rounding, FEASIBLE):
                return found
        return near

    def _values(self, x: Array) -> Array:
        return np.concatenate([x, self._G @ x])

    def _refined(self, qp: QP, x: Array, z: Array, bound: Array) -> tuple[Array, Array]:
        """A step of iterative refinement: it takes off most of what rounding with an ill-conditioned P has left."""
        n, rows, active = x.size, self._rows, z.nonzero()[0]
        x = x - scipy.linalg.cho_solve(self._factor, self._P @ x + qp.c + z[:n] + z[n:] @ self._G)
        more = np.zeros_like(z)
        more[active] = _correction(rows.S[np.ix_(active, active)], (self._values(x) - bound)[active])
        return x - rows.R @ more, z + more


def _correction(S: Array, excess: Array) -> Array:
    """What to add to active rows' multipliers to take the excess (m,) off these rows.

    Nothing to those of rows that depend on the others: where there are such, multipliers are not unique, and the ones
    that an interior-point method ends with have the right signs.

    Args:
        S: (m, m) G P^-1 G' of the active rows.
        excess: (m,).
    """
    size = S.diagonal()
    factor, more, failed = lapack.dposv(S, excess)
    if not failed and (factor.diagonal() ** 2 > DEPENDENT * size).all():
        return np.asarray(more)
    unit = np.sqrt(np.where(size > 0.0, size, 1.0))
    factor, order, rank, _ = lapack.dpstrf(S / unit[:, None] / unit, tol=DEPENDENT)
    kept = order[:rank] - 1
    more = np.zeros_like(excess)
    more[kept] = lapack.dpotrs(factor[:rank, :rank], (excess / unit)[kept])[0] / unit[kept]
    return more


def _rounds(
    at: Callable[[Indices, Array], tuple[Array, Array]],
    values: Array,
    multipliers: Array,
    lower: Array,
    upper: Array,
    *,
    most: int = MOST_ROUNDS,
) -> tuple[Indices, Array, bool]:
    """The active rows at the optimum, the multipliers of all rows there, and whether it was found.

    Args:
        at: the values (rows,) of all rows at the optimum over some rows held at given bounds, and the multipliers of
            those rows.
        values: (rows,) at the start.
        multipliers: (rows,) at the start, in whatever unit they are to outweigh the distance to the bound.
        lower: (rows,) bounds.
        upper: (rows,) likewise; the same where a row is an equality.
        most: rounds.
    """
    equal = np.flatnonzero(lower == upper)
    side = (multipliers > upper - values).astype(np.int8) - (-multipliers > values - lower)
    side[equal] = 1
    start = side
    for turn in range(most):
        active = side.nonzero()[0]
        values, held = at(active, np.where(side > 0, upper, lower)[active])
        above, below = values - upper, lower - values
        against = np.maximum(above, below)
        against[active] = -held * side[active] / max(1.0, np.abs(held).max(initial=0.0))
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
