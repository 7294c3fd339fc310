"""Flights shared by the tests; each is flown once per session and worker."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from hypothesis import settings

from quadsim.flight import rundir
from quadsim.flight.rundir import Run
from quadsim.vehicle import Vehicle
from scenarios.build import build_vehicle
from scenarios.loading import load_scenario
from scenarios.run import Flight, Outputs, fly_scenario, run_scenario

# Examples are not timed: a busy machine is no failure.  On CI they are the same ones each time.
settings.register_profile("quadsim", deadline=None, derandomize="CI" in os.environ)
settings.load_profile("quadsim")

NO_PRODUCTS = Outputs(video=False, recording=False, figures=False)


@pytest.fixture(scope="session")
def vehicle() -> Vehicle:
    return build_vehicle(load_scenario("paper-constrained"))


@pytest.fixture(scope="session")
def short_run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Six seconds of the constrained flight in a run directory with its summary, scenario and Parquet files."""
    directory = tmp_path_factory.mktemp("short") / "paper-constrained"
    run_scenario(load_scenario("paper-constrained", ["duration=6.0"]), directory, NO_PRODUCTS)
    return rundir.load_run(directory)


@pytest.fixture(scope="session")
def short_run_directory(short_run: Run) -> Path:
    return short_run.directory


@pytest.fixture(scope="session")
def constrained_flight() -> Flight:
    """The paper's whole constrained flight, in memory, plant at the physics rate."""
    return fly_scenario(load_scenario("paper-constrained"))


@pytest.fixture(scope="session")
def unconstrained_flight() -> Flight:
    """The paper's whole unconstrained flight, in memory."""
    return fly_scenario(load_scenario("paper-unconstrained"))
