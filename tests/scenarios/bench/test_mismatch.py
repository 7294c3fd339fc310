"""`quadsim bench ladder`: conditions that can be flown, flights judged by rule, whole results, refusals."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import fault_injection
import make_robustness
import pytest
from support import fly_here

from quadsim.errors import InputError, ParameterError
from quadsim.flight import metrics
from quadsim.report.table import Mark
from scenarios.bench.mismatch.benchmark import (
    Cell,
    fly_cell,
    mismatch_markdown,
    run_mismatch,
    time_cell,
    write_mismatch,
)
from scenarios.bench.mismatch.conditions import CONDITIONS
from scenarios.bench.mismatch.controllers import FULL, VARIANTS, equip, tilt_bound
from scenarios.bench.mismatch.survival import MismatchBench, MismatchFlight, mismatch_legend, mismatch_tables
from scenarios.cli import main
from scenarios.commands import EXIT_DONE, EXIT_WRONG_INPUT
from scenarios.loading import load_scenario
from scenarios.many import answers
from scenarios.run import fly_scenario
from scenarios.schema.robust import RobustSpec

SHORT = ("duration=1.0", "controller.horizon=10")
FILES = {"ladder.json", "ladder.md", "ladder.png", "ladder.svg"}
WELL = MismatchFlight(
    reason=None,
    flown=60.0,
    rmse={"x": 0.5, "y": 0.25, "z": 1.0},
    end_error=0.01,
    peak_tilt=4.9,
    violated=0.0,
    fallbacks=0,
    step_p99=2.0,
)


def cell(controller: str, condition: str, *settings: str) -> Cell:
    return Cell(scenario="paper-constrained", settings=settings, controller=controller, condition=condition)


def made_up() -> MismatchBench:
    flights = {
        ("a", "calm"): WELL,
        ("a", "storm"): replace(WELL, reason="diverged", flown=12.6, end_error=None, peak_tilt=None, rmse=None),
        ("b", "calm"): replace(WELL, end_error=0.8, peak_tilt=5.3, violated=0.25, fallbacks=3),
        ("b", "storm"): replace(WELL, end_error=300.0),
    }
    return MismatchBench(
        scenario="paper-constrained",
        duration=60.0,
        tilt_bound=5.0,
        controllers={"a": "one", "b": "another"},
        conditions={"calm": "none", "storm": "wind"},
        flights=flights,
        machine={"cores": 2},
    )


@pytest.mark.parametrize(
    ("changes", "survived", "fate"),
    [
        ({}, True, ""),
        ({"reason": "diverged", "flown": 12.6}, False, "lost, 13 s"),
        ({"end_error": 10.1}, False, "diverged"),
        ({"peak_tilt": 91.0, "end_error": 10.1}, False, "overturned"),
        ({"reason": "no plan", "flown": 0.0, "end_error": None, "peak_tilt": None}, False, "lost, 0 s"),
    ],
)
def test_survival_is_judged_by_its_rules(changes: dict[str, object], survived: bool, fate: str) -> None:
    flight = replace(WELL, **changes)  # type: ignore[arg-type]
    assert (flight.survived, flight.fate) == (survived, fate)


def test_tables_show_each_flight_where_it_belongs() -> None:
    tables = {grid.key: grid for grid in mismatch_tables(made_up())}
    assert tables["end"].head == ("", "a", "b")
    texts = {key: [[each.text for each in line] for line in grid.lines] for key, grid in tables.items()}
    assert texts["end"] == [["calm", "0.010", "0.800"], ["storm", "lost, 13 s", "diverged"]]
    assert texts["tilt"][0] == ["calm", "4.900", "5.300"]
    assert texts["violated"][0] == ["calm", "0", "0.25"]
    assert texts["rmse"][0][1] == "0.50, 0.25, 1.00"
    assert texts["fallbacks"][0] == ["calm", "0", "3"]
    marks = [each.mark for line in tables["end"].lines for each in line[1:]]
    assert marks == [Mark.BEST, Mark.WARN, Mark.BAD, Mark.BAD]
    assert [each.mark for each in tables["tilt"].lines[0][1:]] == [Mark.BEST, Mark.WARN]
    assert "- **b**: another" in mismatch_legend(made_up())


@pytest.mark.parametrize("condition", CONDITIONS)
def test_every_condition_flies_with_the_whole_controller(condition: str) -> None:
    """The shortest flight with all of it: the settings are valid, and the controllers can be built."""
    eventful = any("events" in setting for setting in CONDITIONS[condition].settings)
    duration = 12.1 if eventful else 0.1
    found = fly_cell(cell("+ tightening", condition, f"duration={duration}", "controller.horizon=10"))
    assert found.reason is None
    assert found.flown == duration


@pytest.mark.parametrize("controller", VARIANTS)
def test_every_controller_flies(controller: str) -> None:
    found = fly_cell(cell(controller, "delay 20 ms", *SHORT))
    assert found.survived
    assert found.rmse is not None
    assert found.rmse["z"] > 0.0
    assert found.step_p99 is not None
    assert 0.0 < found.step_p99 < 1e3


def test_parts_are_switched_on_one_after_another() -> None:
    scenario = load_scenario("paper-constrained")

    def robust(name: str) -> RobustSpec:
        spec = equip(scenario, name, CONDITIONS["all by half"]).controller
        assert isinstance(spec, RobustSpec)
        assert spec.soft is not None
        assert spec.fallback.enabled
        return spec

    def parts(name: str) -> tuple[float | str, float, bool, bool, bool]:
        spec = robust(name)
        learns, tightened = spec.offset_free is not None, spec.tightening is not None
        return spec.rotor_lag, spec.delay, spec.heading, learns, tightened

    assert parts("soft") == (0.0, 0.0, False, False, False)
    assert parts("+ model") == (0.025, 0.01, True, False, False)
    assert parts("+ offset-free") == (0.025, 0.01, True, True, False)
    assert parts("+ tightening") == (0.025, 0.01, True, True, True)
    assert equip(scenario, "paper", CONDITIONS["nominal"]) == scenario


@pytest.mark.parametrize(("condition", "lag"), [("nominal", None), ("lag 80 ms", 0.05), ("delay 20 ms", 0.045)])
def test_baselines_are_given_the_lag_that_gains_have_to_allow_for(condition: str, lag: float | None) -> None:
    scenario = load_scenario("paper-constrained")
    for name in ("PID", "geometric"):
        assert equip(scenario, name, CONDITIONS[condition]).controller.lag == pytest.approx(lag)  # type: ignore[union-attr]


def test_what_the_paper_s_controller_loses_the_robust_one_flies() -> None:
    """Eleven seconds with rotors slower than stated, through the beginning of the step along x."""
    lost = fly_cell(cell("paper", "lag 80 ms", "duration=14.0"))
    assert lost.reason is not None
    assert 10.0 < lost.flown < 14.0
    found = fly_cell(cell("+ offset-free", "lag 80 ms", "duration=14.0"))
    assert found.survived
    assert found.peak_tilt is not None
    assert 5.0 < found.peak_tilt < 5.2
    assert 0.0 < found.violated < 2.0


def test_numbers_are_those_of_the_flight() -> None:
    """The paper's controller in the nominal condition is the scenario itself."""
    log = fly_scenario(load_scenario("paper-constrained", ["duration=3.0"])).log
    found = fly_cell(cell("paper", "nominal", "duration=3.0"))
    numbers = metrics.tracking(log.control)
    assert found.rmse == {axis: numbers["rmse"][axis] for axis in "xyz"}
    assert found.end_error == pytest.approx(math.hypot(*(numbers["final_error"][axis] for axis in "xyz")))
    assert (found.flown, found.peak_tilt, found.fallbacks) == (3.0, metrics.peak_tilt(log.plant.state), 0)


def test_steps_are_timed_in_flights_of_their_own() -> None:
    taken = time_cell(cell("PID", "nominal", *SHORT))
    assert taken is not None
    assert 0.0 < taken < 1e3


def test_a_lost_first_period_has_no_numbers() -> None:
    found = fly_cell(cell("paper", "nominal", "duration=1.0", "initial.euler=[40.0, 0.0, 0.0]"))
    assert (found.flown, found.rmse, found.end_error, found.peak_tilt, found.step_p99) == (0.0, None, None, None, None)
    assert not found.survived


@pytest.fixture(scope="module")
def quick() -> MismatchBench:
    """Flown in this process, its times made up."""
    with pytest.MonkeyPatch.context() as patch:
        fly_here(patch)
        patch.setattr("scenarios.bench.mismatch.benchmark.time_cell", lambda cell: 2.0)
        return run_mismatch(settings=["controller.horizon=10"], quick=True)


def test_results_do_not_depend_on_processes() -> None:
    one = cell("PID", "mass +30 %", *SHORT)
    (away,) = answers(fly_cell, [one], workers=1)
    assert replace(away, step_p99=None) == replace(fly_cell(one), step_p99=None)


def test_quick_flights_are_short_and_few(quick: MismatchBench) -> None:
    assert (quick.duration, len(quick.flights)) == (12.0, 9)
    assert [*quick.flights] == [(a, b) for a in quick.controllers for b in quick.conditions]


def test_steps_are_timed_of_the_full_controller_and_in_the_first_condition(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each question is answered at once here, its answer marked with the number of processes that were to be used."""
    calls: list[tuple[int | None, int]] = []

    def answer(function: object, cells: list[Cell], *, workers: int | None, progress: object) -> list[Any]:
        calls.append((workers, len(cells)))
        return [float(workers or 0) for _ in cells] if function is time_cell else [WELL for _ in cells]

    monkeypatch.setattr("scenarios.bench.mismatch.benchmark.answers", answer)
    measured = run_mismatch(workers=2)
    assert calls == [(2, len(VARIANTS) * len(CONDITIONS)), (1, len(VARIANTS) + len(CONDITIONS) - 1)]
    for (controller, condition), flight in measured.flights.items():
        assert flight.step_p99 == (1.0 if controller == FULL or condition == "nominal" else None)


def test_a_ladder_is_written_whole_and_the_same_each_time(quick: MismatchBench, tmp_path: Path) -> None:
    write_mismatch(quick, tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == FILES
    data = json.loads((tmp_path / "ladder.json").read_text())
    assert data["format"] == "quadsim bench ladder"
    assert {entry["controller"] for entry in data["flights"]} == set(quick.controllers)
    drawing = (tmp_path / "ladder.svg").read_text()
    assert ">+ offset-free<" in drawing
    assert ">lost<" in drawing
    assert (tmp_path / "ladder.md").read_text() == mismatch_markdown(quick)
    first = drawing
    (tmp_path / "again").mkdir()
    write_mismatch(quick, tmp_path / "again")
    assert (tmp_path / "again" / "ladder.svg").read_text() == first


def test_the_figure_of_made_up_results_shows_each_outcome(tmp_path: Path) -> None:
    write_mismatch(made_up(), tmp_path)
    drawing = (tmp_path / "ladder.svg").read_text()
    for text in ("0.01", "0.80", "13 s", "diverged", "4.90", "5.30"):
        assert f">{text}<" in drawing


def test_the_page_states_what_is_met_and_what_is_not() -> None:
    measured = replace(made_up(), controllers={FULL: "full"}, conditions={"nominal": "", "wind 3 m/s": ""})
    tilted = replace(WELL, peak_tilt=5.2, violated=0.1, end_error=0.4, step_p99=7.0)
    measured = replace(measured, flights={(FULL, "nominal"): WELL, (FULL, "wind 3 m/s"): tilted})
    reported = [line[1].text for line in make_robustness.targets(measured).lines]
    assert reported == ["in all 2", "in all 1", "not in: wind 3 m/s", "not in: wind 3 m/s"]
    fault = fault_injection.faults()[0]
    injection = fault_injection.Injection(controller="paper", fault=fault, start=3.0)
    found = fault_injection.Consequence(
        injection=injection, reason=None, finite=True, within=True, fallback=1, furthest=0.2, back=10.5
    )
    windy = replace(injection, start=4.5, condition="wind 3 m/s")
    page = make_robustness.page(measured, [found, replace(found, injection=windy, back=4.0)])
    assert "1 of 2 are harmless" in page
    assert f"| {fault.name} | 3.00 (nominal), 4.50 (wind 3 m/s) | 1 of 2 | 1 | 0.2000 | 10.50 |" in page


def test_a_scenario_without_such_bounds_is_refused() -> None:
    with pytest.raises(
        InputError, match=r"paper-unconstrained: the mismatch benchmark needs a constrained controller whose"
    ):
        run_mismatch("paper-unconstrained", quick=True)
    with pytest.raises(InputError, match="are the same, as paper-constrained has"):
        tilt_bound(load_scenario("paper-constrained", ["controller.output_bounds.roll=[-4.0, 5.0]"]))
    assert tilt_bound(load_scenario("paper-constrained")) == 5.0


def test_a_number_of_processes_that_is_none_is_refused() -> None:
    with pytest.raises(ParameterError, match=r"--workers must be at least 1; got 0"):
        run_mismatch(workers=0)


def test_the_command_refuses_and_leaves_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    target = tmp_path / "ladder"
    assert main(["bench", "ladder", "--workers", "0", "--out", str(target)]) == EXIT_WRONG_INPUT
    assert "--workers must be at least 1; got 0" in capsys.readouterr().err
    assert not target.exists()


def test_the_command_prints_json_alone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, quick: MismatchBench
) -> None:
    monkeypatch.setattr("scenarios.bench.mismatch.benchmark.run_mismatch", lambda *arguments, **options: quick)
    assert main(["bench", "ladder", "--quick", "--json", "--out", str(tmp_path / "ladder")]) == EXIT_DONE
    printed = json.loads(capsys.readouterr().out)
    assert len(printed["flights"]) == 9
    assert {path.name for path in (tmp_path / "ladder").iterdir()} == {*FILES, "summary.json"}
