"""`quadsim bench speed`: two controllers at two speeds, flown; its tables and figure of flights that are made up."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from support import fly_here, take_long_steps

from quadsim.assets import vehicle_path
from quadsim.errors import ParameterError
from quadsim.report.table import Grid
from quadsim.vehicle import load_vehicle
from scenarios.bench.speed import (
    LAWS,
    NEAR,
    QUICK_LAWS,
    QUICK_SPEEDS,
    QUICK_WORLD,
    WORLDS,
    Given,
    SpeedBench,
    SpeedFlight,
    fly_cell,
    merged,
    run_speeds,
    speed_legend,
    speed_tables,
)
from scenarios.bench.speed_figure import draw_speeds
from scenarios.benchmarks import bench_speed
from scenarios.design.first_scenario import first_scenario
from scenarios.flight import Flight
from scenarios.loading import parse_scenario
from scenarios.run import fly_scenario
from scenarios.schema.scenario import Scenario

WELL = SpeedFlight(bound=40.0, reason=None, error=0.1, tilt=35.0, violated=0.0, saturated=0.2, fallback=0.0)
FAR = replace(WELL, error=2.0 * NEAR)
BEYOND = replace(WELL, error=0.05, tilt=45.0, violated=0.125)
LOST = replace(WELL, reason="lost", error=None, tilt=121.0, violated=0.5, lost=1)


@pytest.fixture
def measured() -> SpeedBench:
    """The LQR is near, far, then lost; the nonlinear MPC near, beyond its bound, and near again."""
    courses = {"LQR": (WELL, FAR, LOST), "nonlinear": (WELL, BEYOND, WELL)}
    cells = [("loop", speed, law) for speed in (4.0, 6.0, 8.0) for law in courses]
    return SpeedBench(flights={cell: courses[cell[2]][int(cell[1] - 4.0) // 2] for cell in cells})


def texts(grid: Grid) -> list[list[str]]:
    return [[cell.text for cell in cells] for cells in grid.lines]


def test_quick_flies_two_controllers_at_two_speeds(monkeypatch: pytest.MonkeyPatch) -> None:
    fly_here(monkeypatch)
    take_long_steps(monkeypatch, QUICK_WORLD)
    found = bench_speed(quick=True, progress=False)
    assert list(found.flights) == [(QUICK_WORLD, speed, law) for speed in QUICK_SPEEDS for law in QUICK_LAWS]
    for speed in QUICK_SPEEDS:
        linear, nonlinear = (found.flights[QUICK_WORLD, speed, law] for law in QUICK_LAWS)
        assert linear.error is not None
        assert nonlinear.error is not None
        assert nonlinear.error < 0.3 * linear.error
        # Level at constant speed, centripetal acceleration alone requires this tilt; drag, and ramps, for more.
        assert (
            linear.bound == nonlinear.bound == pytest.approx(np.degrees(np.arctan(speed**2 / 5.0 / 9.81)) + 10, abs=3)
        )
        assert nonlinear.tilt > nonlinear.bound - 10.0
    slow, fast = (found.flights[QUICK_WORLD, speed, "nonlinear"] for speed in QUICK_SPEEDS)
    assert slow.error < fast.error  # type: ignore[operator]
    assert json.loads(json.dumps(found.to_json()))["flights"][0]["controller"] == QUICK_LAWS[0]


def test_a_loss_is_a_result(monkeypatch: pytest.MonkeyPatch) -> None:
    take_long_steps(monkeypatch, "loop, drag")
    lost = fly_cell(("loop, drag", 14.0, "LQR", 0))
    assert lost.reason is not None
    assert "lost" in lost.reason
    assert lost.error is None
    assert lost.bound == 80.0


@pytest.mark.parametrize("world", WORLDS)
def test_every_controller_is_one_that_a_scenario_may_have(world: str) -> None:
    name = WORLDS[world].vehicle
    vehicle = load_vehicle(vehicle_path(name))
    data = first_scenario(vehicle, name, course="figure-eight").to_data()
    given = Given(vehicle=vehicle, tuned=data["controller"], period=data["control_period"], bound=50.0)
    types = [parse_scenario({**data, "controller": law.table(given)}).controller.type for law in LAWS.values()]
    assert types == ["lqr", "pid", "constrained", "robust", "geometric", "geometric", "nonlinear", "nonlinear"]


def test_seeds_differ_and_are_merged_with_their_interval(monkeypatch: pytest.MonkeyPatch) -> None:
    def fly(scenario: Scenario) -> Flight:
        return fly_scenario(scenario.model_copy(update={"duration": 1.0}))

    monkeypatch.setattr("scenarios.bench.speed.fly_scenario", fly)
    first, again, other = (fly_cell(("hummingbird, sensors", 6.0, "LQR", seed)) for seed in (0, 0, 1))
    assert first == again
    assert first.error != other.error
    near, far = (replace(WELL, error=error) for error in (0.1, 0.3))
    both = merged([near, far])
    assert both.error == pytest.approx(0.2)
    assert both.half == pytest.approx(12.7062 * 0.1, rel=1e-4)  # Student's t of one degree of freedom
    assert (both.seeds, both.lost, both.reason) == (2, 0, None)
    one = merged([near, LOST])
    assert (one.error, one.half, one.lost, one.reason, one.tilt) == (None, None, 1, "lost", 121.0)
    assert one.violated == 0.25


def test_no_process_is_refused() -> None:
    with pytest.raises(ParameterError, match="--workers must be at least 1; got 0"):
        run_speeds(workers=0)


def test_tables_show_loss_violation_and_the_nearest(measured: SpeedBench) -> None:
    reach, errors, violated, tilts, saturated = speed_tables(measured)
    assert texts(reach) == [["LQR", "6, 4, 6"], ["nonlinear", "8, 8, 4"]]
    assert texts(errors)[1:] == [["loop", "6", "40", "0.500", "0.050"], ["loop", "8", "40", "lost", "0.100"]]
    assert [cell.mark for cell in errors.lines[2]] == ["", "", "", "bad", "best"]
    assert texts(violated)[1:] == [["loop", "6", "40", "0", "12.5"], ["loop", "8", "40", "50.0", "0"]]
    assert texts(tilts)[2][3:] == ["121", "35"]
    assert texts(saturated)[0][3:] == ["20.0", "20.0"]
    assert speed_legend(measured).count("- **") == 3


def test_the_figure_has_a_curve_for_each_and_a_cross_where_one_is_lost(measured: SpeedBench) -> None:
    errors, violations = draw_speeds(measured).axes
    curves = [line for line in errors.get_lines() if line.get_marker() == "o"]
    np.testing.assert_array_equal(curves[0].get_ydata(), [0.1, 2.0 * NEAR, np.nan])
    np.testing.assert_array_equal(curves[1].get_ydata(), [0.1, 0.05, 0.1])
    crosses = [line for line in errors.get_lines() if line.get_marker() == "x"]
    assert [np.asarray(line.get_xdata()).tolist() for line in crosses] == [[8.0], []]
    np.testing.assert_array_equal(violations.get_lines()[0].get_ydata(), [0.0, 0.0, 50.0])
