"""Two campaigns in pairs: what is found, and what is refused."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from quadsim.errors import InputError, OutputError
from quadsim.features.campaign.events import EVENT_NAMES
from quadsim.features.campaign.paired import compare_pairs, events_figure
from quadsim.features.campaign.statistics import estimate, holm
from quadsim.report.table import Mark

MakeCampaign = Callable[..., pa.Table]

NAMES = ("paper", "robust")


def changed(table: pa.Table, name: str, values: list[object]) -> pa.Table:
    i = table.column_names.index(name)
    return table.set_column(i, table.schema.field(i), pa.array(values, table.schema.field(i).type))


@pytest.fixture(scope="module")
def better(make_campaign: MakeCampaign) -> pa.Table:
    return make_campaign(1000, help_by=0.15)


def test_a_better_controller_is_found_to_be(thousand: pa.Table, better: pa.Table) -> None:
    result = compare_pairs(thousand, better, NAMES)
    assert result.verdict == "better"
    failed = [np.array(table["failed"].to_pylist()) for table in (thousand, better)]
    failure = result.events[0]
    assert failure.counts == (failed[0].sum(), failed[1].sum())
    assert (failure.only_a, failure.only_b) == ((failed[0] & ~failed[1]).sum(), (failed[1] & ~failed[0]).sum())
    assert failure.pairs == result.flights == 1000
    assert failure.difference == (failure.only_b - failure.only_a) / 1000 < 0.0
    assert compare_pairs(better, thousand, NAMES).verdict == "worse"


def test_losses_are_compared_beside_failures(make_campaign: MakeCampaign) -> None:
    """Four of forty lost against none read as not distinguishable, without a word of it."""
    one = make_campaign(40, seed=1, severity=100.0)
    other = make_campaign(40, seed=1, severity=100.0)
    verdicts = ["lost"] * 4 + ["violated"] * 36
    result = compare_pairs(changed(one, "verdict", verdicts), changed(other, "verdict", ["violated"] * 40), NAMES)
    assert result.verdict == "not distinguishable"
    lost = next(event for event in result.events if event.event == "lost")
    assert (lost.counts, lost.p, lost.p_holm) == ((4, 0), 0.125, 0.125)
    many = ["lost"] * 12 + ["violated"] * 28
    result = compare_pairs(changed(one, "verdict", many), changed(other, "verdict", ["violated"] * 40), NAMES)
    table = result.to_markdown()
    assert "| lost | 12 (30.0 %) | 0 (0 %) | 12 | 0 | 0 | p < 0.001 | **p < 0.001** |" in table
    assert "| timeout |" not in table, "it never happened"


def test_every_event_and_constraint_is_compared_and_corrected(thousand: pa.Table, better: pa.Table) -> None:
    result = compare_pairs(thousand, better, NAMES)
    assert [event.event for event in result.events] == [*EVENT_NAMES, "roll not held", "slew not held"]
    tested = [event for event in result.events if event.only_a + event.only_b]
    assert [event.p_holm for event in tested] == holm([event.p for event in tested])
    assert all(event.p_holm == 1.0 for event in result.events if event not in tested)
    assert result.to_json()["events"]["lost"]["p_holm"] == next(e for e in result.events if e.event == "lost").p_holm


def test_a_window_that_was_not_reached_is_neither_held_nor_not(thousand: pa.Table) -> None:
    """Of ten pairs, three of the first and one of the second ended before it; one was lost before, one flew on."""
    verdicts = ["satisfied"] * 8 + ["lost", "violated"]
    held = [None, None, None, True, True, True, True, True, False, False]
    one = changed(changed(thousand.slice(0, 10), "verdict", verdicts), "satisfied.slew", held)
    other = changed(one, "satisfied.slew", [True, True, True, None, False, True, True, True, True, True])
    result = compare_pairs(one, other, NAMES)
    (event,) = [event for event in result.events if event.event == "slew not held"]
    assert (event.pairs, event.counts, event.both) == (6, (2, 1), 0)
    assert (event.only_a, event.only_b, event.neither) == (2, 1, 3)
    assert event.difference == -1.0 / 6.0
    share = estimate(one)["constraints"]["slew"]["not_satisfied"]
    assert (share["count"], share["flights"]) == (2, 7), "as the report of one campaign has it"
    assert "| slew not held | 2 (33.3 %) | 1 (16.7 %) | 2 | 1 | 0 |" in result.to_markdown()


def test_a_constraint_that_no_pair_reached_is_absent(thousand: pa.Table) -> None:
    calm = changed(thousand.slice(0, 10), "verdict", ["satisfied"] * 10)
    never = changed(calm, "satisfied.slew", [None] * 10)
    events = [event.event for event in compare_pairs(never, never, NAMES).events]
    assert "roll not held" in events
    assert "slew not held" not in events
    share = estimate(never)["constraints"]["slew"]["not_satisfied"]
    assert (share["count"], share["flights"], share["share"]) == (0, 0, None)


def test_metrics_are_compared_where_both_were_completed(thousand: pa.Table, better: pa.Table) -> None:
    result = compare_pairs(thousand, better, NAMES)
    status = [np.array(table["status"].to_pylist()) == "completed" for table in (thousand, better)]
    both = status[0] & status[1]
    assert result.completed == both.sum() < 1000
    metric = next(metric for metric in result.metrics if metric.name == "worst_margin")
    values = [np.array(table["worst_margin"].to_pylist(), float)[both] for table in (thousand, better)]
    assert metric.difference.pairs == both.sum()
    assert metric.difference.mean == pytest.approx((values[1] - values[0]).mean())
    assert metric.difference.lower is not None
    assert metric.difference.lower > 0.1


def test_a_metric_that_no_pair_has_is_absent_from_the_table(thousand: pa.Table) -> None:
    """A line of `-` says nothing; the data keep the metric."""
    none = changed(thousand, "peak_tilt", [None] * thousand.num_rows)
    for second in (none, thousand):
        result = compare_pairs(none, second, NAMES)
        _events, metrics = result.tables
        assert "peak_tilt" in result.to_json()["metrics"]
        names = {line[0].text.partition(" [")[0] for line in metrics.lines}
        assert "peak_tilt" not in names
        assert "worst_margin" in names


def test_a_difference_within_rounding_is_0(thousand: pa.Table) -> None:
    errors = np.array(thousand["rmse.x"].to_pylist(), float)
    moved = changed(thousand, "rmse.x", [*(errors + 3e-14)])
    compared = compare_pairs(thousand, moved, NAMES)
    assert "closer" not in compared.tracking
    assert "farther" not in compared.tracking
    _events, metrics = compared.tables
    (of_x,) = [line for line in metrics.lines if line[0].text == "rmse.x [m]"]
    assert [cell.text for cell in of_x[3:5]] == ["0", "0 to 0"]
    assert of_x[3].mark == Mark.NONE


def test_a_campaign_and_itself_are_not_distinguishable(thousand: pa.Table) -> None:
    result = compare_pairs(thousand, thousand, ("a", "b"))
    assert result.verdict == "not distinguishable"
    assert result.events[0].p == 1.0
    assert all(metric.difference.mean == 0.0 for metric in result.metrics)


def test_flights_of_one_campaign_alone_are_left_out(thousand: pa.Table, better: pa.Table) -> None:
    order = np.random.default_rng(0).permutation(600)
    result = compare_pairs(thousand, better.take(order), NAMES)
    assert (result.flights, result.left_out) == (600, 400)
    assert result.events == compare_pairs(thousand.slice(0, 600), better.slice(0, 600), NAMES).events


def test_campaigns_of_one_name_are_distinguished(thousand: pa.Table, better: pa.Table) -> None:
    result = compare_pairs(thousand, better, ("paper", "paper"))
    assert result.sentence.startswith("paper (second) ")
    assert "paper (first)" in result.sentence


def test_other_draws_are_refused(thousand: pa.Table) -> None:
    head = thousand.slice(0, 5)
    mass = head["draw.mass"].to_pylist()
    with pytest.raises(InputError, match=r"flight 3 .*draw\.mass = .* 9\.0"):
        compare_pairs(head, changed(head, "draw.mass", [*mass[:3], 9.0, mass[4]]), NAMES)
    with pytest.raises(InputError, match="seed"):
        compare_pairs(head, changed(head, "seed", [1, 10001, 10002, 10003, 10004]), NAMES)


def test_other_definitions_of_failure_are_refused(thousand: pa.Table, better: pa.Table) -> None:
    same = (["violated", "rmse.z>0.5"], ["rmse.z > 0.50", "violation"])
    assert compare_pairs(thousand, better, NAMES, failures=same) == compare_pairs(thousand, better, NAMES)
    error = "'paper' counts violation as failure, and 'robust' lost, rmse.z > 0.5: only campaigns with the same failure"
    with pytest.raises(InputError, match=error):
        compare_pairs(thousand, better, NAMES, failures=(["violated"], ["rmse.z > 0.5", "lost"]))


def test_flights_of_other_numbers_are_refused(thousand: pa.Table) -> None:
    with pytest.raises(InputError, match="flight"):
        compare_pairs(thousand.slice(0, 5), thousand.slice(5, 5), NAMES)


def test_what_one_campaign_alone_draws_is_reported(thousand: pa.Table, better: pa.Table) -> None:
    result = compare_pairs(thousand.drop_columns(["draw.lag"]), better, NAMES)
    assert result.own_draws == ("lag",)
    assert "lag" not in result.shared_draws


def test_a_comparison_is_plain_data_and_a_table(thousand: pa.Table, better: pa.Table) -> None:
    result = compare_pairs(thousand, better, NAMES)
    plain = result.to_json()
    assert json.loads(json.dumps(plain, allow_nan=False)) == plain
    assert plain["verdict"] == "better"
    text = result.to_markdown()
    assert result.sentence in text
    assert "differ:" not in text.partition(result.sentence)[0], "nobody said what differs"
    same, other = (
        compare_pairs(thousand, better, NAMES, differences=d) for d in ((), (("effects.air", None, 3e-4),) * 2)
    )
    assert "differ: 0." in same.to_markdown()
    after = other.to_markdown().partition(other.sentence)[2]
    assert "differ: 2." in after.partition("| failure |")[2], "the result comes first"
    assert "| effects.air | absent | 0.0003 |" in after
    assert "| failure | 30 (3.0 %) |" in text
    assert "| worst_margin |" in text


def test_fields_of_one_campaign_alone_and_paths_come_last(thousand: pa.Table, better: pa.Table) -> None:
    differences = (("effects.air", None, 3e-4), ("vehicle.file", "/home/me/a.toml", "b.toml"), ("seed", 1, 2))
    (grid,) = compare_pairs(thousand, better, NAMES, differences=differences).difference_tables
    assert [line[0].text for line in grid.lines] == ["seed", "effects.air", "vehicle.file"]


def test_the_answer_says_who_tracks_closer_and_a_plot_shows_by_how_much(thousand: pa.Table, better: pa.Table) -> None:
    result = compare_pairs(thousand, better, NAMES)
    assert result.tracking.startswith("RMS error, where both flights were completed: robust is ")
    for metric in result.metrics:
        if metric.name in ("rmse.x", "rmse.y", "rmse.z"):
            difference = metric.difference
            verdict = "not distinguishable"
            if difference.upper is not None and difference.upper < 0.0:
                verdict = "closer"
            elif difference.lower is not None and difference.lower > 0.0:
                verdict = "farther"
            (sentence,) = [part for part in result.tracking.split(";") if f"{verdict} in" in part]
            assert f" {metric.name[-1]}" in sentence
    drawn = [events_figure(result), result.small_plot()]
    (events,), (metrics,) = [figure.panels for figure in drawn if figure is not None]
    assert "failure" in events.x_names
    assert events.series[0].y[0] == pytest.approx(3.0)
    first = result.metrics[0]
    points = [curve for curve in metrics.series if curve.style == "points"]
    assert first.mean_a is not None
    assert first.difference.mean is not None
    assert points[0].y[0] == pytest.approx(100.0 * first.difference.mean / abs(first.mean_a))


def test_a_comparison_without_an_event_has_a_page_without_their_plot(
    make_campaign: MakeCampaign, tmp_path: Path
) -> None:
    calm = make_campaign(5, severity=0.0)
    result = compare_pairs(calm, calm, NAMES)
    assert events_figure(result) is None
    assert 'id="metrics"' in result.write_report(tmp_path / "out").read_text()


def test_the_page_stands_with_its_files(thousand: pa.Table, better: pa.Table, tmp_path: Path) -> None:
    hostile = ("<b>paper</b>", "robust & more")
    page = compare_pairs(thousand, better, hostile).write_report(tmp_path / "out")
    names = {path.name for path in page.parent.iterdir()}
    assert names == {"index.html", "comparison.json", "comparison.md", "summary.json"}
    text = page.read_text()
    assert "<b>paper</b>" not in text
    assert "&lt;b&gt;paper&lt;/b&gt;" in text
    compare_pairs(thousand, thousand, NAMES).write_report(tmp_path / "out", overwrite=True)
    assert "not distinguishable" in page.read_text()
    theirs = tmp_path / "theirs"
    theirs.mkdir()
    (theirs / "index.html").write_text("mine")
    with pytest.raises(OutputError, match="empty"):
        compare_pairs(thousand, better, NAMES).write_report(theirs)
