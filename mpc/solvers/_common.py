"""What the back ends beside PIQP's share: their QP's constraints as one block, and their answers as a `Solution`.

The block lower <= M x <= upper has the rows M = [I; G; A]: the box, the two-sided rows, then the equalities with
lower = upper = b.  Multipliers come back in this order, positive at the upper side and negative at the lower.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy import sparse
from scipy.sparse import csc_matrix

from mpc.qp import QP, Matrix, Solution, Vectors
from quadsim.state import Array

ACTIVE_MULTIPLIER: Final = 1e-5
"""Size of a multiplier from which its constraint counts as active; at the paper's optima they reach 1e3."""

Indices = np.ndarray[tuple[int], np.dtype[np.int64]]


def dense(matrix: Matrix) -> Array:
    """A C-contiguous copy of a matrix."""
    return np.array(matrix.toarray() if isinstance(matrix, csc_matrix) else matrix, order="C")


def start(qp: QP) -> Vectors:
    """The vectors a QP was built with."""
    return Vectors(c=qp.c, b=qp.b, h_l=qp.h_l, h_u=qp.h_u)


def rows(qp: QP) -> csc_matrix:
    """[G; A]."""
    return sparse.vstack([sparse.csc_matrix(qp.G), sparse.csc_matrix(qp.A)], format="csc")


def block(qp: QP) -> csc_matrix:
    """M = [I; G; A]."""
    return sparse.vstack([sparse.identity(qp.c.size), rows(qp)], format="csc")


def lower(qp: QP, vectors: Vectors) -> Array:
    """The block's lower side."""
    return np.concatenate([qp.x_l, vectors.h_l, vectors.b])


def upper(qp: QP, vectors: Vectors) -> Array:
    """The block's upper side."""
    return np.concatenate([qp.x_u, vectors.h_u, vectors.b])


@dataclass(frozen=True, kw_only=True)
class OneSided:
    """The same constraints for solvers that bound from above only: A x = b first, then rows C x <= d.

    Sides at infinity, which no vectors ever change, are left out.

    Attributes:
        qp: whose they are.
        matrix: [A; C], C the block's rows with a finite upper side, then minus those with a finite lower side.
        at_upper, at_lower: indices in the block of the rows of C.
    """

    qp: QP
    matrix: csc_matrix
    at_upper: Indices
    at_lower: Indices

    def right_side(self, vectors: Vectors) -> Array:
        """[b; d]."""
        above, below = upper(self.qp, vectors)[self.at_upper], lower(self.qp, vectors)[self.at_lower]
        return np.concatenate([vectors.b, above, -below])

    def two_sided(self, multipliers: Array) -> Array:
        """The block's multipliers, from those of [A; C]."""
        qp = self.qp
        y, at_upper, at_lower = np.split(multipliers, [qp.b.size, qp.b.size + self.at_upper.size])
        signed = np.zeros(qp.c.size + qp.h_l.size + qp.b.size)
        signed[self.at_upper] += at_upper
        signed[self.at_lower] -= at_lower
        signed[qp.c.size + qp.h_l.size :] = y
        return signed


def one_sided(qp: QP) -> OneSided:
    """A QP's constraints as equalities and one-sided rows."""
    both = sparse.vstack([sparse.identity(qp.c.size), sparse.csc_matrix(qp.G)], format="csc")
    at_upper = np.flatnonzero(np.isfinite(np.concatenate([qp.x_u, qp.h_u])))
    at_lower = np.flatnonzero(np.isfinite(np.concatenate([qp.x_l, qp.h_l])))
    matrix = sparse.vstack([sparse.csc_matrix(qp.A), both[at_upper], -both[at_lower]], format="csc")
    return OneSided(qp=qp, matrix=matrix, at_upper=at_upper, at_lower=at_lower)


def solution(
    qp: QP,
    *,
    x: Array,
    multipliers: Array,
    status: str,
    iterations: int,
    solve_s: float,
    primal_residual: float = math.nan,
    dual_residual: float = math.nan,
) -> Solution:
    """An answer from multipliers in the block's order; residuals are not a number where the solver reports none."""
    z_box, z, y = np.split(multipliers, [qp.c.size, qp.c.size + qp.h_l.size])
    return Solution(
        x=x,
        y=y,
        z=z,
        z_box=z_box,
        status=status,
        iterations=iterations,
        active=int(np.count_nonzero(np.abs(multipliers[: multipliers.size - y.size]) > ACTIVE_MULTIPLIER)),
        primal_residual=primal_residual,
        dual_residual=dual_residual,
        solve_s=solve_s,
    )
