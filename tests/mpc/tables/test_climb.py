"""The bound on the climb acceleration: exact in a climb, active in a flight whose audit holds, refused in one line."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from uneven import published, uneven

import quadsim
from quadsim.assets import vehicle_path
from quadsim.errors import InputError
from quadsim.flight.feasibility import Feasibility
from quadsim.mpc.tables.climb import climb_of_rotors, climb_speeds, climbing_targets, within_tilt
from quadsim.mpc.tables.commands import TargetBounds
from quadsim.rollout.flown import Flight
from quadsim.vehicle import Vehicle, load_vehicle

HUMMINGBIRD = load_vehicle(vehicle_path("hummingbird"))
BOUNDS = (-2.0, 3.0)
UP: dict[str, Any] = {
    "reference": {"type": "steps", "z": [{"start": 1.0, "stop": 4.0, "value": 4.0}]},
    "duration": 6.0,
    "constraints": [],
}
RATES = {"commands": "rates", "inner_lag": [0.05, 0.05, 0.05, 0.1]}
WEIGHTS = {
    "output_weights": {"x": 10.0, "y": 10.0, "z": 100.0, "yaw": 10.0},
    "target_weights": {"thrust": 0.1, "body_rate": 0.1},
}
BEHIND_AUTOPILOT = {"autopilot": {}, "plant.limit_speeds": True}
NONLINEAR = {"type": "nonlinear", "tilt": 30.0, "horizon": 40}
LAWS: dict[str, dict[str, Any]] = {
    "constrained": {},
    "robust": {"controller.type": "robust", "controller.solver": "core"},
    "robust-lag": {
        "controller.type": "robust",
        "controller.rotor_lag": 0.05,
        "effects.rotors": {"rise": 0.05, "fall": 0.05},
    },
    "robust-rates": {"controller": {"type": "robust", "horizon": 40, **RATES, **WEIGHTS}, **BEHIND_AUTOPILOT},
    "nonlinear-thrust": {"controller": NONLINEAR},
    "nonlinear-speed": {"controller": {**NONLINEAR, "inputs": "speed", "weights": {"input": 20.0}}},
    "nonlinear-rates": {"controller": {**NONLINEAR, **RATES}, **BEHIND_AUTOPILOT},
}


def flown(law: str, changes: dict[str, Any]) -> Flight:
    return quadsim.fly(quadsim.load("hummingbird-figure-eight").replace({**UP, **LAWS[law]}).replace(changes))


@pytest.mark.parametrize("law", LAWS)
def test_it_is_active_and_the_audit_holds(law: str) -> None:
    bounded = flown(law, {"controller.climb_acceleration": [*BOUNDS]})
    (finding,) = (each for each in bounded.findings if each.limit.signal == "climb_acceleration")
    assert (finding.limit.lower, finding.limit.upper) == BOUNDS
    assert finding.satisfied
    assert bounded.outcome == "satisfied"
    rising = np.diff(bounded.state["vz"]) / np.diff(bounded.time)
    assert rising.max() == pytest.approx(BOUNDS[1], abs=0.05)
    assert finding.margin == pytest.approx(0.0, abs=0.01)
    free = flown(law, {})
    rising = np.diff(free.state["vz"]) / np.diff(free.time)
    assert rising.max() > BOUNDS[1] + 0.5


@pytest.mark.parametrize("vehicle", [HUMMINGBIRD, uneven(), published("cf21b")], ids=lambda vehicle: vehicle.name)
def test_its_ends_are_the_climbs_with_these_accelerations(vehicle: Vehicle) -> None:
    """With a map of the thrust and for rotors that differ, too; and the targets of an autopilot are the same climbs."""
    row = climb_of_rotors(vehicle, BOUNDS)
    free = TargetBounds(thrust=(0.1 * vehicle.mass * vehicle.gravity, 9.0 * vehicle.mass * vehicle.gravity))
    targets = climbing_targets(free.actuators(vehicle), vehicle, BOUNDS)
    assert row.D is not None
    ends = ((row.lower, targets.u_min), (row.upper, targets.u_max))
    for speeds, (end, target), acceleration in zip(climb_speeds(vehicle, BOUNDS), ends, BOUNDS, strict=True):
        thrust = vehicle.thrusts(speeds).sum()
        assert thrust / vehicle.mass - vehicle.gravity == pytest.approx(acceleration)
        np.testing.assert_allclose(row.D @ speeds, end)
        assert target[0] == pytest.approx(thrust)
    assert row.lower < row.D @ vehicle.hover_speeds < row.upper


def test_the_lower_bound_holds_up_to_the_tilt() -> None:
    """U cos(tilt) / m - g at the raised bound is the stated one; below that of hover's thrust there is none."""
    lower, upper = within_tilt(HUMMINGBIRD, BOUNDS, 30.0)
    assert (HUMMINGBIRD.gravity + lower) * np.cos(np.radians(30.0)) - HUMMINGBIRD.gravity == pytest.approx(-2.0)
    assert upper == BOUNDS[1]


def test_a_course_that_asks_for_more_is_named() -> None:
    circle = {"type": "helix", "start": 1.0, "radius": 1.0, "period": 4.0, "climb": 1.0, "turns": 2.0}
    scenario = quadsim.load("hummingbird-figure-eight").replace({"reference": circle, "constraints": []})
    report = quadsim.feasibility(scenario.replace({"controller.climb_acceleration": [-1e-3, 1e-3]}))
    assert isinstance(report, Feasibility)
    assert any("of climb acceleration" in problem for problem in report.problems)


@pytest.mark.parametrize(
    ("law", "bounds", "message"),
    [
        ("constrained", [3.0, -2.0], "controller.climb_acceleration must have its lower bound below its upper"),
        ("constrained", [0.5, 2.0], r"controller.climb_acceleration must contain 0 m/s\^2, that of hover; got \[0.5"),
        ("constrained", [1.0], "controller.climb_acceleration"),
        ("nonlinear-thrust", [-1.0, 2.0], r"controller\.climb_acceleration must be of a lower bound below -1\.314 m/s"),
    ],
)
def test_wrong_bounds_are_refused(law: str, bounds: list[float], message: str) -> None:
    with pytest.raises(InputError, match=message):
        flown(law, {"controller.climb_acceleration": bounds})


def test_nonlinear_needs_a_tilt_with_it() -> None:
    table = {"type": "nonlinear", "climb_acceleration": [*BOUNDS]}
    with pytest.raises(InputError, match="tilt must be given with climb_acceleration, or the vehicle turns"):
        quadsim.load("hummingbird-figure-eight").replace({"controller": table})
