"""The QP solvers by name; each solves a problem's QP in every period: `Query -> Answer`."""

from __future__ import annotations

import importlib.util
import math
import time as clock
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from typing import Final, NamedTuple, Protocol, TypeAlias

import numpy as np

from quadsim.controller import CORE, GAIN, NO_STATISTICS, Statistics
from quadsim.errors import MissingPackageError, UnknownNameError
from quadsim.mpc.forms.condensing import Condensed, FreeOptimum
from quadsim.mpc.forms.staged import Staged
from quadsim.mpc.problem.ocp import Problem, Query
from quadsim.mpc.problem.qp import QP, Backend, Solution
from quadsim.state import Array

Formulation: TypeAlias = Condensed | Staged
"""The QP formulations of an optimal control problem."""


@dataclass(frozen=True, kw_only=True)
class SolverEntry:
    """A named solver and the form of the problem that it takes."""

    description: str  # one line
    package: str  # import name
    dense: bool = True  # whether it takes the condensed QP; otherwise it takes the staged one
    extra: str = ""  # quadsim's extra that installs the package; empty if it is always installed

    def formulate(self, problem: Problem) -> Formulation:
        """Return the form of the problem that it takes."""
        if self.dense:
            return Condensed(problem)
        return Staged(problem)

    @property
    def installed(self) -> bool:
        """Whether the package is installed; it is not imported yet."""
        return importlib.util.find_spec(self.package) is not None

    @property
    def line(self) -> str:
        """The description, or the command that installs a missing package."""
        if self.installed:
            return self.description
        return f"not installed: pip install 'quadsim[{self.extra}]'"


SOLVERS: Final = {
    "piqp-multistage": SolverEntry(
        description="PIQP, multistage, all states as variables (default)", package="piqp", dense=False
    ),
    "piqp-dense": SolverEntry(description="PIQP, dense Cholesky, on the paper's condensed matrices", package="piqp"),
    "daqp": SolverEntry(description="DAQP, dual active set, condensed, warm-started", package="daqp", extra="daqp"),
}
"""QP solvers that are set up once and then updated in each period."""

COMPILED: Final = SolverEntry(
    description="the compiled core: the exact optimum where matrices are fixed; PIQP answers what it gives up",
    package="quadsim.core",
)

CORES_SECOND: Final = "piqp-multistage"
"""The QP solver of the problems that the core gives up."""

ALIASES: Final = {"piqp": "piqp-multistage"}
"""Other names of solvers, and the solvers that they stand for."""
SUCCESSORS: Final = {"piqp-multistage-1": "piqp-multistage", "core-or-piqp": CORE}
"""Solvers of earlier versions, and what to use in their place."""

INVALID_DATA: Final = "invalid_data"
"""Status of a query with numbers that are not finite, or out of range; no back end receives it."""


def find_solver(name: str) -> SolverEntry:
    """Return the solver of a name: the core, one of `SOLVERS` or of qpsolvers; `UnknownNameError` if there is none."""
    name = ALIASES.get(name, name)
    if name == CORE:
        return COMPILED
    if name in SOLVERS:
        return SOLVERS[name]
    entries = solver_entries()
    if name in entries:
        return entries[name]
    has_qpsolvers = len(entries) > len(SOLVERS) + 1
    if has_qpsolvers:
        hint = ""
    else:
        hint = "pip install 'quadsim[solvers]' adds those of qpsolvers"
    raise UnknownNameError("solver", name, entries, hint, successor=SUCCESSORS.get(name))


def solver_entries() -> dict[str, SolverEntry]:
    """Return all solvers by name: `SOLVERS`, the core, and those of qpsolvers that are installed."""
    entries = SOLVERS | {CORE: COMPILED}
    if importlib.util.find_spec("qpsolvers") is None:
        return entries
    from qpsolvers import available_solvers  # imports every installed solver

    for name in sorted(available_solvers):
        if name in entries or name in ALIASES:
            continue
        description = f"{name} through qpsolvers, condensed, set up anew in each period"
        entries[name] = SolverEntry(description=description, package="qpsolvers", extra="solvers")
    return entries


def make_backend(name: str) -> Backend:
    """Return a new back end of a named QP solver.

    Raises:
        UnknownNameError: there is no such QP solver.
        MissingPackageError: its package is not installed.
    """
    if name == CORE:
        raise UnknownNameError("QP solver", name, SOLVERS, "use make_solver")
    entry = find_solver(name)
    if not entry.installed:
        raise MissingPackageError(f"the solver {name!r}", entry.package, extra=entry.extra)
    if entry.package == "piqp":
        from quadsim.mpc.solvers.piqp import Piqp

        return Piqp(dense=entry.dense)
    if entry.package == "daqp":
        from quadsim.mpc.solvers.daqp import DaqpDense

        return DaqpDense()
    if name in SOLVERS:  # a solver that was added to the list, but not here
        raise UnknownNameError("QP solver", name, SOLVERS, "make_backend cannot make one")
    from quadsim.mpc.solvers.qpsolvers import AnyOfQpsolvers

    return AnyOfQpsolvers(name)


class Method(IntEnum):
    """The part of the QP that had to be solved, with the codes of C (`enum quadsim_found`).

    All other codes of that enumeration mean that no optimum was found.
    """

    FREE = 0  # none: the unconstrained optimum satisfies every constraint
    AXES = 1  # each axis (`quadsim.mpc.solvers.core_axes`) by itself, with its rows of states alone
    WHOLE = 2  # all of it


class Answer(NamedTuple):
    """An optimum as a plan; its arrays are read-only by convention."""

    plan: Array  # (N, nu) inputs [rad/s]; valid only if the status is accepted
    slacks: Array  # (N, m_s) violations of soft rows
    status: str  # `solved`, `unconstrained`, or the reason for a failure
    answered_by: str  # `gain`, `core` or the QP solver's name; see `quadsim.controller.Command`
    stats: Statistics = NO_STATISTICS  # of the solver that answered, completed by `AnswerCheck`
    method: Method = Method.WHOLE  # the part of the QP that had to be solved
    # makes the QP and its solution, from which KKT residuals are computed; None for invalid data
    certificate: Callable[[], tuple[QP, Solution]] | None = None

    @classmethod
    def of(cls, form: Formulation, qp: QP, solution: Solution, answered_by: str) -> Answer:
        """Convert a solver's solution of a QP to a plan and slacks."""
        return cls(
            plan=form.inputs(solution.x),
            slacks=form.slacks(solution.x),
            status=solution.status,
            answered_by=answered_by,
            stats=solution.stats,
            certificate=lambda: (qp, solution),
        )


class Solver(Protocol):
    """Computes a problem's optimum in each period."""

    @property
    def name(self) -> str:
        """Name of the QP solver; see `find_solver`."""

    @property
    def iterates(self) -> frozenset[str]:
        """Names of the solvers whose iterations its answers count."""

    @property
    def formulation(self) -> Formulation:
        """The QP to which its solutions refer."""

    def reset(self) -> None:
        """Clear the last answer, if the next search starts from it."""

    def solve(self, query: Query) -> Answer:
        """Return the optimum of a query; failures are reported in its status."""


class QPSolver:
    """Solves a problem's QP in each period with a named solver.

    With `free_first`, the unconstrained optimum is tried first: if it satisfies every constraint, it is the optimum,
    and no QP is solved.

    Examples:
        >>> import numpy as np
        >>> import quadsim
        >>> from quadsim import mpc
        >>> problem = quadsim.problem("paper-constrained")
        >>> reference = np.tile([1.0, 0.0, 0.0, 0.0], (50, 1))  # x, y, z [m], yaw [rad]
        >>> query = mpc.Query(np.zeros(12), problem.desired(reference), problem.model.u_bar)
        >>> answer = mpc.QPSolver("piqp", problem).solve(query)
        >>> answer.status, answer.plan.shape
        ('solved', (50, 4))
    """

    def __init__(self, name: str, problem: Problem, *, free_first: bool = False) -> None:
        self.name = ALIASES.get(name, name)
        self.formulation = find_solver(name).formulate(problem)
        self._free: FreeOptimum | None = None
        if free_first:
            condensed = None
            if isinstance(self.formulation, Condensed):
                condensed = self.formulation
            self._free = FreeOptimum.of(problem, condensed)
        self.reset()

    @property
    def iterates(self) -> frozenset[str]:
        """See `Solver`; those of qpsolvers do not report their iterations."""
        if self.name in SOLVERS:
            return frozenset({self.name})
        return frozenset()

    def reset(self) -> None:
        """See `Solver.reset`: a new back end replaces one that would start from its last answer."""
        self._backend = make_backend(self.name)
        self._backend.setup(self.formulation.qp)

    def solve(self, query: Query) -> Answer:
        """See `Solver.solve`.

        Data that is not finite gives the status `invalid_data`, since back ends may not notice it.
        """
        form = self.formulation
        if not _is_finite(query):
            no_solution = np.full_like(form.qp.c, math.nan)
            return Answer(
                plan=form.inputs(no_solution),
                slacks=form.slacks(no_solution),
                status=INVALID_DATA,
                answered_by=self.name,
            )
        started = clock.perf_counter()
        answer = None
        if self._free is not None:
            answer = _free_answer(self._free, query)
        spent_s = clock.perf_counter() - started
        if answer is None:
            qp = form.assemble(query)
            answer = Answer.of(form, qp, self._backend.solve(qp), self.name)
            spent_s += answer.stats.solve_s
        return answer._replace(stats=answer.stats._replace(solve_s=spent_s))


def _is_finite(query: Query) -> bool:
    """Return whether state, desired outputs and last input are finite: a sum is not if any of its terms is not."""
    total = query.state.sum() + query.desired.sum() + query.u_before.sum()
    return math.isfinite(total)


def _free_answer(free: FreeOptimum, query: Query) -> Answer | None:
    """Return the unconstrained optimum; None if it violates a constraint.

    The QP is assembled only if the answer's certificate is asked for.
    """
    solution = free.solve(query)
    if solution is None:
        return None
    form = free.form
    return Answer(
        plan=form.inputs(solution.x),
        slacks=form.slacks(solution.x),
        status=solution.status,
        answered_by=GAIN,
        method=Method.FREE,
        certificate=lambda: (form.assemble(query), solution),
    )
