"""The search: Optuna proposes candidates and prunes them on shared draws."""

from __future__ import annotations

import time as clock
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import pyarrow as pa

from quadsim.errors import InputError, MissingPackageError
from quadsim.outputs import Growing
from quadsim.state import Array
from scenarios.campaign.campaign_file import Choice, Integer, LogUniform, Value
from scenarios.campaign.store import Store
from scenarios.many import Row
from scenarios.tuning.tuning_plan import START, Searched, SearchPlan, TuningPlan, Values

if TYPE_CHECKING:
    from optuna.trial import Trial

JOURNAL_FILE: Final = "journal.log"


def require_optuna() -> Any:
    """Return Optuna, or raise MissingPackageError."""
    try:
        import optuna
    except ModuleNotFoundError as error:
        raise MissingPackageError("a tuning", "optuna", extra="tune") from error
    return optuna


@dataclass(frozen=True, kw_only=True)
class Score:
    """The results of a candidate's flights."""

    candidate: int
    flights: int  # that it flew
    count: int  # of them, those with the event that counts
    values: tuple[float, ...]  # of the objectives; empty where no flight has them all
    excess: float  # share of flights with the event, less what is allowed; 1 where there are no values

    @property
    def feasible(self) -> bool:
        """Whether the share of flights with the event is within the allowed share."""
        return self.excess <= 0.0


class Search:
    """The study and the flights of its candidates: trial n is candidate n, and trial 0 the start."""

    def __init__(self, plan: TuningPlan, files: Growing, watch: Callable[..., None], **where: Any) -> None:
        optuna = require_optuna()
        self._plan, self._watch, self._where, self._started = plan, watch, where, clock.perf_counter()
        self.candidates: dict[int, Values] = {START: {}}
        self.scores: dict[int, Score] = {}
        self._flights = SearchPlan(plan.start.spec, plan.start.scenario, tuning=plan, candidates=self.candidates)
        self._store = Store(files, self._flights.schema)
        self._rows: dict[int, Row] = {row["flight"]: row for row in self._store.table().to_pylist()}
        self._flown = self._spared = 0  # flights: now, and those that stopped candidates left out
        journal, file = optuna.storages.journal, str(files.path / JOURNAL_FILE)
        storage = journal.JournalFileBackend(file, journal.JournalFileOpenLock(file))
        self.study = optuna.create_study(
            storage=optuna.storages.JournalStorage(storage),
            study_name=plan.spec.name,
            directions=["minimize"] * len(plan.spec.objectives),
            sampler=optuna.samplers.TPESampler(
                seed=int(np.random.SeedSequence(plan.spec.seed).generate_state(1)[0]),
                multivariate=True,
                constant_liar=True,
                n_startup_trials=plan.spec.batch,
            ),
            pruner=optuna.pruners.WilcoxonPruner(),
        )
        self._space = {entry.name: _distribution(optuna.distributions, entry) for entry in plan.spec.search}

    def run(self) -> pa.Table:
        """Fly the start, then all batches; return the table of their flights."""
        plan = self._plan
        self._fly_missing([START], plan.most)
        if all(_contains(entry, plan.start_values.get(entry.name)) for entry in plan.spec.search):
            self.study.enqueue_trial(dict(plan.start_values))
            self._judge([self.study.ask(self._space)])
        else:  # no trial of this search, which numbers its candidates from 1
            self._judge([self.study.ask()])
        for _ in range(0, plan.spec.trials, plan.spec.batch):
            trials = [self.study.ask(self._space) for _ in range(plan.spec.batch)]
            self.candidates.update((trial.number, trial.params) for trial in trials)
            self._judge(trials)
        return self._store.close(max(self._rows) + 1)

    def _judge(self, trials: Sequence[Trial]) -> None:
        """Fly a few draws of all trials, continue those not worse than the best, then report all to Optuna."""
        going = list(trials)
        for flights in self._plan.spec.flights:
            self._fly_missing([trial.number for trial in going], flights)
            going = [trial for trial in going if self._goes_on(trial, flights)]
        states = require_optuna().trial.TrialState
        for trial in trials:
            score = self.scores[trial.number]
            self._spared += self._plan.most - score.flights
            trial.set_constraint("failures", score.excess)
            state = states.FAIL if not trial.params else None if score.values else states.PRUNED
            self.study.tell(trial, score.values if state is None else None, state=state)

    def _goes_on(self, trial: Trial, flights: int) -> bool:
        """Return whether a trial continues: it can still meet the requirement, and the pruner agrees."""
        rows = self._first(trial.number, flights)
        score = self.scores[trial.number] = self._score(trial.number, rows)
        if score.count > self._plan.requirement.share * self._plan.most:
            return False
        if len(score.values) > 1:  # of several objectives Optuna prunes none
            return True
        for draw, (value,) in enumerate(self._plan.objectives(rows)):
            if np.isfinite(value):
                trial.report(float(value), draw)  # which leaves alone what it was told before
        return not trial.should_prune()

    def _score(self, candidate: int, rows: Sequence[Row]) -> Score:
        """Return the start's mean over all draws, plus a candidate's mean difference on draws that both completed.

        So a candidate that flew only few, easy draws gains no advantage, and hard draws are no disadvantage.
        """
        values, start = self._plan.objectives(rows), self._plan.objectives(self._first(START, self._plan.most))
        whole, met = (np.asarray(np.isfinite(objectives).all(axis=1)) for objectives in (values, start))
        both = whole & met[: len(rows)]
        means: Array = values[whole].mean(axis=0) if whole.any() else np.empty(0)
        if both.any():
            means = start[met].mean(axis=0) + (values - start[: len(rows)])[both].mean(axis=0)
        count = sum(self._plan.guard.holds(row) for row in rows)
        return Score(
            candidate=candidate,
            flights=len(rows),
            count=count,
            values=tuple(means.tolist()),
            excess=count / len(rows) - self._plan.requirement.share if means.size else 1.0,
        )

    def _first(self, candidate: int, flights: int) -> list[Row]:
        return [self._rows[candidate * self._plan.most + draw] for draw in range(flights)]

    def _fly_missing(self, candidates: Sequence[int], flights: int) -> None:
        """Fly the first draws of candidates, except those already flown.

        Raises:
            InputError: some were flown with other values.
        """
        plan, most = self._flights, self._plan.most
        numbers = [candidate * most + draw for candidate in candidates for draw in range(flights)]
        if any(plan.identity(n).items() - self._rows[n].items() for n in numbers if n in self._rows):
            raise InputError("--resume needs the candidates that flew there, and other ones were proposed")
        missing = [number for number in numbers if number not in self._rows]
        if not missing:
            return
        try:
            with closing(plan.fly_all(missing, **self._where)) as rows:
                for row in rows:
                    self._store.add(row)
                    self._rows[row["flight"]] = row
                    self._flown += 1
                    flights = most * (1 + self._plan.spec.trials) - self._spared
                    failed = sum(bool(row["failed"]) for row in self._rows.values())
                    rate = self._flown / max(clock.perf_counter() - self._started, 1e-9)
                    self._watch(flown=len(self._rows), flights=flights, failed=failed, rate=rate)
        finally:
            self._store.flush()

    def answer(self) -> tuple[int, list[int]]:
        """Return the chosen candidate and the Pareto front by its first objective; for one objective, the best.

        The answer is the point of the front nearest to the best of each objective, as a share of its range, among those
        that are no worse than the start in any.  Where no candidate is feasible, it is the one that fails least.
        """
        scores, start = self.scores, self.scores[START]
        whole = [score for score in scores.values() if score.feasible and score.flights == self._plan.most]
        points = {score.values for score in whole}
        best = [p for p in points if not any(other != p and np.less_equal(other, p).all() for other in points)]
        front = [score.candidate for score in sorted(whole, key=lambda score: score.values) if score.values in best]
        if not front:
            least = min(
                scores.values(), key=lambda score: (score.excess, -score.flights, score.values, score.candidate)
            )
            return least.candidate, []
        values = np.array([scores[candidate].values for candidate in front])
        distances = np.linalg.norm((values - values.min(axis=0)) / np.maximum(np.ptp(values, axis=0), 1e-300), axis=1)
        near = [front[i] for i in np.argsort(distances, kind="stable")]
        if not start.feasible:
            return near[0], front
        return next((c for c in near if np.less_equal(scores[c].values, start.values).all()), START), front


def _distribution(kinds: Any, entry: Searched) -> Any:
    match entry:
        case Choice():
            return kinds.CategoricalDistribution(entry.values)
        case Integer():
            return kinds.IntDistribution(entry.low, entry.high)
    return kinds.FloatDistribution(entry.low, entry.high, log=isinstance(entry, LogUniform))


def _contains(entry: Searched, value: Value | None) -> bool:
    if isinstance(entry, Choice):
        return value in entry.values
    return isinstance(value, int | float) and entry.low <= value <= entry.high
