"""DAQP: a dual active-set method that factorises the Hessian once and starts from the last active set.

Where the QP states which bound is the same one step later in the plan, that set is moved one step earlier: where active
bounds alternate along the plan, it is wrong nearly everywhere as it was.

Arnström, Bemporad and Axehill, A Dual Active-Set Solver for Embedded Quadratic Programming Using Recursive LDL'
Updates, IEEE TAC 2022.
"""

from __future__ import annotations

import time as clock
from typing import Final

import daqp
import numpy as np
from numpy.typing import NDArray

from mpc.qp import QP, Solution, Vectors
from mpc.solvers import _common
from quadsim.controller import SOLVED
from quadsim.state import Array

Sense = NDArray[np.intc]

SETTINGS: Final = {
    "primal_tol": 1e-8,  # rad or rad/s; its own 1e-6 is as fast
    "iter_limit": 5000,  # changes of the active set; the paper's QPs take 1 to 180
}

STATUS: Final = {
    1: SOLVED,
    -1: "primal_infeasible",
    -2: "cycling",
    -3: "dual_infeasible",
    -4: "max_iterations",
    -5: "non_convex",
    -6: "overdetermined_start",
    -7: "max_time",
}
_ACTIVE: Final = 1
_LOWER: Final = 2
_EQUALITY: Final = 5
"""How DAQP marks bounds: active at first, at the lower side, always active."""


class DaqpDense:
    """Back end for dense QPs; see `mpc.qp.Backend`."""

    def __init__(self) -> None:
        self._model = daqp.Model()
        self._model.settings = SETTINGS

    def setup(self, qp: QP) -> None:
        """See `mpc.qp.Backend.setup`."""
        self._qp = qp
        self._sense: Sense | None = None
        sense = np.zeros(qp.c.size + qp.h_l.size + qp.b.size, dtype=np.intc)
        sense[qp.c.size + qp.h_l.size :] = _EQUALITY
        hessian, rows = _common.dense(qp.P), _common.dense(_common.rows(qp))
        self._model.setup(
            hessian, qp.c.copy(), rows, _common.upper(qp, qp.vectors), _common.lower(qp, qp.vectors), sense
        )

    def solve(self, vectors: Vectors) -> Solution:
        """See `mpc.qp.Backend.solve`."""
        qp = self._qp
        started = clock.perf_counter()
        upper, lower = _common.upper(qp, vectors), _common.lower(qp, vectors)
        self._model.update(f=vectors.c, bupper=upper, blower=lower, sense=self._sense)
        x, _, flag, info = self._model.solve()
        self._sense = self._moved(info["lam"]) if flag == 1 else None
        elapsed = clock.perf_counter() - started
        status = STATUS.get(flag, f"daqp_{flag}")
        return _common.solution(qp, x, info["lam"], status=status, iterations=info["iterations"], solve_s=elapsed)

    def _moved(self, multipliers: Array) -> Sense | None:
        """The active set moved one step earlier, with nothing active at the last step; None to start as it was."""
        later = self._qp.later
        if later is None:
            return None
        found = (multipliers != 0.0) * (_ACTIVE + _LOWER * (multipliers < 0.0))
        sense = np.full(multipliers.size, _EQUALITY, dtype=np.intc)
        sense[: later.size] = np.where(later == np.arange(later.size), 0, found[later])
        return sense
