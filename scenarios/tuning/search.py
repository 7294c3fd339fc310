"""Optuna: proposes candidates from the scores of earlier ones, in a journal that outlives the process."""

from __future__ import annotations

import contextlib
import json
import logging
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from quadsim.errors import FileError, MissingPackageError
from quadsim.outputs import Growing
from scenarios.campaign.plan import cell
from scenarios.campaign.spec import ChoiceSpec, IntegerSpec, LogUniformSpec, Value
from scenarios.tuning.ranking import Score
from scenarios.tuning.spec import START, SearchSpec

if TYPE_CHECKING:
    from optuna.distributions import BaseDistribution
    from optuna.study import Study
    from optuna.trial import FrozenTrial

    from scenarios.tuning.plan import TuningPlan, Values

JOURNAL_FILE: Final = "journal.log"
_LEAST: Final = 4  # fewest feasible trials for importances


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


class Search:
    """The study of a tuning: trial n is candidate n, and trial 0 the start.

    Its journal has the form of Optuna's `JournalFileBackend`, and is written in whole steps: a batch that is proposed,
    or the scores of one.

    Args:
        plan: the tuning.
        files: its directory.

    Raises:
        MissingPackageError: Optuna is not installed.
        FileError: the journal that is there is damaged.
    """

    def __init__(self, plan: TuningPlan, files: Growing) -> None:
        self._optuna, self._plan, self._files = require_optuna(), plan, files
        self._logs = _read(files)
        self._written = len(self._logs)
        self._excess: dict[int, float] = {}
        optuna = self._optuna
        with _quiet():
            self._study: Study = optuna.create_study(
                storage=optuna.storages.JournalStorage(_journal(self._logs)),
                study_name=plan.spec.name,
                directions=["minimize"] * len(plan.spec.objectives),
                load_if_exists=True,
            )
        self._space = {entry.name: _distribution(optuna, entry) for entry in plan.spec.search}

    @property
    def proposed(self) -> int:
        """Candidates that were proposed, with the start."""
        return len(self._study.get_trials(deepcopy=False))

    @property
    def unfinished(self) -> bool:
        """Whether a batch was proposed and is not scored yet."""
        return any(not trial.state.is_finished() for trial in self._study.get_trials(deepcopy=False))

    def begin(self, score: Score) -> None:
        """Let the search know the start, if its values are within the ranges."""
        if self.proposed:
            return
        params = self._start_parameters()
        with _quiet():
            if params:
                self._study.enqueue_trial(params)
                self._study.sampler = self._sampler()
                self._study.ask(self._space)
            else:
                self._study.add_trial(self._optuna.create_trial(state=self._optuna.trial.TrialState.FAIL))
        if params:
            self.tell([score])
        self._write()

    def ask(self) -> dict[int, Values]:
        """A batch of candidates, by their numbers: the one that is not scored yet, or a new one.

        The same study gives the same batch in any process: each batch has a sampler with its own seed.
        """
        running = [trial for trial in self._study.get_trials(deepcopy=False) if not trial.state.is_finished()]
        if running:
            return {trial.number: self._values(trial) for trial in running}
        with _quiet():
            self._study.sampler = self._sampler()
            proposed = [self._study.ask(self._space) for _ in range(self._plan.spec.batch)]
        self._write()
        trials = self._study.get_trials(deepcopy=False)
        return {trial.number: self._values(trials[trial.number]) for trial in proposed}

    def tell(self, scores: Sequence[Score]) -> None:
        """The scores of a batch."""
        with _quiet():
            for score in scores:
                self._excess[score.candidate] = score.excess
                self._study.tell(score.candidate, list(score.values))
        self._write()

    def _sampler(self) -> Any:
        """One for the next batch, with a seed of that batch."""
        seed = np.random.SeedSequence([self._plan.spec.seed, self.proposed]).generate_state(1)
        return self._optuna.samplers.TPESampler(
            seed=int(seed[0]),
            multivariate=True,
            constant_liar=True,
            n_startup_trials=self._plan.spec.batch,
            constraints_func=lambda trial: (self._excess[trial.number],),
        )

    def candidates(self) -> dict[int, Values]:
        """Every candidate that was proposed, by its number; the start has no values."""
        trials = self._study.get_trials(deepcopy=False)
        return {START: {}, **{trial.number: self._values(trial) for trial in trials if trial.number != START}}

    def importance(self, scores: Sequence[Score], objective: int) -> dict[str, float]:
        """The share of each field, by name, in what distinguishes good candidates; empty for too few.

        Source: Watanabe, Bansal and Hutter, PED-ANOVA, IJCAI 2023, over the feasible candidates.
        """
        optuna = self._optuna
        trials = self._study.get_trials(deepcopy=False)
        feasible = [each for each in scores if each.feasible and trials[each.candidate].params]
        if len(feasible) < _LEAST or len(self._space) < 2:
            return {}
        with _quiet():
            study = optuna.create_study()
            for each in feasible:
                params = trials[each.candidate].params
                study.add_trial(
                    optuna.create_trial(params=params, distributions=self._space, value=each.values[objective])
                )
            found = optuna.importance.get_param_importances(
                study, evaluator=optuna.importance.PedAnovaImportanceEvaluator()
            )
        return {name: float(share) for name, share in found.items()}

    def _values(self, trial: FrozenTrial) -> Values:
        """The values of a trial as a scenario has them."""
        values: dict[str, Value] = dict(trial.params)
        for entry in self._plan.spec.search:
            if isinstance(entry, ChoiceSpec):
                values[entry.name] = next(each for each in entry.values if cell(each) == values[entry.name])
        return {entry.name: values[entry.name] for entry in self._plan.spec.search}

    def _start_parameters(self) -> dict[str, Any]:
        """The start as a trial's parameters; none where it is outside of what is searched."""
        found = {}
        for entry in self._plan.spec.search:
            value = self._plan.start_values.get(entry.name)
            if isinstance(entry, ChoiceSpec):
                inside = value in entry.values
            else:
                inside = isinstance(value, int | float) and entry.low <= value <= entry.high
            if value is None or not inside:
                return {}
            found[entry.name] = cell(value) if isinstance(entry, ChoiceSpec) else value
        return found

    def _write(self) -> None:
        if len(self._logs) > self._written:
            lines = (json.dumps(log, separators=(",", ":")) + "\n" for log in self._logs)
            self._files.write({JOURNAL_FILE: "".join(lines).encode()})
            self._written = len(self._logs)


def _distribution(optuna: Any, entry: SearchSpec) -> BaseDistribution:
    kinds = optuna.distributions
    match entry:
        case ChoiceSpec():
            return kinds.CategoricalDistribution([cell(value) for value in entry.values])
        case IntegerSpec():
            return kinds.IntDistribution(entry.low, entry.high)
    return kinds.FloatDistribution(entry.low, entry.high, log=isinstance(entry, LogUniformSpec))


def _read(files: Growing) -> list[Mapping[str, Any]]:
    """The entries of the journal that is there.

    Raises:
        FileError: it is none.
    """
    path = files.path / JOURNAL_FILE
    if not path.is_file():
        return []
    try:
        return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    except (OSError, ValueError) as error:
        raise FileError(path, f"is no journal ({error})") from error


def _journal(logs: list[Mapping[str, Any]]) -> Any:
    """A back end of Optuna's journal storage with its entries in a list."""
    from optuna.storages.journal import BaseJournalBackend

    class InMemory(BaseJournalBackend):  # type: ignore[misc]
        def read_logs(self, log_number_from: int) -> Iterable[dict[str, Any]]:
            return [dict(log) for log in logs[log_number_from:]]

        def append_logs(self, entries: list[dict[str, Any]]) -> None:
            logs.extend(json.loads(json.dumps(entry)) for entry in entries)

    return InMemory()


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Suppress Optuna's notices, such as those on experimental parts."""
    logger = logging.getLogger("optuna")
    level = logger.level
    logger.setLevel(logging.ERROR)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            yield
        finally:
            logger.setLevel(level)
