"""Flights shared by the tests; each is flown once per session and worker."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import settings

from quadsim.flight import rundir
from quadsim.flight.rundir import Run
from quadsim.vehicle import Vehicle
from scenarios.cost.study import MEASURES, CandidateTimes, CostStudy, Outcome, Sweep, SweepPoint, Variation
from scenarios.loading import load_scenario
from scenarios.parts.vehicle import build_vehicle
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


def make_outcome(scale: float = 1.0, *, reason: str | None = None, settled: float | None = 4.0) -> Outcome:
    """A flight of ten periods whose measures are `scale` times 1, 2, 3 and so on."""
    return Outcome(
        reason=reason,
        flown=0.5,
        statuses={"infeasible": 1, "solved": 3, "unconstrained": 6},
        fallbacks=1,
        active=3,
        numbers={key: scale * (i + 1.0) for i, key in enumerate(MEASURES)},
        settling=[
            {"channel": "x", "time": 0.0, "before": 0.0, "after": 1.0, "settled": settled},
            {"channel": "x", "time": 10.0, "before": 1.0, "after": 0.0, "settled": 3.0},
        ],
    )


@pytest.fixture
def cost_study() -> CostStudy:
    """A made-up study in which everything that can happen does: flights lost, plans held, steps that never settle."""
    step_ms = np.linspace(1.0, 10.0, 10)
    shortcut = ("unconstrained",) * 6 + ("solved",) * 3 + ("infeasible",)
    lost = make_outcome(9.0, reason="the plant diverged", settled=None)
    times = {"p50": 0.5, "p95": 0.8, "p99": 0.9, "max": 1.0}
    return CostStudy(
        name="bounded",
        horizon=20,
        deadline_ms=50.0,
        duration=0.5,
        constrained=make_outcome(2.0),
        unconstrained=make_outcome(4.0, settled=8.0),
        others={"free": make_outcome(3.0)},
        reference=[{"settled": 5.0}, {"settled": None}],
        contenders=(
            CandidateTimes(name="gain", step_ms=0.01 * step_ms, statuses=("solved",) * 10, repeats=3),
            CandidateTimes(name="as flown", step_ms=step_ms, statuses=shortcut, repeats=3),
            CandidateTimes(name="QP by slow", step_ms=8.0 * step_ms, statuses=("solved",) * 10, repeats=1),
        ),
        left_out={"absent": "pip install it"},
        tilt=Sweep(
            name="tilt bound",
            unit="deg",
            base=5.0,
            points=(
                SweepPoint(value=2.0, constrained=make_outcome(3.0, settled=None), step_ms=times),
                SweepPoint(value=5.0, constrained=make_outcome(2.0), step_ms=times),
                SweepPoint(value=10.0, constrained=lost, step_ms={}),
            ),
        ),
        horizons=Sweep(
            name="horizon",
            unit="periods",
            base=20,
            points=(
                SweepPoint(value=10, constrained=make_outcome(3.0), step_ms=times, unconstrained=lost),
                SweepPoint(value=20, constrained=make_outcome(2.0), step_ms=times, unconstrained=make_outcome(4.0)),
            ),
        ),
        variations=(
            Variation(arm_length=0.2, drag_to_thrust=0.012, outcome=make_outcome(2.0)),
            Variation(arm_length=0.5, drag_to_thrust=0.024, outcome=make_outcome(2.5)),
            Variation(arm_length=0.5, drag_to_thrust=0.048, outcome=lost),
        ),
        machine={"processor": "abacus", "cores": 2},
    )
