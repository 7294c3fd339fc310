"""What came of a tuning, as plain data: the search, the fresh flights, and how optimistic the one was of the other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import pyarrow as pa

from quadsim.state import Array
from scenarios.campaign.plan import cell
from scenarios.campaign.statistics.comparison import compare_events
from scenarios.campaign.statistics.inference import paired_difference
from scenarios.campaign.statistics.requirement import judge
from scenarios.schema.scenario import Scenario
from scenarios.tuning.objective import STATISTICS
from scenarios.tuning.ranking import Score, objective_values
from scenarios.tuning.spec import START

if TYPE_CHECKING:
    from scenarios.tuning.plan import TuningPlan, Values

NAMES: Final = ("start", "best")  # what the two are called that fly fresh draws


@dataclass(frozen=True, kw_only=True)
class Found:
    """What a search found."""

    scores: Sequence[Score]  # of all candidates, by their numbers
    candidates: Mapping[int, Values]  # and their values
    answer: Score
    front: Sequence[Score]  # the Pareto front, by the first objective; of one objective, the best
    importance: Sequence[Mapping[str, float]]  # of each objective: shares of the searched fields, by name
    best: Scenario  # the answer


def summarise(plan: TuningPlan, found: Found, start: pa.Table, best: pa.Table) -> dict[str, Any]:
    """`summary.json`.

    Args:
        plan: the tuning.
        found: by its search.
        start: the fresh flights of the start.
        best: those of the answer; the same where that is the start.
    """
    at_start = next(each for each in found.scores if each.candidate == START)
    fresh = [objective_values(plan, table.to_pylist()) for table in (start, best)]
    event = plan.requirement.event
    compared = compare_events({event.text: (event.column(start), event.column(best))})[0]
    count_start, count_best = compared.counts
    sentence = f"{compared.event} in {count_best} of {compared.pairs} flights, and in {count_start} of the start's"
    start_shown, best_shown = _shown(plan, {}), _shown(plan, found.candidates[found.answer.candidate])
    objectives = [
        {
            **objective.model_dump(),
            "start": at_start.values[i],
            "best": found.answer.values[i],
            **_gain(at_start.values[i], found.answer.values[i], fresh[0][:, i], fresh[1][:, i], objective.statistic),
        }
        for i, objective in enumerate(plan.spec.objectives)
    ]
    return {
        "tuning": plan.spec.name,
        "description": plan.spec.description,
        "scenario": plan.scenario.name,
        "require": plan.requirement.text,
        "counted": f"P({plan.guard.text}) {plan.requirement.operation} {plan.requirement.share:g}",
        "answer": found.answer.candidate,
        "trials": len(found.scores) - 1,
        "search_flights": sum(each.flights for each in found.scores),
        "draws": plan.most,
        "search": [
            {**entry.model_dump(), "start": start_shown[entry.name], "best": best_shown[entry.name]}
            for entry in plan.spec.search
        ],
        "objectives": objectives,
        "fresh": {
            name: {"flights": table.num_rows, "requirement": judge(table, plan.requirement).to_json()}
            for name, table in zip(NAMES, (start, best), strict=True)
        },
        "event": asdict(compared) | {"sentence": sentence},
        "front": [each.candidate for each in found.front],
        "importance": {
            objective.name: dict(shares)
            for objective, shares in zip(plan.spec.objectives, found.importance, strict=True)
        },
        "candidates": [
            {**asdict(each), "feasible": each.feasible, "search": _shown(plan, found.candidates[each.candidate])}
            for each in found.scores
        ],
    }


def _gain(search_start: float, search_best: float, start: Array, best: Array, statistic: str) -> dict[str, Any]:
    """An objective on the draws that chose the answer, on fresh ones, and what the first promised too much.

    All differences are the best's less the start's, as shares of the start's; negative is better.
    """
    both = np.isfinite(start) & np.isfinite(best)
    if not both.any():
        return {"fresh_start": None, "fresh_best": None, "promised": None, "kept": None, "optimism": None, "pairs": 0}
    of = STATISTICS[statistic]
    fresh_start, fresh_best = of(start[both]), of(best[both])
    paired = paired_difference(start[both], best[both])
    promised = (search_best - search_start) / abs(search_start) if search_start else None
    confirmed = (fresh_best - fresh_start) / abs(fresh_start) if fresh_start else None
    return {
        "fresh_start": fresh_start,
        "fresh_best": fresh_best,
        "pairs": int(both.sum()),
        "mean_difference": paired.mean,
        "lower": paired.lower,
        "upper": paired.upper,
        "promised": promised,
        "kept": confirmed,
        "optimism": None if promised is None or confirmed is None else confirmed - promised,
    }


def _shown(plan: TuningPlan, values: Values) -> dict[str, Any]:
    """The searched values of a candidate, as a table has them; None where the start has none."""
    own = values or plan.start_values
    return {entry.name: cell(own[entry.name]) if entry.name in own else None for entry in plan.spec.search}
