"""Code that is not ours is named, with its file and digest, before any of it runs."""

from __future__ import annotations

import hashlib
import shutil
import sys
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path

import pytest
import tomlkit

from scenarios.cli import main
from scenarios.commands import EXIT_DONE, EXIT_WRONG_INPUT
from scenarios.parts.foreign_code import find_code
from scenarios.schema.plugin import PluginSpec

LAW = """
import sys
print("HERE IT RUNS", file=sys.stderr)
import numpy as np

class Hover:
    def __init__(self, vehicle, *, period, horizon):
        self.speeds = np.full(4, vehicle.hover_speed)
    def step(self, now, state, reference):
        return self.speeds
"""
BARE = ("--no-video", "--no-recording", "--no-figures")
NOTICE = "quadsim: runs code that is not quadsim's: controller theirs_7:Hover from "


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder with somebody's controller and a scenario for it; no module of it stays imported."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "theirs_7.py").write_text(LAW)
    (tmp_path / "theirs.toml").write_text(
        'base = "hover"\nname = "theirs"\nduration = 0.2\nconstraints = []\ncontroller = "theirs_7:Hover"\n'
    )
    before = set(sys.modules)
    yield tmp_path
    forget(before)


def forget(before: set[str]) -> None:
    """As in a new process."""
    for name in set(sys.modules) - before:
        if name.startswith(("theirs_7", "pack_7")):
            del sys.modules[name]


def digest_of(path: Path) -> str:
    return "sha256:" + hashlib.sha256(f"{path.name}/.\0".encode() + path.read_bytes()).hexdigest()


@pytest.mark.parametrize(
    "command", [["run", "theirs.toml", *BARE], ["check", "theirs.toml"], ["check", "theirs.toml", "--json"]]
)
def test_it_is_named_before_it_is_imported(here: Path, command: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(command) == EXIT_DONE
    notice, ran, *more = capsys.readouterr().err.splitlines()
    assert notice == f"{NOTICE}{here}/theirs_7.py, {digest_of(here / 'theirs_7.py')}"
    assert ran == "HERE IT RUNS"
    assert more == []


def test_controllers_of_ours_are_not_announced(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", "hover", "--set", "duration=0.2"]) == EXIT_DONE
    assert capsys.readouterr().err == ""


def test_a_finished_run_runs_nothing(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Its scenario names a controller; checking, comparing and filming read its tables alone."""
    assert main(["run", "theirs.toml", *BARE, "--out", "run"]) == EXIT_DONE
    capsys.readouterr()
    forget(set(sys.modules) - {"theirs_7"})
    assert main(["check", "run"]) == EXIT_DONE
    assert main(["compare", "run", "--out", "page"]) == EXIT_DONE
    assert capsys.readouterr().err == ""
    assert "theirs_7" not in sys.modules


@pytest.fixture
def campaign(here: Path, capsys: pytest.CaptureFixture[str]) -> Path:
    """A campaign of somebody's, three of its five flights flown, as it comes to another machine."""
    made = {
        "name": "theirs",
        "scenario": "hover",
        "flights": 3,
        "failure": ["lost"],
        "set": {"duration": 0.2, "constraints": [], "controller": "theirs_7:Hover"},
    }
    (here / "campaign.toml").write_text(tomlkit.dumps(made))
    options = ["--workers", "1", "--no-report", "--json", "--out", "c"]
    assert main(["campaign", "campaign.toml", *options]) == EXIT_DONE
    capsys.readouterr()
    forget(set(sys.modules) - {"theirs_7"})
    return here / "c"


def test_replay_and_resume_report_what_runs_and_whether_it_flew_the_campaign(
    campaign: Path, here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for command in (
        ["replay", "c", *BARE],
        ["campaign", "campaign.toml", "--out", "c", "--resume", "--flights", "5", "--workers", "1", "--no-report"],
    ):
        assert main(command) == EXIT_DONE
        notice, known, ran, *_ = capsys.readouterr().err.splitlines()
        assert notice == f"{NOTICE}{here}/theirs_7.py, {digest_of(here / 'theirs_7.py')}"
        assert known == "quadsim: that is the code which flew the campaign, by its digest"
        assert ran == "HERE IT RUNS"
        forget(set(sys.modules) - {"theirs_7"})


def test_other_code_than_flew_a_campaign_is_reported_before_it_runs(
    campaign: Path, here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recorded = digest_of(here / "theirs_7.py")
    (here / "theirs_7.py").write_text(LAW + "# another\n")
    assert main(["replay", "c", *BARE]) == EXIT_DONE
    notice, other, ran, *_ = capsys.readouterr().err.splitlines()
    assert notice == f"{NOTICE}{here}/theirs_7.py, {digest_of(here / 'theirs_7.py')}"
    assert other == f"quadsim: that is NOT the code which flew the campaign: recorded was {recorded}"
    assert ran == "HERE IT RUNS"


def test_what_is_missing_is_reported_too(campaign: Path, here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (here / "theirs_7.py").unlink()
    shutil.rmtree(here / "__pycache__", ignore_errors=True)
    assert main(["replay", "c", *BARE]) == EXIT_WRONG_INPUT
    assert capsys.readouterr().err.startswith(NOTICE + "a module that is not found\n")


def test_a_module_in_packages_is_found_and_none_of_them_imported(here: Path) -> None:
    """`importlib.util.find_spec` would run the `__init__.py` of each."""
    folder = here / "pack_7" / "inner"
    folder.mkdir(parents=True)
    for init in (here / "pack_7" / "__init__.py", folder / "__init__.py"):
        init.write_text("raise SystemExit('it ran')\n")
    (folder / "law.py").write_text(LAW)
    code = find_code(PluginSpec(type="pack_7.inner.law:Hover"))
    assert (code.file, code.root) == (folder / "law.py", here / "pack_7")
    before = code.digest
    (folder / "__init__.py").write_text("")
    assert code.digest != before  # the whole package counts
    assert not [name for name in sys.modules if name.startswith("pack_7")]


def test_a_module_that_is_loaded_is_the_one_that_runs(here: Path) -> None:
    assert find_code(PluginSpec(type="tomlkit.api:Hover")).root == Path(str(tomlkit.__file__)).parent
    assert find_code(PluginSpec(type="sys:Hover")).file is None
    assert find_code(PluginSpec(type="nowhere_7.at.all:Hover")).file is None


def test_an_entry_point_is_found(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    entry = metadata.EntryPoint(name="theirs", value="theirs_7:Hover", group="quadsim.controllers")
    monkeypatch.setattr(metadata, "entry_points", lambda group: metadata.EntryPoints([entry]))
    code = find_code(PluginSpec(type="theirs"))
    assert (code.module, code.attribute, code.file) == ("theirs_7", "Hover", here / "theirs_7.py")


def test_a_run_of_a_package_that_is_not_installed_here_is_checked(
    here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    entry = metadata.EntryPoint(name="theirs", value="theirs_7:Hover", group="quadsim.controllers")
    with monkeypatch.context() as installed:
        installed.setattr(metadata, "entry_points", lambda group: metadata.EntryPoints([entry]))
        assert main(["run", "theirs.toml", "--set", 'controller.type="theirs"', *BARE, "--out", "run"]) == EXIT_DONE
    capsys.readouterr()
    assert main(["check", "run"]) == EXIT_DONE
    assert capsys.readouterr().err == ""
