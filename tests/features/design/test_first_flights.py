"""First scenarios, made from a vehicle's numbers and flown once; all of them: tests/first_flights.py."""

from __future__ import annotations

import math
import tomllib
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomlkit
from first_flights import FirstFlight, fly_first, vehicles

import quadsim
from quadsim.assets import vehicle_path
from quadsim.errors import ParameterError
from quadsim.features.design.controller_text import BASELINE_SHARE
from quadsim.features.design.courses_by_rule import ALLOWED_SHARE, COURSES, HEIGHT_OVER_ERROR
from quadsim.features.design.first_scenario import DESIGNED_LAWS, first_scenario
from quadsim.mpc.laws.lqr import bryson_objective
from quadsim.mpc.laws.robust import Robust
from quadsim.scenarios.assembly import Assembly
from quadsim.scenarios.loading import parse_scenario
from quadsim.vehicle import VEHICLE_UNITS, Vehicle, load_vehicle

pytestmark = pytest.mark.slow("first flights")

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


TURNED = replace(
    ALL["crazyflie2"],
    **{"rotor_rise": 0.038, "rotor_fall": 0.038, "inflow": 2.4e-6},
    **{"rotor_moment": (8.2e-8, 10.5e-8), "inflow_moment": (2e-4, 3e-4), "rate_damping": (2e-5,) * 3},
)
"""As real small ones with brushless rotors are turned: by 43 rad/s^2 per m/s."""


def flown_turned(law: str, course: str, changes: dict[str, Any]) -> tuple[str, float]:
    """The outcome of its first scenario with some changes, and the RMS error over the course's size."""
    numbers = {name: value for name in VEHICLE_UNITS if (value := getattr(TURNED, name)) is not None}
    first = first_scenario(TURNED, TURNED.name, course=course, law=law)
    scenario = parse_scenario(first.to_data() | {"vehicle": {"file": TURNED.name, **numbers}})
    flight = quadsim.fly(scenario.replace(changes), progress=False)
    return flight.outcome, math.hypot(*(flight.metrics[f"rmse.{axis}"] for axis in "xyz")) / first.size


@pytest.mark.parametrize("course", ["step", "figure-eight"])
@pytest.mark.parametrize(
    ("law", "ignorant"),
    [
        ("robust", {"controller.moment": False}),
        ("pid", {"controller.moment": False}),
        ("geometric", {}),
        ("nonlinear", {}),
        ("rates", {}),
    ],
)
def test_a_vehicle_that_the_air_turns_flies_first_time(law: str, ignorant: dict[str, Any], course: str) -> None:
    """A law that knows the moment holds its course; one that does not know it is worse by a factor."""
    assert TURNED.turned_by_air == pytest.approx(43.0, abs=0.5)
    outcome, error = flown_turned(law, course, {})
    assert outcome == "satisfied"
    if ignorant:
        outcome, worse = flown_turned(law, course, ignorant)
        assert outcome != "satisfied"
        assert worse > 1.4 * error


def test_an_lqr_that_knows_the_moment_lags_behind_a_moving_course_all_the_same() -> None:
    """It tracks no acceleration, on no vehicle."""
    outcome, error = flown_turned("lqr", "step", {})
    assert outcome == "violated"
    assert error < flown_turned("lqr", "step", {"controller.moment": False})[1]


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


@pytest.mark.parametrize("law", DESIGNED_LAWS[1:])
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
        assert data["initial"]["position"][2] >= bounds["floor"] - HEIGHT_OVER_ERROR * bounds["hold_z"] - 1e-3


def test_the_figure_eight_comes_near_to_what_it_is_made_for() -> None:
    """60 % of g tan(40 deg) is a tilt of 26.7 deg: a course that requires less would prove nothing."""
    flight = flown("hummingbird", "figure-eight", "robust")
    assert 25.0 < flight.tilt < 32.0


@pytest.mark.representative("first flights")
@pytest.mark.parametrize("law", DESIGNED_LAWS)
@pytest.mark.parametrize("course", COURSES)
def test_the_file_states_what_is_flown(course: str, law: str) -> None:
    made = first_scenario(ALL["hummingbird"], "hummingbird", course=course, law=law)
    text = made.to_toml()
    assert tomllib.loads(text) == made.to_data()
    assert max(map(len, text.splitlines())) <= 160
    scenario = parse_scenario(made.to_data())
    predictive = law in ("nonlinear", "rates")
    assert scenario.controller.type == ("nonlinear" if predictive else law)
    stated = {limit.signal: (limit.lower, limit.upper) for limit in scenario.constraints}
    limits = Assembly(scenario, ALL["hummingbird"]).limits
    bounds = {limit.signal: (limit.lower, limit.upper) for limit in limits}
    if isinstance(scenario.controller, Robust):
        assert bounds["roll"] == tuple(scenario.controller.output_bounds["roll"])
        assert bounds["slew"] == tuple(scenario.controller.input_bounds.slew)
    elif predictive:
        assert made.to_data()["controller"]["tilt"] == bounds["tilt"][1]
        assert "slew" not in bounds
    else:
        assert made.to_data()["controller"]["tilt"] <= BASELINE_SHARE * (bounds["roll"][1] or 0.0)
    assert bounds["speed"] == (ALL["hummingbird"].speed_min, ALL["hummingbird"].speed_max)
    assert not stated.keys() & Assembly(scenario, ALL["hummingbird"]).bounds.keys()  # nothing is said twice
    for axis in "xyz":
        assert bounds[f"{axis}_error"] == pytest.approx(
            (-ALLOWED_SHARE * made.size, ALLOWED_SHARE * made.size), rel=0.01
        )
    assert bounds["z"][0] == pytest.approx(ALL["hummingbird"].enclosing_radius, abs=1e-3)


@pytest.mark.parametrize("law", DESIGNED_LAWS)
def test_a_tilt_bound_of_ones_own_is_in_the_design_and_in_the_audit(law: str) -> None:
    made = first_scenario(ALL["hummingbird"], "hummingbird", law=law, tilt=22.5)
    assert made.notes[1].endswith(" --tilt 22.5")
    limits = {limit.signal: limit.upper for limit in Assembly(parse_scenario(made.to_data())).limits}
    assert {limits[name] for name in ("roll", "pitch", "tilt") if name in limits} == {22.5}
    commanded = made.to_data()["controller"].get("tilt", 22.5)
    assert commanded == (22.5 if law in ("robust", "nonlinear", "rates") else BASELINE_SHARE * 22.5)
    deviation = ALL["hummingbird"].gravity * math.tan(math.radians(22.5)) / 6.0**2  # m, at w = 6 rad/s
    if law == "robust":
        assert made.to_data()["controller"]["output_weights"]["x"] == pytest.approx(deviation**-2.0, rel=5e-3)


def test_a_tilt_bound_is_one_at_which_the_rotors_carry_the_weight() -> None:
    weak = replace(ALL["hummingbird"], speed_max=1.1 * ALL["hummingbird"].hover_speed)
    held = math.degrees(math.acos(1.0 / 1.1**2))
    assert first_scenario(weak, "hummingbird", tilt=round(held, 1) - 0.1).size == 1.0
    for tilt in (round(held, 1) + 0.1, 0.5):
        with pytest.raises(ParameterError, match=f"--tilt .*1 and {held:.3g}"):
            first_scenario(weak, "hummingbird", tilt=tilt)
    strong = replace(ALL["hummingbird"], speed_max=3.0 * ALL["hummingbird"].hover_speed)
    with pytest.raises(ParameterError, match="--tilt"):
        first_scenario(strong, "hummingbird", tilt=81.0)
    with pytest.raises(ParameterError, match="--tilt"):
        quadsim.scenario("hover", tilt=25.0)


def test_the_comment_on_the_period_names_the_one_that_was_chosen() -> None:
    made = first_scenario(ALL["hummingbird"], "hummingbird", tilt=20.0)
    period = made.to_data()["control_period"]
    assert f"limited by what a period of {1e3 * period:g} ms can serve;" in made.notes


def in_other_units(vehicle: Vehicle, scale: float) -> Vehicle:
    """The same vehicle with its rotors' speeds in another unit than rad/s: the same thrusts, torques and drag."""
    assert vehicle.rotor_inertia is not None
    assert vehicle.rotor_drag is not None
    return replace(
        vehicle,
        speed_min=scale * vehicle.speed_min,
        speed_max=scale * vehicle.speed_max,
        thrust_coefficient=vehicle.thrust_coefficient / scale**2,
        rotor_inertia=vehicle.rotor_inertia / scale,
        rotor_drag=vehicle.rotor_drag / scale,
    )


RPM = 60.0 / math.tau


@pytest.mark.parametrize(
    ("law", "scale"), [("robust", RPM), *((law, scale) for law in ("lqr", "pid", "geometric") for scale in (RPM, 1e3))]
)
def test_no_speed_but_the_vehicles_own_limits_a_flight(law: str, scale: float) -> None:
    flights = []
    for vehicle in (ALL["hummingbird"], in_other_units(ALL["hummingbird"], scale)):
        made = first_scenario(vehicle, vehicle.name, course="step", law=law).to_data()
        numbers = {name: getattr(vehicle, name) for name in VEHICLE_UNITS if getattr(vehicle, name) is not None}
        table = {name: [*value] if isinstance(value, tuple) else value for name, value in numbers.items()}
        made |= {"duration": 1.5, "vehicle": {"file": vehicle.name, **table}}
        made["reference"] |= {axis: [{"start": 0.2, "stop": 9.0, "value": 2.0}] for axis in "xyz"}
        flights.append(quadsim.fly(parse_scenario(made), progress=False))
    one, other = flights
    assert one.command.max() > 1.1 * one.vehicle.hover_speed
    np.testing.assert_allclose(other.command, scale * one.command, rtol=5e-3)  # numbers of a file have three digits
    np.testing.assert_allclose(other.log.control.truth, one.log.control.truth, atol=1e-2)


@pytest.mark.parametrize("ratio", [1.02, 1.15])
@pytest.mark.parametrize("law", ["robust", "lqr", "pid", "geometric"])
def test_a_vehicle_of_little_thrust_to_weight_keeps_its_height(law: str, ratio: float) -> None:
    """A step aside, for which the thrust must carry the weight at a tilt."""
    vehicle = replace(ALL["lopes2011"], speed_max=math.sqrt(ratio) * ALL["lopes2011"].hover_speed)
    made = first_scenario(vehicle, "lopes2011", law=law).to_data()
    made["vehicle"]["speed_max"] = vehicle.speed_max
    made["reference"] = {"x": [{"start": 0.5, "stop": 9.0, "value": 0.5}], "response_time": 2.0}
    flight = quadsim.fly(parse_scenario(made), progress=False)
    assert np.abs(flight.state["z"] - flight.reference["z"]).max() < 0.1
    assert np.abs(flight.state["x"][-1] - flight.reference["x"][-1]) < 0.1


def test_the_default_lqr_is_slower_where_rotors_are_slow_and_as_it_was_elsewhere() -> None:
    def weight(vehicle: Vehicle, period: float | None) -> float:
        return float(bryson_objective(vehicle, period).Q_u[0, 0])

    for name in ("hummingbird", "lopes2011", "random-17"):
        assert weight(ALL[name], 0.05) == weight(ALL[name], None)
    slow = ALL["random-08"]
    assert weight(slow, 0.05) >= 4.0 * weight(slow, None)
    assert np.log2(weight(slow, 0.05) / weight(slow, None)) % 2.0 == pytest.approx(0.0, abs=1e-9)
