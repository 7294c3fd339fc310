"""How many steps make a stage: the QP in its forms, by PIQP alone."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Final

import numpy as np

from mpc.ocp import Problem
from mpc.paper.condensed import condensed
from mpc.qp import Backend, Formulation, Vectors
from mpc.solvers.piqp_dense import PiqpDense
from mpc.solvers.piqp_sparse import PiqpMultistage
from mpc.staged import Staged, usual_steps
from quadsim.state import Array
from scenarios.bench.bench_results import StageLength
from scenarios.bench.queries import Queries
from scenarios.bench.timing import StepTimes
from scenarios.progress import Progress

STEPS_TRIED: Final = (1, 2, 3, 4, 5, 6, 8, 10, 13, 17, 20, 25)

Query = tuple[Array, Array, Array]  # xi(k), y_d and u(k-1)


def time_stages(
    problem: Problem,
    queries: Queries,
    asked: Sequence[range],
    race: Callable[..., dict[str, StepTimes]],
    progress: Progress,
) -> tuple[StageLength, ...]:
    """The QP condensed and cut into stages of M steps, on the periods in which constraints are active."""
    default = usual_steps(problem.model.nu)

    def query(period: int) -> Query:
        reference = queries.reference[period + 1 : period + 1 + problem.horizon]
        return queries.state[period], problem.objective.desired(reference), queries.speeds_before[period]

    candidates: dict[int | None, _QPEntrant] = {None: _QPEntrant(condensed(problem), PiqpDense(), query)}
    for length in sorted({*STEPS_TRIED, default}):
        candidates[length] = _QPEntrant(Staged(problem, steps_per_stage=length), PiqpMultistage(), query)
    named = {str(steps): candidate for steps, candidate in candidates.items()}
    laps = race(named, asked, progress=partial(progress, "stages"))
    found_active = candidates[default].active
    active = np.array([found_active[period] > 0 for segment in asked for period in segment])
    counted = active if active.any() else np.ones_like(active)
    found = []
    for steps, candidate in candidates.items():
        p50, p99 = np.percentile(laps[str(steps)].median[counted], [50, 99])
        size = candidate.formulation.qp.c.size
        found.append(StageLength(steps=steps, variables=size, p50=float(p50), p99=float(p99), default=steps == default))
    return tuple(found)


class _QPEntrant:
    """A form of the QP with its back end, without a controller around it."""

    def __init__(self, formulation: Formulation, backend: Backend, query: Callable[[int], Query]) -> None:
        self.formulation, self._backend, self._query = formulation, backend, query
        self.active: dict[int, int] = {}  # constraints active in the answer, by period
        backend.setup(formulation.qp)

    def prepare(self, period: int) -> None:
        """See `scenarios.bench.timing.Candidate.prepare`."""
        self._period = period
        self._vectors: Vectors = self.formulation.vectors(*self._query(period))

    def answer(self) -> None:
        """See `scenarios.bench.timing.Candidate.answer`."""
        self.active[self._period] = self._backend.solve(self._vectors).active
