"""Whole tunings: a known best, the same draws for all, a bound on failures, and the same answer however interrupted."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import optuna
import pytest
from tuning_formula import BEST_SPEED, BEST_Z, Formula, error_of, tune_by, write_tuning

from quadsim.errors import InputError, MissingPackageError, OutputError
from quadsim.outputs import SUMMARY_FILE
from scenarios.campaign.rows import read_table
from scenarios.loading import load_scenario
from scenarios.rollout import Rollout
from scenarios.tuning import tuning as module
from scenarios.tuning.search import JOURNAL_FILE
from scenarios.tuning.tuning import TuningResult, sentences, verdict
from scenarios.tuning.tuning_plan import START, TuningPlan, load_tuning


def tune(plan: TuningPlan, directory: Path, by: Formula | int, **options: Any) -> TuningResult:
    """Without a report; flown by a formula, or by so many workers."""
    if isinstance(by, Formula):
        return tune_by(by, plan, directory, report=False, **options)
    return module.fly_tuning(plan, directory, workers=by, report=False, **options)


@pytest.fixture
def plan(tmp_path: Path) -> TuningPlan:
    return load_tuning(str(write_tuning(tmp_path)))


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> TuningResult:
    """The tuning, undisturbed, with its pages; nobody changes its directory."""
    here = tmp_path_factory.mktemp("whole")
    return tune_by(Formula(), load_tuning(str(write_tuning(here))), here / "t")


def content(result: TuningResult) -> tuple[bytes, ...]:
    names = ("flights.parquet", "best.toml", "start/flights.parquet")
    summary = json.loads((result.directory / SUMMARY_FILE).read_text())
    del summary["files"]  # some of which hold clock times
    return (*((result.directory / name).read_bytes() for name in names), json.dumps(summary).encode())


def test_a_known_optimum_is_found(whole: TuningResult) -> None:
    controller: Any = whole.best.controller
    assert abs(np.log10(controller.input_weights.speed / BEST_SPEED)) < 0.5
    assert abs(controller.output_weights["z"] - BEST_Z) < 200.0
    start, best = (whole.summary["candidates"][candidate] for candidate in (START, whole.summary["answer"]))
    assert best["values"][0] < start["values"][0]
    assert whole.holds
    result = load_scenario(str(whole.directory / "best.toml"))
    assert result == whole.best
    assert Rollout(result).fly().outcome == "satisfied"


def test_all_candidates_meet_the_same_draws(whole: TuningResult) -> None:
    draws = {(row["flight"] - 8 * row["candidate"], row["seed"], row["draw.mass"]) for row in whole.table.to_pylist()}
    assert sorted(draw for draw, *_ in draws) == list(range(8))


def test_candidates_that_are_worse_on_shared_draws_stop_early(whole: TuningResult, plan: TuningPlan) -> None:
    """The formula's luck is the same for all candidates: whoever is worse than the best is so on every draw."""
    scores = {each["candidate"]: each for each in whole.summary["candidates"]}
    best = scores[START]["values"]
    for first in range(1, plan.spec.trials, plan.spec.batch):
        batch = [scores[candidate] for candidate in range(first, first + plan.spec.batch)]
        assert [each["flights"] == 8 for each in batch] == [each["values"] <= best for each in batch]
        best = min(best, *(each["values"] for each in batch))
    flown = [each["flights"] for each in scores.values()]
    assert set(flown) == {4, 8}  # 2 draws decide nothing
    assert flown.count(4) > len(flown) / 2


def test_few_flights_are_corrected_by_what_the_start_did_there(whole: TuningResult, plan: TuningPlan) -> None:
    """The formula's luck is the same for all candidates, so that any number of flights gives the score of all."""
    luck = float(np.mean([error_of(plan.start.of(draw)) for draw in range(plan.most)])) - error_of(plan.start.scenario)
    for each in whole.summary["candidates"]:
        values = {} if each["candidate"] == START else each["search"]
        expected = error_of(plan.candidate(values, "little")) + luck
        assert each["values"][0] == pytest.approx(expected, rel=1e-9)


def test_fresh_draws_are_others_and_the_optimism_is_reported(whole: TuningResult) -> None:
    assert whole.comparison is not None
    assert whole.comparison.flights == 20
    (gain,) = json.loads((whole.directory / SUMMARY_FILE).read_text())["objectives"]
    tables = [whole.directory / name / "flights.parquet" for name in ("start", f"candidate-{whole.summary['answer']}")]
    seeds = [set(read_table(path)["seed"].to_pylist()) for path in tables]
    assert seeds[0] == seeds[1]
    assert not seeds[0] & set(whole.table["seed"].to_pylist())
    # the formula has the same difference on every draw
    difference = gain["best"] - gain["start"]
    assert [gain["mean"], gain["lower"], gain["upper"]] == pytest.approx([difference] * 3)
    assert gain["fresh_best"] - gain["fresh_start"] == pytest.approx(difference)


def test_the_page_has_optunas_plots_and_links_to_what_is_there(whole: TuningResult) -> None:
    page, plots = read_page(whole)
    links = re.findall(r'href="([^"#:]+)"', page)
    pages = {"start/index.html", f"candidate-{whole.summary['answer']}/index.html", "comparison/index.html"}
    assert pages | {"best.toml", "journal.log"} <= set(links)
    assert [link for link in links if not (whole.directory / link).is_file()] == []
    assert "a &lt;b&gt;bowl" in page
    assert plots == {"candidates", "importance0", "slice0"}
    assert "://" not in re.sub(r"<script>.*?</script>|<script type.*?</script>", "", page, flags=re.DOTALL)
    assert verdict(whole.summary) in page
    assert "violation in 0 of 20 flights" in sentences(whole.summary)[0]


def read_page(result: TuningResult) -> tuple[str, set[str]]:
    """The page, and the names of its plots."""
    page = (result.directory / "index.html").read_text(encoding="utf-8")
    return page, set(re.findall(r'<div class="plot" id="(\w+)"', page))


def test_an_interrupted_search_ends_as_it_would_have(plan: TuningPlan, whole: TuningResult, tmp_path: Path) -> None:
    flown: list[int] = []
    for stops_after, stopped_by in ((5, KeyboardInterrupt), (21, RuntimeError), (40, KeyboardInterrupt), (7, OSError)):
        engine = Formula(stops_after=stops_after, stopped_by=stopped_by, backwards=len(flown) % 2 == 1)
        with pytest.raises(stopped_by):
            tune(plan, tmp_path / "t", engine, resume=True)
        flown += engine.flown
    last = Formula(backwards=True)
    result = tune(plan, tmp_path / "t", last, resume=True)
    assert content(result) == content(whole)
    flown += last.flown
    fresh = 2 * plan.spec.fresh.flights
    assert len(flown) == whole.table.num_rows + fresh  # nothing was flown twice


KILLED = """
import os, signal, sys
from pathlib import Path
from scenarios.tuning.tuning_plan import load_tuning
from tuning_formula import Formula, tune_by

killed = Formula(stops_after=21, stopped_by=lambda: os.kill(os.getpid(), signal.SIGKILL))
tune_by(killed, load_tuning(sys.argv[1]), Path(sys.argv[2]), report=False)
"""


def test_a_killed_search_ends_as_it_would_have(plan: TuningPlan, whole: TuningResult, tmp_path: Path) -> None:
    """SIGKILL within the second batch, when the flights of the first are on the disk."""
    command = [sys.executable, "-c", KILLED, str(tmp_path / "little.toml"), str(tmp_path / "t")]
    done = subprocess.run(command, env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)})
    assert done.returncode == -signal.SIGKILL
    engine = Formula()
    assert content(tune(plan, tmp_path / "t", engine, resume=True)) == content(whole)
    assert len(engine.flown) < whole.table.num_rows + 2 * plan.spec.fresh.flights


def test_more_trials_may_follow(plan: TuningPlan, whole: TuningResult, tmp_path: Path) -> None:
    few = load_tuning(str(write_tuning(tmp_path)), trials=12)
    tune(few, tmp_path / "t", Formula())
    assert content(tune(plan, tmp_path / "t", Formula(), resume=True)) == content(whole)


def test_candidates_that_fail_too_often_stop_early_and_are_no_answer(tmp_path: Path) -> None:
    """The best of the bowl violates: the answer is the best beside it."""

    def violated(scenario: Any) -> bool:
        return bool(scenario.controller.output_weights["z"] > 250.0)

    plan = load_tuning(str(write_tuning(tmp_path, require="P(violation) < 0.3 @ 50%")))  # 2 flights of 8
    result = tune(plan, tmp_path / "t", Formula(violated=violated))
    controller: Any = result.best.controller
    assert controller.output_weights["z"] <= 250.0
    assert result.holds
    failing = [each for each in result.summary["candidates"][1:] if each["search"]["z"] > 250.0]
    assert {(each["flights"], each["count"], each["feasible"]) for each in failing} == {(4, 4, False)}


def test_where_all_fail_the_answer_reports_it(tmp_path: Path) -> None:
    plan = load_tuning(str(write_tuning(tmp_path, trials=6)))
    result = tune(plan, tmp_path / "t", Formula(violated=lambda scenario: True))
    assert not result.holds
    assert not result.summary["front"]


def test_two_objectives_have_a_front_of_files_that_fly(tmp_path: Path) -> None:
    opposed = {"name": "opposed", "expression": "sqrt(rmse.x) * draw.mass - 3 * rmse.x"}
    objectives = [{"name": "error", "expression": "rmse.x"}, opposed]
    plan = load_tuning(str(write_tuning(tmp_path, objectives=objectives, trials=12)))
    result = tune_by(Formula(), plan, tmp_path / "t")
    assert read_page(result)[1] == {"candidates", "importance0", "slice0", "importance1", "slice1"}
    values = {each["candidate"]: each["values"] for each in result.summary["candidates"]}
    front = [values[candidate] for candidate in result.summary["front"]]
    assert len(front) > 1
    assert front == sorted(front)
    assert [second for _, second in front] == sorted((second for _, second in front), reverse=True)
    files = {path.name for path in result.directory.glob("front-*.toml")}
    assert files == {f"front-{candidate}.toml" for candidate in result.summary["front"]}
    load_scenario(str(result.directory / min(files)))


def test_optuna_opens_the_journal(whole: TuningResult) -> None:
    journal = optuna.storages.journal.JournalFileBackend(str(whole.directory / JOURNAL_FILE))
    study = optuna.load_study(study_name="little", storage=optuna.storages.JournalStorage(journal))
    assert len(study.trials) == 25
    assert study.trials[START].params == {"speed": 0.01, "z": 100.0}
    assert [trial.values for trial in study.trials] == [[*each["values"]] for each in whole.summary["candidates"]]
    assert study.best_trial.number == whole.summary["answer"]


def test_a_start_outside_of_the_ranges_is_no_trial_of_the_search(tmp_path: Path) -> None:
    horizon = {"name": "n", "fields": ["controller.horizon"], "distribution": "integer", "low": 20, "high": 30}
    solver = {"name": "s", "fields": ["controller.solver"], "distribution": "choice"}
    solver["values"] = ["piqp-dense", "piqp-multistage"]
    plan = load_tuning(str(write_tuning(tmp_path, search=[horizon, solver], trials=6)))
    start, *others = tune(plan, tmp_path / "t", Formula()).summary["candidates"]
    assert start["search"] == {"n": 4.0, "s": plan.start_values["s"]}
    assert all(20 <= each["search"]["n"] <= 30 and each["search"]["s"] in solver["values"] for each in others)
    assert [each["candidate"] for each in others] == [1, 2, 3, 4, 5, 6]


def test_processes_fly_the_same_search(tmp_path: Path) -> None:
    """Real flights, by one process and by two: the same bytes."""
    changes: dict[str, Any] = {"trials": 4, "batch": 4, "flights": [1, 2], "fresh": {"flights": 2, "seed": 1}}
    plan = load_tuning(str(write_tuning(tmp_path, **changes)))
    results = [tune(plan, tmp_path / f"{workers}", workers) for workers in (1, 2)]
    assert content(results[0]) == content(results[1])
    assert results[0].table["status"].to_pylist() == ["completed"] * results[0].table.num_rows


# --- what is refused -----------------------------------------------------------------------------------------------


def test_a_tuning_is_not_overwritten_without_a_request(plan: TuningPlan, whole: TuningResult) -> None:
    with pytest.raises(OutputError, match="a tuning is already there; continue it with --resume"):
        tune(plan, whole.directory, Formula())


def test_another_tuning_is_not_gone_on_with(whole: TuningResult, tmp_path: Path) -> None:
    other = {"scenario": "hover", "set": {"duration": 1.0}}
    for changes, named in (({"seed": 5}, "seed"), ({"campaign": other}, "campaign, scenario")):
        plan = load_tuning(str(write_tuning(tmp_path, **changes)))
        with pytest.raises(InputError, match=f"needs the same tuning and the same code, and its {named} differs"):
            tune(plan, whole.directory, Formula(), resume=True)


def test_flights_of_other_candidates_are_not_gone_on_with(
    plan: TuningPlan, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As of a processor whose last bits lead Optuna elsewhere."""
    with pytest.raises(KeyboardInterrupt):
        tune(plan, tmp_path / "t", Formula(stops_after=10))
    monkeypatch.setattr(optuna.trial.Trial, "params", {"speed": 0.01, "z": 299.0})
    with pytest.raises(InputError, match="--resume needs the candidates that flew there"):
        tune(plan, tmp_path / "t", Formula(), resume=True)


def test_without_optuna_the_message_names_the_extra(
    plan: TuningPlan, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "optuna", None)
    with pytest.raises(MissingPackageError, match=r"needs the package 'optuna': pip install 'quadsim\[tune\]'"):
        tune(plan, tmp_path / "t", Formula())
    assert not (tmp_path / "t").exists()
