"""Any solver of qpsolvers, by its name there, on the condensed QP, set up anew in each period.

Caron et al., qpsolvers: Quadratic Programming Solvers in Python, https://github.com/qpsolvers/qpsolvers.
"""

from __future__ import annotations

import time as clock
import warnings
from typing import Any, Final

import numpy as np
import qpsolvers
from scipy.sparse import csc_matrix

from quadsim.controller import SOLVED, Statistics
from quadsim.mpc.problem.qp import QP, Solution

ACTIVE_MULTIPLIER: Final = 1e-5
"""Multiplier from which a constraint counts as active; at the paper's optima they reach 1e3."""
UNSOLVED: Final = "unsolved"
"""Status of a QP without a solution; qpsolvers does not say why."""

SETTINGS: Final[dict[str, dict[str, Any]]] = {
    "clarabel": {"tol_gap_abs": 1e-12, "tol_gap_rel": 1e-12, "tol_feas": 1e-9},  # its own leave 5e-3 rad/s
    "osqp": {"eps_abs": 1e-5, "eps_rel": 0.0, "max_iter": 10_000},  # at 1e-4 the first input is off by 1e-2 rad/s
    "proxqp": {"eps_abs": 1e-7, "eps_rel": 0.0, "max_iter": 1000},
}
"""Tighter tolerances for solvers whose defaults are too loose for commands."""


class AnyOfQpsolvers:
    """A back end, by its name in `qpsolvers.available_solvers`; see `quadsim.mpc.problem.qp.Backend`."""

    def __init__(self, name: str) -> None:
        self._name = name
        if name in qpsolvers.dense_solvers:
            self._matrix = np.asarray
        else:
            self._matrix = csc_matrix

    def setup(self, qp: QP) -> None:
        """Do nothing: each QP is set up anew."""

    def solve(self, qp: QP) -> Solution:
        """See `Backend.solve`; a two-sided row or box entry becomes two, without infinite sides."""
        started = clock.perf_counter()
        rows = np.concatenate([np.eye(qp.c.size), qp.G])
        lower = np.concatenate([qp.x_l, qp.h_l])
        upper = np.concatenate([qp.x_u, qp.h_u])
        above = np.isfinite(upper)
        below = np.isfinite(lower)
        one_sided = np.concatenate([rows[above], -rows[below]])
        equalities: tuple[Any, Any] = (None, None)
        if qp.b.size:
            equalities = (self._matrix(qp.A), qp.b)
        problem = qpsolvers.Problem(
            self._matrix(qp.P),
            qp.c,
            self._matrix(one_sided),
            np.concatenate([upper[above], -lower[below]]),
            *equalities,
        )
        try:
            with warnings.catch_warnings(action="ignore"):  # about conversions and failures, which the status reports
                answer = qpsolvers.solve_problem(problem, solver=self._name, **SETTINGS.get(self._name, {}))
        except qpsolvers.QPError:
            answer = qpsolvers.Solution(problem)
        elapsed = clock.perf_counter() - started
        multipliers = np.zeros(upper.size)
        y = np.full(qp.b.size, np.nan)
        if answer.found and answer.x is not None and answer.z is not None:
            x = answer.x
            if answer.y is not None:
                y = answer.y
            of_upper, of_lower = np.split(answer.z, [np.count_nonzero(above)])
            multipliers[above] += of_upper
            multipliers[below] -= of_lower
        else:
            x = np.full_like(qp.c, np.nan)
            multipliers = multipliers * np.nan
        z_box, z = np.split(multipliers, [qp.c.size])
        status = SOLVED
        if np.isnan(x).any():
            status = UNSOLVED
        return Solution(
            x=x,
            y=y,
            z=z,
            z_box=z_box,
            status=status,
            stats=Statistics(active=int(np.count_nonzero(np.abs(multipliers) > ACTIVE_MULTIPLIER)), solve_s=elapsed),
        )
