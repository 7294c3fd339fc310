"""ProxQP: a proximal augmented Lagrangian method, its dense back end.

Bambade et al., PROX-QP: Yet another Quadratic Programming Solver for Robotics and beyond, RSS 2022.
"""

from __future__ import annotations

import time as clock
from typing import Any, Final

import numpy as np
from proxsuite import proxqp

from mpc.qp import QP, Solution, Vectors
from mpc.solvers import _common
from quadsim.controller import SOLVED

SETTINGS: Final[dict[str, Any]] = {
    "eps_abs": 1e-7,  # at 1e-6 the first input is off by 2e-3 rad/s
    "eps_rel": 0.0,
    "eps_primal_inf": 1e-10,  # at its own 1e-4 feasible QPs are called infeasible
    "eps_dual_inf": 1e-10,
    "max_iter": 1000,
}
"""The start is ProxQP's own, the optimum without inequalities.  Starting from the previous solution is slower on the
paper's QPs, whose half is solved by that guess, and its `WARM_START_WITH_PREVIOUS_RESULT` crashes the process."""

STATUS: Final = {
    proxqp.PROXQP_SOLVED: SOLVED,
    proxqp.PROXQP_SOLVED_CLOSEST_PRIMAL_FEASIBLE: "primal_infeasible",
    proxqp.PROXQP_MAX_ITER_REACHED: "max_iterations",
    proxqp.PROXQP_PRIMAL_INFEASIBLE: "primal_infeasible",
    proxqp.PROXQP_DUAL_INFEASIBLE: "dual_infeasible",
    proxqp.PROXQP_NOT_RUN: "unsolved",
}


class ProxqpDense:
    """Back end for dense QPs; see `mpc.qp.Backend`."""

    def setup(self, qp: QP) -> None:
        """See `mpc.qp.Backend.setup`."""
        self._qp = qp
        self._solver = proxqp.dense.QP(qp.c.size, qp.b.size, qp.h_l.size, True)
        for name, value in SETTINGS.items():
            setattr(self._solver.settings, name, value)
        defaults = self._solver.settings  # handed over with each QP, or an infeasible one leaves its penalties behind
        self._penalties = {name: getattr(defaults, f"default_{name}") for name in ("rho", "mu_eq", "mu_in")}
        P, A, G = _common.dense(qp.P), _common.dense(qp.A), _common.dense(qp.G)
        self._solver.init(P, qp.c, A, qp.b, G, qp.h_l, qp.h_u, qp.x_l, qp.x_u)

    def solve(self, vectors: Vectors) -> Solution:
        """See `mpc.qp.Backend.solve`."""
        qp, solver = self._qp, self._solver
        started = clock.perf_counter()
        solver.update(
            g=vectors.c, b=vectors.b, l=vectors.h_l, u=vectors.h_u, l_box=qp.x_l, u_box=qp.x_u, **self._penalties
        )
        solver.solve()
        elapsed = clock.perf_counter() - started
        results = solver.results
        z, z_box = np.split(np.array(results.z), [qp.h_l.size])
        return _common.solution(
            qp,
            np.array(results.x),
            np.concatenate([z_box, z, results.y]),
            status=STATUS[results.info.status],
            iterations=int(results.info.iter),
            solve_s=elapsed,
            residuals=(float(results.info.pri_res), float(results.info.dua_res)),
        )
