"""A problem whose model changes from period to period, solved whole."""

from __future__ import annotations

from typing import Final

import numpy as np

from mpc.ocp import Problem, Rest
from mpc.solvers import Answer, refusal
from mpc.solvers.piqp_backends import PiqpChanging
from mpc.staged import Staged
from quadsim.controller import SOLVED
from quadsim.state import Array

STEPS_PER_STAGE: Final = 4
"""M where the model changes, the fastest of 1 to 7 for 16 states, though 2 to 5 hardly differ."""
LARGEST: Final = 1e6
"""Magnitude of a number in the data beyond which it is no vehicle's: four steps of such numbers multiply to 1e30, where
PIQP takes bounds for infinite."""


class Relinearised:
    """A problem whose model changes from period to period, solved whole by PIQP.

    Attributes:
        last: predicted states (N, n) and plan (N, nu) of the last period, if that was solved.
    """

    def __init__(self, problem: Problem) -> None:
        self._form = Staged(problem, steps_per_stage=STEPS_PER_STAGE, changing=True)
        self._backend = PiqpChanging()
        self._backend.setup(self._form.qp)
        self.last: tuple[Array, Array] | None = None

    def solve(self, A: Array, B: Array, c: Array, x0: Array, desired: Array, u_before: Array, u_rest: Array) -> Answer:
        """Solve one period's QP, of A_i (N, n, n), B_i (N, n, nu), c_i (N, n); x0 is x(k), u_rest u_s [rad/s].

        Data that is not finite, or beyond `LARGEST`, is answered with the status `invalid_data`: PIQP cannot be trusted
        to notice.
        """
        form = self._form
        self.last = None
        if all(np.abs(part).max() <= LARGEST for part in (A, B, c, x0, desired, u_before, u_rest)):
            matrices = form.prepare(A, B)
            rest = Rest(np.zeros_like(x0), u_rest)
            qp = form.changed(matrices, form.changed_vectors(matrices, c, x0, desired, u_before, rest))
            solution = self._backend.solve_changed(qp)
        else:
            solution = refusal(form.qp)
        plan = form.inputs(solution.x)
        if solution.status == SOLVED and np.isfinite(plan).all():
            self.last = form.states(matrices, c, x0, solution.x), plan
        return Answer(plan=plan, slacks=form.slacks(solution.x), solution=solution)
