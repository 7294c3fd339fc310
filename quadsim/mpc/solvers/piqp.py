"""PIQP: a proximal interior-point method, with a dense Cholesky factorisation or one in stages.

`Piqp.setup` takes the QP's matrices once, `solve` the vectors of a period.  In stages it exploits the block-banded form
of `quadsim.mpc.forms.staged`, linear in the horizon.  Schwan, Jiang, Kuhn and Jones, "PIQP: A Proximal Interior-Point
Quadratic Programming Solver", 2023.
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

TOLERANCE: Final = 1e-9
"""Absolute tolerance; PIQP's default is 1e-8. Next to a barely active constraint, the inputs converge only as its
square root: over the paper's flight, the staged QP's first inputs are within 4e-4 rad/s of the optimum at 1e-8, and
within 2e-4 at 1e-9, for one more iteration."""

GAP: Final = 1e-10
"""Tolerance of the duality gap.  With PIQP's default of 1e-8, a bound that is just touched puts the first input of one
form of the QP 4e-3 rad/s off, whatever `TOLERANCE` is."""

CHANGING_TOLERANCE: Final = 1e-8
"""For changing matrices; PIQP's default.  A tenth of it takes 3 more of 20 iterations where tilt is at its bound."""

CHANGING_SCALINGS: Final = 3
"""Passes of PIQP's scaling, repeated for new matrices: its default of ten takes 0.2 ms longer without benefit."""


class Piqp:
    """See `Backend`; multistage, for block-banded QPs with the variables in stage order, or `dense`.

    `changing`: whether the matrices' values change from period to period.
    """

    def __init__(self, *, dense: bool = False, changing: bool = False) -> None:
        self._solver: Any
        if dense:
            self._solver = piqp.DenseSolver()
        else:
            self._solver = piqp.SparseSolver()
        settings = self._solver.settings
        if not dense:
            settings.kkt_solver = piqp.KKTSolver.sparse_multistage
        settings.max_iter = MAX_ITERATIONS
        settings.eps_abs = TOLERANCE
        settings.eps_rel = 0.1 * TOLERANCE
        settings.eps_duality_gap_abs = settings.eps_duality_gap_rel = GAP
        if changing:
            settings.preconditioner_iter = CHANGING_SCALINGS
            settings.eps_abs = settings.eps_duality_gap_abs = CHANGING_TOLERANCE
            settings.eps_rel = settings.eps_duality_gap_rel = 0.1 * CHANGING_TOLERANCE

    def setup(self, qp: QP) -> None:
        """See `quadsim.mpc.problem.qp.Backend.setup`; PIQP must receive every vector that is updated later.

        Rows without a finite side are left out: PIQP would set them to zero in `G` for good.
        """
        self._kept = _bounded(qp)
        self._last = qp
        G = self._of_rows(qp.G)
        h_l = self._of_rows(qp.h_l)
        h_u = self._of_rows(qp.h_u)
        self._solver.setup(qp.P, qp.c, qp.A, qp.b, G, h_l, h_u, qp.x_l, qp.x_u)

    def solve(self, qp: QP) -> Solution:
        """Update the differences from the last QP, including matrices of the same pattern, solve, and copy the result.

        PIQP's result arrays are views that the next solve overwrites, and a failed solve leaves a finite x: the status
        is the only thing to go by.  Sizes must be right: a wrong one keeps the old data silently.  One update for all:
        two would scale the data twice.
        """
        started = clock.perf_counter()
        if np.array_equal(_bounded(qp), self._kept):
            last = self._last
            self._last = qp
            changed: dict[str, Any] = {}
            if qp.P is not last.P or qp.A is not last.A or qp.G is not last.G:
                changed = {"P": qp.P, "A": qp.A, "G": self._of_rows(qp.G)}
            if qp.x_l is not last.x_l or qp.x_u is not last.x_u:
                changed |= {"x_l": qp.x_l, "x_u": qp.x_u}
            h_l = self._of_rows(qp.h_l)
            h_u = self._of_rows(qp.h_u)
            self._solver.update(**changed, c=qp.c, b=qp.b, h_l=h_l, h_u=h_u)
        else:
            self.setup(qp)
        status = self._solver.solve()
        elapsed = clock.perf_counter() - started
        result = self._solver.result
        info = self._solver.result.info
        active = _active(result.z_l, result.s_l) + _active(result.z_u, result.s_u)
        active += _active(result.z_bl, result.s_bl) + _active(result.z_bu, result.s_bu)
        z = np.zeros(len(self._kept))
        z[self._kept] = result.z_u - result.z_l
        return Solution(
            x=result.x.copy(),
            y=result.y.copy(),
            z=z,
            z_box=result.z_bu - result.z_bl,
            status=STATUS[status],
            stats=Statistics(
                iterations=int(info.iter),
                active=active,
                reported_primal=float(info.primal_res),
                reported_dual=float(info.dual_res),
                solve_s=elapsed,
            ),
        )

    def _of_rows(self, part: Any) -> Any:
        """Return what belongs to the rows that PIQP has, of a matrix or vector of all."""
        if self._kept.all():
            return part
        return part[self._kept]


def _active(multipliers: Array, slacks: Array) -> int:
    """Return how many constraints are active at an interior-point optimum: their slacks are small, and below these."""
    return int(np.count_nonzero(np.minimum(multipliers, ACTIVE_SLACK) > slacks))


def _bounded(qp: QP) -> NDArray[np.bool_]:
    """Return which rows have a finite side."""
    return np.asarray(np.isfinite(qp.h_l) | np.isfinite(qp.h_u))
