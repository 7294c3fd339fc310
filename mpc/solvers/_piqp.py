"""What the two PIQP back ends share: settings, statuses, copies, counting active constraints."""

from __future__ import annotations

import time as clock
from collections.abc import Mapping
from typing import Any, Final

import numpy as np
import piqp

from mpc.qp import QP, Matrix, Solution, Vectors
from quadsim.controller import SOLVED

MAX_ITERATIONS: Final = 100
"""Cap for hopeless data (NaN runs PIQP to its limit); the paper's QPs take 8 to 23."""

ACTIVE_SLACK: Final = 1e-6
"""Distance to a bound (rad or rad/s) below which a constraint may count as active."""

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


def configure(solver: Any, *, gap: float | None = None) -> None:
    """Settings common to all that use PIQP; of the duality gap where one is given."""
    solver.settings.max_iter = MAX_ITERATIONS
    solver.settings.eps_abs = TOLERANCE
    solver.settings.eps_rel = 0.1 * TOLERANCE
    if gap is not None:
        solver.settings.eps_duality_gap_abs = solver.settings.eps_duality_gap_rel = gap


def setup(solver: Any, qp: QP) -> None:
    """Hand the whole QP over; a PIQP solver must see every vector it will later be updated with."""
    solver.setup(qp.P, qp.c, qp.A, qp.b, qp.G, qp.h_l, qp.h_u, qp.x_l, qp.x_u)


def solve(solver: Any, vectors: Vectors, *, matrices: Mapping[str, Matrix] | None = None) -> Solution:
    """Update the vectors, and matrices where there are others, solve, copy everything out.

    PIQP's result arrays are views that the next solve overwrites, and a failed solve leaves a finite x: the
    status is the only thing to go by.  Sizes are ours to get right, since a wrong one keeps the old data silently.
    One update for all: two would scale the data twice.
    """
    started = clock.perf_counter()
    solver.update(**(matrices or {}), c=vectors.c, b=vectors.b, h_l=vectors.h_l, h_u=vectors.h_u)
    status = solver.solve()
    elapsed = clock.perf_counter() - started
    result = solver.result
    # At an interior-point optimum a constraint is active where its multiplier exceeds its slack, and that is small.
    active = sum(
        int(np.count_nonzero(np.minimum(multiplier, ACTIVE_SLACK) > slack))
        for multiplier, slack in (
            (result.z_l, result.s_l),
            (result.z_u, result.s_u),
            (result.z_bl, result.s_bl),
            (result.z_bu, result.s_bu),
        )
    )
    return Solution(
        x=result.x.copy(),
        y=result.y.copy(),
        z=result.z_u - result.z_l,
        z_box=result.z_bu - result.z_bl,
        status=STATUS[status],
        iterations=int(result.info.iter),
        active=active,
        primal_residual=float(result.info.primal_res),
        dual_residual=float(result.info.dual_res),
        solve_s=elapsed,
    )
