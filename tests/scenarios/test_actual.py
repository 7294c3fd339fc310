"""`[actual]`: the plant is the vehicle as it really is, and the controller does not know."""

from __future__ import annotations

import tomllib
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support import NO_PRODUCTS

import quadsim
from quadsim.controller import StepInputs
from quadsim.errors import ParameterError
from quadsim.mpc.problem.ocp import Problem
from quadsim.report.comparison_rows import comparison_rows
from quadsim.rollout.flown import Flight
from quadsim.rollout.reaudit import reaudit
from quadsim.rollout.rollout import Rollout
from quadsim.rollout.stored import read_flight
from quadsim.scenarios.assembly import Assembly
from quadsim.scenarios.loading import load_scenario, parse_scenario
from quadsim.scenarios.schema.scenario import Scenario
from quadsim.state import STATE_NAMES, Array
from quadsim.vehicle import VEHICLE_UNITS, Vehicle

BASE = [
    "initial.position=[0.0, 0.0, 0.2]",
    "effects.ground.effect=true",  # where the radius of the rotors acts
    "obstacles=[{type='sphere', name='ball', position=[1.4, 0.0, 0.2], radius=0.5}]",  # where the vehicle's size does
]
ACTUAL: dict[str, Any] = {
    "mass": 4.4,
    "gravity": 9.7,
    "inertia": [0.04, 0.04, 0.07],
    "products_of_inertia": [0.001, 0.0, 0.0],
    "arm_length": 0.35,
    "rotor_azimuths": [10.0, -80.0, 190.0, 100.0],
    "rotor_positions": [[0.3, 0.0, 0.1], [0.0, -0.3, 0.0], [-0.28, 0.0, 0.0], [0.0, 0.3, 0.0]],
    "rotor_spins": [-1, 1, -1, 1],
    "thrust_coefficient": 3e-4,
    "thrust_of_speed": [0.01, 2.2e-4],
    "thrust_of_throttle": [2.0, 14.0],
    "drag_to_thrust": 0.03,
    "speed_min": 150.0,
    "speed_max": 210.0,
    "rotor_rise": 0.03,
    "rotor_fall": 0.03,
    "rotor_inertia": 1e-4,
    "rotor_radius": 0.15,
    "rotor_drag": 1e-3,
    "inflow": 1e-3,
    "rotor_moment": [1e-4, 1e-4],
    "inflow_moment": [0.01, 0.01],
    "rate_damping": [0.01, 0.01, 0.01],
    "body_drag": [0.05, 0.05, 0.1],
    "extent": 0.8,
}
LAGGING = ["actual.rotor_rise=0.05", "actual.rotor_fall=0.05"]  # rotors with inertia need a lag


def flown(scenario: Scenario) -> Array:
    """Truth after 20 ms of commands from the lowest to the highest, near a floor and an obstacle, moving."""
    state = np.zeros(len(STATE_NAMES))
    state[[STATE_NAMES.index(name) for name in ("x", "z", "vx", "vz", "pitch")]] = 0.15, 0.2, 1.0, 0.1, 0.05
    with Assembly(scenario).plant() as plant:
        plant.reset(state)
        plant.advance(np.array([100.0, 180.0, 220.0, 240.0]), 20)
        return plant.state()


@dataclass(frozen=True)
class Acting:
    """What the plant and the controller of a scenario do."""

    flown: Array  # see `flown`
    vehicle: Vehicle  # as the controller knows it
    problem: Problem
    plan: Array  # of its first period


@cache
def acting(*changes: str) -> Acting:
    scenario = load_scenario("hover", [*BASE, *changes])
    speeds = np.full(4, 190.0)
    state = np.full(12, 0.02)
    target = np.full((scenario.controller.horizon, 4), 0.1)
    with Rollout(scenario) as rollout:
        law = rollout.loop.controller
        law.reset(speeds)
        plan = law.step(StepInputs(acting=speeds), state, target).plan
    return Acting(flown(scenario), rollout.vehicle, Assembly(scenario).problem(), plan)


@pytest.mark.parametrize("name", ACTUAL)
def test_each_parameter_moves_the_plant_and_not_the_controller(name: str) -> None:
    lag = LAGGING if name == "rotor_inertia" else []
    modelled = acting(*lag)
    real = acting(*lag, f"actual.{name}={ACTUAL[name]}")
    assert np.abs(real.flown - modelled.flown).max() > 1e-9
    assert real.vehicle == modelled.vehicle
    for of in (lambda p: p.model.A, lambda p: p.model.B, lambda p: p.model.u_bar, lambda p: p.bounds.u_max):
        np.testing.assert_array_equal(of(modelled.problem), of(real.problem))
    np.testing.assert_array_equal(modelled.plan, real.plan)


def test_a_throttle_is_refused_that_the_plant_does_not_have() -> None:
    """Of all parameters, it alone has no effect on the plant."""
    assert {*VEHICLE_UNITS} - {*ACTUAL} == {"throttle_offset"}
    rule = r"actual\.throttle_offset must be absent: the plant takes rotor speeds, only logs have a throttle; got 0\.1"
    with pytest.raises(ParameterError, match=rule):
        quadsim.fly(load_scenario("hover", ["actual.throttle_offset=0.1"]))


@pytest.fixture(scope="module")
def heavy(fly_once: Callable[..., Flight]) -> Flight:
    return fly_once("hover", "actual.mass=4.4")


def test_a_mass_that_the_paper_s_law_does_not_know_leaves_it_too_low(heavy: Flight) -> None:
    last = heavy.state["z"][-40:]
    assert np.ptp(last) < 1e-3
    assert heavy.reference["z"][-1] - last[-1] > 0.15


def test_the_same_mass_in_the_model_leaves_no_error(fly_once: Callable[..., Flight]) -> None:
    assert fly_once("hover", "vehicle.mass=4.4").metrics["rmse.z"] < 1e-6


def test_both_vehicles_are_recorded_and_shown(tmp_path: Path) -> None:
    scenario = load_scenario("hover", ["duration=0.5", "actual.mass=4.4", "actual.arm_length=0.35"])
    directory = tmp_path / "heavy"
    Rollout(scenario).fly().save(directory, **NO_PRODUCTS)
    run = read_flight(directory)
    flight = quadsim.read(directory)
    assert (run.summary["vehicle"]["mass"], run.summary["actual"]["mass"]) == (4.0, 4.4)
    assert (flight.vehicle.mass, flight.actual.mass, run.actual.arm_length) == (4.0, 4.4, 0.35)
    assert reaudit(directory).satisfied == flight.satisfied
    cells = {row.label: row.cells[0].text for row in comparison_rows([run])}
    assert cells["vehicle"] == "lopes2011, modelled with mass 4.0 for 4.4, arm_length 0.3 for 0.35"
    assert cells["mass"] == "4.4"
    again = quadsim.fly(flight.scenario, progress=False)
    np.testing.assert_array_equal(again.command, flight.command)


def test_what_the_effects_leave_to_the_vehicle_is_that_of_the_actual_one() -> None:
    scenario = load_scenario("hummingbird-real-rotors", ["actual.rotor_rise=0.05"])
    written = Assembly(scenario).resolved.scenario
    assert written.effects.rotors is not None
    assert written.effects.rotors.rise == 0.05
    assert written.vehicle.rotor_rise == 0.0125
    again = parse_scenario(tomllib.loads(written.to_toml()))
    assert Assembly(again).resolved.scenario.to_toml() == written.to_toml()
