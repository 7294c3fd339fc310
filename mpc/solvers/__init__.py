"""The QP solvers by name: a formulation of the problem and a back end that solves it."""

from __future__ import annotations

import importlib
import importlib.metadata
import importlib.util
from dataclasses import dataclass
from typing import Final

from mpc.condensed import condensed
from mpc.multistage import multistage
from mpc.problem import Problem
from mpc.qp import Backend, Formulation, FormulationBuilder, Solution
from quadsim.errors import MissingPackageError, UnknownNameError
from quadsim.state import Array


@dataclass(frozen=True, kw_only=True)
class SolverEntry:
    """How a named solver is made, and one line about it.

    Attributes:
        formulate: builds the form of the problem that the back end takes.
        backend: `module:class` of the back end, imported when it is first used.
        package: distribution that it needs, for its version.
        module: what that distribution is imported as.
        description: one line.
    """

    formulate: FormulationBuilder
    backend: str
    package: str
    module: str
    description: str

    @property
    def installed(self) -> bool:
        """Whether the package is there; importing it is left for later."""
        return importlib.util.find_spec(self.module) is not None

    @property
    def version(self) -> str:
        """Version of the installed package."""
        return importlib.metadata.version(self.package)


SOLVERS: Final[dict[str, SolverEntry]] = {
    "piqp-multistage": SolverEntry(
        formulate=multistage,
        backend="mpc.solvers.piqp_sparse:PiqpMultistage",
        package="piqp",
        module="piqp",
        description="PIQP, multistage, partially condensed (default)",
    ),
    "piqp-dense": SolverEntry(
        formulate=condensed,
        backend="mpc.solvers.piqp_dense:PiqpDense",
        package="piqp",
        module="piqp",
        description="PIQP, dense Cholesky, on the paper's condensed matrices",
    ),
}


def make_backend(name: str) -> Backend:
    """A fresh back end of a named solver.

    Raises:
        UnknownNameError: there is no such solver.
        MissingPackageError: it needs a package that is not installed.
    """
    if name not in SOLVERS:
        raise UnknownNameError("solver", name, SOLVERS)
    entry = SOLVERS[name]
    if not entry.installed:
        raise MissingPackageError(f"the solver {name!r}", entry.package, extra="solvers")
    module, _, kind = entry.backend.partition(":")
    backend: Backend = getattr(importlib.import_module(module), kind)()
    return backend


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
        self._backend = make_backend(name)
        self.name = name
        self.formulation: Formulation = SOLVERS[name].formulate(problem)
        self._backend.setup(self.formulation.qp)

    def solve(self, state: Array, desired: Array, u_before: Array) -> Answer:
        """Solve for xi(k) (n,), y_d (N, n_r) and u(k-1) (nu,)."""
        solution = self._backend.solve(self.formulation.vectors(state, desired, u_before))
        return Answer(plan=self.formulation.inputs(solution.x), solution=solution)
