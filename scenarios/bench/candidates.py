"""The controllers that take part in `quadsim bench solvers`, and what they answered."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, Final, NamedTuple

import numpy as np

from mpc.constrained import ConstrainedMPC
from mpc.exact.shortcut import with_shortcut
from mpc.ocp import Problem, Query
from mpc.paper.condensed import Condensed
from mpc.qp import Backend, Formulation, kkt_residuals
from mpc.solvers import SOLVERS, Answer, QPSolver, Solver, make_backend
from mpc.solvers.piqp_backends import PiqpDense, PiqpMultistage
from mpc.staged import Staged, usual_steps
from quadsim.controller import ACCEPTED, Command
from quadsim.state import Array
from scenarios.bench.bench_results import StageLength
from scenarios.bench.polish import polish
from scenarios.bench.queries import QueriedController, Queries
from scenarios.bench.timing import StepTimes
from scenarios.progress import Progress

WITH_SHORTCUT: Final = ("daqp",)  # solvers that are shown both with and without shortcuts, besides the default
REFERENCE_SOLVER: Final = "piqp-dense"  # where the search for the optimum in closed form starts
STEPS_TRIED: Final = (1, 2, 3, 4, 5, 6, 8, 10, 13, 17, 20, 25)


class Entry(NamedTuple):
    """One candidate: a solver, with or without the shortcuts of `mpc.exact.shortcut`."""

    solver: str
    shortcut: bool

    @property
    def name(self) -> str:
        """What it is called."""
        return f"{self.solver} + shortcut" if self.shortcut else self.solver


def entries(default: Entry, solvers: Sequence[str]) -> list[Entry]:
    """The default first, then each installed solver alone, then those that are shown with shortcuts as well."""
    installed = [name for name in solvers if SOLVERS[name].installed]
    alone = [Entry(solver=name, shortcut=False) for name in installed]
    both = [Entry(solver=name, shortcut=True) for name in installed if name in WITH_SHORTCUT]
    return [default, *(entry for entry in (*alone, *both) if entry != default)]


class _Witnessed:
    """A solver, see `mpc.solvers.Solver`, whose last answer can be looked at."""

    def __init__(self, solver: Solver) -> None:
        self.name, self.formulation, self.reset = solver.name, solver.formulation, solver.reset
        self._solve = solver.solve
        self.last: Answer | None = None

    def solve(self, query: Query) -> Answer:
        self.last = self._solve(query)
        return self.last


class StepCandidate:
    """A constrained controller that is given a flight's queries, and whose solver's answers are recorded."""

    def __init__(self, entry: Entry, problem: Problem, queries: Queries) -> None:
        self.entry, self.problem = entry, problem
        whole = QPSolver(entry.solver, problem)
        self._solver = _Witnessed(with_shortcut(problem, whole) if entry.shortcut else whole)
        self.formulation = self._solver.formulation
        self._queried = QueriedController(ConstrainedMPC(problem, self._solver, shortcut=False), queries)
        self.answers: dict[int, tuple[Command | None, Answer]] = {}
        """What was answered in the first pass, by period: the command, if any, and the solver's answer."""
        self._period: int | None = None

    def prepare(self, period: int) -> None:
        """See `scenarios.bench.timing.Candidate.prepare`; keeps what was answered last."""
        self.keep()
        self._period, self._solver.last = period, None
        self._queried.prepare(period)

    def answer(self) -> None:
        """See `scenarios.bench.timing.Candidate.answer`."""
        self._queried.answer()

    def keep(self) -> None:
        """Keep the last answer, if it is the first to its question."""
        if self._period is not None and self._solver.last is not None:
            self.answers.setdefault(self._period, (self._queried.command, self._solver.last))

    def ways(self, periods: Sequence[int]) -> np.ndarray[tuple[int], np.dtype[np.object_]]:
        """The `mpc.solvers.Method` in which each period was answered."""
        self.keep()
        return np.array([self.answers[period][1].method for period in periods], dtype=object)

    def statuses(self, periods: Sequence[int]) -> tuple[str, ...]:
        """What each period was answered."""
        self.keep()
        return tuple(self._queried.statuses[period] for period in periods)


class Reference(NamedTuple):
    """The optimum of each period's QP, in closed form."""

    inputs: Mapping[int, Array]  # first input u(k) (4,) by period [rad/s]
    kkt: float  # worst KKT residual of them all


def reference_optima(problem: Problem, queries: Queries, periods: Sequence[int]) -> Reference:
    """Solve the periods' QPs in closed form; see `scenarios.bench.polish`."""
    formulation, backend = Condensed(problem), make_backend(REFERENCE_SOLVER)
    backend.setup(formulation.qp)
    inputs, worst = {}, 0.0
    for period in periods:
        qp = formulation.pose(queries.of_qp(problem, period)).qp
        optimum = polish(qp, backend.solve(qp))
        worst = float(np.maximum(worst, kkt_residuals(qp, optimum).worst))  # NaN stays NaN
        inputs[period] = formulation.inputs(optimum.x)[0]
    return Reference(inputs=inputs, kkt=worst)


def judge(candidate: StepCandidate, queries: Queries, periods: Sequence[int], reference: Reference) -> dict[str, Any]:
    """Hold the answers of an entrant's first pass against the optimum, and against the KKT conditions of its own QP.

    Fields of `scenarios.bench.bench_results.CandidateResult`: `statuses`, `ways`, `failures`, `input_error` and `kkt`.
    """
    candidate.keep()
    statuses: Counter[str] = Counter()
    errors, residuals = [], []
    for period in periods:
        command, answer = candidate.answers[period]
        if command is None or command.status not in ACCEPTED:
            # a point that is called solved is rejected where it breaks the hard input bounds
            statuses["rejected" if answer.status in ACCEPTED else answer.status] += 1
            continue
        statuses[command.status] += 1
        errors.append(np.abs(command.speeds - reference.inputs[period]).max())
        assert answer.certificate is not None
        residuals.append(kkt_residuals(*answer.certificate()).worst)
    return {
        "statuses": dict(sorted(statuses.items())),
        "ways": dict(Counter(map(str, candidate.ways(periods)))),
        "failures": len(periods) - len(errors),
        "input_error": float(np.max(errors)) if errors else None,
        "kkt": float(np.max(residuals)) if residuals else None,
    }


def time_stages(
    problem: Problem,
    queries: Queries,
    timed: Sequence[range],
    race: Callable[..., dict[str, StepTimes]],
    progress: Progress,
) -> tuple[StageLength, ...]:
    """The QP condensed and cut into stages of M steps, on the periods in which constraints are active."""
    default, query = usual_steps(problem.model.nu), partial(queries.of_qp, problem)
    candidates = {"condensed": _QPEntrant(Condensed(problem), PiqpDense(), query)}
    for length in sorted({*STEPS_TRIED, default}):
        candidates[str(length)] = _QPEntrant(Staged(problem, steps_per_stage=length), PiqpMultistage(), query)
    laps = race(candidates, timed, progress=partial(progress, "stages"))
    found_active = candidates[str(default)].active
    active = np.array([found_active[period] > 0 for segment in timed for period in segment])
    counted = active if active.any() else np.ones_like(active)
    found = []
    for name, candidate in candidates.items():
        p50, p99 = np.percentile(laps[name].median[counted], [50, 99])
        found.append(
            StageLength(
                steps=int(name) if name.isdigit() else None,
                variables=candidate.formulation.qp.c.size,
                p50=float(p50),
                p99=float(p99),
                default=name == str(default),
            )
        )
    return tuple(found)


class _QPEntrant:
    """A form of the QP with its back end, without a controller around it."""

    def __init__(self, formulation: Formulation, backend: Backend, query: Callable[[int], Query]) -> None:
        self.formulation, self._backend, self._query = formulation, backend, query
        self.active: dict[int, int] = {}  # constraints active in the answer, by period
        backend.setup(formulation.qp)

    def prepare(self, period: int) -> None:
        self._period = period
        self._qp = self.formulation.pose(self._query(period)).qp

    def answer(self) -> None:
        self.active[self._period] = self._backend.solve(self._qp).active
