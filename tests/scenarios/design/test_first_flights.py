"""First scenarios, made from a vehicle's numbers and flown once; all of them: tests/first_flights.py."""

from __future__ import annotations

import tomllib
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import tomlkit
from first_flights import FirstFlight, fly_first, vehicles

import quadsim
from mpc.baselines.lqr import bryson_objective
from mpc.robust.settings import Robust
from quadsim.assets import vehicle_path
from quadsim.vehicle import Vehicle, load_vehicle
from scenarios.design.first_scenario import BASELINE_SHARE, CLEARANCE, COURSES, LAWS, ROOM, first_scenario
from scenarios.loading import parse_scenario

ALL = {vehicle.name: vehicle for vehicle in vehicles()}
HARDEST = ("random-08", "random-17")
"""The slowest rotors, and the one that strays most."""


@cache
def flown(name: str, course: str, law: str) -> FirstFlight:
    return fly_first(ALL[name], course, law)


@pytest.mark.parametrize("name", ["crazyflie2", *HARDEST])
def test_the_robust_controller_flies_it_first_time(name: str) -> None:
    for course in COURSES:
        assert flown(name, course, "robust").meets_the_bar, course


def test_rotors_with_inertia_and_no_lag_make_a_scenario_that_flies(tmp_path: Path) -> None:
    """Rotors that change their speed at once can have no inertia: the scenario leaves it out, and says so."""
    tables = tomllib.loads(vehicle_path("hummingbird").read_text())
    file = tmp_path / "mine.toml"
    file.write_text(tomlkit.dumps({k: v for k, v in tables.items() if k not in ("rotor_rise", "rotor_fall")}))
    vehicle = load_vehicle(file)
    assert vehicle.rotor_inertia
    assert vehicle.rotor_rise is None
    made = parse_scenario(first_scenario(vehicle, str(file)).to_data())
    assert quadsim.fly(made.replace({"duration": 0.5}), progress=False).log.reason is None


@pytest.mark.parametrize("law", LAWS[1:])
def test_pid_and_geometric_control_meet_all_requirements_and_the_lqr_tracks_no_moving_course(law: str) -> None:
    for course in ("hover", "figure-eight"):
        flight = flown("crazyflie2", course, law)
        assert ("tracking" in flight.failed) == (law == "lqr" and course != "hover"), flight
        assert flight.outcome == ("violated" if flight.failed else "satisfied")


@pytest.mark.parametrize(
    ("changes", "violated"),
    [
        ({}, set()),
        ({"initial.position": [0.0, 0.0, 0.2]}, {"floor"}),  # the course keeps its initial height
        ({"controller.input_weights.speed": 0.01}, {"hold_y"}),
    ],
)
def test_a_course_below_the_floor_or_a_detuned_controller_is_violated(
    changes: dict[str, object], violated: set[str]
) -> None:
    scenario = quadsim.scenario(vehicle="hummingbird", course="figure-eight").scenario.replace(changes)
    flight = quadsim.fly(scenario)
    assert flight.outcome == ("violated" if violated else "satisfied")
    assert {finding.limit.name for finding in flight.audit if not finding.satisfied} == violated


@pytest.mark.parametrize("course", COURSES)
def test_a_course_that_is_tracked_stays_above_the_floor(course: str) -> None:
    for vehicle in ALL.values():
        data = first_scenario(vehicle, vehicle.name, course=course).to_data()
        bounds = {constraint["name"]: constraint["lower"] for constraint in data["constraints"]}
        assert bounds["floor"] >= vehicle.enclosing_radius
        assert data["initial"]["position"][2] >= bounds["floor"] - CLEARANCE * bounds["hold_z"] - 1e-3


def test_the_figure_eight_comes_near_to_what_it_is_made_for() -> None:
    """60 % of g tan(40 deg) is a tilt of 26.7 deg: a course that requires less would prove nothing."""
    flight = flown("hummingbird", "figure-eight", "robust")
    assert 25.0 < flight.tilt < 32.0


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("course", COURSES)
def test_the_file_states_what_is_flown(course: str, law: str) -> None:
    made = first_scenario(ALL["hummingbird"], "hummingbird", course=course, law=law)
    text = made.to_toml()
    assert tomllib.loads(text) == made.to_data()
    assert max(map(len, text.splitlines())) <= 160
    scenario = parse_scenario(made.to_data())
    assert scenario.controller.type == ("nonlinear" if law == "rates" else law)
    bounds = {limit.signal: (limit.lower, limit.upper) for limit in scenario.constraints}
    if isinstance(scenario.controller, Robust):
        assert bounds["roll"] == tuple(scenario.controller.output_bounds["roll"])
        assert bounds["slew"] == tuple(scenario.controller.input_bounds.slew)
    elif law == "rates":
        assert made.to_data()["controller"]["tilt"] == bounds["roll"][1]
        assert "slew" not in bounds
    else:
        assert made.to_data()["controller"]["tilt"] <= BASELINE_SHARE * (bounds["roll"][1] or 0.0)
    for axis in "xyz":
        assert bounds[f"{axis}_error"] == pytest.approx((-ROOM * made.size, ROOM * made.size), rel=0.01)
    assert bounds["z"][0] == pytest.approx(ALL["hummingbird"].enclosing_radius, abs=1e-3)


def test_the_default_lqr_is_slower_where_rotors_are_slow_and_as_it_was_elsewhere() -> None:
    def weight(vehicle: Vehicle, period: float | None) -> float:
        return float(bryson_objective(vehicle, period).Q_u[0, 0])

    for name in ("hummingbird", "lopes2011", "random-17"):
        assert weight(ALL[name], 0.05) == weight(ALL[name], None)
    slow = ALL["random-08"]
    assert weight(slow, 0.05) >= 4.0 * weight(slow, None)
    assert np.log2(weight(slow, 0.05) / weight(slow, None)) % 2.0 == pytest.approx(0.0, abs=1e-9)
