"""The page of a campaign: complete, offline, escaped, small enough, and drawn by a browser without a complaint."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from browser import CLASHES, opened

from quadsim.features.campaign.campaign_file import CampaignFile
from quadsim.features.campaign.campaign_report import (
    campaign_overview,
    constraint_table,
    group_table,
    histograms,
    scatters,
    worst_draws_table,
    worst_table,
    write_report,
)
from quadsim.features.campaign.rows import CampaignSummary
from quadsim.features.campaign.statistics import estimate, interval, percent
from quadsim.report.figure import Panel
from quadsim.report.to_matplotlib import to_png

pytestmark = pytest.mark.slow("campaigns")

MakeCampaign = Callable[..., pa.Table]

HOSTILE = "<script>alert(1)</script> & more"
NAME = "paper-robustness"
CASES = {"five": (5, 1.0), "clean": (60, 0.0), "lost": (40, 100.0), "one": (1, 1.0), "none": (0, 1.0)}


def write(
    directory: Path,
    table: pa.Table,
    text: str = "What is flown.",
    summary: CampaignSummary | None = None,
    failure: Sequence[str] = ("violated", "rmse.z > 0.5"),
) -> str:
    directory.mkdir(exist_ok=True)
    spec = CampaignFile(name=NAME, description=text, scenario="hover", flights=1000, failure=[*failure])
    page = write_report(directory, table, json.loads(json.dumps(summary or estimate(table))), spec)
    assert page == directory / "index.html"
    return page.read_text()


@pytest.fixture(scope="module")
def estimated(thousand: pa.Table) -> CampaignSummary:
    return estimate(thousand)


@pytest.fixture(scope="module")
def reported(thousand: pa.Table, estimated: CampaignSummary, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The directory of a campaign of a thousand flights, with its report."""
    directory = tmp_path_factory.mktemp("reported") / "runs" / "my campaign"
    directory.mkdir(parents=True)
    for name in ("flights.parquet", "summary.json"):
        (directory / name).write_bytes(b"")
    write(directory, thousand, summary=estimated)
    return directory


def without_scripts(page: str) -> str:
    return re.sub(r"<script.*?</script>", "", page, flags=re.DOTALL)


def test_the_page_shows_what_the_flights_show(estimated: CampaignSummary, reported: Path) -> None:
    directory = reported
    text = without_scripts((directory / "index.html").read_text())
    assert '<p class="verdict bad">30 of 1000 ' in text
    assert "rmse.z &gt; 0.5 m" in text
    assert "1000 of 1000" in text
    worst = estimated["worst"][0]["flight"]
    assert f"quadsim replay &#39;{directory}&#39; --flight {worst}<" in text
    assert {path.name for path in directory.iterdir()} == {
        *("index.html", "campaign.png"),
        *("flights.parquet", "summary.json"),
    }
    for url in re.findall(r'(?:href|src)="([^"#]+)"', text):
        assert url == "data:," or (directory / url).is_file(), url
    assert not re.search(r"""(?:src|href)=["']?(?:https?:)?//""", text)


@pytest.mark.usefixtures("undrawn")
def test_violations_that_are_no_failures_and_flights_not_flown_are_pointed_out(
    make_campaign: MakeCampaign, tmp_path: Path
) -> None:
    table = make_campaign(60)
    text = write(tmp_path / "out", table, failure=["lost", "margin.roll < -0.25"])
    violated = sum(table["violated"].to_pylist())
    assert violated > 0
    assert "margin.roll &lt; -0.25 deg" in text
    assert f"{violated} of 60 " in text
    assert "60 of 1000 " in text


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize("case", CASES)
def test_campaigns_of_every_kind_have_a_page(make_campaign: MakeCampaign, tmp_path: Path, case: str) -> None:
    flights, severity = CASES[case]
    table = make_campaign(flights, severity=severity)
    text = without_scripts(write(tmp_path / "out", table))
    failed = sum(table["failed"].to_pylist())
    mark = "bad" if failed else "good" if flights else ""
    assert f'<p class="verdict {mark}">{failed} of {flights} flight' in text
    assert "nan" not in text.lower().replace("dominan", "")
    assert ('class="plot"' in text) is (flights > 0)


@pytest.mark.usefixtures("undrawn")
def test_a_campaign_without_required_constraints_has_a_page(thousand: pa.Table, tmp_path: Path) -> None:
    some = thousand.slice(0, 50)
    for name in ("worst_margin", "worst_constraint"):
        i = some.column_names.index(name)
        some = some.set_column(i, some.schema.field(i), pa.nulls(50, some.schema.field(i).type))
    assert scatters(some) == []
    assert 'id="scatter"' not in write(tmp_path / "out", some)


def with_values(table: pa.Table, name: str, changes: dict[int, float | None]) -> pa.Table:
    values = [changes.get(i, value) for i, value in enumerate(table[name].to_pylist())]
    i = table.column_names.index(name)
    return table.set_column(i, table.schema.field(i), pa.array(values))


def over(table: pa.Table, parameter: str) -> Panel:
    (panel,) = (panel for panel in scatters(table) if panel.x_label.startswith(parameter))
    return panel


def test_every_flight_is_in_its_histogram_below_or_above_the_bound(thousand: pa.Table) -> None:
    drawn = {panel.x_label.partition(" [")[0]: panel for panel in histograms(thousand)}
    assert "slack_max" not in drawn, "it is the same in all flights"
    bars = {series.label: series for series in drawn["worst margin"].series}
    values = np.array(thousand["worst_margin"].to_pylist(), float)
    assert sum(series.y.sum() for series in bars.values()) == np.isfinite(values).sum()
    assert bars["violated"].y[bars["violated"].x > 0.0].sum() == 0.0, "no bar holds both sides of 0"
    np.testing.assert_array_equal(bars["violated"].base, bars["satisfied"].y + bars["satisfied"].base)


def test_what_is_only_rounding_is_0(thousand: pa.Table) -> None:
    """A margin of 2.8e-14 rad/s is a bound that is reached, and a spread of such margins is no histogram."""
    table = with_values(thousand, "margin.slew", {0: 2.8e-14})
    summary = estimate(table)
    (slew,) = [cells for cells in constraint_table(summary).lines if cells[0].text == "slew"]
    assert slew[4].text == "0 rad/s"
    reached = dict(enumerate(np.random.default_rng(0).normal(scale=1e-14, size=thousand.num_rows)))
    table = with_values(thousand, "worst_margin", reached)
    assert "worst margin" not in {panel.x_label.partition(" [")[0] for panel in histograms(table)}
    panel = over(table, "wind")
    assert {float(value) for series in panel.series for value in series.y} == {0.0}


def test_a_flight_far_out_is_at_the_edge_and_does_not_flatten_the_others(thousand: pa.Table) -> None:
    table = with_values(with_values(thousand, "worst_margin", {0: -1e6, 1: None}), "draw.wind", {3: 400.0})
    panel = over(table, "wind")
    markers = {int(flight): s.marker for s in panel.series if s.flights is not None for flight in s.flights}
    flights = table["flight"].to_pylist()
    result = [markers[flights[i]] for i in (0, 1, 3)]
    assert result == ["triangle-down", "triangle-down", "triangle-right"]
    assert len(markers) == 1000, "every flight is a point"
    assert panel.y_range is not None
    assert panel.y_range[0] > -0.6
    assert max(series.x.max() for series in panel.series) < 7.0


def test_many_flights_are_thinned_evenly_and_by_verdict(make_campaign: MakeCampaign) -> None:
    table = make_campaign(5000)
    shown = {series.label: series.x.size for series in over(table, "solver").series if series.marker[:8] != "triangle"}
    verdicts = table["verdict"].to_pylist()
    assert shown["satisfied"] == 1000
    assert shown["violated"] == verdicts.count("violated")
    assert over(table, "solver").x_names == ("daqp", "gain", "piqp")


def test_the_figure_shows_the_parameters_that_matter_most(thousand: pa.Table, estimated: CampaignSummary) -> None:
    figure = campaign_overview(thousand, estimated, NAME)
    assert [panel.x_label for panel in figure.panels] == [*("worst margin [half bands]", "wind [m/s]", "mass", "yaw")]
    assert to_png(figure, dpi=40) == to_png(figure, dpi=40)


def test_shares_are_reported_with_the_digits_they_need() -> None:
    assert [percent(share) for share in (0.0, 0.037, 0.5, 0.00372, 0.99973, 1.0, None)] == [
        *("0 %", "3.7 %", "50.0 %", "0.37 %", "99.973 %", "100 %", "-")
    ]
    assert interval(0.0262, 0.0506) == "2.6 to 5.1 %"
    assert interval(0.0, 0.00368) == "0 to 0.37 %"
    assert interval(0.9106, 0.999578) == "91.1 to 99.958 %"


@pytest.mark.usefixtures("undrawn")
def test_a_browser_draws_the_page_and_has_no_complaint(make_campaign: MakeCampaign, tmp_path: Path) -> None:
    folder = tmp_path / ("where_no_line_can_break_" * 6)
    folder.mkdir()
    write(folder / "out", make_campaign(300), HOSTILE)
    page = folder / "out" / "index.html"
    assert folder.name in page.read_text()
    assert "<script>alert" not in page.read_text()
    with opened(page, width=390, dark=True) as tab:
        assert tab.evaluate("document.documentElement.dataset.drawn") == "2"
        points = tab.locator("#scatter .scatterlayer .point").count()
        assert points == 9 * 300, "every flight over every parameter"
        assert tab.locator("#metrics .barlayer .point").count() > 100
        assert tab.get_by_text("Chart Studio").count() == 0
        for key in ("metrics", "scatter"):
            assert tab.evaluate(CLASHES, tab.locator(f"#{key}").element_handle()) == 0, key
        table = tab.locator(".wide", has_text="interval").first
        table.evaluate("table => { table.scrollLeft = 100; }")
        pinned = table.locator("tbody th").first.bounding_box()["x"]
        assert pinned == table.bounding_box()["x"], "the first column scrolls out of sight"


def test_failures_over_a_drawn_number_are_those_of_its_fifths(thousand: pa.Table) -> None:
    result = estimate(thousand)["parameters"]["wind"]["groups"]
    wind, failed = (np.array(thousand[name].to_pylist(), float) for name in ("draw.wind", "failed"))
    assert [group["flights"] for group in result] == [200] * 5
    assert result[0]["low"] == wind.min()
    assert result[-1]["high"] == wind.max()
    for group, after in zip(result, [*result[1:], None], strict=True):
        inside = (wind >= group["low"]) & (wind <= group["high"])
        assert group["count"] == failed[inside].sum()
        assert after is None or group["high"] < after["low"]
    assert result[-1]["share"] > result[0]["share"]


def test_few_values_are_groups_of_their_own_and_few_flights_none(thousand: pa.Table) -> None:
    i = thousand.column_names.index("draw.horizon")
    horizons = pa.array([20 + 10 * (k % 3) for k in range(1000)])
    result = estimate(thousand.set_column(i, "draw.horizon", horizons))["parameters"]["horizon"]["groups"]
    assert [(group["low"], group["high"], group["flights"]) for group in result] == [
        *((20.0, 20.0, 334), (30.0, 30.0, 333), (40.0, 40.0, 333))
    ]
    assert len(estimate(thousand.slice(0, 30))["parameters"]["mass"]["groups"]) == 3
    assert estimate(thousand.slice(0, 11))["parameters"]["mass"]["groups"] == []


def test_groups_are_shown_where_some_fail_and_some_do_not(make_campaign: MakeCampaign, thousand: pa.Table) -> None:
    grid = group_table(estimate(thousand))
    names = ["mass", "inertia", "noise", "yaw", "lag [s]", "wind [m/s]", "horizon", "solver", "payload"]
    assert [line[0].text for line in grid.lines] == names
    assert all(len(line) == len(grid.head) == 6 for line in grid.lines)
    assert [cell.text.partition(":")[0] for cell in grid.lines[7]][1:4] == ["daqp", "gain", "piqp"]
    assert not group_table(estimate(make_campaign(60, severity=0.0))).lines
    assert not group_table(estimate(make_campaign(60, severity=100.0).slice(0, 0))).lines


def test_the_worst_flights_have_a_table_with_one_command(thousand: pa.Table) -> None:
    summary = estimate(thousand)
    grid = worst_table(summary, "my runs")
    assert grid.head == ("flight", "verdict", "worst margin", "constraint", "flown [s]", "reason")
    assert grid.note.endswith(f"quadsim replay 'my runs' --flight {summary['worst'][0]['flight']}")
    rows = {row["flight"]: row for row in thousand.to_pylist()}
    margins = [(rows[int(line[0].text)]["margin.roll"], line[2].text) for line in grid.lines if line[3].text == "roll"]
    assert margins
    assert [f"{margin:.4g} deg" for margin, _ in margins] == [shown for _, shown in margins]
    drawn = worst_draws_table(summary)
    assert drawn.head == ("flight", *(line[0].text for line in grid.lines))
    assert not worst_table(estimate(thousand.slice(0, 0)), "a").lines
    assert not worst_draws_table(estimate(thousand.slice(0, 0))).lines
