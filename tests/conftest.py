"""Flights shared by the tests; each is flown once per session, whichever of its workers needs it first."""

from __future__ import annotations

import fcntl
import os
import pickle
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import settings

from quadsim import rundir
from quadsim.rundir import Run
from quadsim.vehicle import Vehicle
from scenarios import runner
from scenarios.build import build_vehicle
from scenarios.cost.study import ARM_LENGTHS, DRAGS
from scenarios.loading import load_scenario
from scenarios.runner import Flight, Outputs

# Examples are not timed: a busy machine is no failure.  On CI they are the same ones each time.
settings.register_profile("quadsim", deadline=None, derandomize="CI" in os.environ)
settings.load_profile("quadsim")

NO_PRODUCTS = Outputs(video=False, recording=False, figures=False)
LONG = (
    *("scenarios/campaign/test_cluster.py", "scenarios/test_library.py", "scenarios/test_cli.py"),
    *("scenarios/campaign/test_survival.py", "scenarios/test_faults.py", "scenarios/test_bench.py", "test_commands.py"),
    *("test_safety.py", "scenarios/campaign/test_local.py", "scenarios/test_ladder.py", "test_documents.py"),
    *("scenarios/test_soak.py", "quadsim/test_video.py", "scenarios/campaign/test_run.py", "scenarios/test_paper.py"),
    *("scenarios/campaign/test_kills.py", "scenarios/test_mutations.py", "scenarios/test_any_scenario.py"),
    *("quadsim/campaign/test_report.py", "quadsim/test_report.py", "scenarios/test_terminal.py"),
    *("mpc/test_robust.py", "quadsim/test_figures.py", "scenarios/test_cost.py", "mpc/test_tightening.py"),
)
"""Modules that take longest; those not named take less than ten seconds each."""


def pytest_configure(config: pytest.Config) -> None:
    """Give modules to the workers in the order of `pytest_collection_modifyitems`, not by their number of tests."""
    if hasattr(config.option, "loadscopereorder"):
        config.option.loadscopereorder = False


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Long modules first, so that no worker is left alone with one in the end."""
    here = Path(__file__).parent
    rank = {here / name: i for i, name in enumerate(LONG)}
    items.sort(key=lambda item: rank.get(item.path, len(rank)))


def pytest_sessionstart() -> None:
    """Have no long module that is not there: a name that was changed is no longer first."""
    assert all((Path(__file__).parent / name).is_file() for name in LONG)


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
                    path.write_bytes(pickle.dumps(runner.fly_scenario(load_scenario(name, settings)), protocol=-1))
            known[key] = pickle.loads(path.read_bytes())
        return known[key]

    return fly


@pytest.fixture(scope="session")
def vehicle() -> Vehicle:
    return build_vehicle(load_scenario("paper-constrained"))


@pytest.fixture(scope="session")
def short_run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Six seconds of the constrained flight in a run directory with its summary, scenario and Parquet files."""
    directory = tmp_path_factory.mktemp("short") / "paper-constrained"
    runner.run(load_scenario("paper-constrained", ["duration=6.0"]), directory, NO_PRODUCTS)
    return rundir.load_run(directory)


@pytest.fixture(scope="session")
def short_run_directory(short_run: Run) -> Path:
    return short_run.directory


@pytest.fixture(scope="session")
def constrained_flight(fly_once: Fly) -> Flight:
    """The paper's whole constrained flight."""
    return fly_once("paper-constrained")


@pytest.fixture(scope="session")
def unconstrained_flight(fly_once: Fly) -> Flight:
    """The paper's whole unconstrained flight."""
    return fly_once("paper-unconstrained")


@pytest.fixture(scope="session")
def varied_flights(fly_once: Fly) -> dict[tuple[float, float], Flight]:
    """The constrained flight over arm length [m] and drag to thrust [m], which the paper leaves out."""
    return {
        (arm, drag): fly_once("paper-constrained", f"vehicle.arm_length={arm}", f"vehicle.drag_to_thrust={drag}")
        for arm in ARM_LENGTHS
        for drag in DRAGS
    }
