"""PIQP with a dense Cholesky factorisation."""

from __future__ import annotations

import piqp

from mpc.qp import QP, Solution, Vectors
from mpc.solvers import _piqp


class PiqpDense:
    """Back end for dense QPs; see `mpc.qp.Backend`."""

    def __init__(self) -> None:
        self._solver = piqp.DenseSolver()
        _piqp.configure(self._solver, gap=_piqp.GAP)

    def setup(self, qp: QP) -> None:
        """See `mpc.qp.Backend.setup`."""
        _piqp.setup(self._solver, qp)

    def solve(self, vectors: Vectors) -> Solution:
        """See `mpc.qp.Backend.solve`."""
        return _piqp.solve(self._solver, vectors)
