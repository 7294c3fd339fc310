"""The controllers that take part in `quadsim bench solvers`, and what they answered."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from mpc.condensed import condensed
from mpc.constrained import ConstrainedMPC
from mpc.polish import polish
from mpc.problem import Problem
from mpc.qp import QP, Solution, kkt_residuals
from mpc.solvers import SOLVERS, Answer, QPSolver, make_backend
from quadsim.controller import ACCEPTED, SOLVED, UNCONSTRAINED, Command, Moment
from quadsim.errors import FlightError
from quadsim.state import Array
from scenarios.queries import Queries

WITH_SHORTCUT: Final = ("daqp",)
"""Solvers that are shown both with and without the shortcut, besides the default."""
REFERENCE_SOLVER: Final = "piqp-dense"
"""Where the search for the optimum in closed form starts."""


@dataclass(frozen=True, kw_only=True)
class Entry:
    """One contender: a solver, with or without the unconstrained optimum tried first."""

    solver: str
    shortcut: bool

    @property
    def name(self) -> str:
        """What it is called."""
        return f"{self.solver} + shortcut" if self.shortcut else self.solver


def entries(default: Entry, solvers: Sequence[str]) -> list[Entry]:
    """The default first, then each installed solver alone, then those that are shown with the shortcut as well."""
    installed = [name for name in solvers if SOLVERS[name].installed]
    alone = [Entry(solver=name, shortcut=False) for name in installed]
    both = [Entry(solver=name, shortcut=True) for name in installed if name in WITH_SHORTCUT]
    return [default, *(entry for entry in (*alone, *both) if entry != default)]


class _Witnessed(QPSolver):
    """The solver, whose last answer can be looked at."""

    last: Answer | None = None

    def solve(self, state: Array, desired: Array, u_before: Array) -> Answer:
        """See `mpc.solvers.QPSolver.solve`."""
        self.last = super().solve(state, desired, u_before)
        return self.last


class StepEntrant:
    """A controller that is asked a flight's queries, each after the command that was given before it in that flight."""

    def __init__(self, entry: Entry, problem: Problem, queries: Queries) -> None:
        self.entry, self.problem, self._queries = entry, problem, queries
        self.solver = _Witnessed(entry.solver, problem)
        self._controller = ConstrainedMPC(problem, self.solver, shortcut=entry.shortcut)
        self.answers: dict[int, tuple[Command | None, Answer | None]] = {}
        """What was answered in the first pass, by period: the command, if any, and the solver's answer, if asked."""
        self._command: Command | None = None
        self._period: int | None = None

    def prepare(self, period: int) -> None:
        """See `scenarios.bench.race.Entrant.prepare`; keeps what was answered last."""
        self.keep()
        self._period = period
        queries = self._queries
        self._controller.reset(queries.speeds_before[period])
        reference = queries.reference[period + 1 : period + 1 + self.problem.horizon]
        self._query = (Moment(time=float(queries.t[period])), queries.state[period], reference)
        self._command, self.solver.last = None, None

    def answer(self) -> None:
        """See `scenarios.bench.race.Entrant.answer`."""
        try:
            self._command = self._controller.step(*self._query)
        except FlightError:  # there is no earlier plan to hold: the solver failed
            self._command = None

    def keep(self) -> None:
        """Keep the last answer, if it is the first to its question."""
        if self._period is not None:
            self.answers.setdefault(self._period, (self._command, self.solver.last))

    def shortcuts(self, periods: Sequence[int]) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
        """Which periods were answered by the shortcut."""
        self.keep()
        commands = [self.answers[period][0] for period in periods]
        return np.array([command is not None and command.status == UNCONSTRAINED for command in commands])

    def failures(self, periods: Sequence[int]) -> int:
        """How many periods were left without their optimum."""
        self.keep()
        commands = [self.answers[period][0] for period in periods]
        return sum(command is None or command.status not in ACCEPTED for command in commands)


@dataclass(frozen=True, kw_only=True)
class Reference:
    """The optimum of each period's QP, in closed form.

    Attributes:
        inputs: first input u(k) (4,) by period [rad/s].
        kkt: worst KKT residual of them all.
    """

    inputs: Mapping[int, Array]
    kkt: float


def reference_optima(problem: Problem, queries: Queries, periods: Sequence[int]) -> Reference:
    """Solve the periods' QPs in closed form; see `mpc.polish`."""
    formulation, backend = condensed(problem), make_backend(REFERENCE_SOLVER)
    backend.setup(formulation.qp)
    inputs, worst = {}, 0.0
    for period in periods:
        vectors = formulation.vectors(*_query(problem, queries, period))
        qp = formulation.qp.with_vectors(vectors)
        optimum = polish(qp, backend.solve(vectors))
        worst = float(np.maximum(worst, kkt_residuals(qp, optimum).worst))  # NaN stays NaN
        inputs[period] = formulation.inputs(optimum.x)[0]
    return Reference(inputs=inputs, kkt=worst)


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """What an entrant's answers were worth; see `quadsim.bench.Contender`."""

    statuses: dict[str, int]
    failures: int
    input_error: float | None
    kkt: float | None


def judge(entrant: StepEntrant, queries: Queries, periods: Sequence[int], reference: Reference) -> Verdict:
    """Hold the answers of an entrant's first pass against the optimum, and against the KKT conditions of its own QP."""
    entrant.keep()
    problem, formulation, plain = entrant.problem, entrant.solver.formulation, condensed(entrant.problem)
    statuses: Counter[str] = Counter()
    errors, residuals = [], []
    for period in periods:
        command, answer = entrant.answers[period]
        if command is None or command.status not in ACCEPTED:
            statuses[_failure(answer)] += 1
            continue
        statuses[command.status] += 1
        errors.append(np.abs(command.speeds - reference.inputs[period]).max())
        if command.status == UNCONSTRAINED:
            qp = plain.qp.with_vectors(plain.vectors(*_query(problem, queries, period)))
            residuals.append(kkt_residuals(qp, _without_multipliers(qp, command.plan)).worst)
        else:
            assert answer is not None  # or there would be no command
            qp = formulation.qp.with_vectors(formulation.vectors(*_query(problem, queries, period)))
            residuals.append(kkt_residuals(qp, answer.solution).worst)
    return Verdict(
        statuses=dict(sorted(statuses.items())),
        failures=len(periods) - len(errors),
        input_error=float(np.max(errors)) if errors else None,
        kkt=float(np.max(residuals)) if residuals else None,
    )


def _query(problem: Problem, queries: Queries, period: int) -> tuple[Array, Array, Array]:
    """xi(k), y_d and u(k-1)."""
    reference = queries.reference[period + 1 : period + 1 + problem.horizon]
    return queries.state[period], problem.objective.desired(reference), queries.speeds_before[period]


def _without_multipliers(qp: QP, plan: Array) -> Solution:
    """An unconstrained optimum as a solution of the condensed QP."""
    return Solution(
        x=plan.ravel(),
        y=np.zeros_like(qp.b),
        z=np.zeros_like(qp.h_l),
        z_box=np.zeros_like(qp.c),
        status=UNCONSTRAINED,
        iterations=0,
        active=0,
        primal_residual=0.0,
        dual_residual=0.0,
        solve_s=0.0,
    )


def _failure(answer: Answer | None) -> str:
    """Why there was no command; a point that is called solved is rejected where it breaks the hard input bounds."""
    assert answer is not None  # the solver was asked, or there would be a command
    return "rejected" if answer.solution.status == SOLVED else answer.solution.status
