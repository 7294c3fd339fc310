"""The section on the cost of constraints reports what the study holds."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from quadsim.report.figures.canvas import write_drawings
from quadsim.report.table import Cell, Grid, Mark
from scenarios.cost.cost_curves import lost_at, step_curves, sweep_panels
from scenarios.cost.cost_figures import write_cost_figures
from scenarios.cost.cost_plots import cost_plots
from scenarios.cost.cost_tables import cost_markdown, cost_tables
from scenarios.cost.section import cost_sentences
from scenarios.cost.study import MEASURES, CostStudy


def table(study: CostStudy, key: str) -> Grid:
    return {grid.key: grid for grid in cost_tables(study)}[key]


def line(grid: Grid, name: str) -> tuple[Cell, ...]:
    (found,) = (cells for cells in grid.lines if cells[0].text == name)
    return found


def texts(cells: tuple[Cell, ...]) -> list[str]:
    return [cell.text for cell in cells[1:]]


def test_every_line_is_as_long_as_its_head(cost_study: CostStudy) -> None:
    for grid in cost_tables(cost_study):
        assert {len(cells) for cells in grid.lines} == {len(grid.head)}, grid.title


def test_times_become_shares_of_the_period_and_rates(cost_study: CostStudy) -> None:
    grid = table(cost_study, "computation")
    assert texts(line(grid, "as flown")) == ["5.5", "9.55", "9.91", "10", "20 %", "101", "100", "1"]
    assert texts(line(grid, "... its 6 periods answered by the unconstrained optimum"))[0] == "3.5"
    assert texts(line(grid, "... its 4 periods answered with active constraints"))[0] == "8.5"
    late = line(grid, "QP by slow")
    assert (late[5].text, late[5].mark) == ("160 %", Mark.BAD)
    assert line(grid, "gain")[5].mark is Mark.NONE
    assert "the median of 1 or 3 repeats" in grid.note
    assert "Left out: absent, pip install it." in grid.note


def test_a_difference_is_with_constraints_less_without(cost_study: CostStudy) -> None:
    grid = table(cost_study, "bounds")
    assert grid.head == ("", "bounded", "without its constraints", "difference", "ratio", "free")
    assert texts(line(grid, "peak tilt at the samples [deg]")) == ["2", "4", "-2", "0.5", "3"]
    assert texts(line(grid, "settling, x at 0 s [s] (filtered reference: 5)")) == ["4", "8", "-4", "0.5", "4"]
    assert texts(line(grid, "settling, x at 10 s [s]")) == ["3", "3", "0", "1", "3"]


def test_a_lost_flight_is_shown_as_such_and_its_numbers_are_not(cost_study: CostStudy) -> None:
    lost = line(table(cost_study, "tilt-sweep"), "10")
    assert (lost[1].text, lost[1].mark) == ("lost at 0.5 s", Mark.BAD)
    assert [cell.text for cell in lost[6:]] == ["-"] * 9
    free = line(table(cost_study, "horizon-sweep"), "10")
    assert [cell.text for cell in free[-4:]] == ["lost at 0.5 s", "-", "-", "-"]
    assert texts(line(table(cost_study, "sensitivity"), "RMS error x [m]")) == ["6", "7.5", "-", "1.5"]


def test_a_sweep_shows_statuses_held_plans_and_what_never_settles(cost_study: CostStudy) -> None:
    grid = table(cost_study, "tilt-sweep")
    first, own = line(grid, "2"), line(grid, "5")
    assert texts(first)[:9] == ["completed", "3", "6", "1", "30", "9", "12", "15", "never (1 of 2 steps)"]
    assert first[4].mark is Mark.BAD
    assert own[0].mark is Mark.BEST
    assert own[9].text == "4 s"
    assert texts(own)[-2:] == ["0.5", "0.9"]


def test_the_sentences_answer_in_numbers(cost_study: CostStudy) -> None:
    written = "\n".join(cost_sentences(cost_study))
    for part in (
        "with constraints a step takes 5.5 ms in the median, 9.9 ms at the 99th percentile and 10 ms at most",
        "That is 100 times and 100 times what the gain",
        "the longest step is 20 % of the period of 50 ms, and enough for 100 Hz",
        "In 6 of 10 periods the unconstrained optimum satisfies every constraint",
        "QP by slow 44 ms in the median and 80 ms at most, 12.5 Hz, 4 of its steps too late",
        "x 6 instead of 12 m",
        "Settling after the steps of the course: x 3 to 4 s instead of 3 to 8 s.",
        "What they buy: peak tilt at the physics rate 4 instead of 8 deg",
        "free, without constraints and tuned by weights and a horizon of its own, tilts by up to 6 deg",
        "From tilt bound 2 deg to 5 deg: RMS error x goes from 9 to 6 m",
        "With constraints the vehicle is lost at 10 deg.",
        "Without constraints the vehicle is lost at N = 10; with them, nowhere.",
        "an earlier plan is held, at N = 10 (1 periods) and N = 20 (1 periods)",
        "The vehicle is lost at L = 0.5 m, d/b = 0.048 m.",
        "RMS error x 6 to 7.5 m",
    ):
        assert part in written, part


def test_what_constraints_make_larger_is_not_bought(cost_study: CostStudy) -> None:
    turned = replace(cost_study, constrained=cost_study.unconstrained, unconstrained=cost_study.constrained)
    written = "\n".join(cost_sentences(turned))
    assert "What they buy" not in written
    assert "What they do not make smaller: peak tilt at the physics rate 8 instead of 4 deg" in written


def test_flights_that_were_lost_or_never_flown_are_reported_too(cost_study: CostStudy) -> None:
    nothing = replace(cost_study.constrained, reason="no plan", flown=0.0, statuses={}, numbers={}, active=0)
    written = "\n".join(cost_sentences(replace(cost_study, constrained=nothing, candidates=())))
    assert "bounded is lost at 0 s with its constraints: no plan." in written
    assert "Tracking" not in written
    grids = cost_tables(replace(cost_study, constrained=nothing, candidates=()))
    assert "computation" not in {grid.key for grid in grids}


def test_the_json_is_strict_and_whole(cost_study: CostStudy) -> None:
    data = json.loads(json.dumps(cost_study.to_json(), allow_nan=False))
    assert data["constrained"]["numbers"].keys() == MEASURES.keys()
    assert (data["contenders"][1]["shortcuts"], data["contenders"][1]["failures"]) == (6, 1)
    assert data["contenders"][0]["step_ms"] == pytest.approx(np.linspace(0.01, 0.1, 10))
    assert [point["value"] for point in data["tilt"]["points"]] == [2.0, 5.0, 10.0]


def test_markdown_has_every_sentence_and_table(cost_study: CostStudy) -> None:
    sentences = cost_sentences(cost_study)
    text = cost_markdown(cost_study, sentences)
    assert all(f"- {sentence}\n" in text for sentence in sentences)
    assert text.count("\n## ") == len(cost_tables(cost_study))
    assert "| **5** | completed | 3 | 6 |" in text


def test_curves_are_the_studys_and_have_gaps_where_flights_were_lost(cost_study: CostStudy) -> None:
    gain = step_curves(cost_study)[0]
    assert (gain.x[0], gain.x[-1], gain.y[0], gain.y[-1]) == pytest.approx((0.01, 0.1, 10.0, 100.0))
    errors, settling, *_, steps = sweep_panels(cost_study, cost_study.tilt)
    np.testing.assert_array_equal(errors.curves[0].y, [9.0, 6.0, np.nan])
    np.testing.assert_array_equal(errors.curves[1].y, [12.0] * 3)  # the bound on tilt is nothing to the free flight
    np.testing.assert_array_equal(settling.curves[0].y, [np.nan, 4.0, np.nan])
    assert settling.never == (2.0,)
    np.testing.assert_array_equal(steps.curves[1].y, [0.9, 0.9, np.nan])
    assert lost_at(cost_study.tilt) == ([10.0], [])
    assert lost_at(cost_study.horizons) == ([], [10])


@pytest.mark.usefixtures("coarse")
def test_figures_are_the_same_bytes_each_time_and_show_what_is_lost(
    cost_study: CostStudy, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The second time one of them is drawn, with marks of every kind."""
    first = write_cost_figures(cost_study, tmp_path / "one")
    monkeypatch.setattr(
        "scenarios.cost.cost_figures.write_drawings",
        lambda drawings, directory: write_drawings({"cost_tilt": drawings["cost_tilt"]}, directory),
    )
    second = write_cost_figures(cost_study, tmp_path / "two")
    names = [f"cost_{what}.{kind}" for what in ("steps", "tilt", "horizon") for kind in ("png", "svg")]
    assert [path.name for path in first] == names
    for one, two in zip(first[2:4], second, strict=True):
        assert one.read_bytes() == two.read_bytes()
    tilt, horizon = ((tmp_path / "one" / f"cost_{what}.svg").read_text() for what in ("tilt", "horizon"))
    assert "red x: lost with constraints" in tilt
    assert "red triangle: does not settle" in tilt
    assert "grey x: lost without constraints" in horizon
    assert "red x" not in horizon


def test_plots_mark_what_is_lost(cost_study: CostStudy) -> None:
    plots = {plot.key: json.loads(plot.json) for plot in cost_plots(cost_study)}
    assert list(plots) == ["cost-steps", "cost-tilt", "cost-horizon"]
    marks = [note["text"] for note in plots["cost-tilt"]["layout"]["annotations"]]
    assert marks.count("x") == 6  # in each panel
    assert marks.count("\u25b2") == 1
    assert {trace["name"] for trace in plots["cost-steps"]["data"]} == {"gain", "as flown", "QP by slow"}
    without_times = cost_plots(replace(cost_study, candidates=()))
    assert [plot.key for plot in without_times] == ["cost-tilt", "cost-horizon"]
