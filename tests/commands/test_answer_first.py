"""The answer comes before its decoration: no figure, page or verdict file that fails takes a result with it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Never

import pytest
import tomlkit
from flown_logs import fly_eight, write_log

import quadsim
from quadsim.commands.cli import main
from quadsim.console.results import EXIT_DONE, EXIT_WRONG_INPUT
from quadsim.errors import OutputError

SHORT = ("--set", "duration=0.5", "--set", "constraints=[]")
MASS = {"name": "mass", "fields": ["vehicle.mass"], "distribution": "grid", "values": [3.9, 4.0, 4.1]}
CAMPAIGN = {"name": "c", "scenario": "hover", "flights": 3, "set": {"duration": 0.5, "constraints": []}, "vary": [MASS]}


def fail(*_: object, **__: object) -> Never:
    raise ValueError("no\nLaTeX")


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, campaigns_here: None) -> Path:
    """A working directory in which no figure can be drawn."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("quadsim.report.to_matplotlib.draw", fail)
    return tmp_path


@pytest.mark.slow("campaigns")
def test_a_campaign_whose_figure_fails_has_its_summary_its_page_and_a_line(
    here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (here / "c.toml").write_text(tomlkit.dumps(CAMPAIGN), encoding="utf-8")
    for options in ((), ("--resume",)):
        assert main(["campaign", "c.toml", "--out", "c", "--workers", "1", *options]) == EXIT_DONE
        output = capsys.readouterr()
        assert "0 of 3 " in output.out
        assert "campaign.png" in output.err
        summary = json.loads((here / "c" / "summary.json").read_text())
        assert "flights.parquet" in summary["files"]
        assert "index.html" in summary["unhashed"]
        assert "campaign.png" not in {*summary["files"], *summary["unhashed"]}


@pytest.mark.slow("campaigns")
def test_a_campaign_whose_report_fails_is_complete_all_the_same(
    here: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("quadsim.features.campaign.campaign_report.render_page", fail)
    (here / "c.toml").write_text(tomlkit.dumps(CAMPAIGN), encoding="utf-8")
    assert main(["campaign", "c.toml", "--out", "c", "--workers", "1"]) == EXIT_DONE
    assert "report" in capsys.readouterr().err
    assert json.loads((here / "c" / "manifest.json").read_text())["status"] == "complete"
    assert main(["campaign", "c.toml", "--out", "c", "--workers", "1", "--no-report", "--overwrite"]) == EXIT_DONE


def test_runs_and_their_comparison_stand_without_figures(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", "hover", *SHORT, "--no-video", "--no-recording", "--out", "r"]) == EXIT_DONE
    assert "quadsim: figures failed: ValueError: no LaTeX" in capsys.readouterr().err.splitlines()
    assert main(["compare", "r", "r", "--out", "pair"]) == EXIT_DONE
    output = capsys.readouterr()
    assert "outcome" in output.out
    assert "comparison.png" in output.err
    assert {path.name for path in (here / "pair").glob("*.*")} == {"comparison.md", "index.html", "summary.json"}
    assert "comparison.png" not in (here / "pair" / "index.html").read_text()


@pytest.mark.parametrize(
    ("command", "broken", "shown"),
    [
        (("check", "hover", *SHORT, "--junit", "v.xml"), "quadsim.console.junit.write_junit", "verdict"),
        (("compare", "r", "r", "--out", "pair"), "quadsim.report.comparison_page.render_page", "outcome"),
        (("vehicle", "hummingbird", "--out", "v.png"), "quadsim.report.vehicle_drawing.write_figure", "hummingbird"),
    ],
    ids=["junit", "page", "picture"],
)
def test_an_output_that_was_asked_for_and_fails_comes_after_the_result_and_decides_the_status(
    here: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    command: tuple[str, ...],
    broken: str,
    shown: str,
) -> None:
    quadsim.fly(quadsim.load("hover", {"duration": 0.5}), progress=False).save("r", figures=False, video=False)
    monkeypatch.setattr(broken, fail)
    assert main([*command]) == EXIT_WRONG_INPUT
    output = capsys.readouterr()
    assert shown in output.out
    assert "no LaTeX" in output.err.splitlines()[-1]
    assert not (here / command[-1]).exists()


@pytest.mark.slow("identification")
def test_an_identified_vehicle_is_written_before_its_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_log(fly_eight("hummingbird"), tmp_path / "eight.csv")
    monkeypatch.setattr("quadsim.features.identify.report._render", fail)
    files = {"out": tmp_path / "mine.toml", "page": tmp_path / "mine.html"}
    with pytest.raises(OutputError, match=r"mine\.html") as caught:
        quadsim.identify(tmp_path / "eight.csv", vehicle="hummingbird", **files)
    assert quadsim.load_vehicle(files["out"]).name == "hummingbird"
    assert "identified" in str(caught.value.result)
    assert not files["page"].exists()


def test_a_notebook_says_that_a_plot_failed(here: Path) -> None:
    scenario = quadsim.load("hover", {"duration": 0.5})
    flight = quadsim.fly(scenario, progress=False)
    for shown in (scenario, flight, quadsim.compare(flight, flight)):
        assert "no LaTeX" in shown._repr_html_()
