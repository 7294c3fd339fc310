"""The search: Optuna proposes candidates, and stops them on draws that all of them share."""

from __future__ import annotations

import time as clock
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import closing
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import pyarrow as pa

from quadsim.errors import InputError, MissingPackageError
from quadsim.outputs import Growing
from scenarios.campaign.pilot import CampaignPilot
from scenarios.campaign.plan import cell
from scenarios.campaign.results.store import Store
from scenarios.campaign.results.table import Row
from scenarios.campaign.spec import ChoiceSpec, IntegerSpec, LogUniformSpec, Value
from scenarios.many import ERROR
from scenarios.tuning.objective import Score, objective_values, score
from scenarios.tuning.plan import START, TuningPlan, Values
from scenarios.tuning.spec import SearchSpec

if TYPE_CHECKING:
    from optuna.trial import Trial

JOURNAL_FILE: Final = "journal.log"


def require_optuna() -> Any:
    """Optuna.

    Raises:
        MissingPackageError: it is not installed.
    """
    try:
        import optuna
    except ModuleNotFoundError as error:
        raise MissingPackageError("a tuning", "optuna", extra="tune") from error
    return optuna


class TuningPilot:
    """Flies candidates on draws that all share; flight c * `TuningPlan.most` + i is that of candidate c on draw i.

    See `scenarios.campaign.pilot.Pilot`.
    """

    def __init__(self, tuning: TuningPlan, candidates: Mapping[int, Values]) -> None:
        self.plan, self._tuning, self._candidates = tuning.start, tuning, candidates
        self._pilots: dict[int, CampaignPilot] = {}  # made where they fly

    def fly(self, flight: int) -> Row:
        """The row of a flight; a candidate that is no scenario fails it."""
        candidate, draw = divmod(flight, self._tuning.most)
        try:
            if candidate not in self._pilots:
                self._pilots[candidate] = CampaignPilot(self._tuning.of(self._candidates[candidate]))
        except InputError as error:
            return self.failed(flight, str(error), ERROR)
        return {**self._pilots[candidate].fly(draw), **self.identity(flight)}

    def failed(self, flight: int, reason: str, verdict: str) -> Row:
        """The row of a flight that raised, met a limit, or whose process died."""
        row = CampaignPilot(self.plan).failed(flight % self._tuning.most, reason, verdict)
        return {**row, **self.identity(flight)}

    def identity(self, flight: int) -> Row:
        """The columns that identify a flight of the search."""
        candidate = flight // self._tuning.most
        values = self._tuning.shown(self._candidates[candidate])
        return {"flight": flight, "candidate": candidate, **{f"search.{name}": each for name, each in values.items()}}


class Search:
    """The study and the flights of its candidates: trial n is candidate n, and trial 0 the start."""

    def __init__(
        self, plan: TuningPlan, files: Growing, fly: Callable[..., Generator[Row]], watch: Callable[..., None]
    ) -> None:
        optuna = require_optuna()
        self._plan, self._fly, self._watch, self._started = plan, fly, watch, clock.perf_counter()
        self._store = Store(files, plan.schema)
        self._rows: dict[int, Row] = {row["flight"]: row for row in self._store.table().to_pylist()}
        self._flown = self._spared = 0  # flights: now, and those that stopped candidates left out
        self.candidates: dict[int, Values] = {START: {}}
        self.scores: dict[int, Score] = {}
        journal, file = optuna.storages.journal, str(files.path / JOURNAL_FILE)
        storage = journal.JournalFileBackend(file, journal.JournalFileOpenLock(file))
        self.study = optuna.create_study(
            storage=optuna.storages.JournalStorage(storage),
            study_name=plan.spec.name,
            directions=["minimize"] * len(plan.expressions),
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
        """Fly the start, then all batches; the table of their flights."""
        plan = self._plan
        self._fly_missing([START], plan.most)
        if all(_contains(entry, plan.start_values.get(entry.name)) for entry in plan.spec.search):
            self.study.enqueue_trial(plan.shown({}))
            self._judge([self.study.ask(self._space)])
        else:  # no trial of this search, which numbers its candidates from 1
            self.study.add_trial(require_optuna().trial.create_trial(state=require_optuna().trial.TrialState.FAIL))
            self._score(START, plan.most)
        for _ in range(0, plan.spec.trials, plan.spec.batch):
            trials = [self.study.ask(self._space) for _ in range(plan.spec.batch)]
            self.candidates |= {trial.number: self._values(trial) for trial in trials}
            self._judge(trials)
        return self._store.close(max(self._rows) + 1)

    def _judge(self, trials: Sequence[Trial]) -> None:
        """All trials fly a few draws, those that are not worse than the best go on to more; then all are told."""
        going, before = list(trials), 0
        for flights in self._plan.spec.flights:
            self._fly_missing([trial.number for trial in going], flights)
            going = [trial for trial in going if self._goes_on(trial, before, flights)]
            before = flights
        for trial in trials:
            found = self.scores[trial.number]
            self._spared += self._plan.most - found.flights
            trial.set_constraint("failures", found.excess)
            pruned = require_optuna().trial.TrialState.PRUNED  # where no flight has all objectives
            self.study.tell(trial, found.values or None, state=None if found.values else pruned)

    def _goes_on(self, trial: Trial, before: int, flights: int) -> bool:
        """Whether a trial flies on: it can still hold the requirement, and the pruner, by the draws since, agrees."""
        if self._score(trial.number, flights).count > self._plan.requirement.share * self._plan.most:
            return False
        if len(self._plan.expressions) > 1:  # of which Optuna prunes none
            return True
        for draw, (value,) in enumerate(objective_values(self._plan, self._flights(trial.number, flights))):
            if draw >= before and np.isfinite(value):
                trial.report(float(value), draw)
        return not trial.should_prune()

    def _score(self, candidate: int, flights: int) -> Score:
        rows, start = self._flights(candidate, flights), self._flights(START, self._plan.most)
        self.scores[candidate] = score(self._plan, candidate, rows, start)
        return self.scores[candidate]

    def _flights(self, candidate: int, flights: int) -> list[Row]:
        return [self._rows[candidate * self._plan.most + draw] for draw in range(flights)]

    def _fly_missing(self, candidates: Sequence[int], flights: int) -> None:
        """Have candidates fly their first draws, except those already flown.

        Raises:
            InputError: some were flown with other values.
        """
        most = self._plan.most
        pilot = TuningPilot(self._plan, {candidate: self.candidates[candidate] for candidate in candidates})
        numbers = [candidate * most + draw for candidate in candidates for draw in range(flights)]
        if any(pilot.identity(each).items() - self._rows[each].items() for each in numbers if each in self._rows):
            raise InputError("--resume needs the candidates that flew there, and other ones were proposed")
        missing = [number for number in numbers if number not in self._rows]
        if not missing:
            return
        try:
            with closing(self._fly(pilot, missing)) as rows:
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

    def _values(self, trial: Trial) -> Values:
        """The values of a trial as a scenario has them."""
        values: dict[str, Value] = dict(trial.params)
        for entry in self._plan.spec.search:
            if isinstance(entry, ChoiceSpec):
                values[entry.name] = {cell(value): value for value in entry.values}[trial.params[entry.name]]
        return values

    def answer(self) -> tuple[int, list[int]]:
        """The answer, and the Pareto front by its first objective: of one objective, the best.

        The answer is the point of the front nearest to the best of each objective, as a share of its range, among those
        that are no worse than the start in any.  Where no candidate is feasible, it is the one that fails least.
        """
        scores, start = self.scores, self.scores[START]
        if len(self._plan.expressions) > 1:
            front = [trial.number for trial in self.study.best_trials]
        else:
            whole = [each for each in scores.values() if each.feasible and each.flights == self._plan.most]
            front = [each.candidate for each in whole if each.values == min(other.values for other in whole)][:1]
        front.sort(key=lambda candidate: scores[candidate].values)
        if not front:
            least = min(scores.values(), key=lambda each: (each.excess, -each.flights, each.values, each.candidate))
            return least.candidate, []
        values = np.array([scores[candidate].values for candidate in front])
        width = np.ptp(values, axis=0)
        distances = np.linalg.norm((values - values.min(axis=0)) / np.where(width > 0.0, width, 1.0), axis=1)
        near = [front[i] for i in np.argsort(distances, kind="stable")]
        if not start.feasible:
            return near[0], front
        return next((c for c in near if np.less_equal(scores[c].values, start.values).all()), START), front


def _distribution(kinds: Any, entry: SearchSpec) -> Any:
    match entry:
        case ChoiceSpec():
            return kinds.CategoricalDistribution([cell(value) for value in entry.values])
        case IntegerSpec():
            return kinds.IntDistribution(entry.low, entry.high)
    return kinds.FloatDistribution(entry.low, entry.high, log=isinstance(entry, LogUniformSpec))


def _contains(entry: SearchSpec, value: Value | None) -> bool:
    if isinstance(entry, ChoiceSpec):
        return value in entry.values
    return isinstance(value, int | float) and entry.low <= value <= entry.high
