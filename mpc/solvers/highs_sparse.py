"""HiGHS: an active-set method for convex QPs in a solver made for linear and integer programs; no warm start.

On the paper's QPs it calls many a convex problem non-convex, and now and then a point optimal that violates a row by
60: so its claim is checked, and `violated` is the answer then.  It is here to be compared, not to be flown.

Huangfu and Hall, Parallelizing the dual revised simplex method, Mathematical Programming Computation 2018.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import time as clock
from collections.abc import Iterator
from typing import Any, Final

import highspy
import numpy as np
from scipy import sparse

from mpc.qp import QP, Solution, Vectors
from mpc.solvers import _common
from quadsim.controller import SOLVED

SETTINGS: Final[dict[str, Any]] = {
    "threads": 1,
    "qp_iteration_limit": 6000,  # where it finds the optimum it takes 2000 to 5000
}

LARGEST_VIOLATION: Final = 1e-5  # of any row or box entry by a point that HiGHS calls optimal [rad or rad/s]

STATUS: Final = {
    highspy.HighsModelStatus.kOptimal: SOLVED,
    highspy.HighsModelStatus.kNotset: "non_convex",  # set by the QP solver alone
    highspy.HighsModelStatus.kSolveError: "numerics",
    highspy.HighsModelStatus.kInfeasible: "primal_infeasible",
    highspy.HighsModelStatus.kUnboundedOrInfeasible: "primal_infeasible",
    highspy.HighsModelStatus.kUnbounded: "dual_infeasible",
    highspy.HighsModelStatus.kTimeLimit: "max_time",
    highspy.HighsModelStatus.kIterationLimit: "max_iterations",
    highspy.HighsModelStatus.kInterrupt: "interrupted",
}


class HighsSparse:
    """Back end for sparse QPs; see `mpc.qp.Backend`."""

    def setup(self, qp: QP) -> None:
        """See `mpc.qp.Backend.setup`."""
        self._qp = qp
        rows, hessian = _common.rows(qp), sparse.tril(qp.P, format="csc")
        self._row_index = np.arange(rows.shape[0], dtype=np.int32)
        self._column_index = np.arange(rows.shape[1], dtype=np.int32)
        model = highspy.HighsModel()
        lp = model.lp_
        lp.num_row_, lp.num_col_ = rows.shape
        lp.col_cost_, lp.col_lower_, lp.col_upper_ = qp.c, qp.x_l, qp.x_u
        lp.row_lower_, lp.row_upper_ = np.concatenate([qp.h_l, qp.b]), np.concatenate([qp.h_u, qp.b])
        lp.a_matrix_.format_ = highspy.MatrixFormat.kColwise
        lp.a_matrix_.start_, lp.a_matrix_.index_, lp.a_matrix_.value_ = rows.indptr, rows.indices, rows.data
        model.hessian_.dim_ = rows.shape[1]
        model.hessian_.format_ = highspy.HessianFormat.kTriangular
        model.hessian_.start_, model.hessian_.index_ = hessian.indptr, hessian.indices
        model.hessian_.value_ = hessian.data
        self._solver = highspy.Highs()
        self._solver.silent()
        for name, value in SETTINGS.items():
            self._solver.setOptionValue(name, value)
        self._solver.passModel(model)

    def solve(self, vectors: Vectors) -> Solution:
        """See `mpc.qp.Backend.solve`."""
        solver, rows, columns = self._solver, self._row_index, self._column_index
        lower, upper = np.concatenate([vectors.h_l, vectors.b]), np.concatenate([vectors.h_u, vectors.b])
        started = clock.perf_counter()
        solver.changeColsCost(columns.size, columns, vectors.c)
        solver.changeRowsBounds(rows.size, rows, lower, upper)
        with hushed():
            solver.run()
        elapsed = clock.perf_counter() - started
        answer, info = solver.getSolution(), solver.getInfo()
        x = np.array(answer.col_value) if answer.value_valid else np.full(columns.size, np.nan)
        duals = (answer.col_dual, answer.row_dual) if answer.dual_valid else (x * np.nan, lower * np.nan)
        status = STATUS.get(solver.getModelStatus(), "unsolved")
        if status == SOLVED:
            qp, values = self._qp, np.concatenate([x, self._qp.G @ x, self._qp.A @ x])
            violation = np.maximum(_common.lower(qp, vectors) - values, values - _common.upper(qp, vectors)).max()
            status = "violated" if violation > LARGEST_VIOLATION else SOLVED
        return _common.solution(
            self._qp,
            x,
            -np.concatenate(duals),  # HiGHS counts them positive at the lower side
            status=status,
            iterations=max(0, int(info.qp_iteration_count)),
            solve_s=elapsed,
            residuals=(float(info.max_primal_infeasibility), float(info.max_dual_infeasibility)),
        )


@contextlib.contextmanager
def hushed() -> Iterator[None]:
    """Discard what C writes to stdout: the QP solver prints `error` there, silent or not, when it fails."""
    libc = ctypes.CDLL(None)
    libc.fflush(None)
    saved, null = os.dup(1), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(null, 1)
        yield
    finally:
        libc.fflush(None)
        os.dup2(saved, 1)
        os.close(saved)
        os.close(null)
