"""The comparison page: complete or not there, escaped, offline, and without a complaint from a browser."""

import dataclasses
import re
import shutil
from collections.abc import Iterator
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
from browser import CLASHES, opened
from support import draw_nothing, recording, renamed

from quadsim.errors import OutputError, ParameterError
from quadsim.report import comparison_page
from quadsim.report.comparison_page import write_comparison
from quadsim.report.figure import Figure
from quadsim.report.flight_figures import page_figures
from quadsim.report.to_plotly import to_plot
from quadsim.rollout.flown import Flight

pytestmark = pytest.mark.slow("comparisons")

HOSTILE = "<script>alert(1)</script> & \"more\" 'quoted'"


@pytest.fixture(scope="module", autouse=True)
def _undrawn() -> Iterator[None]:
    """Figures have tests of their own; pages show plots."""
    with pytest.MonkeyPatch.context() as patch:
        draw_nothing(patch)
        yield


@pytest.fixture(scope="module")
def filmed_run(short_run: Flight, tmp_path_factory: pytest.TempPathFactory) -> Flight:
    """The short flight with a video, a recording and a figure beside it; nothing reads them but a browser."""
    directory = tmp_path_factory.mktemp("filmed") / "run"
    shutil.copytree(short_run.directory, directory)
    iio.imwrite(directory / "flight.mp4", np.zeros((5, 32, 64, 3), np.uint8), fps=5)
    (directory / "flight.rrd").write_bytes(b"recording")
    (directory / "figures").mkdir()
    (directory / "figures" / "figure4_states.png").write_bytes(b"picture")
    return dataclasses.replace(short_run, directory=directory)


@pytest.fixture(scope="module")
def page_of_two(filmed_run: Flight, aborted_run: Flight, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of the filmed flight and the one that was lost."""
    return write_comparison([filmed_run, aborted_run], tmp_path_factory.mktemp("page") / "out")


def without_scripts(page: str) -> str:
    return re.sub(r"<script.*?</script>", "", page, flags=re.DOTALL)


@pytest.mark.representative("comparisons")
def test_the_page_stands_beside_its_files(page_of_two: Path) -> None:
    page = page_of_two
    assert (page.parent.name, page.name) == ("out", "index.html")
    assert page.stat().st_size < 8e6
    assert {path.name for path in page.parent.iterdir()} == {
        *("index.html", "comparison.png", "comparison.md", "summary.json"),
        *("paper-constrained.mp4", "paper-constrained.jpg", "paper-constrained", "lost"),
    }
    for url in re.findall(r'(?:href|src|poster)="([^"#]+)"', without_scripts(page.read_text())):
        assert url == "data:," or (page.parent / url).is_file(), url


@pytest.mark.representative("comparisons")
def test_the_text_gives_outcomes_reasons_and_numbers_and_nothing_is_fetched(page_of_two: Path) -> None:
    text = without_scripts(page_of_two.read_text())
    assert not re.search(r"""(?:src|href)=["']?(?:https?:)?//""", text)
    assert "default-src 'none'" in text
    assert "the plant&#39;s state is &lt;not&gt; finite &amp; more" in text
    assert text.count("<video") == 1
    (opening,) = re.findall(r'</h1>\s*<p class="verdict bad">([^<]*)</p>', text)
    assert "arrival_x" in opening
    assert "paper-constrained/flight.rrd" in text
    assert "lost/flight.rrd" not in text


def test_hostile_names_are_text_and_other_courses_and_verdicts_are_pointed_out(
    short_run: Flight, tmp_path: Path
) -> None:
    control = dataclasses.replace(short_run.log.control, reference=short_run.log.control.reference + 1.0)
    log = dataclasses.replace(short_run.log, control=control)
    held = short_run.findings[:1]
    other = dataclasses.replace(short_run, log=log, findings=held)
    other = recording(other, expected="lost", as_expected=False)
    page = write_comparison([renamed(short_run, HOSTILE), other], tmp_path / "out")
    text = page.read_text()
    assert "2 different courses" in text
    assert '<td class="bad">satisfied (expected lost)</td>' in text
    assert "<script>alert" not in text
    assert "&lt;script&gt;alert(1)&lt;/script&gt;" in text
    assert (page.parent / "script-alert-1-script-more-quoted").is_dir()


def test_runs_of_one_name_keep_their_files_apart(
    short_run: Flight, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(comparison_page, "page_figures", lambda runs: [])
    page = write_comparison([short_run, short_run, renamed(short_run, "!"), renamed(short_run, "?")], tmp_path / "out")
    folders = {path.name for path in page.parent.iterdir() if path.is_dir()}
    assert len(folders) == 4
    assert {"run", "run-2"} <= folders


def test_runs_without_a_period_or_constraints_are_compared(
    short_run: Flight, empty_run: Flight, tmp_path: Path
) -> None:
    free = dataclasses.replace(short_run, findings=())
    assert write_comparison([empty_run, free], tmp_path / "two").is_file()
    text = write_comparison([empty_run], tmp_path / "one").read_text()
    assert 'class="plot"' not in text
    assert "primal_infeasible" in text


def test_a_place_that_holds_a_run_is_refused_and_no_runs_too(short_run: Flight) -> None:
    for place in (short_run.directory, short_run.directory.parent):
        with pytest.raises(OutputError, match="run"):
            write_comparison([short_run], place)
    with pytest.raises(ParameterError, match=r"comparison\.runs"):
        write_comparison([], short_run.directory)
    assert (short_run.directory / "summary.json").is_file()


def test_plots_of_many_long_runs_stay_small(short_run: Flight) -> None:
    t = np.linspace(0.0, 360.0, 72_001)
    rows = np.arange(t.size) % short_run.log.plant.t.size
    plant = dataclasses.replace(
        short_run.log.plant, t=t, state=short_run.log.plant.state[rows], speeds=short_run.log.plant.speeds[rows]
    )
    long = dataclasses.replace(short_run, log=dataclasses.replace(short_run.log, plant=plant))
    assert sum(len(to_plot(each).json) for each in page_figures([long] * 10) if isinstance(each, Figure)) < 3e6


def test_a_browser_draws_the_page_and_has_no_complaint(short_run: Flight, aborted_run: Flight, tmp_path: Path) -> None:
    page = write_comparison([renamed(short_run, HOSTILE), aborted_run], tmp_path / "out")
    with opened(page) as tab:
        tab.evaluate("Plotly.relayout('states', {'xaxis.range': [1, 2]})")
        tab.locator("[data-run=run0]").uncheck()
        tab.wait_for_function("document.getElementById('states').data.some((trace) => trace.visible === false)")
        tab.wait_for_function("document.getElementById('solve_times').layout.xaxis.range[0] === 1")
        panels = "['states', 'inputs', 'solve_times'].map((id) => document.getElementById(id))"
        assert tab.evaluate(f"{panels}.map((panel) => panel.layout.xaxis.range)") == [[1, 2]] * 3
        curves = f"{panels}[0].data.filter((trace) => trace.legendgroup).slice(0, 4)"
        assert tab.evaluate(f"{curves}.map((trace) => trace.visible ?? true)") == [False, True] * 2
        assert tab.locator(".main-svg .trace").count() > 40
        titles = tab.evaluate("[...document.querySelectorAll('.modebar-btn')].map((button) => button.dataset.title)")
    assert {title.replace("a png", "a PNG") for title in titles} == {  # of an older plotly
        *("Download plot as a PNG", "Zoom", "Pan", "Zoom in", "Zoom out", "Autoscale", "Reset axes"),
        *("Orbital rotation", "Turntable rotation", "Reset camera to default", "Reset camera to last save"),
    }, "no button may send data away"


INK = """() => {
  const plot = document.getElementById("states");
  const { backgroundColor } = getComputedStyle(plot.querySelector(".main-svg"));
  return { paper: backgroundColor, page: getComputedStyle(document.body).backgroundColor, ink: plot.layout.font.color };
}"""


def test_the_first_screen_has_the_video_and_five_rows_and_a_phone_all_of_it(page_of_two: Path) -> None:
    with opened(page_of_two) as tab:
        assert tab.locator("video").count() == 1
        rows = tab.locator(".numbers").first.locator("tr")
        labels = ["outcome", "worst constraint", "RMS error, position [m]", "highest speed [m/s]", "step time [ms]"]
        assert [row.locator("th").inner_text() for row in rows.all()] == labels
        for shown in (tab.locator("video"), *rows.all()):
            box = shown.bounding_box()
            assert box["y"] + box["height"] <= 800, "below the first screen"
        film = tab.locator("video").bounding_box()
        assert film["height"] >= 9.0 / 16.0 * film["width"] + 78.0, "the controls, 76 px high, cover what it says"
        poster = "src => new Promise((done) => Object.assign(new Image(), { src, onload() { done(this.width); } }))"
        assert tab.evaluate(poster, tab.locator("video").get_attribute("poster")) == 640
        light = tab.evaluate(INK)
    with opened(page_of_two, width=390, dark=True) as tab:
        for row in tab.locator("tr.row").all()[:12]:
            label, *values = [cell.bounding_box() for cell in row.locator("th, td").all()]
            assert all(value["y"] >= label["y"] + label["height"] for value in values), "not under its label"
            assert all(value["x"] + value["width"] <= 390 for value in values), "out of sight"
        for key in ("states", "inputs", "solve_times"):
            assert tab.evaluate(CLASHES, tab.locator(f"#{key}").element_handle()) == 0, key
        dark = tab.evaluate(INK)
    assert light["paper"] == dark["paper"] == "rgba(0, 0, 0, 0)", "a plot shows the page beneath it"
    assert light["page"] != dark["page"]
    assert light["ink"] != dark["ink"]


def test_a_film_that_cannot_be_read_has_no_poster(filmed_run: Flight, tmp_path: Path) -> None:
    damaged = shutil.copytree(filmed_run.directory, tmp_path / "damaged")
    (damaged / "flight.mp4").write_bytes(b"film")
    page = write_comparison([dataclasses.replace(filmed_run, directory=damaged)], tmp_path / "out")
    assert "<video" in page.read_text()
    assert "poster=" not in without_scripts(page.read_text())
    assert not list(page.parent.glob("*.jpg"))
