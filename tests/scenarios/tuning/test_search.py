"""Optuna's study of a tuning: its journal is Optuna's own form, and what is proposed does not depend on the process."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import optuna
import pytest
from tuning_formula import write_tuning

from quadsim.errors import FileError
from quadsim.outputs import growing
from scenarios.tuning.plan import TuningPlan, load_tuning
from scenarios.tuning.ranking import Score
from scenarios.tuning.run import MANIFEST_FILE
from scenarios.tuning.search import JOURNAL_FILE, Search
from scenarios.tuning.spec import START


@pytest.fixture
def plan(tmp_path: Path) -> TuningPlan:
    return load_tuning(str(write_tuning(tmp_path)))


def scored(candidate: int, value: float) -> Score:
    return Score(candidate=candidate, flights=8, count=0, completed=8, values=(value,), excess=-0.1)


def distance(values: Any) -> float:
    return abs(float(values["z"]) - 300.0)


def carry_on(plan: TuningPlan, directory: Path, batches: int, *, again: bool) -> list[dict[int, Any]]:
    """The batches, each by a new study where `again`, as after a kill."""
    found = []
    with growing(directory, MANIFEST_FILE) as files:
        search = Search(plan, files)
        search.begin(scored(START, 5.0))
        for _ in range(batches):
            batch = search.ask()
            if again:
                search = Search(plan, files)
                assert search.unfinished
                assert search.ask() == batch
            found.append(batch)
            search.tell([scored(number, distance(values)) for number, values in batch.items()])
    return found


def test_what_is_proposed_does_not_depend_on_the_process(plan: TuningPlan, tmp_path: Path) -> None:
    whole, broken = (carry_on(plan, tmp_path / f"{again}", 4, again=again) for again in (False, True))
    assert whole == broken
    assert [sorted(batch) for batch in whole] == [list(range(1 + 6 * i, 7 + 6 * i)) for i in range(4)]


def test_optuna_itself_opens_the_journal(plan: TuningPlan, tmp_path: Path) -> None:
    batches = carry_on(plan, tmp_path / "t", 2, again=False)
    journal = optuna.storages.journal.JournalFileBackend(str(tmp_path / "t" / JOURNAL_FILE))
    study = optuna.load_study(study_name="little", storage=optuna.storages.JournalStorage(journal))
    assert len(study.trials) == 13
    assert study.trials[3].params == batches[0][3]
    assert study.trials[START].params == {"speed": 0.01, "z": plan.start_values["z"]}


def test_a_start_outside_of_the_ranges_is_no_trial_of_the_search(tmp_path: Path) -> None:
    search: dict[str, Any] = {
        "name": "n",
        "fields": ["controller.horizon"],
        "distribution": "integer",
        "low": 20,
        "high": 30,
    }
    choice = {
        "name": "s",
        "fields": ["controller.solver"],
        "distribution": "choice",
        "values": ["piqp-dense", "piqp-multistage"],
    }
    plan = load_tuning(str(write_tuning(tmp_path, search=[search, choice])))
    with growing(tmp_path / "t", MANIFEST_FILE) as files:
        found = Search(plan, files)
        found.begin(scored(START, 5.0))
        assert found.candidates() == {START: {}}
        batch = found.ask()
    assert sorted(batch) == [1, 2, 3, 4, 5, 6]
    assert {values["n"] for values in batch.values()} <= set(range(20, 31))
    assert {values["s"] for values in batch.values()} <= set(choice["values"])


def test_a_field_that_matters_is_distinguished_from_one_that_does_not(plan: TuningPlan, tmp_path: Path) -> None:
    with growing(tmp_path / "t", MANIFEST_FILE) as files:
        search = Search(plan, files)
        search.begin(scored(START, 300.0))
        scores = [scored(START, 300.0)]
        assert search.importance(scores, 0) == {}
        for _ in range(8):
            candidates = search.ask()
            batch = [scored(number, distance(values)) for number, values in candidates.items()]
            search.tell(batch)
            scores += batch
        found = search.importance(scores, 0)
    assert sum(found.values()) == pytest.approx(1.0)
    assert found["z"] > found["speed"]


def test_a_damaged_journal_is_refused(plan: TuningPlan, tmp_path: Path) -> None:
    with growing(tmp_path / "t", MANIFEST_FILE) as files:
        files.write({JOURNAL_FILE: b"no journal\n"})
        with pytest.raises(FileError, match="is no journal"):
            Search(plan, files)
