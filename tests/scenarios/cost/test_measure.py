"""The study of what constraints cost, on a short flight and small sweeps."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support import fly_here

from mpc.solvers import SOLVERS
from quadsim.controller import Moment
from quadsim.errors import InputError, MissingPackageError
from quadsim.flight.metrics import percentiles
from scenarios import many
from scenarios.bench.queries import QueriedController, recorded
from scenarios.build import build_controller
from scenarios.cli import main
from scenarios.commands import EXIT_DONE, EXIT_WRONG_INPUT
from scenarios.cost import cost_flights
from scenarios.cost.cost_flights import without_constraints
from scenarios.cost.measure import find_study, fly_variations, study_cost
from scenarios.cost.study import CostStudy
from scenarios.flight import Outputs, summarise
from scenarios.loading import load_scenario
from scenarios.parts.vehicle import build_vehicle
from scenarios.run import fly_scenario, run_scenario
from scenarios.schema.scenario import Scenario

SETTINGS = ["duration=2.0", "controller.horizon=10"]
SMALL: dict[str, Any] = {
    "tilts": (3.0,),
    "horizons": (8,),
    "arm_lengths": (0.3, 0.5),
    "drags": (0.024,),
    "solvers": ("piqp-dense",),
}

FLY_MANY = many.fly_many  # by processes
FLIGHTS_ALONE: dict[str, Any] = {**SMALL, "tilts": (), "horizons": (), "arm_lengths": (), "solvers": ()}


def scenario(*settings: str, name: str = "paper-constrained") -> Scenario:
    return load_scenario(name, [*SETTINGS, *settings])


@pytest.fixture(scope="module", autouse=True)
def _here() -> Iterator[None]:
    """Flights are flown in this process, and steps timed once; one test compares that with another process."""
    with pytest.MonkeyPatch.context() as patch:
        fly_here(patch)
        patch.setattr(cost_flights, "REPEATS", 1)
        yield


@pytest.fixture(scope="module")
def study() -> CostStudy:
    return study_cost(scenario(), [scenario(name="paper-unconstrained")], workers=1, **SMALL)


def untimed(study: CostStudy) -> dict[str, Any]:
    """The study's JSON without what a clock measured."""
    data = study.to_json()
    del data["contenders"]
    for sweep in ("tilt", "horizons"):
        for point in data[sweep]["points"]:
            del point["step_ms"]
    return data


def test_the_study_is_the_same_where_other_processes_fly(study: CostStudy, monkeypatch: pytest.MonkeyPatch) -> None:
    """All its flights; that answers come in their order is `scenarios.many`'s."""
    monkeypatch.setattr("scenarios.many.fly_many", FLY_MANY)
    again = study_cost(scenario(), [scenario(name="paper-unconstrained")], workers=1, timed=study.candidates, **SMALL)
    assert untimed(again) == untimed(study)


def test_runs_can_be_compared_without_the_solver_that_flew_them(monkeypatch: pytest.MonkeyPatch) -> None:
    targets = ["paper-constrained", "paper-unconstrained"]
    assert find_study(targets, requested=None)
    monkeypatch.setattr(type(SOLVERS["daqp"]), "installed", False)
    assert find_study(targets, requested=None) == []
    with pytest.raises(MissingPackageError, match="needs the package 'piqp'"):
        find_study(targets, requested=True)


def test_flights_of_one_name_are_distinguished() -> None:
    slower = scenario("controller.horizon=12", name="paper-unconstrained")
    study = study_cost(scenario(), [scenario(name="paper-unconstrained"), slower], workers=1, **FLIGHTS_ALONE)
    assert list(study.others) == ["paper-unconstrained", "paper-unconstrained (2)"]


def test_the_flight_is_the_scenarios_own(study: CostStudy) -> None:
    flight = fly_scenario(scenario())
    summary, outcome = summarise(flight), study.constrained
    assert outcome.statuses == summary["controller"]["statuses"]
    assert outcome.numbers["rmse_z"] == summary["tracking"]["rmse"]["z"]
    assert outcome.numbers["total_variation"] == summary["control"]["total_variation"]
    assert list(outcome.settling) == summary["tracking"]["settling"]
    tilt = np.degrees(np.abs(flight.log.plant.state[:, [6, 8]]).max())
    assert outcome.numbers["tilt_plant"] == pytest.approx(tilt)


def test_the_counterpart_has_the_same_weights_and_no_constraints(study: CostStudy) -> None:
    free = load_scenario("paper-unconstrained", SETTINGS)
    spec = scenario().controller
    same = free.controller.model_copy(
        update={"output_weights": spec.output_weights, "input_weights": spec.input_weights}
    )
    flight = fly_scenario(free.model_copy(update={"controller": same}))
    assert study.unconstrained.numbers["step_max"] == pytest.approx(np.abs(flight.log.control.slews).max())
    assert study.unconstrained.numbers["step_max"] > 10.0
    assert list(study.others) == ["paper-unconstrained"]
    assert study.others["paper-unconstrained"].numbers != study.unconstrained.numbers


def test_a_compared_counterpart_is_not_reported_twice() -> None:
    own = scenario()
    free = without_constraints(own).model_copy(update={"name": "counterpart"})
    assert study_cost(own, [free], workers=1, **FLIGHTS_ALONE).others == {}


def test_sweeps_hold_their_own_value_and_their_own_settings(study: CostStudy) -> None:
    assert [point.value for point in study.tilt.points] == [3.0, 5.0]
    assert [point.value for point in study.horizons.points] == [8, 10]
    assert (study.tilt.base, study.horizons.base) == (5.0, 10)
    assert study.tilt.points[1].constrained == study.horizons.points[1].constrained == study.constrained
    assert study.horizons.points[1].unconstrained == study.unconstrained
    tilted = fly_scenario(
        scenario("controller.output_bounds.roll=[-3.0, 3.0]", "controller.output_bounds.pitch=[-3.0, 3.0]")
    )
    assert study.tilt.points[0].constrained.numbers["rmse_z"] == summarise(tilted)["tracking"]["rmse"]["z"]
    assert all(point.step_ms["p50"] > 0.0 for point in (*study.tilt.points, *study.horizons.points))


def test_variations_change_the_vehicle(study: CostStudy) -> None:
    assert [(v.arm_length, v.drag_to_thrust) for v in study.variations] == [(0.3, 0.024), (0.5, 0.024)]
    own, other = (variation.outcome for variation in study.variations)
    assert own == study.constrained
    assert other != own
    assert fly_variations(scenario(), arm_lengths=(0.5,), drags=(0.024,), workers=1)[0].outcome == other


def test_candidates_answer_the_queries_of_the_flight(study: CostStudy) -> None:
    gain, flown, dense = study.candidates
    assert [candidate.name for candidate in study.candidates] == [
        *("unconstrained gain", "constrained, as flown", "QP by piqp-dense")
    ]
    assert {candidate.step_ms.size for candidate in study.candidates} == {40}
    assert 0 < flown.shortcut.sum() < 40
    assert int(flown.shortcut.sum()) == study.constrained.statuses["unconstrained"]
    assert gain.shortcut.all()
    assert not dense.shortcut.any()
    assert gain.failures == flown.failures == dense.failures == 0
    assert np.median(gain.step_ms) < np.median(dense.step_ms)


def test_a_replay_gives_the_commands_of_the_flight() -> None:
    own = scenario()
    flight = fly_scenario(own)
    queries = recorded(own, flight.log.control, 10)
    controller = build_controller(own, build_vehicle(own))
    for k in range(40):
        controller.reset(queries.speeds_before[k])
        command = controller.step(Moment(time=queries.t[k]), queries.state[k], queries.reference[k + 1 : k + 11])
        np.testing.assert_allclose(command.speeds, flight.log.control.speeds[k], atol=1e-6)
    queried = QueriedController(controller, queries)
    for k in range(40):
        queried.prepare(k)
        queried.answer()
    assert tuple(queried.statuses.values()) == flight.log.control.status


def test_a_time_stands_in_a_study_once(study: CostStudy) -> None:
    """The flight that is studied has one line of times, wherever it appears; another study may be given its own."""
    flown = percentiles(study.candidates[1].step_ms)
    assert study.tilt.points[1].step_ms == study.horizons.points[1].step_ms == flown
    few = {**SMALL, "tilts": (), "horizons": (), "arm_lengths": ()}
    given = [replace(candidate, step_ms=2.0 * candidate.step_ms) for candidate in study.candidates]
    again = study_cost(scenario(), workers=1, timed=given, **few)
    np.testing.assert_array_equal(again.candidates[2].step_ms, 2.0 * study.candidates[2].step_ms)
    assert again.tilt.points[0].step_ms == percentiles(given[1].step_ms)


def test_a_solver_that_is_not_installed_is_named_and_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(type(SOLVERS["qpoases"]), "installed", property(lambda entry: entry.package == "piqp"))
    few = {**FLIGHTS_ALONE, "solvers": ("piqp-dense", "qpoases")}
    found = study_cost(scenario(), workers=1, **few)
    assert [candidate.name for candidate in found.candidates][2:] == ["QP by piqp-dense"]
    assert "pip install 'quadsim[solvers]'" in found.left_out["qpoases"]


def test_flights_that_are_lost_stay_in_the_study() -> None:
    """Rolled by 60 deg, no plan comes back within 5 deg in time: the first QP has no solution."""
    upside = scenario("initial.euler=[60.0, 0.0, 0.0]")
    found = study_cost(upside, workers=1, **{**SMALL, "tilts": (70.0,), "arm_lengths": ()})
    assert not found.constrained.completed
    assert found.constrained.numbers == {}
    assert found.candidates == ()
    assert [point.constrained.completed for point in found.tilt.points] == [False, True]
    assert [bool(point.step_ms) for point in found.tilt.points] == [False, True]
    assert {entry["settled"] for entry in found.constrained.settling} == {None}


def test_progress_is_reported_to_its_end() -> None:
    seen: dict[str, tuple[int, int]] = {}
    few = {**FLIGHTS_ALONE, "tilts": (3.0,)}
    study_cost(scenario(), workers=1, progress=lambda stage, done, total: seen.update({stage: (done, total)}), **few)
    assert list(seen) == ["steps", "flights", "sweeps"]
    assert all(done == total > 0 for done, total in seen.values())


# --- which comparisons are studied, and the command ----------------------------------------------------------------


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Run directories of both controllers of the paper, and of a constrained hover."""
    directory = tmp_path_factory.mktemp("runs")
    tables = Outputs(video=False, recording=False, figures=False)
    for name in ("paper-constrained", "paper-unconstrained", "hover"):
        run_scenario(load_scenario(name, SETTINGS), directory / name, tables)
    return {name: str(directory / name) for name in ("paper-constrained", "paper-unconstrained", "hover")}


def test_a_study_is_made_where_its_question_is_posed(runs: dict[str, str]) -> None:
    bounded, free, hover = runs["paper-constrained"], runs["paper-unconstrained"], runs["hover"]
    found = find_study([free, bounded], requested=None)
    assert [each.name for each in found] == ["paper-constrained", "paper-unconstrained"]
    assert find_study([free, bounded], requested=False) == []
    assert find_study([free], requested=None) == []
    assert find_study([bounded, bounded], requested=None) == []
    assert find_study([hover, free], requested=None) == []  # not of one course
    assert [each.name for each in find_study([hover, free], requested=True)] == ["hover"]
    assert len(find_study(["paper-constrained", "paper-unconstrained"], requested=None)) == 2


def test_a_long_course_is_studied_only_on_request(runs: dict[str, str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("scenarios.cost.measure.LONGEST_UNREQUESTED", 1.0)
    both = [runs["paper-constrained"], runs["paper-unconstrained"]]
    assert find_study(both, requested=None) == []
    assert len(find_study(both, requested=True)) == 2


def test_a_run_without_a_readable_scenario_is_compared_all_the_same(runs: dict[str, str], tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    targets = [runs["paper-constrained"], str(tmp_path / "run")]
    assert find_study(targets, requested=None) == []
    with pytest.raises(InputError, match=r"scenario\.toml: no such scenario file"):
        find_study(targets, requested=True)


@pytest.mark.usefixtures("undrawn")
def test_compare_puts_the_study_on_the_page(
    runs: dict[str, str],
    study: CostStudy,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def made(constrained: Scenario, others: Sequence[Scenario], **_: object) -> CostStudy:
        assert constrained.name == study.name
        assert [each.name for each in others] == list(study.others)
        return study

    monkeypatch.setattr("scenarios.cost.measure.study_cost", made)
    both = [runs["paper-unconstrained"], runs["paper-constrained"]]
    assert main(["compare", *both, "--out", str(tmp_path / "page")]) == EXIT_DONE
    written = {path.name for path in (tmp_path / "page").iterdir()}
    assert {"cost.json", "cost.md", "cost_steps.svg", "cost_tilt.png", "cost_horizon.svg"} <= written
    assert '<section id="cost">' in (tmp_path / "page" / "index.html").read_text()
    assert main(["compare", *both, "--no-cost", "--overwrite", "--out", str(tmp_path / "page")]) == EXIT_DONE
    assert "cost.json" not in {path.name for path in (tmp_path / "page").iterdir()}
    assert capsys.readouterr().err == ""


def test_a_study_without_a_constrained_flight_is_refused(
    runs: dict[str, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["compare", runs["paper-unconstrained"], "--cost", "--out", str(tmp_path / "page")]
    assert main(arguments) == EXIT_WRONG_INPUT
    message = "quadsim: --cost needs a flight by a constrained controller among those that are compared\n"
    assert capsys.readouterr().err == message
    assert not (tmp_path / "page").exists()
