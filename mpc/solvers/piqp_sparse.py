"""PIQP with its multistage factorisation, for block-banded QPs with the variables in stage order."""

from __future__ import annotations

import piqp

from mpc.qp import QP, Solution, Vectors
from mpc.solvers import _piqp


class PiqpMultistage:
    """Back end for block-banded QPs; see `mpc.qp.Backend`."""

    def __init__(self) -> None:
        self._solver = piqp.SparseSolver()
        self._solver.settings.kkt_solver = piqp.KKTSolver.sparse_multistage
        _piqp.configure(self._solver)

    def setup(self, qp: QP) -> None:
        """See `mpc.qp.Backend.setup`."""
        _piqp.setup(self._solver, qp)

    def solve(self, vectors: Vectors) -> Solution:
        """See `mpc.qp.Backend.solve`."""
        return _piqp.solve(self._solver, vectors)
