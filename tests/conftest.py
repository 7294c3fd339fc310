"""Flights shared by the tests; each is flown once per session, whichever of its workers needs it first."""

from __future__ import annotations

import fcntl
import gc
import os
import pickle
import signal
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import settings
from support import NO_PRODUCTS, draw_nothing, fly_here
from without_features import USING

from quadsim.console.progress import Progress, silent
from quadsim.features.entries import FEATURES
from quadsim.rollout.flown import Flight
from quadsim.rollout.rollout import Rollout
from quadsim.rollout.stored import read_flight
from quadsim.scenarios.assembly import Assembly
from quadsim.scenarios.catalogue import scenario_names
from quadsim.scenarios.loading import load_scenario
from quadsim.vehicle import Vehicle

# Compiled code is cached, whatever the environment sets: the workers, and all processes that tests
# start, would compile the same modules again.  `make clean` removes it.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

# Examples are not timed: a busy machine is no failure.  On CI they are the same ones each time.
settings.register_profile("thorough", deadline=None, derandomize="CI" in os.environ)
settings.register_profile("quick", settings.get_profile("thorough"), max_examples=25)  # of `make test`
settings.load_profile("thorough")

LONG = (
    "test_benchmarks.py",
    "test_commands.py",
    "report/test_comparison_page.py",
    "features/campaign/test_campaign_report.py",
    "features/gym/test_environment.py",
    "features/gym/test_learning.py",
    "scenarios/test_library.py",
    "rollout/test_many.py",
    "features/campaign/test_campaign.py",
    "features/design/test_first_flights.py",
    "commands/test_api.py",
    "rollout/test_infeasibility.py",
    "report/film/test_video.py",
    "test_documents.py",
    "test_docstrings.py",
    "commands/test_process.py",
    "test_refusals.py",
    "rollout/test_nothing_lost.py",
    "mpc/laws/test_robust.py",
    "features/papers/test_reproduction.py",
    "rollout/test_any_scenario.py",
    "mpc/forms/test_staged.py",
    "rollout/test_run.py",
    "commands/test_cli.py",
    "rollout/test_reaudit.py",
    "test_packaging.py",
    "rollout/test_conflicts.py",
    "mpc/problem/test_tightening.py",
    "mpc/solvers/test_core.py",
    "mpc/laws/test_rates.py",
    "test_main_path.py",
    "test_without_features.py",
    "sim/test_autopilot.py",
    "sim/estimation/test_estimator.py",
    "rollout/test_piloted.py",
    "rollout/test_take_off.py",
    "rollout/test_space.py",
    "rollout/test_verdicts.py",
    "features/identify/test_identify_fit.py",
    "features/papers/test_beyond.py",
    "test_snapshots.py",
)
"""Modules that take longest."""
collect_ignore = [module for module, used in USING.items() if not {*used} <= {*FEATURES}]
"""Tests of features that have been taken away."""
_fly = Rollout.fly
"""Whatever stands in for it in a test."""


def pytest_addoption(parser: pytest.Parser) -> None:
    """No test may need another one before it."""
    parser.addoption("--reversed", action="store_true", help="run the tests in reversed order")


def pytest_configure(config: pytest.Config) -> None:
    """Give modules to the workers in the order of `pytest_collection_modifyitems`, not by their number of tests."""
    if hasattr(config.option, "loadscopereorder"):
        config.option.loadscopereorder = False
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # as in a shell's background: children would never hear it
        signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Long modules first, so that no worker is left alone with one in the end; or all the other way round."""
    here = Path(__file__).parent
    rank = {here / name: i for i, name in enumerate(LONG)}
    items.sort(key=lambda item: rank.get(item.path, len(rank)))
    if config.getoption("--reversed"):
        items.reverse()


def pytest_collection_finish() -> None:
    """Have few passes of Python's cycle collector: they took 9 % of all."""
    gc.set_threshold(20_000, 20, 50)


Fly = Callable[..., Flight]


@pytest.fixture(scope="session")
def session_directory(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One directory for all workers of this session."""
    own = tmp_path_factory.getbasetemp()
    return own.parent if "PYTEST_XDIST_WORKER" in os.environ else own


@pytest.fixture(scope="session")
def fly_once(session_directory: Path) -> Fly:
    """Flies a scenario of the library with settings, in memory, plant at the physics rate; the same one only once."""
    known: dict[str, Flight] = {}

    def fly(name: str, *settings: str) -> Flight:
        key = " ".join([name, *settings])
        if key not in known:
            path = session_directory / f"{key.replace('/', '_')}.flight"
            with path.with_suffix(".lock").open("w") as lock:
                fcntl.flock(lock, fcntl.LOCK_EX)
                if not path.exists():
                    path.write_bytes(pickle.dumps(_fly(Rollout(load_scenario(name, settings))), protocol=-1))
            known[key] = pickle.loads(path.read_bytes())
        return known[key]

    return fly


@pytest.fixture(scope="session")
def vehicle() -> Vehicle:
    return Assembly(load_scenario("paper-constrained")).vehicle


@pytest.fixture(scope="session")
def short_run(fly_once: Fly, tmp_path_factory: pytest.TempPathFactory) -> Flight:
    """Six seconds of the constrained flight in a run directory with its summary, scenario and Parquet files."""
    directory = tmp_path_factory.mktemp("short") / "paper-constrained"
    fly_once("paper-constrained", "duration=6.0").save(directory, **NO_PRODUCTS)
    return read_flight(directory)


@pytest.fixture(scope="session")
def short_run_directory(short_run: Flight) -> Path:
    return short_run.directory


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """See `support.draw_nothing`."""
    draw_nothing(monkeypatch)


@pytest.fixture
def campaigns_here(monkeypatch: pytest.MonkeyPatch) -> None:
    """See `support.fly_here`."""
    fly_here(monkeypatch)


@pytest.fixture
def fly_known(fly_once: Fly) -> Fly:
    """Stands in for `Rollout.fly`: a scenario as the library has it is flown once per session."""

    def fly(rollout: Rollout, progress: Progress = silent) -> Flight:
        scenario = rollout.scenario
        substituted = rollout._events._build is None
        if not substituted and scenario.name in scenario_names() and load_scenario(scenario.name) == scenario:
            return fly_once(scenario.name)
        return _fly(rollout, progress)

    return fly


@pytest.fixture(scope="session")
def constrained_flight(fly_once: Fly) -> Flight:
    """The paper's whole constrained flight."""
    return fly_once("paper-constrained")


@pytest.fixture(scope="session")
def unconstrained_flight(fly_once: Fly) -> Flight:
    """The paper's whole unconstrained flight."""
    return fly_once("paper-unconstrained")
