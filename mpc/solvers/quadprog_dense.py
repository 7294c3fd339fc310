"""quadprog: the dual active-set method of Goldfarb and Idnani (1983); no warm start."""

from __future__ import annotations

import time as clock

import numpy as np
import quadprog
import scipy.linalg

from mpc.qp import QP, Solution, Vectors
from mpc.solvers import _common
from quadsim.controller import SOLVED
from quadsim.errors import InputError
from quadsim.state import Array


class QuadprogDense:
    """Back end for dense QPs; see `mpc.qp.Backend`.

    The Hessian is factorised once.  Rows are one-sided, C' x >= b: each two-sided one becomes two.
    """

    def setup(self, qp: QP) -> None:
        """See `mpc.qp.Backend.setup`.

        Raises:
            InputError: the Hessian is not positive definite to working precision.
        """
        self._qp = qp
        self._sides = _common.OneSided(qp)
        try:
            factor = scipy.linalg.cholesky(_common.dense(qp.P))
        except scipy.linalg.LinAlgError as error:
            raise InputError(
                f"quadprog needs a Hessian with a Cholesky factor ({error}): the weights are too far apart"
            ) from error
        self._inverse_factor: Array = scipy.linalg.solve_triangular(factor, np.eye(qp.c.size))
        self._columns: Array = np.ascontiguousarray(-self._sides.matrix.toarray().T)

    def solve(self, vectors: Vectors) -> Solution:
        """See `mpc.qp.Backend.solve`."""
        qp, right_side = self._qp, -self._sides.right_side(vectors)
        started = clock.perf_counter()
        try:
            x, _, _, counts, multipliers, _ = quadprog.solve_qp(
                self._inverse_factor, -vectors.c, self._columns, right_side, qp.b.size, factorized=True
            )
            status, iterations = SOLVED, int(counts[0])
        except ValueError as error:
            x, multipliers = np.full(qp.c.size, np.nan), np.full(right_side.size, np.nan)
            status = "primal_infeasible" if "no solution" in str(error) else "numerics"
            iterations = 0
        return _common.solution(
            qp,
            x,
            self._sides.two_sided(multipliers),
            status=status,
            iterations=iterations,
            solve_s=clock.perf_counter() - started,
        )
