"""Clarabel: an interior-point method over cones, here zero and non-negative ones, with an LDL' factorisation.

Goulart and Chen, Clarabel: An interior-point solver for conic programs with quadratic objectives, 2024.
"""

from __future__ import annotations

import time as clock
from typing import Any, Final

import clarabel
import numpy as np
from scipy import sparse

from mpc.qp import QP, Solution, Vectors
from mpc.solvers import _common
from quadsim.controller import SOLVED

SETTINGS: Final[dict[str, Any]] = {
    "verbose": False,
    "max_iter": 100,  # the paper's QPs take 10 to 20
    "max_threads": 1,
    "presolve_enable": False,  # what it reduces cannot be updated
    "tol_gap_abs": 1e-11,  # at 1e-10 the first input is off by up to 1.5e-3 rad/s, at its own 1e-8 by 5e-3 and more
    "tol_gap_rel": 1e-11,
    "tol_feas": 1e-9,
}

STATUS: Final = {
    "Solved": SOLVED,
    "AlmostSolved": "solved_inaccurate",
    "PrimalInfeasible": "primal_infeasible",
    "AlmostPrimalInfeasible": "primal_infeasible",
    "DualInfeasible": "dual_infeasible",
    "AlmostDualInfeasible": "dual_infeasible",
    "MaxIterations": "max_iterations",
    "MaxTime": "max_time",
    "NumericalError": "numerics",
    "InsufficientProgress": "insufficient_progress",
    "CallbackTerminated": "interrupted",
    "Unsolved": "unsolved",
}


class ClarabelSparse:
    """Back end for sparse QPs; see `mpc.qp.Backend`.

    Cones are one-sided: each two-sided row becomes two, and a side at infinity none.
    """

    def setup(self, qp: QP) -> None:
        """See `mpc.qp.Backend.setup`."""
        self._qp = qp
        self._sides = _common.OneSided(qp)
        settings = clarabel.DefaultSettings()
        for name, value in SETTINGS.items():
            setattr(settings, name, value)
        self._solver = clarabel.DefaultSolver(
            sparse.triu(qp.P, format="csc"),
            qp.c,
            self._sides.matrix,
            self._sides.right_side(qp.vectors),
            [clarabel.ZeroConeT(qp.b.size), clarabel.NonnegativeConeT(self._sides.matrix.shape[0] - qp.b.size)],
            settings,
        )

    def solve(self, vectors: Vectors) -> Solution:
        """See `mpc.qp.Backend.solve`."""
        started = clock.perf_counter()
        self._solver.update(q=vectors.c, b=self._sides.right_side(vectors))
        answer = self._solver.solve()
        elapsed = clock.perf_counter() - started
        return _common.solution(
            self._qp,
            np.array(answer.x),
            self._sides.two_sided(np.array(answer.z)),
            status=STATUS[str(answer.status)],
            iterations=int(answer.iterations),
            solve_s=elapsed,
            residuals=(float(answer.r_prim), float(answer.r_dual)),
        )
