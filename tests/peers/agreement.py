"""Every QP solver on the same recorded QPs, judged by KKT residuals that we compute, and by qpmpc's first inputs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from peers.checks import Check
from peers.recorded import Query

from mpc.ocp import Problem
from mpc.qp import KKTResiduals, kkt_residuals
from mpc.solvers import SOLVERS, QPSolver
from quadsim.controller import SOLVED
from quadsim.state import Array

SLOW: Final = {"osqp": 10, "highs": 10}
"""Solvers that are called every so many periods only; they take 0.1 s and more for each."""
MAY_FAIL: Final = frozenset(SLOW)
"""Solvers that give up on some of the QPs, and report it."""
ALLOWED_DIFFERENCE, ALLOWED_RESIDUAL = 1e-3, 1e-2
"""Of what a solver calls solved: its first input from the reference [rad/s], and its worst KKT residual."""


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """One solver on the recorded QPs; difference and residuals are the worst over those it calls solved.

    Attributes:
        solver: its name in `SOLVERS`.
        queried: number of QPs.
        failures: how many it did not call solved.
        difference: its first inputs from the reference, the largest over rotors and QPs [rad/s].
        residuals: of its solutions, in the units of the QP it was given.
    """

    solver: str
    queried: int
    failures: int
    difference: float
    residuals: KKTResiduals

    @property
    def checks(self) -> tuple[Check, ...]:
        """Its first inputs and its residuals, and its failures unless they are its habit."""
        name, peer = f"`{self.solver}`, {self.queried} QPs", SOLVERS[self.solver].package
        checks = (
            Check(
                what=f"{name}: first input",
                peer=peer,
                measured=self.difference,
                allowed=ALLOWED_DIFFERENCE,
                unit="rad/s",
            ),
            Check(
                what=f"{name}: worst KKT residual", peer=peer, measured=self.residuals.worst, allowed=ALLOWED_RESIDUAL
            ),
        )
        if self.solver in MAY_FAIL:
            return checks
        return (*checks, Check(what=f"{name}: failures", peer=peer, measured=self.failures, allowed=0.0))


def measure(name: str, problem: Problem, queries: Sequence[Query], reference: Array) -> Verdict:
    """Call one solver, every period or, of `SLOW` ones, every so many.

    Args:
        name: in `SOLVERS`.
        problem: the optimisation.
        queries: K of them, in the order of the flight, which solvers that start warm make use of.
        reference: (K, 4) first inputs to compare with [rad/s].
    """
    solver, every = QPSolver(name, problem), SLOW.get(name, 1)
    queried, expected_inputs = queries[::every], reference[::every]
    differences, residuals = [], []
    for query, expected in zip(queried, expected_inputs, strict=True):
        answer = solver.solve(query.state, query.desired, query.u_before)
        if answer.solution.status != SOLVED:
            continue
        vectors = solver.formulation.vectors(query.state, query.desired, query.u_before)
        residuals.append(kkt_residuals(solver.formulation.qp.with_vectors(vectors), answer.solution))
        differences.append(np.abs(answer.plan[0] - expected).max())
    return Verdict(
        solver=name,
        queried=len(queried),
        failures=len(queried) - len(residuals),
        difference=float(np.max(differences, initial=0.0)),
        residuals=KKTResiduals(
            stationarity=_worst([each.stationarity for each in residuals]),
            primal=_worst([each.primal for each in residuals]),
            complementarity=_worst([each.complementarity for each in residuals]),
            dual=_worst([each.dual for each in residuals]),
        ),
    )


def _worst(figures: list[float]) -> float:
    """The largest; NaN if any is."""
    return float(np.max(figures, initial=0.0))
