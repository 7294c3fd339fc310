"""qpOASES, the paper's own solver, through CasADi: an online active-set method, started from the last active set.

Ferreau et al., qpOASES: a parametric active-set algorithm for quadratic programming, Math. Prog. Comp. 2014.
"""

from __future__ import annotations

import contextlib
import io
from typing import Any, Final

import casadi
import numpy as np

from quadsim.controller import SOLVED, Statistics
from quadsim.mpc.problem.qp import QP, Solution

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


class Qpoases:
    """A back end for condensed QPs; see `quadsim.mpc.problem.qp.Backend`."""

    def setup(self, qp: QP) -> None:
        """See `quadsim.mpc.problem.qp.Backend.setup`."""
        shapes = {"h": casadi.Sparsity.dense(*qp.P.shape), "a": casadi.Sparsity.dense(*qp.G.shape)}
        with contextlib.redirect_stdout(io.StringIO()):  # its copyright notice, whatever the print level
            self._solver = casadi.conic("qp", "qpoases", shapes, SETTINGS)

    def solve(self, qp: QP) -> Solution:
        """See `quadsim.mpc.problem.qp.Backend.solve`."""
        result = self._solver(h=qp.P, g=qp.c, a=qp.G, lba=qp.h_l, uba=qp.h_u, lbx=qp.x_l, ubx=qp.x_u)
        stats = self._solver.stats()
        x, z_box, z = (result[name].full().ravel() for name in ("x", "lam_x", "lam_a"))
        status = SOLVED if stats["success"] else str(stats["return_status"])
        return Solution(x, np.zeros(0), z, z_box, status=status, stats=Statistics(iterations=int(stats["iter_count"])))
