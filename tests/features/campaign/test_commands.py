"""`quadsim campaign`, `replay`, and `compare` of campaigns, as a person calls them."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import sys
import time as clock
from pathlib import Path
from xml.etree import ElementTree

import pytest
import tomlkit

import quadsim
from quadsim.commands.cli import main
from quadsim.console.results import EXIT_DONE, EXIT_FAILED, EXIT_WRONG_INPUT

EXAMPLES = Path(__file__).resolve().parents[3] / "examples"
MASS = {"name": "mass", "fields": ["effects.load.mass_factor"], "distribution": "uniform", "low": 0.5, "high": 1.5}
CAMPAIGN = {
    "name": "little",
    "scenario": "hover",
    "flights": 6,
    "failure": ["lost", "max_error.z > 0.2"],
    "set": {"duration": 0.5, "constraints": []},
    "vary": [MASS],
}
HASTY = (
    "from quadsim.commands import entry; from quadsim.features.campaign import store; "
    "store.FLUSH_S = 0.3; raise SystemExit(entry.main())"
)
"""A command line whose campaigns write what is flown as soon as it is there."""
BARE = ("--no-video", "--no-recording", "--no-figures")


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A directory with two campaigns on the same draws, and their files; the second is lighter."""
    here = tmp_path_factory.mktemp("campaigns")
    for name, base in (("first", 0.0), ("second", 0.05)):
        path = here / f"{name}.toml"
        changed = {"duration": 0.5, "constraints": [], "initial": {"position": [0.0, 0.0, base]}}
        path.write_text(tomlkit.dumps({**CAMPAIGN, "name": name, "set": changed}), encoding="utf-8")
        assert main(["campaign", str(path), "--out", str(here / name), "--workers", "2"]) == EXIT_DONE
    return here


@pytest.fixture
def file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "little.toml"
    path.write_text(tomlkit.dumps(CAMPAIGN), encoding="utf-8")
    return path


def test_the_summary_alone_as_json(file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["campaign", str(file), "--json", "--no-report", "--flights", "2", "--seed", "9"]) == EXIT_DONE
    output = capsys.readouterr()
    assert json.loads(output.out)["flights"] == 2
    assert output.err == ""


def test_a_requirement_decides_the_exit_status(file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = ["--no-report", "--require", "P(lost) < 0.5 @ 95%", "--junit", "gate.xml"]
    assert main(["campaign", str(file), *options]) == EXIT_DONE
    assert main(["campaign", str(file), "--resume", *options, "--require", "P(lost) < 0.01 @ 95%"]) == EXIT_FAILED
    assert "299 flights" in capsys.readouterr().out.replace("\n", " ")
    suite = ElementTree.parse("gate.xml").getroot()
    assert (suite.get("tests"), suite.get("failures")) == ("2", "1")


@pytest.mark.slow("campaigns")
def test_a_replay_gives_the_same_numbers(
    flown: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["replay", str(flown / "first"), "--flight", "2", *BARE]) == EXIT_DONE
    assert json.loads((tmp_path / "runs" / "first-2" / "summary.json").read_text())["scenario"] == "first-2"
    assert {"index.html", "campaign.png"} <= {path.name for path in (flown / "first").iterdir()}


@pytest.mark.slow("campaigns")
def test_a_replay_by_other_code_starts_with_a_notice(
    flown: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    other = shutil.copytree(flown / "first", tmp_path / "other")
    manifest = json.loads((other / "manifest.json").read_text())
    (other / "manifest.json").write_text(json.dumps({**manifest, "code": "sha256:0"}))
    assert main(["replay", str(other), "--flight", "2", *BARE]) == EXIT_DONE
    notice = "quadsim: other code flew that campaign, so numbers may differ"
    assert capsys.readouterr().err.splitlines()[0] == notice


def test_two_campaigns_are_compared_flight_by_flight(
    flown: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["compare", str(flown / "first"), str(flown / "second"), "--out", str(tmp_path / "pairs")]
    assert main(arguments) == EXIT_DONE
    output = " ".join(capsys.readouterr().out.split())
    assert "Pairs share their seed, mass. Fields in which the campaigns differ: 1." in output
    pairs = tmp_path / "pairs"
    page, table = ((pairs / name).read_text(encoding="utf-8") for name in ("index.html", "comparison.md"))
    for text in (output, table, page):
        first = text.index("of 6 paired flights")
        assert 0 < first < text.index("initial.position.2"), "the conclusion comes first"
    result = json.loads((pairs / "comparison.json").read_text(encoding="utf-8"))
    assert result["differences"] == [{"field": "initial.position.2", "values": [0.0, 0.05]}]


@pytest.mark.slow("campaigns")
@pytest.mark.usefixtures("campaigns_here")
def test_the_campaigns_of_the_example_are_pairs_with_one_audit(tmp_path: Path) -> None:
    """docs/own-controller.md compares them; here the first seconds of two flights."""
    for name in ("my", "paper"):
        file = EXAMPLES / f"{name}_campaign.toml"
        options = {"flights": 2, "changes": ["duration=2.0"], "workers": 1, "report": False}
        result = quadsim.campaign(file, out=tmp_path / name, progress=False, **options)
        assert result.summary["events"]["lost"]["count"] == 0
    pair = quadsim.compare(tmp_path / "my", tmp_path / "paper", names=["mine", "paper"])
    assert (pair.flights, pair.shared_draws, pair.own_draws, pair.audits) == (2, ("mass", "wind"), (), ())
    assert pair.verdict != "not comparable"


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["campaign", "little.toml", "--workers", "0"], "workers"),
        (["campaign", "little.toml", "--until-width", "2"], "--until-width"),
        (["campaign", "little.toml", "--require", "P(lost) < 2 @ 95%"], "'P(lost) < 2 @ 95%'"),
        (["campaign", "little.toml", "--require", "P(rmse.q > 1) < 0.1 @ 95%"], "'rmse.q'"),
        (["campaign", "little.toml", "--require", "P(lost) < 1% @ 95%", "--junit", "."], "folder"),
        (["campaign", "little.toml", "--require", "P(lost) < 1% @ 95%", "--junit", "gone/v.xml"], "gone/v.xml"),
        (["campaign", "little.toml", "--cluster", "gone.toml"], "gone.toml"),
        (["replay", "little.toml"], "little.toml"),
        (["compare", "{flown}/first", "hover", "--out", "pairs"], "hover"),
        (["compare", "{flown}/first", "{flown}/second", "--name", "A", "--name", "A"], "names"),
        (["compare", "{flown}/first", "{flown}/second", "--figures"], "--figures"),
    ],
)
def test_wrong_input_is_status_2_with_one_message_and_flies_nothing(
    flown: Path, file: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], named: str
) -> None:
    before = {path.name for path in file.parent.iterdir()}
    assert main([each.replace("{flown}", str(flown)) for each in arguments]) == EXIT_WRONG_INPUT
    output = capsys.readouterr()
    assert output.out == ""
    assert output.err.startswith("quadsim: ")
    assert named in output.err
    assert {path.name for path in file.parent.iterdir()} == before


@pytest.mark.slow("process")
def test_ctrl_c_keeps_what_was_flown(file: Path) -> None:
    command = [sys.executable, "-c", HASTY, "campaign", str(file), "--out", "c", "--flights", "2000"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as campaign:
        parts = file.parent / "c" / "parts"
        while len([*parts.glob("part-*.parquet")]) < 2:  # the row of the first is counted by then
            assert campaign.poll() is None
            clock.sleep(0.1)
        campaign.send_signal(signal.SIGINT)
        _, output = campaign.communicate(timeout=30.0)
        assert campaign.returncode == 130
    assert "/c has the flights so far, --resume continues it" in output
    assert "Traceback" not in output
    manifest = json.loads((file.parent / "c" / "manifest.json").read_text())
    assert manifest["status"] == "interrupted"
    assert 0 < manifest["flown"] < 2000
