"""The commands in the documents exist, and run as they are printed."""

from __future__ import annotations

import re
import shlex
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from _pytest.mark.structures import ParameterSet
from flown_logs import fly_eight, write_log
from support import NO_PRODUCTS, fly_here

import quadsim
from quadsim.commands.app import app
from quadsim.commands.cli import main
from quadsim.console.results import EXIT_DONE, EXIT_FAILED
from quadsim.errors import RenderingUnavailableError
from quadsim.report.film.video import rendering_backend
from quadsim.rollout.flown import Flight
from quadsim.rollout.rollout import Rollout
from quadsim.scenarios.loading import load_scenario

ROOT = Path(__file__).resolve().parent.parent
CAMPAIGN = ("--set", "duration=1.0", "--set", "constraints=[]", "--flights", "2", "--no-report")
ADDED = {
    "run": ("--no-video", "--set", "duration=2.0", "--set", "constraints=[]", "--overwrite"),
    "compare": ("--overwrite",),
    "export": ("--set", "duration=1.0"),
    "identify": ("--overwrite",),
    "campaign": (*CAMPAIGN, "--out", "campaign"),
    "live": ("--script", "push.toml"),
    "replay": ("--no-video", "--no-recording", "--no-figures"),
}
"""What makes a command cheap enough to run here."""


OWN_VEHICLE = ROOT / "docs" / "own-vehicle.md"
"""Its lines build on each other, and have a test of their own: features/design/test_own_vehicle_page.py."""
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted({*(ROOT / "docs").glob("*.md")} - {OWN_VEHICLE})]
DOCUMENTS = "\n".join(path.read_text() for path in PAGES)
LINES = [
    line.strip()
    for block in re.findall(r"^```sh\n(.*?)^```", DOCUMENTS, re.DOTALL | re.MULTILINE)
    for line in block.splitlines()
]
QUADSIM = [*dict.fromkeys(line.partition("#")[0].strip() for line in LINES if line.startswith("quadsim "))]
ELSEWHERE = ("quadsim view", "--cluster", "--fly", "casadi")
"""`view` opens a window and stays; a cluster, and what takes an emulator or CasADi, have tests of their own."""
README = (ROOT / "README.md").read_text(encoding="utf-8")
SLOW = pytest.mark.slow("commands")
REPRESENTATIVE = pytest.mark.representative("commands")


def marked(line: str) -> ParameterSet:
    """A documented command among the slow ones, of which `make test` runs those of the README."""
    marks = [SLOW, REPRESENTATIVE] if line in README else [SLOW]
    return pytest.param(line, marks=marks)


def runs_here(line: str) -> bool:
    return not any(word in line for word in ELSEWHERE)


def arguments_of(line: str) -> list[str]:
    """A command line's words after the command itself, without its comment and where its output goes."""
    words = shlex.split(line, comments=True)[1:]
    return words[: words.index(">")] if ">" in words else words


@pytest.fixture
def workplace(
    line: str,
    request: pytest.FixtureRequest,
    fly_known: Callable[..., Flight],
    flown: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The working directory after `make demo`, with a shorter flight in the place of both.

    Scenarios of the library that are flown as they are have been flown once.  A log and a campaign are there for the
    commands that read them.
    """
    if "eight.csv" in line:
        shutil.copy(request.getfixturevalue("eight"), tmp_path)
    if "examples/" in line:
        (tmp_path / "examples").symlink_to(ROOT / "examples")
    if re.search(r"runs/(campaigns|mine|other|paper)\b(?!-)", line):
        campaign = request.getfixturevalue("campaign")
        for place in (f"campaigns/{campaign.name}", "mine", "other", "paper"):
            shutil.copytree(campaign, tmp_path / "runs" / place)
    (tmp_path / "mine.toml").write_text('base = "paper-nominal"\nname = "mine"\nfailure = ["lost"]\n')
    for name in ("mine-vehicle", "start", "identified"):
        (tmp_path / f"{name}.toml").write_text(quadsim.vehicle_report(template=True).content)
    (tmp_path / "first.toml").write_text('base = "hover"\n')  # in the place of the one made for that vehicle
    (tmp_path / "push.toml").write_text(
        'duration = 0.2\ninputs = [{ at = 0.1, type = "pull", to = [1.0, 0.0, 1.0] }]\n'
    )
    for name in ("paper-unconstrained", "paper-constrained"):
        shutil.copytree(flown, tmp_path / "runs" / name)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("quadsim.rollout.rollout.Rollout.fly", fly_known)


@pytest.fixture(scope="session")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of 0.1 s, which is 3 frames of film."""
    directory = tmp_path_factory.mktemp("flown") / "paper-constrained"
    Rollout(load_scenario("paper-constrained", ["duration=0.1"])).fly().save(directory, **NO_PRODUCTS)
    return directory


@pytest.fixture(scope="session")
def campaign(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The campaign of the README, shorter and of fewer flights."""
    directory = tmp_path_factory.mktemp("campaign") / "paper-robustness"
    with pytest.MonkeyPatch.context() as patch:
        fly_here(patch)
        assert main(["campaign", "paper-robustness", *CAMPAIGN, "--out", str(directory)]) == EXIT_DONE
    return directory


@pytest.fixture(scope="session")
def eight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log of the vehicle that the template describes."""
    directory = tmp_path_factory.mktemp("logged")
    (directory / "template.toml").write_text(quadsim.vehicle_report(template=True).content)
    return write_log(fly_eight(directory / "template.toml"), directory / "eight.csv")


def test_every_command_is_documented_and_every_documented_one_exists() -> None:
    assert len(QUADSIM) >= 5
    for line in QUADSIM:
        words = [word for word in arguments_of(line) if word != "--json"]  # of every command
        app.parse_args(words, exit_on_error=False, print_error=False)
    assert {arguments_of(line)[0] for line in QUADSIM} == {name for name in app if not name.startswith("-")}


@pytest.mark.usefixtures("workplace", "undrawn", "campaigns_here")
@pytest.mark.parametrize("line", [marked(line) for line in QUADSIM if runs_here(line)])
def test_documented_command_runs(line: str, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = arguments_of(line)
    command = arguments[0]
    if command == "video":
        try:
            rendering_backend()
        except RenderingUnavailableError as error:
            pytest.skip(str(error))
    unsupported = "--require" in arguments  # by so few flights
    assert main([*arguments, *ADDED.get(command, ())]) == (EXIT_FAILED if unsupported else EXIT_DONE)
    assert capsys.readouterr().out


def test_documented_make_targets_exist() -> None:
    blocks = {
        target
        for line in LINES
        if line.startswith("make ") and not line.startswith("make -C")  # of another directory
        for target in re.findall(r" ([a-z-]+)\b", line.partition("#")[0])
    }
    named = blocks | set(re.findall(r"`make ([a-z-]+)", DOCUMENTS))
    assert {"demo", "test", "setup", "check", "numbers"} <= named
    phony = re.search(r"^\.PHONY: (.+)$", (ROOT / "Makefile").read_text(), re.MULTILINE)
    assert phony is not None
    assert named <= set(phony[1].split())
