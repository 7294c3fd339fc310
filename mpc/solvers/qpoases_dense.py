"""qpOASES, the paper's own solver, through CasADi: an online active-set method, started from the last active set.

Ferreau et al., qpOASES: a parametric active-set algorithm for quadratic programming, Math. Prog. Comp. 2014.
"""

from __future__ import annotations

import contextlib
import io
import time as clock
from typing import Any, Final

import casadi
import numpy as np

from mpc.qp import QP, Solution, Vectors
from mpc.solvers import _common
from quadsim.controller import SOLVED

SETTINGS: Final[dict[str, Any]] = {
    "printLevel": "none",
    "error_on_fail": False,
    "print_time": False,
    "nWSR": 5000,  # changes of the active set
    "hessian_type": "posdef",
    "enableDriftCorrection": 0,
    "enableFarBounds": False,
    "enableFlippingBounds": False,
    "enableNZCTests": False,
    "enableRamping": False,
    "numRefinementSteps": 0,
}
"""Those of qpOASES's own `setToMPC`: a fifth faster here than the ones that are meant to be reliable, as exact."""

FAILURES: Final = {"infeasib": "primal_infeasible", "unbounded": "dual_infeasible", "maximum number": "max_iterations"}
"""What to look for in qpOASES's sentence about a failure, and its name here; `numerics` otherwise."""


class QpoasesDense:
    """Back end for dense QPs; see `mpc.qp.Backend`.

    CasADi hands the matrices over with each call; qpOASES then refactorises, from the active set of the call before.
    """

    def setup(self, qp: QP) -> None:
        """See `mpc.qp.Backend.setup`."""
        self._qp = qp
        hessian, rows = _common.dense(qp.P), _common.rows(qp).toarray()
        shapes = {"h": casadi.Sparsity.dense(*hessian.shape), "a": casadi.Sparsity.dense(*rows.shape)}
        with contextlib.redirect_stdout(io.StringIO()):  # its copyright notice, whatever the print level
            self._solver = casadi.conic("qp", "qpoases", shapes, SETTINGS)
        constant = {"h": hessian, "a": rows, "lbx": qp.x_l, "ubx": qp.x_u}
        self._constant = {name: casadi.DM(value) for name, value in constant.items()}

    def solve(self, vectors: Vectors) -> Solution:
        """See `mpc.qp.Backend.solve`."""
        lower, upper = np.concatenate([vectors.h_l, vectors.b]), np.concatenate([vectors.h_u, vectors.b])
        started = clock.perf_counter()
        answer = self._solver(g=vectors.c, lba=lower, uba=upper, **self._constant)
        elapsed = clock.perf_counter() - started
        stats = self._solver.stats()
        failure = next((name for part, name in FAILURES.items() if part in str(stats["return_status"])), "numerics")
        status = SOLVED if stats["success"] else failure
        return _common.solution(
            self._qp,
            answer["x"].full().ravel(),
            np.concatenate([answer["lam_x"].full().ravel(), answer["lam_a"].full().ravel()]),
            status=status,
            iterations=int(stats["iter_count"]),
            solve_s=elapsed,
        )
