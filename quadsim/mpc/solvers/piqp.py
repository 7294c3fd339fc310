"""PIQP: a proximal interior-point method, with a dense or a multistage Cholesky factorisation.

`Piqp.setup` takes the QP's matrices once, `solve` the vectors of a period.  The multistage factorisation exploits the
block-banded matrices of `quadsim.mpc.forms.staged`: its time grows linearly with the horizon.  Schwan, Jiang, Kuhn and
Jones, "PIQP: A Proximal Interior-Point Quadratic Programming Solver", 2023.
"""

from __future__ import annotations

import time as clock
from typing import Any, Final

import numpy as np
import piqp
from numpy.typing import NDArray

from quadsim.controller import SOLVED, Statistics
from quadsim.mpc.problem.qp import QP, Solution
from quadsim.state import Array

MAX_ITERATIONS: Final = 100  # limit for hopeless data (NaN runs PIQP to its limit); the paper's QPs take 8 to 23

ACTIVE_SLACK: Final = 1e-6  # distance to a bound (rad or rad/s) below which a constraint may be active

STATUS: Final = {
    piqp.PIQP_SOLVED: SOLVED,
    piqp.PIQP_MAX_ITER_REACHED: "max_iterations",
    piqp.PIQP_PRIMAL_INFEASIBLE: "primal_infeasible",
    piqp.PIQP_DUAL_INFEASIBLE: "dual_infeasible",
    piqp.PIQP_NUMERICS: "numerics",
    piqp.PIQP_UNSOLVED: "unsolved",
    piqp.PIQP_INVALID_SETTINGS: "invalid_settings",
}
"""PIQP's status codes in the words of `quadsim.mpc.problem.qp.Solution.status`."""

TOLERANCE: Final = 1e-9
"""Absolute tolerance; PIQP's default is 1e-8.  Next to a barely active constraint, the error of the inputs shrinks only
with the square root of the tolerance: over the paper's flight, the staged QP's first inputs are within 4e-4 rad/s of
the optimum at 1e-8, and within 2e-4 at 1e-9, for one more iteration."""

RELATIVE_SHARE: Final = 0.1
"""Relative tolerance as a share of the absolute one; PIQP's default too is a tenth of it."""

GAP: Final = 1e-10
"""Tolerance of the duality gap, absolute and relative.  With PIQP's default of 1e-8, a bound that is just touched puts
the first input of one form of the QP 4e-3 rad/s off, whatever `TOLERANCE` is."""

CHANGING_TOLERANCE: Final = 1e-8
"""Absolute tolerance, also of the duality gap, where matrices change; PIQP's default.  With a tenth of it, PIQP takes 3
iterations more, of about 20, where tilt is at its bound."""

CHANGING_SCALINGS: Final = 3
"""Passes of PIQP's scaling where matrices change, which repeats it in every period: the default of ten passes takes
0.2 ms longer without benefit."""


class Piqp:
    """PIQP as a `quadsim.mpc.problem.qp.Backend`."""

    def __init__(self, *, dense: bool = False, changing: bool = False) -> None:
        """Choose PIQP's factorisation and its tolerances.

        Args:
            dense: for dense matrices; otherwise multistage, for block-banded ones, with the variables in stage order.
            changing: whether the matrices' values change from period to period.
        """
        self._solver: Any
        if dense:
            self._solver = piqp.DenseSolver()
        else:
            self._solver = piqp.SparseSolver()
        settings = self._solver.settings
        if not dense:
            settings.kkt_solver = piqp.KKTSolver.sparse_multistage
        settings.max_iter = MAX_ITERATIONS
        if changing:
            settings.preconditioner_iter = CHANGING_SCALINGS
            settings.eps_abs = CHANGING_TOLERANCE
            settings.eps_rel = RELATIVE_SHARE * CHANGING_TOLERANCE
            settings.eps_duality_gap_abs = CHANGING_TOLERANCE
            settings.eps_duality_gap_rel = RELATIVE_SHARE * CHANGING_TOLERANCE
        else:
            settings.eps_abs = TOLERANCE
            settings.eps_rel = RELATIVE_SHARE * TOLERANCE
            settings.eps_duality_gap_abs = GAP
            settings.eps_duality_gap_rel = GAP

    def setup(self, qp: QP) -> None:
        """See `quadsim.mpc.problem.qp.Backend.setup`.

        PIQP receives only the rows of `G` that have a finite bound: it would set any other row to zero for good.  It
        must receive here every vector that is updated later.
        """
        self._kept = _bounded(qp)
        self._last = qp
        G = self._kept_rows(qp.G)
        h_l = self._kept_rows(qp.h_l)
        h_u = self._kept_rows(qp.h_u)
        self._solver.setup(qp.P, qp.c, qp.A, qp.b, G, h_l, h_u, qp.x_l, qp.x_u)

    def solve(self, qp: QP) -> Solution:
        """Solve a QP and copy the result: PIQP's arrays are views that the next solve overwrites.

        A failed solve leaves a finite x: the status is the only thing to go by.
        """
        started = clock.perf_counter()
        if np.array_equal(_bounded(qp), self._kept):
            self._update(qp)
        else:
            self.setup(qp)
        status = self._solver.solve()
        elapsed = clock.perf_counter() - started
        result = self._solver.result
        z = np.zeros(len(self._kept))
        z[self._kept] = result.z_u - result.z_l
        return Solution(
            x=result.x.copy(),
            y=result.y.copy(),
            z=z,
            z_box=result.z_bu - result.z_bl,
            status=STATUS[status],
            stats=_statistics(result, elapsed),
        )

    def _update(self, qp: QP) -> None:
        """Give PIQP what differs from the last QP; a matrix keeps its pattern.

        PIQP takes a vector of a wrong size without an error, and keeps the old data.  It scales the data in every
        update, so all differences are in one.
        """
        last = self._last
        self._last = qp
        changed: dict[str, Any] = {}
        if qp.P is not last.P or qp.A is not last.A or qp.G is not last.G:
            changed = {"P": qp.P, "A": qp.A, "G": self._kept_rows(qp.G)}
        if qp.x_l is not last.x_l or qp.x_u is not last.x_u:
            changed |= {"x_l": qp.x_l, "x_u": qp.x_u}
        h_l = self._kept_rows(qp.h_l)
        h_u = self._kept_rows(qp.h_u)
        self._solver.update(**changed, c=qp.c, b=qp.b, h_l=h_l, h_u=h_u)

    def _kept_rows(self, part: Any) -> Any:
        """Return the rows that PIQP has received, of `G` or of a vector with one entry per row of `G`."""
        if self._kept.all():
            return part
        return part[self._kept]


def _statistics(result: Any, elapsed: float) -> Statistics:
    """Return the statistics of PIQP's result, after so many seconds."""
    active = _active(result.z_l, result.s_l) + _active(result.z_u, result.s_u)
    active += _active(result.z_bl, result.s_bl) + _active(result.z_bu, result.s_bu)
    return Statistics(
        iterations=int(result.info.iter),
        active=active,
        reported_primal=float(result.info.primal_res),
        reported_dual=float(result.info.dual_res),
        solve_s=elapsed,
    )


def _active(multipliers: Array, slacks: Array) -> int:
    """Return how many constraints are active at an interior-point optimum.

    The slack of an active constraint is small, and smaller than its multiplier.
    """
    return int(np.count_nonzero(np.minimum(multipliers, ACTIVE_SLACK) > slacks))


def _bounded(qp: QP) -> NDArray[np.bool_]:
    """Return which rows of `G` have a finite bound."""
    return np.asarray(np.isfinite(qp.h_l) | np.isfinite(qp.h_u))
