"""A comparison's rows on verdicts, courses, ground, measured states and late commands."""

import copy
import dataclasses
from typing import Any

import pytest

from quadsim.flight.rundir import Run
from quadsim.report.comparison import (
    comparison_rows,
    failure_sentences,
    verdict,
    verdict_cell,
    violated_by_fallback,
)
from quadsim.report.table import Mark, Row

COURSE = {
    "tilt": 5.61,
    "velocity": 0.5,
    "rotor_min": 183.2,
    "rotor_max": 201.9,
    "jumps": [1.0, 7.0],
    "problems": ["pitch up to 5.61 deg (bound 5)"],
    "sentence": "The course requires up to 5.61 deg of tilt.",
}
GROUND = {
    "takeoff_time": 2.155,
    "touchdown": {"time": 15.885, "speed": 0.052, "horizontal_speed": 0.001, "tilt": 1.25},
    "phase": "landed",
    "crashed": False,
}
ESTIMATION = {
    "rmse": {"x": 0.003, "y": 0.004, "z": 0.012, "roll": 0.01, "pitch": 0.0, "yaw": 0.0},
    "max_error": {"x": 0.03, "y": 0.04, "z": 0.12, "roll": 0.1, "pitch": 0.0, "yaw": 0.0},
    "not_finite": 10,
    "samples": {"position": {"accepted": 95, "rejected": 5, "nis": 1.0}},
}
EVENTS = [{"time": 2.0, "text": "rotor 2 loses 20 %"}, {"time": 3.5, "text": "a push of 4 N for 0.2 s"}]
COMPUTATION = {"delay_ms": {"p50": 12.0, "p95": 30.0, "p99": 45.0, "max": 60.0}, "missed": 3}
EVERYTHING = {
    "course": COURSE,
    "events": EVENTS,
    "ground": GROUND,
    "estimation": ESTIMATION,
    "computation": COMPUTATION,
}


def with_margin(entry: dict[str, Any], margin: float) -> dict[str, Any]:
    """A required constraint that was held, or violated, by a margin."""
    verdict = "satisfied" if margin >= 0.0 else "violated"
    margins = dict.fromkeys(("worst_margin", "worst_margin_sampled"), margin)
    return {**entry, **margins, "worst_time": 1.0, "required": True, "satisfied": margin >= 0.0, "verdict": verdict}


def having(run: Run, scenario: str, **entries: Any) -> Run:
    return dataclasses.replace(run, summary={**copy.deepcopy(run.summary), "scenario": scenario, **entries})


@pytest.fixture
def bare_run(short_run: Run) -> Run:
    """The short flight as an older version wrote it: nothing of what this module tests."""
    bare = {key: value for key, value in short_run.summary.items() if key not in {*EVERYTHING, "expected", "diagnosis"}}
    return having(dataclasses.replace(short_run, summary=bare), "bare")


def cells(rows: list[Row], group: str, label: str) -> list[str]:
    (found,) = (row for row in rows if (row.group, row.label) == (group, label))
    return [cell.text for cell in found.cells]


def test_rows_agree_with_the_summary_and_have_a_dash_where_it_has_no_entry(bare_run: Run) -> None:
    rows = comparison_rows([having(bare_run, "full", **EVERYTHING), bare_run])
    assert cells(rows, "Flight", "events") == ["rotor 2 loses 20 % at 2 s; a push of 4 N for 0.2 s at 3.5 s", "-"]
    assert cells(rows, "Course", "largest tilt required") == ["5.61", "-"]
    assert cells(rows, "Course", "jumps") == ["at 1 s; at 7 s", "-"]
    assert cells(rows, "Course", "beyond the bounds") == ["pitch up to 5.61 deg (bound 5)", "-"]
    assert cells(rows, "Ground", "take-off at") == ["2.155", "-"]
    assert cells(rows, "Ground", "touchdown, descending with") == ["0.052", "-"]
    assert cells(rows, "Ground", "at the end") == ["landed", "-"]
    assert cells(rows, "Measured state", "RMS error of the measured z") == ["0.012", "-"]
    assert cells(rows, "Measured state", "largest error of the measured roll") == ["5.73", "-"], "in degrees"
    assert cells(rows, "Measured state", "samples rejected by the filter") == ["position 5 of 100", "-"]
    assert cells(rows, "Simulated computation", "command after its measurement, maximum") == ["60", "-"]
    assert cells(rows, "Simulated computation", "commands too late to be used") == ["3", "-"]


def test_a_course_that_takes_negative_thrust_has_no_lowest_rotor_speed(bare_run: Run) -> None:
    problems = ["rotor speed up to 604.1 rad/s (limit 250)", "not flyable: a rotor would need a negative thrust"]
    impossible = having(bare_run, "impossible", course={**COURSE, "rotor_min": 0.0, "problems": problems})
    rows = comparison_rows([impossible, having(bare_run, "full", course=COURSE)])
    assert cells(rows, "Course", "lowest rotor speed required") == ["not flyable", "183.2"]


def test_flights_that_met_nothing_have_no_rows_of_it(bare_run: Run) -> None:
    groups = {row.group for row in comparison_rows([bare_run])}
    assert not {"Course", "Ground", "Measured state", "Simulated computation"} & groups


def test_a_flight_that_never_touches_the_ground_or_crashes_on_it(bare_run: Run) -> None:
    aloft = having(bare_run, "aloft", ground={**GROUND, "takeoff_time": None, "touchdown": None, "phase": "flying"})
    crashed = having(bare_run, "crashed", ground={**GROUND, "phase": "crashed", "crashed": True})
    rows = comparison_rows([aloft, crashed])
    assert cells(rows, "Ground", "touchdown at") == ["-", "15.88"]
    (end,) = (row for row in rows if row.label == "at the end")
    assert [cell.mark for cell in end.cells] == [Mark.NONE, Mark.BAD]


@pytest.mark.parametrize(
    ("status", "satisfied", "expected", "as_expected", "text", "mark"),
    [
        ("completed", True, "satisfied", True, "satisfied, as expected", Mark.GOOD),
        ("completed", False, "violated", True, "violated, as expected", Mark.NONE),
        ("aborted", False, "lost", True, "lost, as expected", Mark.NONE),
        ("completed", True, "lost", False, "satisfied, expected: lost", Mark.BAD),
    ],
)
def test_a_verdict_is_held_against_the_one_the_scenario_states(
    bare_run: Run, status: str, satisfied: bool, expected: str, as_expected: bool, text: str, mark: Mark
) -> None:
    constraints = [with_margin(bare_run.summary["constraints"][0], 1.0 if satisfied else -1.0)]
    run = having(bare_run, "flight", status=status, constraints=constraints, expected=expected, as_expected=as_expected)
    found = verdict_cell(run.summary)
    assert (found.text, found.mark) == (text, mark)


def test_a_required_constraint_that_was_not_reached_makes_a_flight_incomplete(bare_run: Run) -> None:
    entry = bare_run.summary["constraints"][0]
    beyond = {"worst_margin": None, "worst_margin_sampled": None, "worst_time": None}
    unreached = {**with_margin(entry, 1.0), **beyond, "name": "arrival", "satisfied": False}
    flown = having(bare_run, "short", constraints=[with_margin(entry, 1.0), unreached], expected="satisfied")
    assert (verdict(flown.summary), verdict_cell(flown.summary).mark) == ("incomplete", Mark.BAD)
    assert verdict({**flown.summary, "constraints": [with_margin(entry, -1.0), unreached]}) == "violated"
    assert verdict({**flown.summary, "constraints": [{**unreached, "required": False}]}) == "satisfied"


def test_a_verdict_needs_no_expectation_and_minds_required_constraints_alone(bare_run: Run) -> None:
    entry = bare_run.summary["constraints"][0]
    summary = {**bare_run.summary, "constraints": [{**with_margin(entry, -1.0), "required": False}]}
    assert verdict(summary) == "satisfied"
    assert verdict_cell(summary).mark is Mark.NONE


DIAGNOSIS = {
    "time": 1.0,
    "status": "primal_infeasible",
    "feasible": False,
    "conflict": [],
    "suggestions": [],
    "sentence": "no answer at t = 1.00 s; cannot hold together: roll upper at +0.15 s .. +0.40 s by 0.8 deg",
    "advice": "to try: controller.output_bounds.roll = [-5.0, 5.8]",
}


def test_fallback_for_good_is_no_success_and_is_reported_with_its_reason(bare_run: Run) -> None:
    held = [with_margin(entry, 1.0) for entry in bare_run.summary["constraints"]]
    broken = [with_margin(entry, -1.0) for entry in bare_run.summary["constraints"]]
    controller = {**bare_run.summary["controller"], "unrecovered": 318}
    good = having(bare_run, "good", constraints=held)
    stuck = having(
        bare_run, "stuck", constraints=held, controller=controller, diagnosis=DIAGNOSIS, expected="satisfied"
    )
    crashed = having(bare_run, "crashed", constraints=held, ground={**GROUND, "crashed": True})
    assert [verdict(run.summary) for run in (good, stuck, crashed)] == ["satisfied", "violated", "violated"]
    assert violated_by_fallback(stuck.summary)
    assert not violated_by_fallback(crashed.summary)
    assert not violated_by_fallback(having(stuck, "both", constraints=broken).summary)
    reasons = ["318 periods in fallback, never recovered", DIAGNOSIS["sentence"], DIAGNOSIS["advice"]]
    assert failure_sentences(stuck.summary) == reasons
    assert cells(comparison_rows([good, stuck]), "Flight", "why no optimum") == ["-", "; ".join(map(str, reasons))]
    assert cells(comparison_rows([good, stuck]), "Solver", "in permanent fallback") == ["0", "318"]
    assert failure_sentences(having(good, "solver", diagnosis={**DIAGNOSIS, "advice": ""}).summary) == [reasons[1]]
