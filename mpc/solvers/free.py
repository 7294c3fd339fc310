"""The optimum of a condensed QP without its constraints: where it satisfies them all, it is the optimum.  Eq. (22)."""

from __future__ import annotations

import time as clock
from typing import Final

import numpy as np
from scipy.linalg import lapack

from mpc.condensing import Condensed
from mpc.qp import QP, Solution
from quadsim.controller import UNCONSTRAINED

LARGEST: Final = 2**20
"""Entries of the condensed QP's matrices beyond which its unconstrained optimum costs more than it saves."""
ROUNDING: Final = 1e-4
"""Error of an input held throughout, found again from its gradient, above which a Hessian is too ill-conditioned."""


class FreeOptimum:
    """The unconstrained optimum of QPs of one form.

    Args:
        form: the form.
        changing: whether matrices change from one QP to the next; if not, the Hessian is factorised once.
    """

    def __init__(self, form: Condensed, *, changing: bool) -> None:
        H = form.cost.H
        self._inputs = m = len(H)
        self._usable, self._factor = True, None
        if not changing:
            factor, failed = lapack.dpotrf(H)
            hold = np.ones(m)
            self._usable = form.qp.P.size + form.qp.G.size <= LARGEST and not failed
            self._usable = self._usable and np.abs(lapack.dpotrs(factor, H @ hold)[0] - hold).max() < ROUNDING
            self._factor = factor

    def __call__(self, qp: QP) -> Solution | None:
        """The unconstrained optimum of a QP where it satisfies every constraint, else None."""
        if not self._usable:
            return None
        started, m = clock.perf_counter(), self._inputs
        if self._factor is None:
            _, u, failed = lapack.dposv(qp.P[:m, :m], -qp.c[:m])
        else:
            u, failed = lapack.dpotrs(self._factor, -qp.c[:m])
        if failed or not ((qp.x_l[:m] <= u) & (u <= qp.x_u[:m])).all():
            return None
        x = np.zeros(qp.c.size)
        x[:m] = u
        if qp.h_l.size:
            values = qp.G @ x
            if not ((qp.h_l <= values) & (values <= qp.h_u)).all():
                return None
        z_box = np.concatenate([np.zeros(m), -qp.c[m:]])
        spent_s = clock.perf_counter() - started
        return Solution(x, np.zeros(0), np.zeros(qp.h_l.size), z_box, status=UNCONSTRAINED, solve_s=spent_s)
