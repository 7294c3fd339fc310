"""The QP solvers by name, and a problem's QP solved each period by one of them: `Query -> Answer`."""

from __future__ import annotations

import importlib.util
import math
import time as clock
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from typing import Final, NamedTuple, Protocol, TypeAlias

import numpy as np
from scipy.linalg import lapack

from mpc.ocp import Problem, Query
from mpc.paper.condensed import Condensed
from mpc.qp import QP, Backend, KKTResiduals, Solution
from mpc.staged import Staged
from quadsim.controller import ACCEPTED, GAIN, UNCONSTRAINED
from quadsim.errors import MissingPackageError, UnknownNameError
from quadsim.state import Array

Formulation: TypeAlias = Condensed | Staged
"""The ways to write an MPC's optimisation as a QP."""


@dataclass(frozen=True, kw_only=True)
class SolverEntry:
    """What a named solver takes, and one line about it."""

    description: str  # one line
    package: str  # what it is imported as
    dense: bool = True  # whether it takes the condensed QP, else the staged one
    steps_per_stage: int | None = None  # of the staged one; None for what suits the inputs
    extra: str = ""  # the extra of this project that installs the package; empty for one that is always there

    def formulate(self, problem: Problem, *, changing: bool = False) -> Formulation:
        """The form of the problem that it takes, for a model that is `changing` from period to period or not."""
        if self.dense:
            return Condensed(problem)
        return Staged(problem, steps_per_stage=self.steps_per_stage, changing=changing)

    @property
    def installed(self) -> bool:
        """Whether the package is there; importing it is left for later."""
        return importlib.util.find_spec(self.package) is not None

    @property
    def line(self) -> str:
        """The description, and how to install what is missing."""
        return self.description if self.installed else f"not installed: pip install 'quadsim[{self.extra}]'"


SOLVERS: Final = {
    "piqp-multistage": SolverEntry(
        description="PIQP, multistage, partially condensed (default)", package="piqp", dense=False
    ),
    "piqp-multistage-1": SolverEntry(
        description="PIQP, multistage, one stage per step", package="piqp", dense=False, steps_per_stage=1
    ),
    "piqp-dense": SolverEntry(description="PIQP, dense Cholesky, on the paper's condensed matrices", package="piqp"),
    "daqp": SolverEntry(description="DAQP, dual active set, condensed, warm-started", package="daqp", extra="daqp"),
}
"""Solvers that are set up once, and told what changes from one period to the next."""

ALIASES: Final = {"piqp": "piqp-multistage"}

INVALID_DATA: Final = "invalid_data"
"""Status of a query with numbers that is passed to no back end."""

LARGEST: Final = 1e6
"""Magnitude of a number in a changing model beyond which it is no vehicle's: four steps of such numbers multiply to
1e30, where PIQP takes bounds for infinite."""


def find_solver(name: str) -> SolverEntry:
    """The solver of a name, one of `SOLVERS` or, where it is installed, of qpsolvers.

    Raises:
        UnknownNameError: there is no such solver.
    """
    name = ALIASES.get(name, name)
    if name in SOLVERS:
        return SOLVERS[name]
    entries = solver_entries()
    if name not in entries:
        hint = "" if len(entries) > len(SOLVERS) else "pip install 'quadsim[solvers]' adds those of qpsolvers"
        raise UnknownNameError("solver", name, entries, hint)
    return entries[name]


def solver_entries() -> dict[str, SolverEntry]:
    """All solvers by name: `SOLVERS`, and those of qpsolvers that are installed."""
    if importlib.util.find_spec("qpsolvers") is None:
        return dict(SOLVERS)
    from qpsolvers import available_solvers  # imports every solver there is

    others = sorted({*available_solvers} - {*SOLVERS, *ALIASES})
    return SOLVERS | {
        name: SolverEntry(
            description=f"{name} through qpsolvers, condensed, set up anew in each period",
            package="qpsolvers",
            extra="solvers",
        )
        for name in others
    }


def make_backend(name: str, *, changing: bool = False) -> Backend:
    """A fresh back end of a named solver, for matrices that are `changing` or not.

    Raises:
        UnknownNameError: there is no such solver.
        MissingPackageError: it needs a package that is not installed.
    """
    entry = find_solver(name)
    if not entry.installed:
        raise MissingPackageError(f"the solver {name!r}", entry.package, extra=entry.extra)
    if entry.package == "piqp":
        from mpc.solvers.piqp_backends import PiqpDense, PiqpMultistage

        return (PiqpDense if entry.dense else PiqpMultistage)(changing=changing)
    if entry.package == "daqp":
        from mpc.solvers.daqp_dense import DaqpDense

        return DaqpDense()
    from mpc.solvers.qpsolvers_backend import AnyOfQpsolvers

    return AnyOfQpsolvers(name)


class Method(StrEnum):
    """How much of the QP had to be solved: see `mpc.exact.shortcut`."""

    FREE = "the unconstrained optimum"
    AXES = "active rows of states alone"
    WHOLE = "the whole QP"


class Answer(NamedTuple):
    """An optimum as a plan; arrays are not to be written to."""

    plan: Array  # (N, nu) inputs [rad/s]; to be used only when the status is accepted
    slacks: Array  # (N, m_s) by how much soft rows are violated
    status: str  # `solved`, `unconstrained`, or what went wrong
    answered_by: str  # `gain`, `active-set` or the QP solver's name; see `quadsim.controller.Command`
    iterations: int = 0  # of whoever answered
    active: int = 0  # constraints active at the optimum
    solve_s: float = 0.0  # wall time [s]
    reported_primal: float = math.nan  # see `mpc.qp.Solution`, as the next
    reported_dual: float = math.nan
    method: Method = Method.WHOLE  # how much of the QP had to be solved
    exact: bool = False  # whether a shortcut found it, or made a solver's answer exact
    states: Array | None = None  # (N, n) predicted, where the model changes and there is an optimum
    certificate: Callable[[], tuple[QP, Solution]] | None = None  # a QP and the solution; None where the data made none
    infeasibility: float = math.nan  # see `mpc.answer.AnswerCheck`, as the next; NaN where it is not computed
    kkt: KKTResiduals | None = None

    @classmethod
    def of(cls, form: Formulation, qp: QP, solution: Solution, answered_by: str) -> Answer:
        """A solver's solution of a QP, as a plan and slacks."""
        return cls(
            form.inputs(solution.x),
            form.slacks(solution.x),
            solution.status,
            answered_by,
            iterations=solution.iterations,
            active=solution.active,
            solve_s=solution.solve_s,
            reported_primal=solution.reported_primal,
            reported_dual=solution.reported_dual,
            certificate=lambda: (qp, solution),
        )


class Solver(Protocol):
    """Finds a problem's optimum each period."""

    @property
    def name(self) -> str:
        """Name of the QP solver; see `find_solver`."""

    @property
    def formulation(self) -> Formulation:
        """The QP that its solutions are of."""

    def reset(self) -> None:
        """Forget the last period's answer, where it is where the next one starts."""

    def solve(self, query: Query) -> Answer:
        """The optimum for a query; whatever happens is in its status."""


class QPSolver:
    """A problem's QP, solved each period by a named solver.

    Queries of a `changing` one have models of their own (`mpc.ocp.Query.steps`); with the `shortcut`, the unconstrained
    optimum of a condensed QP is tried first.
    """

    def __init__(self, name: str, problem: Problem, *, changing: bool = False, shortcut: bool = False) -> None:
        self.name, self._changing = name, changing
        self.formulation = find_solver(name).formulate(problem, changing=changing)
        self._inputs = problem.horizon * problem.model.nu
        self._shortcut = shortcut and isinstance(self.formulation, Condensed)
        self.reset()

    def reset(self) -> None:
        """See `Solver.reset`: back ends that start from their last answer, restart from scratch."""
        self._backend = make_backend(self.name, changing=self._changing)
        self._backend.setup(self.formulation.qp)

    def solve(self, query: Query) -> Answer:
        """See `Solver.solve`.

        Data that is not finite, or beyond `LARGEST` in a model that changes, is answered with the status
        `invalid_data`: no back end can be trusted to notice.
        """
        form = self.formulation
        if not _usable(query):
            nowhere = np.full_like(form.qp.c, math.nan)
            return Answer(form.inputs(nowhere), form.slacks(nowhere), INVALID_DATA, self.name)
        qp, states_of = form.pose(query)
        solution = (self._free(qp) if self._shortcut else None) or self._backend.solve(qp)
        by = GAIN if solution.status == UNCONSTRAINED else self.name
        answer = Answer.of(form, qp, solution, by)
        if self._changing and solution.status in ACCEPTED and np.isfinite(answer.plan).all():
            return answer._replace(states=states_of(solution.x))
        return answer

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
        z_box = np.concatenate([np.zeros(m), -qp.c[m:]])
        spent_s = clock.perf_counter() - started
        return Solution(x, np.zeros(0), np.zeros(qp.h_l.size), z_box, status=UNCONSTRAINED, solve_s=spent_s)


def _usable(query: Query) -> bool:
    """Whether all numbers are finite, those of a changing model also no larger than `LARGEST`."""
    state, desired, u_before, rest, steps = query
    if steps is None:
        return math.isfinite(state.sum() + desired.sum() + u_before.sum())
    parts = (*steps, state, desired, u_before, *(() if rest is None else (rest.u,)))
    return all(np.abs(part).max() <= LARGEST for part in parts)
