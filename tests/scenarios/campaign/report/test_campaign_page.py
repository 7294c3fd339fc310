"""The page of a campaign: complete, offline, escaped, small enough, and drawn by a browser without a complaint."""

import json
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from browser import open_page

from quadsim.errors import OutputError
from quadsim.report.figures.canvas import write_drawings
from quadsim.report.plots.panels import Plot
from scenarios.campaign.report.campaign_curves import histograms
from scenarios.campaign.report.campaign_figure import draw_campaign
from scenarios.campaign.report.campaign_page import write_report
from scenarios.campaign.report.campaign_plots import campaign_plots
from scenarios.campaign.results.table import Summary
from scenarios.campaign.statistics.estimates import estimate
from scenarios.campaign.statistics.scatters import clipping, clouds, margins, shown_flights, thinning
from scenarios.campaign.statistics.wording import interval, percent, side_by_side, signed_points

MakeCampaign = Callable[..., pa.Table]

HOSTILE = "<script>alert(1)</script> & more"
MANIFEST = {"engine": "local", "versions": {"numpy": "2"}, "failure": ["lost", "violated"], "note": HOSTILE, "no": None}
PROBE = """<script>
(async () => {
  while (!("drawn" in document.documentElement.dataset)) await new Promise((done) => setTimeout(done, 50));
  const report = document.createElement("output");
  report.textContent = [
    "drawn " + document.documentElement.dataset.drawn,
    "points " + document.querySelectorAll("#scatter .scatterlayer .point").length,
    "bars " + document.querySelectorAll("#metrics .barlayer .point").length,
    "buttons " + [...document.querySelectorAll(".modebar-btn")].map((button) => button.dataset.title).join(","),
  ].join("; ");
  document.body.append(report);
})();
</script>"""
NAME = "paper-robustness"
CASES = {"five": (5, 1.0), "clean": (60, 0.0), "lost": (40, 100.0), "one": (1, 1.0), "none": (0, 1.0)}


def write(directory: Path, table: pa.Table, name: str = NAME, summary: Summary | None = None) -> str:
    directory.mkdir(exist_ok=True)
    page = write_report(
        directory,
        table=table,
        summary=json.loads(json.dumps(summary or estimate(table))),
        manifest=MANIFEST,
        name=name,
        description="What is flown.",
        failure=["violated", "rmse.z > 0.5"],
    )
    assert page == directory / "index.html"
    return page.read_text()


@pytest.fixture(scope="module")
def thousands(make_campaign: MakeCampaign) -> pa.Table:
    """More flights than are drawn."""
    return make_campaign(5000)


@pytest.fixture(scope="module")
def estimated(thousand: pa.Table) -> Summary:
    return estimate(thousand)


@pytest.fixture(scope="module")
def plots(thousand: pa.Table, estimated: Summary) -> dict[str, Plot]:
    return campaign_plots(thousand, estimated)


@pytest.fixture(scope="module")
def reported(thousand: pa.Table, estimated: Summary, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The directory of a campaign of a thousand flights, with its report."""
    directory = tmp_path_factory.mktemp("reported") / "runs" / "my campaign"
    directory.mkdir(parents=True)
    (directory / "flights.parquet").write_bytes(b"")
    write(directory, thousand, summary=estimated)
    return directory


def without_scripts(page: str) -> str:
    return re.sub(r"<script.*?</script>", "", page, flags=re.DOTALL)


def test_the_page_shows_what_the_flights_show(estimated: Summary, reported: Path) -> None:
    directory = reported
    text = without_scripts((directory / "index.html").read_text())
    assert '<p class="verdict bad">30 of 1000 flights failed: 3.0 % (95 %: 2.0 to 4.3 %)</p>' in text
    assert "(violated, rmse.z &gt; 0.5)" in text
    assert "The worst margin correlates most with wind (" in text
    worst = estimated["worst"][0]["flight"]
    assert f"quadsim replay &#39;{directory}&#39; --flight {worst}<" in text
    for heading in ("How often", "Constraints", "Distributions", "What drives failure", "Worst flights"):
        assert f"<h2>{heading}</h2>" in text
    for table in ("Failures over each varied parameter", "Their parameters"):
        assert f"<span>{table}</span>" in text
    assert "<dt>versions.numpy</dt><dd>2</dd>" in text
    assert {path.name for path in directory.iterdir()} == {
        *("index.html", "campaign.png", "campaign.svg", "flights.parquet")
    }
    for url in re.findall(r'(?:href|src)="([^"#]+)"', text):
        assert url == "data:," or (directory / url).is_file(), url
    assert not re.search(r"""(?:src|href)=["']?(?:https?:)?//""", text)


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
    lost = "lost" in table["verdict"].to_pylist()
    assert ("What is measured of a lost flight, its margins too, ends where it was aborted." in text) is lost


@pytest.mark.usefixtures("undrawn")
def test_a_campaign_without_required_constraints_has_a_page(thousand: pa.Table, tmp_path: Path) -> None:
    some = thousand.slice(0, 50)
    for name in ("worst_margin", "worst_constraint"):
        i = some.column_names.index(name)
        some = some.set_column(i, some.schema.field(i), pa.nulls(50, some.schema.field(i).type))
    assert margins(some) is None
    summary = estimate(some)
    assert "scatter" not in campaign_plots(some, summary)
    assert NAME in write(tmp_path / "out", some, summary=summary)


@pytest.mark.usefixtures("undrawn")
def test_hostile_names_are_text(thousand: pa.Table, tmp_path: Path) -> None:
    names = [HOSTILE if name == "draw.wind" else name for name in thousand.column_names]
    table = thousand.rename_columns([name.replace(HOSTILE, f"draw.{HOSTILE}") for name in names])
    text = write(tmp_path / "out", table, name=HOSTILE)
    assert "<script>alert" not in text
    assert "&lt;script&gt;alert(1)&lt;/script&gt;" in text
    assert "ValueError: &lt;b&gt;no&lt;/b&gt; step" in text


@pytest.mark.usefixtures("undrawn")
def test_thousands_of_flights_stay_small(
    thousands: pa.Table, estimated: Summary, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn = campaign_plots(thousands, estimated)
    monkeypatch.setattr("scenarios.campaign.report.campaign_page.campaign_plots", lambda *_: drawn)
    text = write(tmp_path / "out", thousands, summary=estimated)
    assert len(text) < 15e6
    assert "Drawn are 500 of " in text
    assert sum(len(plot.json) for plot in drawn.values()) < 5e5


def test_thinning_takes_flights_of_each_verdict_evenly(thousands: pa.Table) -> None:
    table = thousands
    shown, again = shown_flights(table), shown_flights(table)
    verdicts = np.array(table["verdict"].to_pylist())
    for verdict, rows in shown.items():
        assert np.array_equal(rows, again[verdict])
        assert set(verdicts[rows]) <= {verdict}
        assert rows.size == min(500, (verdicts == verdict).sum())
    gaps = np.diff(shown["satisfied"])
    assert gaps.max() < 4 * np.median(gaps)
    assert thinning(table).startswith("Drawn are 500 of ")
    assert thinning(table.slice(0, 1000)) == ""


def test_every_flight_is_in_its_histogram(thousand: pa.Table) -> None:
    drawn = {histogram.name: histogram for histogram in histograms(thousand)}
    values = np.array(thousand["worst_margin"].to_pylist(), float)
    found = drawn["worst_margin"]
    assert sum(counts.sum() for counts in found.counts.values()) == np.isfinite(values).sum()
    assert np.any(np.isclose(found.edges, 0.0)), "no bar holds violated and satisfied flights alike"
    assert found.counts["violated"][found.edges[1:] > 1e-9].sum() == 0.0
    assert "slack_max" not in drawn, "it is the same in all flights"


def test_a_lost_flight_does_not_flatten_the_others(thousand: pa.Table) -> None:
    i = thousand.column_names.index("worst_margin")
    values = thousand["worst_margin"].to_pylist()
    values[0], values[1] = -1e6, None
    table = thousand.set_column(i, thousand.schema.field(i), pa.array(values))
    drawn = margins(table)
    assert drawn is not None
    assert drawn.ends[0] > -0.6
    assert drawn.y[0] == drawn.y[1] == np.min(drawn.y)
    none = sum(value is None for value in values)
    assert np.count_nonzero(drawn.edge == "down") == 1 + none
    expected = f"{drawn.shown[0]:.3g}, down to -1e+06; {none} flights without a margin, at the foot."
    assert clipping(drawn, []).endswith(f"1 flight with a margin below {expected}")
    y = drawn.y[drawn.edge == ""]
    assert np.ptp(y) > 0.8 * (drawn.ends[1] - drawn.ends[0]), "the others fill the axis"
    assert next(one for one in histograms(table) if one.name == "worst_margin").label.endswith(
        "1 beyond, in the end bars"
    )


@pytest.mark.usefixtures("undrawn")
def test_outliers_are_drawn_at_the_edge_and_reported(
    thousand: pa.Table, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    table = thousand.slice(0, 200)
    for name, far in (("draw.wind", {3: 400.0, 5: -90.0}), ("worst_margin", {7: 55.0})):
        values = [far.get(i, value) for i, value in enumerate(table[name].to_pylist())]
        i = table.column_names.index(name)
        table = table.set_column(i, table.schema.field(i), pa.array(values))
    drawn = margins(table)
    assert drawn is not None
    assert drawn.y[7] == drawn.y.max() < 1.3
    wind = next(cloud for cloud in clouds(table, drawn) if cloud.name == "wind")
    assert wind.x.max() < 7.0
    assert (wind.edge[3], wind.edge[5], drawn.edge[7]) == ("right", "left", "up")
    assert np.count_nonzero(wind.edge != "") == 2
    summary = estimate(table)
    plots = campaign_plots(table, summary)
    monkeypatch.setattr("scenarios.campaign.report.campaign_page.campaign_plots", lambda *_: plots)
    text = " ".join(without_scripts(write(tmp_path / "out", table, summary=summary)).split())
    assert re.search(r"1 flight with a margin above 0\.\d+, up to 55;", text)
    assert re.search(r"1 flight with wind below \S+, down to -90; 1 flight with wind above 5\.\d+, up to 400\.", text)
    assert "to 400" in (tmp_path / "out" / "campaign.svg").read_text()
    figure = json.loads(plots["scatter"].json)
    symbols = [trace["marker"]["symbol"] for trace in figure["data"] if trace["mode"] == "markers"]
    edges = [symbol for one in symbols if isinstance(one, list) for symbol in one]
    assert edges.count("triangle-right") == edges.count("triangle-left") == 1
    assert edges.count("triangle-up") == 9, "in every panel"


def test_a_curve_is_drawn_over_every_number(thousand: pa.Table, plots: dict[str, Plot]) -> None:
    drawn = margins(thousand)
    assert drawn is not None
    for cloud in clouds(thousand, drawn):
        assert (cloud.course is None) is bool(cloud.names), cloud.name
    figure = json.loads(plots["scatter"].json)
    assert sum(trace["mode"] == "lines" for trace in figure["data"]) == 7


def test_no_tick_label_is_turned(plots: dict[str, Plot]) -> None:
    """Turned ones run into the next row of panels."""
    for plot in plots.values():
        axes = [axis for key, axis in json.loads(plot.json)["layout"].items() if key.startswith("xaxis")]
        assert axes
        assert plot.key == "drivers" or all(axis["tickangle"] == 0 for axis in axes), plot.key
    assert side_by_side(["piqp-multistage-condensed", "daqp", "x" * 30, "of two words"], 40) == [
        *("piqp-mult\nistage-c…", "daqp", "x" * 9 + "\n" + "x" * 8 + "…", "of two\nwords")
    ]


def test_names_are_placed(thousand: pa.Table) -> None:
    drawn = margins(thousand)
    assert drawn is not None
    cloud = next(cloud for cloud in clouds(thousand, drawn) if cloud.name == "solver")
    assert cloud.names == ("daqp", "gain", "piqp")
    assert [cloud.names[round(x)] for x in cloud.x] == thousand["draw.solver"].to_pylist()


def test_shares_are_reported_with_the_digits_they_need() -> None:
    assert [percent(share) for share in (0.0, 0.037, 0.5, 0.00372, 0.99973, 1.0, None)] == [
        *("0 %", "3.7 %", "50.0 %", "0.37 %", "99.973 %", "100 %", "-")
    ]
    assert interval(0.0262, 0.0506) == "2.6 to 5.1 %"
    assert interval(0.0, 0.00368) == "0 to 0.37 %"
    assert interval(0.9106, 0.999578) == "91.1 to 99.96 %"
    assert interval(0.0000001, 0.5) == "0.00001 to 50.0 %"
    assert [signed_points(value) for value in (-0.025, 0.0, 0.0004)] == ["-2.5", "0", "+0.040"]


def test_figures_are_the_same_every_time(
    thousand: pa.Table, estimated: Summary, reported: Path, tmp_path: Path
) -> None:
    summary = json.loads(json.dumps(estimated))
    write_drawings({"campaign": lambda: draw_campaign(NAME, thousand, summary)}, tmp_path)
    for file in ("campaign.png", "campaign.svg"):
        assert (tmp_path / file).read_bytes() == (reported / file).read_bytes()


@pytest.mark.usefixtures("undrawn")
def test_a_browser_draws_the_page_and_has_no_complaint(make_campaign: MakeCampaign, tmp_path: Path) -> None:
    write(tmp_path / "out", make_campaign(300), name=HOSTILE)
    page = tmp_path / "out" / "index.html"
    page.write_text(page.read_text().replace("</body>", f"{PROBE}</body>"))
    dom, console = open_page(page, tmp_path / "profile")
    assert console == []
    report = dict(one.split(" ", 1) for one in re.findall(r"<output>(.*?)</output>", dom)[-1].split("; "))
    assert report["drawn"] == "4"
    assert int(report["points"]) == 9 * 300, "every flight over every parameter"
    assert int(report["bars"]) > 100
    assert "Chart Studio" not in report["buttons"]


def test_a_place_that_cannot_be_is_reported(thousand: pa.Table, estimated: Summary, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(OutputError, match="Not a directory"):
        write_report(tmp_path / "file" / "gone", table=thousand, summary=estimated, manifest={}, name="a")
