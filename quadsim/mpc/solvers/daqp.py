"""DAQP: a dual active-set method that factorises the Hessian once and starts from the last active set.

Arnström, Bemporad and Axehill, A Dual Active-Set Solver for Embedded Quadratic Programming Using Recursive LDL'
Updates, IEEE TAC 2022.
"""

from __future__ import annotations

import time as clock
from typing import Final

import daqp
import numpy as np
from scipy.sparse import csc_matrix

from quadsim.controller import SOLVED, Statistics
from quadsim.mpc.problem.qp import QP, Matrix, Solution
from quadsim.state import Array

DAQP_SETTINGS: Final = {
    "primal_tol": 1e-8,  # rad or rad/s; DAQP's default of 1e-6 is equally fast
    "iter_limit": 5000,  # changes of the active set; the paper's QPs take 1 to 180
}

DAQP_STATUS: Final = {
    1: SOLVED,
    -1: "primal_infeasible",
    -2: "cycling",
    -3: "dual_infeasible",
    -4: "max_iterations",
    -5: "non_convex",
    -6: "overdetermined_start",
    -7: "max_time",
}


class DaqpDense:
    """Back end for dense QPs; see `quadsim.mpc.problem.qp.Backend`."""

    def setup(self, qp: QP) -> None:
        """See `quadsim.mpc.problem.qp.Backend.setup`."""
        self._qp = qp
        self._model = daqp.Model()
        self._model.settings = DAQP_SETTINGS
        sense = np.zeros(qp.c.size + qp.h_l.size + qp.b.size, dtype=np.intc)
        sense[qp.c.size + qp.h_l.size :] = 5  # always active
        rows = np.concatenate([_dense(qp.G), _dense(qp.A)])
        bounds = _sides(qp)
        self._finite = np.isfinite(bounds)
        self._model.setup(_dense(qp.P), qp.c.copy(), rows, *bounds, sense)

    def solve(self, qp: QP) -> Solution:
        """See `quadsim.mpc.problem.qp.Backend.solve`."""
        started = clock.perf_counter()
        upper, lower = _sides(qp)
        same = qp.P is self._qp.P and qp.A is self._qp.A and qp.G is self._qp.G
        if same and np.array_equal(np.isfinite([upper, lower]), self._finite):
            self._model.update(f=qp.c, bupper=upper, blower=lower)
        else:  # from an active bound that is now infinite, it would start at NaN, and call that solved
            self.setup(qp)
        x, _, flag, info = self._model.solve()
        elapsed = clock.perf_counter() - started
        z_box, z, y = np.split(info["lam"], [qp.c.size, qp.c.size + qp.h_l.size])
        return Solution(
            x=x,
            y=y,
            z=z,
            z_box=z_box,
            status=DAQP_STATUS.get(flag, f"daqp_{flag}"),
            stats=Statistics(
                iterations=info["iterations"],
                active=int(np.count_nonzero(z) + np.count_nonzero(z_box)),
                solve_s=elapsed,
            ),
        )


def _dense(matrix: Matrix) -> Array:
    """Return a C-contiguous copy of a matrix."""
    if isinstance(matrix, csc_matrix):
        matrix = matrix.toarray()
    return np.array(matrix, order="C")


def _sides(qp: QP) -> tuple[Array, Array]:
    """Return the upper and lower sides of [x; G x; A x]."""
    return np.concatenate([qp.x_u, qp.h_u, qp.b]), np.concatenate([qp.x_l, qp.h_l, qp.b])
