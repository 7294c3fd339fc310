"""What the back ends beside PIQP's share: their QP's constraints as one block, and their answers as a `Solution`.

The block lower <= M x <= upper has the rows M = [I; G; A]: the box, the two-sided rows, then the equalities with
lower = upper = b.  Multipliers come back in this order, positive at the upper side and negative at the lower.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from scipy import sparse
from scipy.sparse import csc_matrix

from mpc.qp import QP, Matrix, Point, Solution, Vectors
from quadsim.state import Array

ACTIVE_MULTIPLIER: Final = 1e-5
"""Size of a multiplier from which its constraint counts as active; at the paper's optima they reach 1e3."""


def dense(matrix: Matrix) -> Array:
    """A C-contiguous copy of a matrix."""
    return np.array(matrix.toarray() if isinstance(matrix, csc_matrix) else matrix, order="C")


def rows(qp: QP) -> csc_matrix:
    """[G; A]."""
    return sparse.vstack([sparse.csc_matrix(qp.G), sparse.csc_matrix(qp.A)], format="csc")


def lower(qp: QP, vectors: Vectors) -> Array:
    """The block's lower side."""
    return np.concatenate([qp.x_l, vectors.h_l, vectors.b])


def upper(qp: QP, vectors: Vectors) -> Array:
    """The block's upper side."""
    return np.concatenate([qp.x_u, vectors.h_u, vectors.b])


class OneSided:
    """The same constraints for solvers that bound from above only: A x = b first, then rows C x <= d.

    Sides at infinity, which no vectors ever change, are left out.

    Attributes:
        matrix: [A; C], C the block's rows with a finite upper side, then minus those with a finite lower side.
    """

    def __init__(self, qp: QP) -> None:
        self._qp = qp
        both = sparse.vstack([sparse.identity(qp.c.size), sparse.csc_matrix(qp.G)], format="csc")
        self._above = np.flatnonzero(np.isfinite(np.concatenate([qp.x_u, qp.h_u])))
        self._below = np.flatnonzero(np.isfinite(np.concatenate([qp.x_l, qp.h_l])))
        self.matrix = sparse.vstack([sparse.csc_matrix(qp.A), both[self._above], -both[self._below]], format="csc")

    def right_side(self, vectors: Vectors) -> Array:
        """[b; d]."""
        above, below = upper(self._qp, vectors)[self._above], lower(self._qp, vectors)[self._below]
        return np.concatenate([vectors.b, above, -below])

    def two_sided(self, multipliers: Array) -> Array:
        """The block's multipliers, from those of [A; C]."""
        qp = self._qp
        y, above, below = np.split(multipliers, [qp.b.size, qp.b.size + self._above.size])
        signed = np.zeros(qp.c.size + qp.h_l.size + qp.b.size)
        signed[self._above] += above
        signed[self._below] -= below
        signed[qp.c.size + qp.h_l.size :] = y
        return signed


def solution(
    qp: QP,
    x: Array,
    multipliers: Array,
    *,
    status: str,
    iterations: int,
    solve_s: float,
    residuals: tuple[float, float] = (math.nan, math.nan),
) -> Solution:
    """An answer from multipliers in the block's order; residuals are primal and dual, as the solver reports them."""
    z_box, z, y = np.split(multipliers, [qp.c.size, qp.c.size + qp.h_l.size])
    active = int(np.count_nonzero(np.abs(multipliers[: multipliers.size - y.size]) > ACTIVE_MULTIPLIER))
    return Solution(
        made=Point(x=x, y=y, z=z, z_box=z_box),
        status=status,
        iterations=iterations,
        active=active,
        reported_primal=residuals[0],
        reported_dual=residuals[1],
        solve_s=solve_s,
    )
