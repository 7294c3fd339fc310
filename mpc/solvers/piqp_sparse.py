"""PIQP with its multistage factorisation, for block-banded QPs with the variables in stage order."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import piqp

from mpc.qp import QP, Solution, Vectors
from mpc.solvers import _piqp
from quadsim.controller import SOLVED


class PiqpMultistage:
    """Back end for block-banded QPs; see `mpc.qp.Backend`.

    Each row costs time in every iteration, binding or not.  So the QP is first solved without the rows that seldom
    bind; only where its optimum breaks one of them is the whole QP solved, by a second solver.
    """

    def setup(self, qp: QP) -> None:
        """See `mpc.qp.Backend.setup`."""
        rows = qp.h_l.size
        self._kept = rows - qp.seldom
        self._left_out = qp.G[self._kept :]
        self._whole = _multistage_solver(qp)
        relaxed = replace(qp, G=qp.G[: self._kept], h_l=qp.h_l[: self._kept], h_u=qp.h_u[: self._kept], seldom=0)
        self._relaxed = _multistage_solver(relaxed) if qp.seldom else self._whole

    def solve(self, vectors: Vectors) -> Solution:
        """See `mpc.qp.Backend.solve`."""
        kept, rows = self._kept, vectors.h_l.size
        fewer = Vectors(c=vectors.c, b=vectors.b, h_l=vectors.h_l[:kept], h_u=vectors.h_u[:kept])
        solution = _piqp.solve(self._relaxed, fewer, rows=rows)
        if kept == rows or solution.status != SOLVED:
            return solution
        values = self._left_out @ solution.x
        if ((vectors.h_l[kept:] <= values) & (values <= vectors.h_u[kept:])).all():
            return solution
        whole = _piqp.solve(self._whole, vectors, rows=rows)
        iterations, solve_s = solution.iterations + whole.iterations, solution.solve_s + whole.solve_s
        return replace(whole, iterations=iterations, solve_s=solve_s)


def _multistage_solver(qp: QP) -> Any:
    solver = piqp.SparseSolver()
    solver.settings.kkt_solver = piqp.KKTSolver.sparse_multistage
    _piqp.configure(solver, gap=_piqp.GAP)
    _piqp.setup(solver, qp)
    return solver
