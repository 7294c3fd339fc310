"""The rows of a comparison agree with the summaries."""

import copy
import dataclasses
from pathlib import Path
from typing import Any

import pytest

from quadsim.flight.rundir import Run
from quadsim.report.comparison import comparison_rows, distinct_courses, run_names
from quadsim.report.table import Mark, Row, format_number, to_markdown


@pytest.fixture
def worse_run(short_run: Run) -> Run:
    """The short flight with a larger error in x, roll's bound exceeded but not required, the speed's violated."""
    summary: dict[str, Any] = copy.deepcopy(short_run.summary)
    summary["scenario"] = "worse"
    summary["tracking"]["rmse"]["x"] += 1.0
    for entry in summary["constraints"]:
        if entry["name"] in ("roll", "speed"):
            entry.update(worst_margin=-2.5, time_violated=0.75, satisfied=False, required=entry["name"] == "speed")
    summary["controller"]["step_ms"]["p50"] = 3.0 * short_run.summary["controller"]["step_ms"]["p50"]
    summary["controller"]["deadline_misses"] = 1
    return dataclasses.replace(short_run, summary=summary)


def row(rows: list[Row], label: str, group: str | None = None) -> Row:
    (found,) = (each for each in rows if each.label == label and group in (None, each.group))
    return found


def marks(found: Row) -> list[Mark]:
    return [cell.mark for cell in found.cells]


def test_every_row_has_one_cell_per_run(short_run: Run, worse_run: Run, empty_run: Run) -> None:
    rows = comparison_rows([short_run, worse_run, empty_run])
    assert {len(each.cells) for each in rows} == {3}
    assert len({(each.group, each.label) for each in rows}) == len(rows)


def test_values_are_the_summarys_with_angles_in_degrees(short_run: Run) -> None:
    rows, summary = comparison_rows([short_run]), short_run.summary
    assert float(row(rows, "largest error, yaw").cells[0].text) == pytest.approx(30.0)
    assert row(rows, "largest error, yaw").unit == "deg"
    assert float(row(rows, "RMS error, z").cells[0].text) == pytest.approx(summary["tracking"]["rmse"]["z"], rel=1e-3)
    assert float(row(rows, "highest rotor speed").cells[0].text) == pytest.approx(250.0)
    assert row(rows, "bounds", "Constraint slew").cells[0].text == "-10 .. 5"
    assert row(rows, "bounds", "Constraint arrival_x").cells[0].text == "-0.01 .. 0.01, from 59 s"


def test_a_law_has_its_name_and_a_custom_one_its_description(short_run: Run) -> None:
    for recorded, shown in (("geometric", "geometric control"), ("constrained", "constrained MPC"), ("mine", "mine")):
        summary = {**short_run.summary, "controller": {**short_run.summary["controller"], "name": recorded}}
        rows = comparison_rows([dataclasses.replace(short_run, summary=summary)])
        assert row(rows, "controller").cells[0].text == shown


def test_settling_has_a_row_for_each_step_of_the_courses(short_run: Run) -> None:
    def entry(channel: str, time: float, settled: float | None) -> dict[str, Any]:
        return {"channel": channel, "time": time, "before": 0.0, "after": 1.0, "settled": settled}

    def with_settling(*entries: dict[str, Any]) -> Run:
        summary: dict[str, Any] = copy.deepcopy(short_run.summary)
        summary["tracking"]["settling"] = list(entries)
        return dataclasses.replace(short_run, summary=summary)

    older: dict[str, Any] = copy.deepcopy(short_run.summary)
    del older["tracking"]["settling"]
    rows = comparison_rows(
        [
            with_settling(entry("x", 10.0, 4.05), entry("z", 0.0, 5.0)),
            with_settling(entry("x", 10.0, 5.7), entry("z", 0.0, None)),
            dataclasses.replace(short_run, summary=older),
        ]
    )
    assert [cell.text for cell in row(rows, "settling, x at 10 s").cells] == ["4.05", "5.7", "-"]
    assert marks(row(rows, "settling, x at 10 s")) == [Mark.BEST, Mark.NONE, Mark.NONE]
    assert [cell.text for cell in row(rows, "settling, z at 0 s").cells] == ["5", "-", "-"]


def test_the_best_is_marked_only_where_runs_differ(short_run: Run, worse_run: Run) -> None:
    rows = comparison_rows([worse_run, short_run])
    assert marks(row(rows, "RMS error, x")) == [Mark.NONE, Mark.BEST]
    assert marks(row(rows, "RMS error, y")) == [Mark.NONE, Mark.NONE]


def test_an_aborted_flight_is_never_best(short_run: Run, worse_run: Run, aborted_run: Run) -> None:
    found = row(comparison_rows([aborted_run, worse_run]), "RMS error, x")
    assert marks(found) == [Mark.NONE, Mark.NONE]
    assert marks(row(comparison_rows([aborted_run, worse_run, short_run]), "RMS error, x"))[2] is Mark.BEST


def test_verdicts_carry_their_tolerances_and_what_is_required(short_run: Run, worse_run: Run) -> None:
    rows = comparison_rows([short_run, worse_run])
    held, exceeded = row(rows, "verdict", "Constraint roll").cells
    assert (held.text, held.mark) == ("holds (margin 5 deg, tolerance 0.05)", Mark.GOOD)
    assert exceeded.text == "exceeded, not required (margin -2.5 deg, tolerance 0.05)"
    assert exceeded.mark is Mark.WARN
    violated = row(rows, "verdict", "Constraint speed").cells[1]
    assert violated.text == "violated (margin -2.5 rad/s, tolerance 1e-06)"
    assert violated.mark is Mark.BAD
    assert marks(row(rows, "worst margin at the physics rate", "Constraint roll")) == [Mark.NONE, Mark.WARN]
    assert row(rows, "time violated", "Constraint speed").cells[1].text == "0.75"
    assert marks(row(rows, "deadline misses")) == [Mark.NONE, Mark.BAD]


def test_a_bound_exceeded_in_the_commands_alone_is_marked(short_run: Run) -> None:
    summary: dict[str, Any] = copy.deepcopy(short_run.summary)
    (entry,) = (each for each in summary["constraints"] if each["name"] == "speed")
    entry.update(worst_margin_sampled=-120.0, worst_margin=0.0, time_violated=0.0, satisfied=False, required=False)
    clipped = dataclasses.replace(short_run, summary=summary)
    verdict = row(comparison_rows([clipped]), "verdict", "Constraint speed").cells[0].text
    assert verdict == "exceeded, not required (margin -120 rad/s at the samples, tolerance 1e-06)"


def test_a_constraint_that_a_run_lacks_is_shown_as_absent(short_run: Run) -> None:
    free = dataclasses.replace(short_run, summary={**short_run.summary, "scenario": "free", "constraints": []})
    rows = comparison_rows([free, short_run])
    assert row(rows, "verdict", "Constraint roll").cells[0].text == "-"
    assert row(rows, "required constraints").cells[0].text == "none"


def test_names_are_distinct(short_run: Run, aborted_run: Run) -> None:
    elsewhere = dataclasses.replace(short_run, directory=Path("elsewhere"))
    assert run_names([short_run, aborted_run]) == ("paper-constrained", "lost")
    assert run_names([short_run, elsewhere])[1] == "paper-constrained (elsewhere)"
    assert len(set(run_names([short_run, short_run, elsewhere]))) == 3


def test_a_course_is_drawn_once(short_run: Run, aborted_run: Run, empty_run: Run) -> None:
    control = short_run.log.control
    moved = dataclasses.replace(control, reference=control.reference + 1.0)
    other = dataclasses.replace(short_run, log=dataclasses.replace(short_run.log, control=moved))
    assert distinct_courses([empty_run, short_run, aborted_run, other]) == [short_run, other]


def test_markdown_has_a_line_per_row_and_escapes_bars(short_run: Run, worse_run: Run) -> None:
    rows = comparison_rows([short_run, worse_run])
    lines = to_markdown(rows, ("a|b", "worse")).splitlines()
    assert len(lines) == len(rows) + 2
    assert lines[0] == r"|  |  | a\|b | worse |"
    (best,) = (line for line in lines if "RMS error, x [m]" in line)
    assert best.count("**") == 4, "the group's name, and the better of the two"


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (None, "-"),
        (0.0, "0"),
        (-10.0, "-10"),
        (0.344389, "0.3444"),
        (-2.1e-7, "-2.1e-07"),
        (86400.0, "86400"),
        (1.23e30, "1.2e+30"),
    ],
)
def test_numbers_are_short(value: float | None, text: str) -> None:
    assert format_number(value) == text
