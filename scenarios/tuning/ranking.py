"""Which of several candidates is better, from the flights that each has flown.

Candidates meet the same draws, but not all fly as many.  So that few flights do not count against, or for, a candidate
which happened to fly the hard ones, its objectives are corrected by what the start did on the same draws:
its statistic there, less the start's there, plus the start's over all draws (a control variate).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from quadsim.state import Array
from scenarios.campaign.results.events import Flags
from scenarios.campaign.results.table import Row
from scenarios.tuning.objective import STATISTICS
from scenarios.tuning.spec import START

if TYPE_CHECKING:
    from scenarios.tuning.plan import TuningPlan

UNKNOWN: Final = 1e9  # an objective of a candidate that completed no flight


@dataclass(frozen=True, kw_only=True)
class Score:
    """The results of a candidate's flights."""

    candidate: int
    flights: int  # that it flew
    count: int  # of them, those with the event that counts
    completed: int  # of them, those that were completed and have every objective
    values: tuple[float, ...]  # of the objectives, corrected for the draws that it did not meet
    excess: float  # share of flights with the event, less what is allowed; 1 where no flight was completed

    @property
    def feasible(self) -> bool:
        """Whether no larger share of its flights has the event than is allowed."""
        return self.excess <= 0.0


def score(plan: TuningPlan, rows: Mapping[int, Sequence[Row]], candidate: int) -> Score:
    """The score of a candidate.

    Args:
        plan: the tuning.
        rows: of each candidate, those of its flights on the first draws, in their order; of the start, on all draws.
        candidate: which.
    """
    own, start = rows[candidate], rows[START]
    happened = sum(plan.guard.holds(row) for row in own)
    found = objective_values(plan, own)
    whole: Flags = np.asarray(np.isfinite(found).all(axis=1))
    values = (UNKNOWN,) * len(plan.expressions)
    if whole.any():
        reference = objective_values(plan, start)
        met: Flags = np.asarray(np.isfinite(reference).all(axis=1))
        there = reference[: len(own)]
        both = whole & met[: len(own)]
        statistics = [STATISTICS[objective.statistic] for objective in plan.spec.objectives]
        values = tuple(
            statistic(found[both, i]) - statistic(there[both, i]) + statistic(reference[met, i])
            if both.any()
            else statistic(found[whole, i])
            for i, statistic in enumerate(statistics)
        )
    return Score(
        candidate=candidate,
        flights=len(own),
        count=happened,
        completed=int(whole.sum()),
        values=values,
        excess=happened / len(own) - plan.requirement.share if whole.any() else 1.0,
    )


def objective_values(plan: TuningPlan, rows: Sequence[Mapping[str, Any]]) -> Array:
    """(flights, objectives) of some flights; NaN for one that was not completed."""
    found = [
        [expression.value(row) if row["status"] == "completed" else np.nan for expression in plan.expressions]
        for row in rows
    ]
    return np.asarray(found, float).reshape(len(rows), len(plan.expressions))


def ranked(scores: Sequence[Score]) -> list[Score]:
    """Candidates, the best first.

    Feasible ones come before others, which follow by how often they fail.  Of feasible ones, those that no other is
    better than in every objective come first, and so on; within such a front, those near the ideal point.
    """
    feasible = [each for each in scores if each.feasible]
    values = np.array([each.values for each in feasible]).reshape(len(feasible), len(scores[0].values))
    numbers = np.array([each.candidate for each in feasible], int)
    order = np.lexsort((numbers, distances(values), fronts(values)))
    others = sorted((each for each in scores if not each.feasible), key=lambda each: (each.excess, each.values))
    return [*(feasible[i] for i in order), *others]


def fronts(values: Array) -> Array:
    """(K,) the front of each of (K, m) points: 0 for the Pareto front, 1 for that of the rest, and so on."""
    found = np.full(len(values), -1)
    front = 0
    while (found < 0).any():
        left = np.flatnonzero(found < 0)
        beaten = [
            bool(((values[left] <= values[i]).all(axis=1) & (values[left] < values[i]).any(axis=1)).any()) for i in left
        ]
        found[left[~np.array(beaten)]] = front
        front += 1
    return found


def distances(values: Array) -> Array:
    """(K,) of (K, m) points to the ideal one, the best of each objective, each as a share of its range."""
    if not len(values):
        return np.empty(0)
    low, high = values.min(axis=0), values.max(axis=0)
    found: Array = np.linalg.norm((values - low) / np.where(high > low, high - low, 1.0), axis=1)
    return found


def pareto(plan: TuningPlan, scores: Sequence[Score]) -> list[Score]:
    """The feasible candidates of all draws that no other one of these is better than, by their first objective."""
    whole = [each for each in scores if each.feasible and each.flights == plan.most]
    if not whole:
        return []
    first = fronts(np.array([each.values for each in whole])) == 0
    return sorted((each for each, on in zip(whole, first, strict=True) if on), key=lambda each: each.values)


def answer(plan: TuningPlan, scores: Sequence[Score]) -> Score:
    """The candidate that is the answer: of the Pareto front the one nearest to the ideal point.

    Where any of it are no worse than the start in every objective, it is one of those.  Where no candidate is feasible,
    it is the one of all draws that fails least.
    """
    front = pareto(plan, scores)
    if not front:
        return ranked([each for each in scores if each.flights == plan.most])[0]
    start = next(each for each in scores if each.candidate == START)
    no_worse = [
        each for each in front if start.feasible and all(a <= b for a, b in zip(each.values, start.values, strict=True))
    ]
    near = distances(np.array([each.values for each in front]))
    allowed = {each.candidate for each in no_worse or front}
    return min(
        (
            (distance, each.candidate, each)
            for distance, each in zip(near, front, strict=True)
            if each.candidate in allowed
        )
    )[2]
