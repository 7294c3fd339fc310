"""The rows of a comparison agree with the summaries, and the verdicts with their constraints."""

import dataclasses
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support import recording, renamed

from quadsim.flight.audit import Finding
from quadsim.report.comparison import conclusion, distinct_courses, run_names
from quadsim.report.comparison_rows import GLANCE, comparison_rows, verdict_cell
from quadsim.report.flight_sentences import failure_sentences, violated_otherwise
from quadsim.report.table import Cell, Mark, QuantityRow, format_number, to_markdown
from quadsim.rollout.flown import Flight
from quadsim.state import VELOCITY


def having(flight: Flight, name: str, **entries: Any) -> Flight:
    """A flight under another name, with other entries of its summary."""
    return renamed(recording(flight, **entries), name)


def with_margin(finding: Finding, margin: float, **demands: Any) -> Finding:
    """A finding of a constraint that was held, or violated, by a margin."""
    limit = dataclasses.replace(finding.limit, **{"required": True, **demands})
    return dataclasses.replace(
        finding, limit=limit, worst_margin=margin, worst_margin_sampled=margin, worst_time=1.0, time_violated=0.0
    )


def unreached(finding: Finding, name: str) -> Finding:
    """A finding of a required constraint whose window the flight did not reach."""
    nothing = dict.fromkeys(("worst_margin", "worst_margin_sampled", "worst_time"), math.nan)
    return dataclasses.replace(with_margin(finding, 1.0, name=name), **nothing)


def lost(flight: Flight, reason: str) -> Flight:
    """The flight as if it had been lost."""
    return dataclasses.replace(flight, log=dataclasses.replace(flight.log, reason=reason))


def in_fallback(flight: Flight, periods: int) -> Flight:
    """The flight as if it had been in fallback for its last periods."""
    fallback = flight.log.control.fallback.copy()
    fallback[-periods:] = 2
    control = dataclasses.replace(flight.log.control, fallback=fallback)
    controller = {**flight.numbers["controller"], "unrecovered": periods}
    stuck = dataclasses.replace(flight, log=dataclasses.replace(flight.log, control=control))
    return recording(stuck, controller=controller)


@pytest.fixture
def bare_run(short_run: Flight) -> Flight:
    """The short flight as an older version wrote it: without what it met, expected, or could not solve."""
    absent = {"course", "events", "ground", "expected", "diagnosis"}
    recorded = {key: value for key, value in short_run.numbers.items() if key not in absent}
    return renamed(dataclasses.replace(short_run, recorded=recorded), "bare")


@pytest.fixture
def worse_run(short_run: Flight) -> Flight:
    """The short flight with a larger error in x, roll's bound exceeded but not required, the speed's violated."""
    run = having(short_run, "worse")
    run.numbers["tracking"]["rmse"]["x"] += 1.0
    run.numbers["controller"]["deadline_misses"] = 1
    findings = []
    for finding in run.findings:
        if finding.limit.name in ("roll", "speed"):
            limit = dataclasses.replace(finding.limit, required=finding.limit.name == "speed")
            finding = dataclasses.replace(finding, limit=limit, worst_margin=-2.5, time_violated=0.75)
        findings.append(finding)
    return dataclasses.replace(run, findings=tuple(findings))


def cells(rows: list[QuantityRow], label: str, group: str | None = None) -> tuple[Cell, ...]:
    (result,) = (row for row in rows if row.label == label and group in (None, row.group))
    return result.cells


def texts(rows: list[QuantityRow], label: str, group: str | None = None) -> list[str]:
    return [cell.text for cell in cells(rows, label, group)]


def marks(rows: list[QuantityRow], label: str, group: str | None = None) -> list[Mark]:
    return [cell.mark for cell in cells(rows, label, group)]


def judged(run: Flight, name: str, rmse: float, **margins: float) -> Flight:
    """The short flight with an RMS error in x alone, and no constraints but these, with their worst margins."""
    findings = [with_margin(run.findings[0], margin, name=each) for each, margin in margins.items()]
    errors = {**run.numbers["tracking"]["rmse"], "x": rmse, "y": 0.0, "z": 0.0}
    flight = having(run, name, tracking={**run.numbers["tracking"], "rmse": errors})
    return dataclasses.replace(flight, findings=tuple(findings), label=name)


def test_the_conclusion_says_who_holds_and_who_is_closer_by_how_much(short_run: Flight) -> None:
    def says(*runs: Flight) -> Cell:
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
    assert says(mine, judged(short_run, "twin", 0.25, roll=1.0, pitch=2.0)) == Cell(text=same, mark=Mark.GOOD)
    still = [judged(short_run, name, rmse, roll=1.0) for name, rmse in (("still", 1e-12), ("rest", 2e-12))]
    assert "position errors are equal: < 1 nm" in says(*still).text
    strict = dataclasses.replace(paper, findings=paper.findings[:1])
    assert says(mine, strict).text == f"Both flights hold their own constraints; {closer}"
    assert says(strict, wild).text.startswith("paper holds its own constraints, wild violates roll and pitch; ")
    assert says(mine) == Cell(text="mine holds every constraint.", mark=Mark.GOOD)
    three = "mine and paper hold every constraint, wild violates roll and pitch; wild tracks closest: "
    assert says(mine, paper, wild).text == f"{three}0.1 m RMS position error against 0.25 m of the next (60 % less)."
    findings = [with_margin(finding, finding.worst_margin, required=False) for finding in wild.findings]
    reported = dataclasses.replace(wild, findings=tuple(findings))
    assert (says(mine, reported).mark, says(mine, reported).text) == (Mark.WARN, says(mine, wild).text)


def test_the_conclusion_compares_no_errors_of_lost_flights_or_other_courses(
    short_run: Flight, aborted_run: Flight
) -> None:
    mine = judged(short_run, "mine", 0.25, roll=1.0)
    ended = dataclasses.replace(aborted_run, findings=mine.findings)
    assert conclusion([mine, ended], ["mine", "lost"]).text == "mine holds every constraint, lost was lost."
    control = dataclasses.replace(short_run.log.control, reference=short_run.log.control.reference + 1.0)
    other = judged(short_run, "other", 0.1, roll=1.0)
    elsewhere = dataclasses.replace(other, log=dataclasses.replace(short_run.log, control=control))
    assert conclusion([mine, elsewhere], ["mine", "other"]).text == "Both flights hold every constraint."
    bare = dataclasses.replace(short_run, findings=())
    assert conclusion([bare], ["bare"]) == Cell(text="bare is not audited.")
    short = dataclasses.replace(short_run, findings=(unreached(short_run.findings[0], "arrival"),))
    assert conclusion([short], ["short"]) == Cell(text="short does not reach arrival.", mark=Mark.WARN)
    stuck = in_fallback(judged(short_run, "stuck", 0.1, roll=1.0), 40)
    assert conclusion([stuck], ["stuck"]).text == "stuck holds its constraints, but in permanent fallback."


def test_values_are_the_summarys_with_angles_in_degrees(
    short_run: Flight, worse_run: Flight, empty_run: Flight
) -> None:
    rows = comparison_rows([short_run, worse_run, empty_run])
    assert {len(row.cells) for row in rows} == {3}
    assert len({(row.group, row.label) for row in rows}) == len(rows)
    assert float(texts(rows, "largest error, yaw")[0]) == pytest.approx(30.0)
    assert {row.unit for row in rows if row.label == "largest error, yaw"} == {"deg"}
    assert float(texts(rows, "RMS error, z")[0]) == pytest.approx(short_run.numbers["tracking"]["rmse"]["z"], rel=1e-3)
    assert float(texts(rows, "highest rotor speed")[0]) == pytest.approx(250.0)
    assert texts(rows, "bounds", "Constraint slew")[0] == "-10 .. 5"
    assert texts(rows, "bounds", "Constraint arrival_x")[0] == "-0.01 .. 0.01, from 59 s"
    assert texts(rows, "controller")[0] == "constrained MPC"


def test_the_best_of_completed_flights_is_marked_where_they_differ(
    short_run: Flight, worse_run: Flight, aborted_run: Flight
) -> None:
    rows = comparison_rows([aborted_run, worse_run, short_run])
    assert marks(rows, "RMS error, x") == [Mark.NONE, Mark.NONE, Mark.BEST]
    assert marks(rows, "RMS error, y") == [Mark.NONE] * 3
    assert marks(comparison_rows([aborted_run, worse_run]), "RMS error, x") == [Mark.NONE] * 2


def test_what_a_law_does_not_report_is_absent_and_never_the_best(short_run: Flight, worse_run: Flight) -> None:
    unreported = {"solve_ms": dict.fromkeys(("p50", "p95", "p99", "max")), "active_max": None}
    silent = having(short_run, "silent", controller=short_run.numbers["controller"] | unreported)
    rows = comparison_rows([silent, worse_run, short_run])
    label = "optimum alone, by any answerer, median"
    assert texts(rows, label)[0] == texts(rows, "active constraints, most")[0] == "-"
    assert marks(rows, label)[0] is Mark.NONE


def test_constraints_carry_their_tolerances_and_what_is_required(short_run: Flight, worse_run: Flight) -> None:
    free = dataclasses.replace(short_run, findings=())
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


def test_five_rows_come_first_and_no_bound_is_exceeded_without_a_word(short_run: Flight, worse_run: Flight) -> None:
    rows = comparison_rows([short_run, worse_run])
    assert [row.label for row in rows if row.group == GLANCE] == [
        *("outcome", "worst constraint", "RMS error, position", "highest speed", "step time")
    ]
    findings = []
    for finding in worse_run.findings:
        limit = dataclasses.replace(finding.limit, required=finding.limit.name.startswith("arrival"))
        findings.append(dataclasses.replace(finding, limit=limit))
    short = dataclasses.replace(worse_run, findings=tuple(findings))
    short = recording(short, expected="incomplete", as_expected=True)
    (_, outcome), (_, worst) = (cells(comparison_rows([short_run, short]), row.label) for row in rows[:2])
    assert outcome.text.startswith("incomplete, as expected; not reached: arrival_x")
    assert outcome.text.endswith("; violated, not required: roll, speed")
    assert worst == Cell(text="roll violated, not required (margin -2.5 deg, tolerance 0.05)", mark=Mark.WARN)
    reached = [with_margin(finding, 0.01) if finding.limit.required else finding for finding in findings]
    held = dataclasses.replace(worse_run, findings=tuple(reached))
    held = recording(held, expected="satisfied", as_expected=True)
    (_, outcome) = cells(comparison_rows([short_run, held]), "outcome")
    assert outcome == Cell(text="satisfied, as expected; violated, not required: roll, speed", mark=Mark.WARN)
    speeds = short_run.log.plant.state[:, VELOCITY]
    assert texts(rows, "highest speed")[0] == format_number(float(np.linalg.norm(speeds, axis=1).max()))
    errors = [short_run.numbers["tracking"]["rmse"][axis] for axis in "xyz"]
    assert texts(rows, "RMS error, position")[0] == format_number(float(np.linalg.norm(errors)))


def test_a_bound_exceeded_in_the_commands_alone_is_marked(short_run: Flight) -> None:
    (speed,) = (finding for finding in short_run.findings if finding.limit.name == "speed")
    clipped = with_margin(speed, 0.0, required=False)
    clipped = dataclasses.replace(clipped, worst_margin_sampled=-120.0)
    run = dataclasses.replace(short_run, findings=(clipped,))
    shown = texts(comparison_rows([run]), "verdict", "Constraint speed")
    assert shown == ["violated, not required (margin -120 rad/s at the samples, tolerance 1e-06)"]


def test_runs_have_distinct_names_and_a_course_is_drawn_once(
    short_run: Flight, aborted_run: Flight, empty_run: Flight
) -> None:
    elsewhere = dataclasses.replace(short_run, directory=Path("elsewhere"))
    assert run_names([short_run, aborted_run]) == ("paper-constrained", "lost")
    assert run_names([short_run, elsewhere])[1] == "paper-constrained (elsewhere)"
    assert len(set(run_names([short_run, short_run, elsewhere]))) == 3
    controller = {**short_run.numbers["controller"], "name": "MyLaw"}
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


def test_markdown_has_a_line_per_row_and_escapes_bars(short_run: Flight, worse_run: Flight) -> None:
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
    bare_run: Flight, status: str, margin: float, expected: str, text: str, mark: Mark
) -> None:
    run = recording(bare_run, expected=expected, as_expected=text.endswith("as expected"))
    run = dataclasses.replace(run, findings=(with_margin(run.findings[0], margin),))
    if status == "aborted":
        run = lost(run, "at t = 3 s: too far")
    assert verdict_cell(run) == Cell(text=text, mark=mark)


def test_a_verdict_minds_required_constraints_and_whether_they_were_reached(bare_run: Flight) -> None:
    finding = bare_run.findings[0]
    missed = unreached(finding, "arrival")
    held = with_margin(finding, 1.0)
    broken = with_margin(finding, -1.0)
    reported = dataclasses.replace(missed, limit=dataclasses.replace(missed.limit, required=False))
    result = {
        "incomplete": [held, missed],
        "violated": [broken, missed],
        "satisfied": [with_margin(finding, -1.0, required=False), reported],
        "unaudited": [],
    }
    for word, findings in result.items():
        assert dataclasses.replace(bare_run, findings=tuple(findings)).outcome == word


def test_permanent_fallback_is_no_success_and_is_reported_with_its_reason(bare_run: Flight) -> None:
    held, broken = (tuple(with_margin(finding, by) for finding in bare_run.findings) for by in (1.0, -1.0))
    result = {"sentence": "no answer at t = 1.00 s", "advice": "to try: more", "time": 1.0}
    good = dataclasses.replace(bare_run, findings=held)
    stuck = recording(in_fallback(good, 118), diagnosis=result)
    crashed = recording(good, ground={"crashed": True})
    assert violated_otherwise(stuck) == "but in permanent fallback"
    assert violated_otherwise(crashed) is None
    assert violated_otherwise(dataclasses.replace(stuck, findings=broken)) is None
    assert (good.outcome, stuck.outcome) == ("satisfied", "violated")
    reasons = ["118 periods in fallback, never recovered", result["sentence"], result["advice"]]
    assert failure_sentences(stuck) == reasons
    rows = comparison_rows([good, stuck])
    assert texts(rows, "why no optimum") == ["-", "; ".join(map(str, reasons))]
    assert texts(rows, "in permanent fallback") == ["0", "118"]


def test_a_vehicle_that_never_took_off_is_violated_and_told_so(bare_run: Flight) -> None:
    held, broken = (tuple(with_margin(finding, by) for finding in bare_run.findings) for by in (1.0, -1.0))
    controller = {**bare_run.numbers["controller"], "never_took_off": 1.0}
    stays = recording(dataclasses.replace(bare_run, findings=held), controller=controller)
    reason = "told to take off at t = 1 s, never left the ground"
    assert failure_sentences(stays) == [reason]
    assert violated_otherwise(stays) == "but it never took off"
    assert violated_otherwise(dataclasses.replace(stays, findings=broken)) is None
    rows = comparison_rows([stays, lost(stays, "at t = 3 s: too far")])
    first, other = texts(rows, "outcome")
    assert first.endswith(reason)
    assert other.startswith("lost")
    assert other.endswith("at t = 3 s: too far")
    assert texts(rows, "why no optimum") == ["-", "-"]
