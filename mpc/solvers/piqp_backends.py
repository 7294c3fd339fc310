"""PIQP: a proximal interior-point method, with a dense Cholesky factorisation or one in stages."""

from __future__ import annotations

import time as clock
from typing import Any, Final

import numpy as np
import piqp

from mpc.qp import QP, Matrix, Point, Solution, Vectors
from quadsim.controller import SOLVED

MAX_ITERATIONS: Final = 100  # cap for hopeless data (NaN runs PIQP to its limit); the paper's QPs take 8 to 23

ACTIVE_SLACK: Final = 1e-6  # distance to a bound (rad or rad/s) below which a constraint may count as active

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
"""Absolute; PIQP's own is 1e-8.  Next to a constraint that is hardly active the inputs converge as its square root:
over the paper's flight, one form of the QP or another has a first input 1e-3 rad/s from the optimum at 1e-8 and at
3e-9; at 1e-9 all are within 4e-4, for one more iteration."""

GAP: Final = 1e-10
"""Of primal and dual objective.  With PIQP's own 1e-8, a bound that is just touched leaves the first input of one form
of the QP or another 4e-3 rad/s off, whatever `TOLERANCE` is."""

ROUGH_TOLERANCE: Final = 1e-5
"""Of a rough answer, absolute and relative: 9 iterations in the paper's first period, where `TOLERANCE` takes 13."""

_TOLERANCES: Final = ("eps_abs", "eps_rel", "eps_duality_gap_abs", "eps_duality_gap_rel")

CHANGING_TOLERANCE: Final = 1e-8
"""Where matrices change; PIQP's own.  A tenth of it takes 3 more of 20 iterations where tilt is at its bound."""

CHANGING_SCALINGS: Final = 3
"""Passes of PIQP's scaling, which new matrices need again: its usual ten take 0.2 ms longer, and save nothing."""


class _Piqp:
    """Back end on a solver of PIQP's; see `mpc.qp.Backend`."""

    def __init__(self, solver: Any) -> None:
        self._solver, settings = solver, solver.settings
        settings.max_iter = MAX_ITERATIONS
        settings.eps_abs, settings.eps_rel = TOLERANCE, 0.1 * TOLERANCE
        settings.eps_duality_gap_abs = settings.eps_duality_gap_rel = GAP

    def setup(self, qp: QP) -> None:
        """See `mpc.qp.Backend.setup`; PIQP must see every vector that it will later be updated with."""
        self._solver.setup(qp.P, qp.c, qp.A, qp.b, qp.G, qp.h_l, qp.h_u, qp.x_l, qp.x_u)

    def solve(self, vectors: Vectors) -> Solution:
        """See `mpc.qp.Backend.solve`."""
        return solve(self._solver, vectors)

    def solve_changed(self, qp: QP) -> Solution:
        """Solve another QP of the same pattern."""
        return solve(self._solver, qp.vectors, P=qp.P, A=qp.A, G=qp.G)

    def solve_roughly(self, vectors: Vectors) -> Solution:
        """See `mpc.qp.RoughBackend.solve_roughly`."""
        settings = self._solver.settings
        usual = {name: getattr(settings, name) for name in _TOLERANCES}
        for name in usual:
            setattr(settings, name, ROUGH_TOLERANCE)
        solution = solve(self._solver, vectors)
        for name, value in usual.items():
            setattr(settings, name, value)
        return solution


class PiqpDense(_Piqp):
    """PIQP with a dense Cholesky factorisation, for dense QPs."""

    def __init__(self) -> None:
        super().__init__(piqp.DenseSolver())


class PiqpMultistage(_Piqp):
    """PIQP with its multistage factorisation, for block-banded QPs with the variables in stage order."""

    def __init__(self) -> None:
        super().__init__(piqp.SparseSolver())
        self._solver.settings.kkt_solver = piqp.KKTSolver.sparse_multistage


class PiqpChanging(PiqpMultistage):
    """The same for QPs whose matrices change, values only, from one period to the next."""

    def __init__(self) -> None:
        super().__init__()
        _allow_changes(self._solver.settings)


class PiqpDenseChanging(PiqpDense):
    """The dense one for QPs whose matrices change."""

    def __init__(self) -> None:
        super().__init__()
        _allow_changes(self._solver.settings)


def _allow_changes(settings: Any) -> None:
    settings.preconditioner_iter = CHANGING_SCALINGS
    settings.eps_abs = settings.eps_duality_gap_abs = CHANGING_TOLERANCE
    settings.eps_rel = settings.eps_duality_gap_rel = 0.1 * CHANGING_TOLERANCE


def solve(solver: Any, vectors: Vectors, **matrices: Matrix) -> Solution:
    """Update the vectors, and matrices where there are others, solve, copy everything out.

    PIQP's result arrays are views that the next solve overwrites, and a failed solve leaves a finite x: the
    status is the only thing to go by.  Sizes must be right: a wrong one keeps the old data silently.
    One update for all: two would scale the data twice.
    """
    started = clock.perf_counter()
    solver.update(**matrices, **vars(vectors))
    status = solver.solve()
    elapsed = clock.perf_counter() - started
    result, info = solver.result, solver.result.info
    # At an interior-point optimum a constraint is active where its multiplier exceeds its slack, and that is small.
    sides = ((result.z_l, result.s_l), (result.z_u, result.s_u), (result.z_bl, result.s_bl), (result.z_bu, result.s_bu))
    return Solution(
        made=Point(x=result.x.copy(), y=result.y.copy(), z=result.z_u - result.z_l, z_box=result.z_bu - result.z_bl),
        status=STATUS[status],
        iterations=int(info.iter),
        active=sum(int(np.count_nonzero(np.minimum(z, ACTIVE_SLACK) > slack)) for z, slack in sides),
        reported_primal=float(info.primal_res),
        reported_dual=float(info.dual_res),
        solve_s=elapsed,
    )
