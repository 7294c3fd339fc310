"""The worked example: short, flown as in the README, and by entry point."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path

import numpy as np
import pytest

from quadsim.commands.cli import main
from quadsim.rollout.flown import Flight
from quadsim.rollout.rollout import Rollout
from quadsim.scenarios.loading import load_scenario

ROOT = Path(__file__).resolve().parent.parent
EXAMPLES = ROOT / "examples"
SCENARIO = str(EXAMPLES / "my_controller.toml")


@pytest.fixture(autouse=True)
def _forgotten() -> Iterator[None]:
    """Examples are imported anew by each test."""
    yield
    sys.modules.pop("my_controller", None)


def flown() -> Flight:
    return Rollout(load_scenario(SCENARIO)).fly()


def test_it_follows_the_course_within_its_constraints() -> None:
    flight = flown()
    errors = flight.log.control.truth[:, [0, 2, 4]] - flight.log.control.reference[:, :3]
    assert flight.controller == "MyController"
    assert flight.outcome == "satisfied", [f.limit.name for f in flight.findings if not f.satisfied]
    assert np.sqrt(np.mean(errors**2, axis=0)).max() < 0.03
    assert flight.log.predicted is None


def test_its_settings_are_taken_from_the_file() -> None:
    late = Rollout(load_scenario(SCENARIO, ["controller.settings.lead=0"])).fly()
    assert late.outcome == "violated"


def test_an_installed_one_flies_by_the_name_of_its_entry_point(monkeypatch: pytest.MonkeyPatch) -> None:
    point = metadata.EntryPoint("example", "my_controller:MyController", "quadsim.controllers")
    points = metadata.EntryPoints([point])
    monkeypatch.setattr(metadata, "entry_points", lambda *, group: points.select(group=group))
    monkeypatch.syspath_prepend(EXAMPLES)
    flight = Rollout(load_scenario("waypoints", ["controller=example"])).fly()
    assert flight.controller == "MyController"
    np.testing.assert_array_equal(flight.log.plant.state, flown().log.plant.state)


@pytest.mark.usefixtures("undrawn")
def test_the_lines_of_the_pages_are_those_of_the_example(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    readme, page = ((ROOT / name).read_text(encoding="utf-8") for name in ("README.md", "docs/own-controller.md"))
    for line in ('base = "waypoints"', 'controller = "my_controller:MyController"'):
        assert line in page.splitlines()
        assert line in (EXAMPLES / "my_controller.toml").read_text(encoding="utf-8").splitlines()
    command = "quadsim run examples/my_controller.toml"
    assert command in readme
    monkeypatch.chdir(ROOT)
    assert main([*command.split()[1:], "--no-video", "--no-recording", "--out", str(tmp_path / "run")]) == 0
    assert "MyController" in (tmp_path / "run" / "summary.json").read_text(encoding="utf-8")
    assert "my-controller" in capsys.readouterr().out


@pytest.mark.slow("pages")
def test_the_scenarios_of_the_pages_on_controllers_fly(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    names = ("audit", "controllers", "linear", "robust")
    page = "".join((ROOT / "docs" / f"{name}.md").read_text(encoding="utf-8") for name in names)
    monkeypatch.chdir(EXAMPLES)
    blocks = re.findall(r"```toml\n(.*?)```", page, flags=re.DOTALL)
    assert blocks
    for block in blocks:
        (tmp_path / "one.toml").write_text(block, encoding="utf-8")
        scenario = load_scenario(str(tmp_path / "one.toml"), ["duration=1", "constraints=[]"])
        assert Rollout(scenario).fly().outcome in ("satisfied", "unaudited")
