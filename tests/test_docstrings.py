"""Every public name has an example in its docstring, and every example runs."""

from __future__ import annotations

import doctest
import sys
from collections.abc import Callable
from pathlib import Path
from pkgutil import resolve_name
from types import ModuleType

import pytest
from _pytest.mark.structures import ParameterSet

import quadsim
import quadsim.gym
from quadsim import mpc
from quadsim.errors import RenderingUnavailableError
from quadsim.report.film.video import rendering_backend
from quadsim.rollout.flown import Flight

SLOW = pytest.mark.slow("docstrings")
REPRESENTATIVE = pytest.mark.representative("docstrings")
CONSTANTS = {"quadsim.STATE_NAMES", "quadsim.gym.TASKS"}
"""Public names that are no functions or classes, and so have no docstring to run."""
RENDERS = {"quadsim.film"}
"""Whose examples need a machine that renders."""
QUICK = {"quadsim.fly", "quadsim.load"}
"""Of the functions of `quadsim`, those that `make test` runs."""
BUILDING_BLOCKS = (
    "quadsim.flight.audit.Finding",
    "quadsim.flight.audit.Limit",
    "quadsim.flight.audit.audit",
    "quadsim.rollout.flown.Flight",
    "quadsim.rotation.body_to_world",
    "quadsim.rotation.euler_to_quaternion",
    "quadsim.scenarios.assembly.Assembly",
    "quadsim.scenarios.loading.load_scenario",
    "quadsim.scenarios.schema.scenario.Scenario",
)
"""What features and contributors use, beside public names."""


def public_names(package: ModuleType) -> list[str]:
    """The functions and classes that a package hands out, with the package's name."""
    names = [f"{package.__name__}.{name}" for name in sorted(package.__all__)]
    return [name for name in names if name not in CONSTANTS and not isinstance(resolve_name(name), ModuleType)]


def marked(name: str) -> ParameterSet:
    marks = [SLOW, REPRESENTATIVE] if name in QUICK else [SLOW]
    return pytest.param(name, marks=marks)


def run_examples(name: str) -> doctest.TestResults:
    """Run the examples in the docstrings of a name and of its methods."""
    public = resolve_name(name)
    finder = doctest.DocTestFinder()
    runner = doctest.DocTestRunner(verbose=False)
    for examples in finder.find(public, name, module=sys.modules[public.__module__]):
        runner.run(examples)
    return doctest.TestResults(runner.failures, runner.tries)


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An empty working directory."""
    monkeypatch.chdir(tmp_path)


@pytest.mark.usefixtures("here", "undrawn", "campaigns_here")
@pytest.mark.parametrize("name", [marked(name) for name in (*public_names(quadsim), *public_names(quadsim.gym))])
def test_examples_of_public_names_run(
    name: str,
    fly_known: Callable[..., Flight],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    if name in RENDERS:
        try:
            rendering_backend()
        except RenderingUnavailableError as error:
            pytest.skip(str(error))
    monkeypatch.setattr("quadsim.rollout.rollout.Rollout.fly", fly_known)
    failed, attempted = run_examples(name)
    assert attempted > 0
    assert failed == 0, capsys.readouterr().out


@pytest.mark.usefixtures("here")
@pytest.mark.parametrize("name", [*public_names(mpc), *BUILDING_BLOCKS])
def test_examples_of_controllers_and_building_blocks_run(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    failed, attempted = run_examples(name)
    assert attempted > 0
    assert failed == 0, capsys.readouterr().out
