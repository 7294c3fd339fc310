"""The QP solvers by name: a formulation of the problem and a back end that solves it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from mpc.condensed import condensed
from mpc.multistage import multistage
from mpc.problem import Problem
from mpc.qp import Backend, Formulation, FormulationBuilder, Solution
from mpc.solvers.piqp_dense import PiqpDense
from mpc.solvers.piqp_sparse import PiqpMultistage
from quadsim.errors import UnknownNameError
from quadsim.state import Array


@dataclass(frozen=True, kw_only=True)
class SolverEntry:
    """How a named solver is made, and one line about it."""

    formulate: FormulationBuilder
    backend: type[Backend]
    description: str


SOLVERS: Final[dict[str, SolverEntry]] = {
    "piqp-dense": SolverEntry(
        formulate=condensed, backend=PiqpDense, description="PIQP, dense Cholesky, on the paper's condensed matrices"
    ),
    "piqp-multistage": SolverEntry(
        formulate=multistage, backend=PiqpMultistage, description="PIQP, multistage, partially condensed (default)"
    ),
}


@dataclass(frozen=True, kw_only=True)
class Answer:
    """A QP's answer as a plan.

    Attributes:
        plan: (N, nu) inputs [rad/s]; to be used only when the solution's status is `solved`.
        solution: the back end's answer.
    """

    plan: Array
    solution: Solution


class QPSolver:
    """A problem's QP, set up once and solved each period with new vectors."""

    def __init__(self, name: str, problem: Problem) -> None:
        if name not in SOLVERS:
            raise UnknownNameError("solver", name, SOLVERS)
        entry = SOLVERS[name]
        self.name = name
        self.formulation: Formulation = entry.formulate(problem)
        self._backend = entry.backend()
        self._backend.setup(self.formulation.qp)

    def solve(self, state: Array, desired: Array, u_before: Array) -> Answer:
        """Solve for xi(k) (n,), y_d (N, n_r) and u(k-1) (nu,)."""
        solution = self._backend.solve(self.formulation.vectors(state, desired, u_before))
        return Answer(plan=self.formulation.inputs(solution.x), solution=solution)
