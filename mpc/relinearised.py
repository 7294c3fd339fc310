"""A problem whose model changes from period to period, solved whole."""

from __future__ import annotations

import math
import time as clock
from typing import Any, Final

import numpy as np
from scipy.linalg import lapack

from mpc.ocp import Problem, Rest
from mpc.paper.condensed import Condensed
from mpc.qp import QP, ChangingFormulation, Point, Solution
from mpc.solvers import SOLVERS, Answer, make_backend, refusal
from mpc.staged import Staged
from quadsim.controller import ACCEPTED, GAIN, UNCONSTRAINED
from quadsim.state import Array

SOLVER: Final = "piqp-multistage"
STEPS_PER_STAGE: Final = 4
"""M where the model changes, the fastest of 1 to 7 for 16 states, though 2 to 5 hardly differ."""
LARGEST: Final = 1e6
"""Magnitude of a number in the data beyond which it is no vehicle's: four steps of such numbers multiply to 1e30, where
PIQP takes bounds for infinite."""


class Relinearised:
    """A problem whose model changes from period to period, solved whole.

    Args:
        problem: with constraints.
        solver: its name in `mpc.solvers.SOLVERS`; the form is the one that it takes.
        shortcut: whether the unconstrained optimum of a condensed form is tried first.

    Attributes:
        last: predicted states (N, n) and plan (N, nu) of the last period, if that was solved.
    """

    def __init__(self, problem: Problem, solver: str = SOLVER, *, shortcut: bool = False) -> None:
        self._solver = solver
        self._backend: Any = make_backend(solver, changing=True)
        condensed = SOLVERS[solver].formulate is Condensed
        steps = 1 if solver.endswith("-1") else STEPS_PER_STAGE
        self._form: ChangingFormulation = (
            Condensed(problem) if condensed else Staged(problem, steps_per_stage=steps, changing=True)
        )
        self._shortcut = shortcut and condensed
        self._inputs = problem.horizon * problem.model.nu
        self._backend.setup(self._form.qp)
        self.last: tuple[Array, Array] | None = None

    def solve(self, A: Array, B: Array, c: Array, x0: Array, desired: Array, u_before: Array, rest: Rest) -> Answer:
        """Solve one period's QP, of A_i (N, n, n), B_i (N, n, nu), c_i (N, n); x0 is x(k).

        Data that is not finite, or beyond `LARGEST`, is answered with the status `invalid_data`: PIQP cannot be trusted
        to notice.
        """
        form, qp = self._form, None
        self.last = None
        if all(_small(part) for part in (A, B, c, x0, desired, u_before, rest.u)):
            qp, states = form.posed(A, B, c, x0, desired, u_before, rest)
            solution = (self._free(qp) if self._shortcut else None) or self._solve(qp)
        else:
            solution = refusal(form.qp)
        plan = form.inputs(solution.x)
        if solution.status in ACCEPTED and np.isfinite(plan).all():
            self.last = states(solution.x), plan
        by = GAIN if solution.status == UNCONSTRAINED else self._solver
        return Answer(plan, form.slacks(solution.x), solution, by, qp=qp)

    def _solve(self, qp: QP) -> Solution:
        if hasattr(self._backend, "solve_changed"):
            solution: Solution = self._backend.solve_changed(qp)
            return solution
        backend = make_backend(self._solver)
        backend.setup(qp)
        return backend.solve(qp.vectors)

    def _free(self, qp: QP) -> Solution | None:
        """The unconstrained optimum of a condensed QP, where it satisfies every constraint."""
        started, m = clock.perf_counter(), self._inputs
        _, u, failed = lapack.dposv(qp.P[:m, :m], -qp.c[:m])
        if failed or (u < qp.x_l[:m]).any() or (u > qp.x_u[:m]).any():
            return None
        x = np.zeros(qp.c.size)
        x[:m] = u
        if qp.h_l.size:
            values = qp.G @ x
            if (values < qp.h_l).any() or (values > qp.h_u).any():
                return None
        return Solution(
            made=Point(x=x, y=np.zeros(0), z=np.zeros(qp.h_l.size), z_box=np.concatenate([np.zeros(m), -qp.c[m:]])),
            status=UNCONSTRAINED,
            iterations=0,
            active=0,
            reported_primal=math.nan,
            reported_dual=math.nan,
            solve_s=clock.perf_counter() - started,
        )


def _small(part: Array) -> bool:
    """Whether no entry is beyond `LARGEST`, or no number; nearly always the sum of their squares is not either."""
    return bool(np.vdot(part, part) <= LARGEST**2 or np.abs(part).max() <= LARGEST)
