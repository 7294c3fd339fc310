"""The QP solvers by name: a formulation of the problem and a back end that solves it."""

from __future__ import annotations

import importlib
import importlib.metadata
import importlib.util
import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from functools import partial
from typing import Final, NamedTuple, Protocol

import numpy as np

from mpc.ocp import Problem, Rest
from mpc.paper.condensed import Condensed
from mpc.qp import QP, Backend, Formulation, KKTResiduals, Point, RoughBackend, Solution, Vectors
from mpc.staged import Staged
from quadsim.errors import MissingPackageError, UnknownNameError
from quadsim.state import Array


@dataclass(frozen=True)
class SolverEntry:
    """How a named solver is made, and one line about it."""

    formulate: Callable[[Problem], Formulation]  # builds the form of the problem that the back end takes
    backend: str  # `module:class` of the back end in this folder, imported when it is first used
    package: str  # distribution that it needs, and what it is imported as
    description: str  # one line
    changing: str = ""  # the back end where matrices change, if it is another
    extra: str = "solvers"  # the extra of this project that installs the package; empty for one that is always there

    @property
    def installed(self) -> bool:
        """Whether the package is there; importing it is left for later."""
        return importlib.util.find_spec(self.package) is not None

    @property
    def version(self) -> str:
        """Version of the installed package."""
        return importlib.metadata.version(self.package)

    @property
    def line(self) -> str:
        """The description, and how to install what is missing."""
        return self.description if self.installed else f"not installed: pip install 'quadsim[{self.extra}]'"


SOLVERS: Final = {
    "piqp-multistage": SolverEntry(
        Staged,
        "piqp_backends:PiqpMultistage",
        "piqp",
        "PIQP, multistage, partially condensed (default)",
        "piqp_backends:PiqpChanging",
        extra="",
    ),
    "piqp-multistage-1": SolverEntry(
        partial(Staged, steps_per_stage=1),
        "piqp_backends:PiqpMultistage",
        "piqp",
        "PIQP, multistage, one stage per step",
        "piqp_backends:PiqpChanging",
        extra="",
    ),
    "piqp-dense": SolverEntry(
        Condensed,
        "piqp_backends:PiqpDense",
        "piqp",
        "PIQP, dense Cholesky, on the paper's condensed matrices",
        "piqp_backends:PiqpDenseChanging",
        extra="",
    ),
    "daqp": SolverEntry(
        Condensed, "daqp_dense:DaqpDense", "daqp", "DAQP, dual active set, condensed, warm-started", extra="daqp"
    ),
    "osqp": SolverEntry(
        Condensed, "osqp_sparse:OsqpSparse", "osqp", "OSQP, operator splitting, condensed, warm-started"
    ),
    "clarabel": SolverEntry(
        Staged, "clarabel_sparse:ClarabelSparse", "clarabel", "Clarabel, interior point, partially condensed"
    ),
    "proxqp": SolverEntry(
        Condensed, "proxqp_dense:ProxqpDense", "proxsuite", "ProxQP, proximal augmented Lagrangian, dense, condensed"
    ),
    "quadprog": SolverEntry(
        Condensed,
        "quadprog_dense:QuadprogDense",
        "quadprog",
        "quadprog, Goldfarb and Idnani's dual active set, condensed",
    ),
    "highs": SolverEntry(
        Condensed,
        "highs_sparse:HighsSparse",
        "highspy",
        "HiGHS, active set, condensed; fails on most of the paper's QPs",
    ),
    "qpoases": SolverEntry(
        Condensed,
        "qpoases_dense:QpoasesDense",
        "casadi",
        "qpOASES through CasADi, the paper's own solver, condensed, warm-started",
    ),
}


INVALID_DATA: Final = "invalid_data"
"""Status of a query with numbers that is passed to no back end."""


def make_backend(name: str, *, changing: bool = False) -> Backend:
    """A fresh back end of a named solver, for matrices that are `changing` or not.

    Raises:
        UnknownNameError: there is no such solver.
        MissingPackageError: it needs a package that is not installed.
    """
    if name not in SOLVERS:
        raise UnknownNameError("solver", name, SOLVERS)
    entry = SOLVERS[name]
    if not entry.installed:
        raise MissingPackageError(f"the solver {name!r}", entry.package, extra=entry.extra)
    module, _, kind = ((changing and entry.changing) or entry.backend).partition(":")
    backend: Backend = getattr(importlib.import_module(f"{__name__}.{module}"), kind)()
    return backend


class Method(StrEnum):
    """How much of the QP had to be solved: see `mpc.exact.shortcut`."""

    FREE = "the unconstrained optimum"
    AXES = "active rows of states alone"
    WHOLE = "the whole QP"


class Answer(NamedTuple):
    """An optimum as a plan."""

    plan: Array  # (N, nu) inputs [rad/s]; to be used only when the solution's status is accepted
    slacks: Array  # (N, m_s) by how much soft rows are violated
    solution: Solution  # to `qp`
    answered_by: str  # `gain`, `active-set` or the QP solver's name; see `quadsim.controller.Command`
    method: Method = Method.WHOLE  # how much of the QP had to be solved
    qp: QP | Callable[[], QP] | None = None  # what was solved, or what makes it; None where the data made none
    infeasibility: float = math.nan  # see `mpc.answer.AnswerCheck`, as the next; NaN where it is not computed
    kkt: KKTResiduals | None = None


class Solver(Protocol):
    """Finds a problem's optimum each period."""

    @property
    def name(self) -> str:
        """Name of the QP solver, in `SOLVERS`."""
        ...

    @property
    def formulation(self) -> Formulation:
        """The QP that its solutions are of."""
        ...

    def reset(self) -> None:
        """Forget the last period's answer, where it is where the next one starts."""
        ...

    def solve(self, state: Array, desired: Array, u_before: Array, rest: Rest | None = None) -> Answer:
        """The optimum for xi(k) (n,), y_d (N, n_r) and u(k-1) (nu,) [rad/s], at the problem's rest state or another.

        Whatever happens is in its status.
        """
        ...


class QPSolver:
    """A problem's QP, set up once and solved each period with new vectors."""

    def __init__(self, name: str, problem: Problem) -> None:
        self._backend = make_backend(name)
        self.name = name
        self.formulation: Formulation = SOLVERS[name].formulate(problem)
        self._backend.setup(self.formulation.qp)

    def reset(self) -> None:
        """See `Solver.reset`: back ends that start from their last answer, restart from scratch."""
        self._backend = make_backend(self.name)
        self._backend.setup(self.formulation.qp)

    def solve(self, state: Array, desired: Array, u_before: Array, rest: Rest | None = None) -> Answer:
        """See `Solver.solve`.

        Data that is not finite is answered with the status `invalid_data`: no back end can be trusted to notice.
        """
        return self._by(self._backend.solve, state, desired, u_before, rest)

    @property
    def can_solve_roughly(self) -> bool:
        """Whether its back end has a rough answer to give."""
        return isinstance(self._backend, RoughBackend)

    def solve_roughly(self, state: Array, desired: Array, u_before: Array, rest: Rest | None = None) -> Answer:
        """The same, only so well that the active set can be seen.

        Raises:
            TypeError: the back end has no rough answer to give.
        """
        if not isinstance(self._backend, RoughBackend):
            raise TypeError(f"{self.name} has no rough answer to give")
        return self._by(self._backend.solve_roughly, state, desired, u_before, rest)

    def _by(
        self,
        solve: Callable[[Vectors], Solution],
        state: Array,
        desired: Array,
        u_before: Array,
        rest: Rest | None,
    ) -> Answer:
        form, qp = self.formulation, None
        if math.isfinite(state.sum() + desired.sum() + u_before.sum()):
            vectors = form.vectors(state, desired, u_before, rest)
            solution, qp = solve(vectors), partial(form.qp.with_vectors, vectors)
        else:
            solution = refusal(form.qp)
        x = solution.x
        return Answer(form.inputs(x), form.slacks(x), solution, self.name, qp=qp)


def refusal(qp: QP) -> Solution:
    """What is answered without asking a back end."""
    return Solution(
        made=Point(*(np.full_like(part, math.nan) for part in (qp.c, qp.b, qp.h_l, qp.c))),
        status=INVALID_DATA,
        iterations=0,
        active=0,
        reported_primal=math.nan,
        reported_dual=math.nan,
        solve_s=0.0,
    )
