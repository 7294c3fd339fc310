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
        _piqp.configure(self._solver, gap=_piqp.GAP)

    def setup(self, qp: QP) -> None:
        """See `mpc.qp.Backend.setup`."""
        _piqp.setup(self._solver, qp)

    def solve(self, vectors: Vectors) -> Solution:
        """See `mpc.qp.Backend.solve`."""
        return _piqp.solve(self._solver, vectors)


class PiqpChanging(PiqpMultistage):
    """The same for QPs whose matrices change, values only, from one period to the next."""

    SCALINGS = 3
    """Passes of PIQP's scaling, which new matrices need anew: its usual ten take 0.2 ms longer, and save nothing."""
    TOLERANCE = 1e-8
    """PIQP's own.  A tenth of it takes three of twenty iterations more where tilt is at its bound."""

    def __init__(self) -> None:
        super().__init__()
        settings = self._solver.settings
        settings.preconditioner_iter = self.SCALINGS
        settings.eps_abs, settings.eps_rel = self.TOLERANCE, 0.1 * self.TOLERANCE
        settings.eps_duality_gap_abs, settings.eps_duality_gap_rel = self.TOLERANCE, 0.1 * self.TOLERANCE

    def solve_changed(self, qp: QP) -> Solution:
        """Solve another QP of the same pattern."""
        vectors = Vectors(c=qp.c, b=qp.b, h_l=qp.h_l, h_u=qp.h_u)
        return _piqp.solve(self._solver, vectors, matrices={"P": qp.P, "A": qp.A, "G": qp.G})
