"""Every QP solver on the same recorded QPs, judged by KKT residuals that we compute, and by qpmpc's first inputs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from peers.checks import Check
from peers.qpoases import Qpoases
from peers.recorded import Query

from quadsim.controller import SOLVED
from quadsim.mpc.forms.condensing import Condensed
from quadsim.mpc.problem.ocp import Problem
from quadsim.mpc.problem.qp import KKTResiduals, kkt_residuals
from quadsim.mpc.solvers import SOLVERS, find_solver, make_backend
from quadsim.state import Array

QPOASES: Final = "qpoases"
PACKAGES: Final = {name: entry.package for name, entry in SOLVERS.items()} | {
    "clarabel": "clarabel",
    "osqp": "osqp",
    "proxqp": "proxsuite",
    "quadprog": "quadprog",
    QPOASES: "casadi",
}
"""Of every solver that takes part: ours, some of qpsolvers, and the paper's own."""
SLOW: Final = dict.fromkeys(("osqp", "proxqp", "clarabel", "quadprog"), 10)
"""Solvers that are called every so many periods only: qpsolvers sets them up anew each time."""
MAY_FAIL: Final = frozenset(("osqp", "proxqp"))
"""Solvers that give up on some of the QPs, and report it."""
ALLOWED_DIFFERENCE = 1e-3
ALLOWED_RESIDUAL = 1e-2
"""Of what a solver calls solved: its first input from the reference [rad/s], and its worst KKT residual."""


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """One solver on the recorded QPs; difference and residuals are the worst over those it calls solved."""

    solver: str  # its name in `PACKAGES`
    queried: int  # number of QPs
    failures: int  # how many it did not call solved
    difference: float  # its first inputs from the reference, the largest over rotors and QPs [rad/s]
    residuals: KKTResiduals  # of its solutions, in the units of the QP it was given

    @property
    def checks(self) -> tuple[Check, ...]:
        """Its first inputs and its residuals, and its failures unless they are its habit."""
        name = f"`{self.solver}`, {self.queried} QPs"
        peer = PACKAGES[self.solver]
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
        name: in `PACKAGES`.
        problem: the optimisation.
        queries: K of them, in the order of the flight, which solvers that start warm make use of.
        reference: (K, 4) first inputs to compare with [rad/s].
    """
    form = Condensed(problem) if name == QPOASES else find_solver(name).formulate(problem)
    backend = Qpoases() if name == QPOASES else make_backend(name)
    every = SLOW.get(name, 1)
    backend.setup(form.qp)
    queried = queries[::every]
    expected_inputs = reference[::every]
    differences = []
    residuals = []
    for query, expected in zip(queried, expected_inputs, strict=True):
        qp = form.assemble(query.posed)
        solution = backend.solve(qp)
        if solution.status != SOLVED:
            continue
        residuals.append(kkt_residuals(qp, solution))
        differences.append(np.abs(form.inputs(solution.x)[0] - expected).max())
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
