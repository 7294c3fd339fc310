"""OSQP: operator splitting, factorised once, warm-started.

Stellato et al., OSQP: An Operator Splitting Solver for Quadratic Programs, Mathematical Programming Computation 2020.
"""

from __future__ import annotations

import time as clock
from typing import Any, Final

import numpy as np
import osqp
from scipy import sparse

from mpc.qp import QP, Solution, Vectors
from mpc.solvers import _common
from quadsim.controller import SOLVED

SETTINGS: Final[dict[str, Any]] = {
    "eps_abs": 1e-5,  # at 1e-4 the first input is off by 1e-2 rad/s
    "eps_rel": 0.0,
    "max_iter": 10_000,  # then it gives up, as it does in take-off; ten times as many do not change that
    "polishing": False,  # it prints, silent or not, and is not needed at these tolerances
    "verbose": False,
}

STATUS: Final = {
    osqp.SolverStatus.OSQP_SOLVED: SOLVED,
    osqp.SolverStatus.OSQP_SOLVED_INACCURATE: "solved_inaccurate",
    osqp.SolverStatus.OSQP_PRIMAL_INFEASIBLE: "primal_infeasible",
    osqp.SolverStatus.OSQP_PRIMAL_INFEASIBLE_INACCURATE: "primal_infeasible",
    osqp.SolverStatus.OSQP_DUAL_INFEASIBLE: "dual_infeasible",
    osqp.SolverStatus.OSQP_DUAL_INFEASIBLE_INACCURATE: "dual_infeasible",
    osqp.SolverStatus.OSQP_MAX_ITER_REACHED: "max_iterations",
    osqp.SolverStatus.OSQP_TIME_LIMIT_REACHED: "max_time",
    osqp.SolverStatus.OSQP_NON_CVX: "non_convex",
    osqp.SolverStatus.OSQP_SIGINT: "interrupted",
    osqp.SolverStatus.OSQP_UNSOLVED: "unsolved",
}


class OsqpSparse:
    """Back end for sparse QPs; see `mpc.qp.Backend`."""

    def __init__(self) -> None:
        self._solver = osqp.OSQP()

    def setup(self, qp: QP) -> None:
        """See `mpc.qp.Backend.setup`."""
        self._qp = qp
        block = sparse.vstack([sparse.identity(qp.c.size), _common.rows(qp)], format="csc")
        lower, upper = _common.lower(qp, qp.vectors), _common.upper(qp, qp.vectors)
        self._solver.setup(sparse.triu(qp.P, format="csc"), qp.c, block, lower, upper, **SETTINGS)

    def solve(self, vectors: Vectors) -> Solution:
        """See `mpc.qp.Backend.solve`."""
        qp = self._qp
        started = clock.perf_counter()
        self._solver.update(q=vectors.c, l=_common.lower(qp, vectors), u=_common.upper(qp, vectors))
        answer = self._solver.solve(raise_error=False)
        elapsed = clock.perf_counter() - started
        info = answer.info
        return _common.solution(
            qp,
            np.array(answer.x),
            np.array(answer.y),
            status=STATUS[info.status_val],
            iterations=int(info.iter),
            solve_s=elapsed,
            residuals=(float(info.prim_res), float(info.dual_res)),
        )
