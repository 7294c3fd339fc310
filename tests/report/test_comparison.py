"""The rows of a comparison agree with the summaries, and the verdicts with their constraints."""

import copy
import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from quadsim.flight.audit import flight_verdict
from quadsim.flight.rundir import Run, findings_of
from quadsim.report.comparison import (
    GLANCE,
    comparison_rows,
    conclusion,
    distinct_courses,
    failure_sentences,
    run_names,
    verdict_cell,
    violated_otherwise,
)
from quadsim.report.table import Cell, Mark, QuantityRow, format_number, to_markdown
from quadsim.state import VELOCITY


def having(run: Run, scenario: str, **entries: Any) -> Run:
    return dataclasses.replace(run, summary={**copy.deepcopy(run.summary), "scenario": scenario, **entries})


def with_margin(entry: dict[str, Any], margin: float) -> dict[str, Any]:
    """A required constraint that was held, or violated, by a margin."""
    margins = dict.fromkeys(("worst_margin", "worst_margin_sampled"), margin)
    result = {"required": True, "satisfied": margin >= 0.0, "verdict": "satisfied" if margin >= 0.0 else "violated"}
    return {**entry, **margins, **result, "worst_time": 1.0}


@pytest.fixture
def bare_run(short_run: Run) -> Run:
    """The short flight as an older version wrote it: without what it met, expected, or could not solve."""
    bare = {
        key: value
        for key, value in short_run.summary.items()
        if key not in {"course", "events", "ground", "expected", "diagnosis"}
    }
    return having(dataclasses.replace(short_run, summary=bare), "bare")


@pytest.fixture
def worse_run(short_run: Run) -> Run:
    """The short flight with a larger error in x, roll's bound exceeded but not required, the speed's violated."""
    run = having(short_run, "worse")
    run.summary["tracking"]["rmse"]["x"] += 1.0
    for entry in run.summary["constraints"]:
        if entry["name"] in ("roll", "speed"):
            entry.update(worst_margin=-2.5, time_violated=0.75, satisfied=False, required=entry["name"] == "speed")
    run.summary["controller"]["deadline_misses"] = 1
    return run


def cells(rows: list[QuantityRow], label: str, group: str | None = None) -> tuple[Cell, ...]:
    (result,) = (row for row in rows if row.label == label and group in (None, row.group))
    return result.cells


def texts(rows: list[QuantityRow], label: str, group: str | None = None) -> list[str]:
    return [cell.text for cell in cells(rows, label, group)]


def marks(rows: list[QuantityRow], label: str, group: str | None = None) -> list[Mark]:
    return [cell.mark for cell in cells(rows, label, group)]


def judged(run: Run, name: str, rmse: float, **margins: float) -> Run:
    """The short flight with an RMS error in x alone, and no constraints but these, with their worst margins."""
    entry, verdict = run.summary["constraints"][0], "satisfied" if min(margins.values()) >= 0.0 else "violated"
    constraints = [{**with_margin(entry, margin), "name": each} for each, margin in margins.items()]
    rmse_table = {**run.summary["tracking"]["rmse"], "x": rmse, "y": 0.0, "z": 0.0}
    return having(
        dataclasses.replace(run, label=name),
        name,
        verdict=verdict,
        constraints=constraints,
        tracking={**run.summary["tracking"], "rmse": rmse_table},
    )


def test_the_conclusion_says_who_holds_and_who_is_closer_by_how_much(short_run: Run) -> None:
    def says(*runs: Run) -> Cell:
        return conclusion(runs, run_names(runs))

    mine = judged(short_run, "mine", 0.25, roll=1.0, pitch=2.0)
    paper = judged(short_run, "paper", 0.5, roll=1.0, pitch=2.0)
    wild = judged(short_run, "wild", 0.1, roll=-1.0, pitch=-2.0)
    closer = "mine tracks closer: 0.25 m RMS position error against 0.5 m (50 % less)."
    assert says(mine, paper) == Cell(text=f"Both flights hold every constraint; {closer}", mark=Mark.GOOD)
    assert says(paper, mine) == says(mine, paper)
    assert says(mine, wild) == Cell(
        text="mine holds every constraint, wild violates roll and pitch; "
        "wild tracks closer: 0.1 m RMS position error against 0.25 m (60 % less).",
        mark=Mark.BAD,
    )
    torn = judged(short_run, "torn", 0.1, roll=1.0, pitch=-2.0)
    neither = "wild violates roll and pitch and torn violates pitch; position errors are equal: 0.1 m RMS."
    assert says(wild, torn) == Cell(text=neither, mark=Mark.BAD)
    same = "Both flights hold every constraint; position errors are equal: 0.25 m RMS."
    assert says(mine, judged(short_run, "twin", 0.25, roll=1.0)) == Cell(text=same, mark=Mark.GOOD)
    still = [judged(short_run, name, rmse, roll=1.0) for name, rmse in (("still", 1e-12), ("rest", 2e-12))]
    assert says(*still).text == "Both flights hold every constraint; position errors are equal: < 1 nm RMS."
    strict = dataclasses.replace(paper, limits=paper.limits[:1])
    assert says(mine, strict).text == f"Both flights hold their own constraints; {closer}"
    assert says(strict, wild).text.startswith("paper holds its own constraints, wild violates roll and pitch; ")
    assert says(mine) == Cell(text="mine holds every constraint.", mark=Mark.GOOD)
    three = "mine and paper hold every constraint, wild violates roll and pitch; wild tracks closest: "
    assert says(mine, paper, wild).text == f"{three}0.1 m RMS position error against 0.25 m of the next (60 % less)."
    for entry in wild.summary["constraints"]:
        entry["required"] = False
    reported = dataclasses.replace(wild, summary={**wild.summary, "verdict": "satisfied"})
    assert (says(mine, reported).mark, says(mine, reported).text) == (Mark.WARN, says(mine, wild).text)


def test_the_conclusion_compares_no_errors_of_lost_flights_or_other_courses(short_run: Run, aborted_run: Run) -> None:
    mine = judged(short_run, "mine", 0.25, roll=1.0)
    lost = having(aborted_run, "lost", verdict="lost", constraints=[])
    assert conclusion([mine, lost], ["mine", "lost"]).text == "mine holds every constraint, lost was lost."
    control = dataclasses.replace(short_run.log.control, reference=short_run.log.control.reference + 1.0)
    other = judged(short_run, "other", 0.1, roll=1.0)
    elsewhere = dataclasses.replace(other, log=dataclasses.replace(short_run.log, control=control))
    assert conclusion([mine, elsewhere], ["mine", "other"]).text == "Both flights hold every constraint."
    bare = having(short_run, "bare", verdict="unaudited", constraints=[], status="aborted")
    assert conclusion([bare], ["bare"]) == Cell(text="bare is not audited.")
    unmet = {**with_margin(short_run.summary["constraints"][0], 1.0), "name": "arrival"}
    unmet.update(dict.fromkeys(("worst_margin", "worst_margin_sampled", "worst_time")), satisfied=False)
    short = having(short_run, "short", verdict="incomplete", constraints=[unmet])
    assert conclusion([short], ["short"]) == Cell(text="short does not reach arrival.", mark=Mark.WARN)
    stuck = judged(short_run, "stuck", 0.1, roll=1.0)
    stuck.summary.update(verdict="violated", controller={**stuck.summary["controller"], "unrecovered": 40})
    assert conclusion([stuck], ["stuck"]).text == "stuck holds its constraints, but in permanent fallback."


def test_values_are_the_summarys_with_angles_in_degrees(short_run: Run, worse_run: Run, empty_run: Run) -> None:
    rows = comparison_rows([short_run, worse_run, empty_run])
    assert {len(row.cells) for row in rows} == {3}
    assert len({(row.group, row.label) for row in rows}) == len(rows)
    assert float(texts(rows, "largest error, yaw")[0]) == pytest.approx(30.0)
    assert {row.unit for row in rows if row.label == "largest error, yaw"} == {"deg"}
    assert float(texts(rows, "RMS error, z")[0]) == pytest.approx(short_run.summary["tracking"]["rmse"]["z"], rel=1e-3)
    assert float(texts(rows, "highest rotor speed")[0]) == pytest.approx(250.0)
    assert texts(rows, "bounds", "Constraint slew")[0] == "-10 .. 5"
    assert texts(rows, "bounds", "Constraint arrival_x")[0] == "-0.01 .. 0.01, from 59 s"
    assert texts(rows, "controller")[0] == "constrained MPC"


def test_the_best_of_completed_flights_is_marked_where_they_differ(
    short_run: Run, worse_run: Run, aborted_run: Run
) -> None:
    rows = comparison_rows([aborted_run, worse_run, short_run])
    assert marks(rows, "RMS error, x") == [Mark.NONE, Mark.NONE, Mark.BEST]
    assert marks(rows, "RMS error, y") == [Mark.NONE] * 3
    assert marks(comparison_rows([aborted_run, worse_run]), "RMS error, x") == [Mark.NONE] * 2


def test_what_a_law_does_not_report_is_absent_and_never_the_best(short_run: Run, worse_run: Run) -> None:
    unreported = {"solve_ms": dict.fromkeys(("p50", "p95", "p99", "max")), "active_max": None}
    silent = having(short_run, "silent", controller=short_run.summary["controller"] | unreported)
    rows = comparison_rows([silent, worse_run, short_run])
    label = "optimum alone, by any answerer, median"
    assert texts(rows, label)[0] == texts(rows, "active constraints, most")[0] == "-"
    assert marks(rows, label)[0] is Mark.NONE


def test_constraints_carry_their_tolerances_and_what_is_required(short_run: Run, worse_run: Run) -> None:
    free = having(short_run, "free", constraints=[])
    rows = comparison_rows([short_run, worse_run, free])
    assert texts(rows, "verdict", "Constraint roll") == [
        "holds (margin 5 deg, tolerance 0.05)", "violated, not required (margin -2.5 deg, tolerance 0.05)", "-",
    ]  # fmt: skip
    assert marks(rows, "verdict", "Constraint roll")[:2] == [Mark.GOOD, Mark.WARN]
    assert texts(rows, "verdict", "Constraint speed")[1] == "violated (margin -2.5 rad/s, tolerance 1e-06)"
    assert marks(rows, "verdict", "Constraint speed")[1] is Mark.BAD
    assert marks(rows, "worst margin at the physics rate", "Constraint roll")[:2] == [Mark.NONE, Mark.WARN]
    assert texts(rows, "time violated", "Constraint speed")[1] == "0.75"
    assert marks(rows, "deadline misses")[1] is Mark.BAD
    assert texts(rows, "required constraints")[2] == "none audited"


def test_five_rows_come_first_and_no_bound_is_exceeded_without_a_word(short_run: Run, worse_run: Run) -> None:
    rows = comparison_rows([short_run, worse_run])
    assert [row.label for row in rows if row.group == GLANCE] == [
        *("outcome", "worst constraint", "RMS error, position", "highest speed", "step time")
    ]
    for entry in worse_run.summary["constraints"]:
        entry["required"] = entry["name"].startswith("arrival")
    worse_run.summary.update(expected="incomplete", as_expected=True)
    (_, outcome), (_, worst) = (cells(comparison_rows([short_run, worse_run]), row.label) for row in rows[:2])
    assert outcome.text.startswith("incomplete, as expected; not reached: arrival_x")
    assert outcome.text.endswith("; violated, not required: roll, speed")
    assert worst == Cell(text="roll violated, not required (margin -2.5 deg, tolerance 0.05)", mark=Mark.WARN)
    for entry in worse_run.summary["constraints"]:
        if entry["required"]:
            entry.update(with_margin(entry, 0.01))
    worse_run.summary.update(expected="satisfied")
    worse_run.summary["verdict"] = "satisfied"
    (_, outcome) = cells(comparison_rows([short_run, worse_run]), "outcome")
    assert outcome == Cell(text="satisfied, as expected; violated, not required: roll, speed", mark=Mark.WARN)
    speeds = short_run.log.plant.state[:, VELOCITY]
    assert texts(rows, "highest speed")[0] == format_number(float(np.linalg.norm(speeds, axis=1).max()))
    errors = [short_run.summary["tracking"]["rmse"][axis] for axis in "xyz"]
    assert texts(rows, "RMS error, position")[0] == format_number(float(np.linalg.norm(errors)))


def test_a_bound_exceeded_in_the_commands_alone_is_marked(short_run: Run) -> None:
    run = having(short_run, "clipped")
    (entry,) = (each for each in run.summary["constraints"] if each["name"] == "speed")
    entry.update(worst_margin_sampled=-120.0, worst_margin=0.0, time_violated=0.0, satisfied=False, required=False)
    shown = texts(comparison_rows([run]), "verdict", "Constraint speed")
    assert shown == ["violated, not required (margin -120 rad/s at the samples, tolerance 1e-06)"]


def test_runs_have_distinct_names_and_a_course_is_drawn_once(short_run: Run, aborted_run: Run, empty_run: Run) -> None:
    elsewhere = dataclasses.replace(short_run, directory=Path("elsewhere"))
    assert run_names([short_run, aborted_run]) == ("paper-constrained", "lost")
    assert run_names([short_run, elsewhere])[1] == "paper-constrained (elsewhere)"
    assert len(set(run_names([short_run, short_run, elsewhere]))) == 3
    controller = {**short_run.summary["controller"], "name": "MyLaw"}
    own = having(short_run, "paper-constrained", controller=controller)
    assert run_names([short_run, own]) == ("paper-constrained (constrained MPC)", "paper-constrained (MyLaw)")
    own_elsewhere = dataclasses.replace(own, directory=Path("elsewhere"))
    assert run_names([short_run, own, own_elsewhere, aborted_run]) == (
        "paper-constrained (constrained MPC)",
        "paper-constrained (MyLaw, paper-constrained)",
        "paper-constrained (MyLaw, elsewhere)",
        "lost",
    )
    assert run_names([own, own]) == ("paper-constrained, 1", "paper-constrained, 2")
    assert run_names([dataclasses.replace(own, label="mine"), own]) == ("mine", "paper-constrained")
    control = dataclasses.replace(short_run.log.control, reference=short_run.log.control.reference + 1.0)
    other = dataclasses.replace(short_run, log=dataclasses.replace(short_run.log, control=control))
    assert distinct_courses([empty_run, short_run, aborted_run, other]) == [short_run, other]


def test_markdown_has_a_line_per_row_and_escapes_bars(short_run: Run, worse_run: Run) -> None:
    rows = comparison_rows([short_run, worse_run])
    lines = to_markdown(rows, ("a|b", "worse")).splitlines()
    assert len(lines) == len(rows) + 2
    assert lines[0] == r"|  |  | a\|b | worse |"
    (best,) = (line for line in lines if "RMS error, x [m]" in line)
    assert best.count("**") == 4, "the group's name, and the better of the two"
    numbers = {None: "-", 0.0: "0", -10.0: "-10", 0.344389: "0.3444", -2.1e-7: "-2.1e-07", 1.23e30: "1.2e+30"}
    assert {value: format_number(value) for value in numbers} == numbers


@pytest.mark.parametrize(
    ("status", "margin", "expected", "text", "mark"),
    [
        ("completed", 1.0, "satisfied", "satisfied, as expected", Mark.GOOD),
        ("completed", -1.0, "violated", "violated, as expected", Mark.NONE),
        ("completed", 1.0, "lost", "satisfied (expected lost)", Mark.BAD),
        ("aborted", 1.0, "lost", "lost, as expected", Mark.NONE),
    ],
)
def test_a_verdict_is_compared_with_the_one_the_scenario_states(
    bare_run: Run, status: str, margin: float, expected: str, text: str, mark: Mark
) -> None:
    constraints = [with_margin(bare_run.summary["constraints"][0], margin)]
    as_expected = text.endswith("as expected")
    verdict = text.partition(" ")[0].strip(",")
    run = having(
        bare_run,
        "a",
        status=status,
        verdict=verdict,
        constraints=constraints,
        expected=expected,
        as_expected=as_expected,
    )
    assert verdict_cell(run.summary) == Cell(text=text, mark=mark)


def test_a_verdict_minds_required_constraints_and_whether_they_were_reached(bare_run: Run) -> None:
    entry = bare_run.summary["constraints"][0]
    beyond = dict.fromkeys(("worst_margin", "worst_margin_sampled", "worst_time"))
    unreached = {**with_margin(entry, 1.0), **beyond, "name": "arrival", "satisfied": False}
    held, broken = with_margin(entry, 1.0), with_margin(entry, -1.0)
    result = {
        "incomplete": [held, unreached],
        "violated": [broken, unreached],
        "satisfied": [{**broken, "required": False}, {**unreached, "required": False}],
        "unaudited": [],
    }
    for word, constraints in result.items():
        findings = findings_of({"constraints": constraints})
        assert flight_verdict(findings, aborted=False, lost=False, failed=False) == word


def test_permanent_fallback_is_no_success_and_is_reported_with_its_reason(bare_run: Run) -> None:
    held, broken = ([with_margin(entry, by) for entry in bare_run.summary["constraints"]] for by in (1.0, -1.0))
    result = {"sentence": "no answer at t = 1.00 s", "advice": "to try: more", "time": 1.0}
    controller = {**bare_run.summary["controller"], "unrecovered": 318}
    good = having(bare_run, "good", constraints=held)
    stuck = having(good, "stuck", controller=controller, diagnosis=result)
    crashed = having(good, "crashed", ground={"crashed": True})
    assert violated_otherwise(stuck.summary) == "but in permanent fallback"
    assert violated_otherwise(crashed.summary) is None
    assert violated_otherwise(having(stuck, "both", constraints=broken).summary) is None
    reasons = ["318 periods in fallback, never recovered", result["sentence"], result["advice"]]
    assert failure_sentences(stuck.summary) == reasons
    rows = comparison_rows([good, stuck])
    assert texts(rows, "why no optimum") == ["-", "; ".join(map(str, reasons))]
    assert texts(rows, "in permanent fallback") == ["0", "318"]


def test_a_vehicle_that_never_took_off_is_violated_and_told_so(bare_run: Run) -> None:
    held, broken = ([with_margin(entry, by) for entry in bare_run.summary["constraints"]] for by in (1.0, -1.0))
    controller = {**bare_run.summary["controller"], "never_took_off": 1.0}
    stays = having(bare_run, "stays", verdict="violated", constraints=held, controller=controller)
    reason = "told to take off at t = 1 s, never left the ground"
    assert failure_sentences(stays.summary) == [reason]
    assert violated_otherwise(stays.summary) == "but it never took off"
    assert violated_otherwise(having(stays, "both", constraints=broken).summary) is None
    rows = comparison_rows(
        [stays, having(stays, "lost", status="aborted", verdict="lost", reason="at t = 3 s: too far")]
    )
    first, lost = texts(rows, "outcome")
    assert first.endswith(reason)
    assert lost.startswith("lost")
    assert lost.endswith("at t = 3 s: too far")
    assert texts(rows, "why no optimum") == ["-", "-"]
