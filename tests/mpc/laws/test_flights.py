"""Whole flights of the three linear MPCs, on their model's vehicle and on vehicles that differ from the model."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from quadsim.flight.log import FlightLog
from quadsim.sim.effects import Effects
from quadsim.sim.effects.load import Load
from quadsim.sim.effects.rotors import RotorDynamics
from quadsim.state import INDEX, make_state
from quadsim.vehicle import Vehicle

Build = Callable[..., Any]
Fly = Callable[..., FlightLog]


@pytest.mark.slow("baselines")
def test_every_vehicle_arrives_along_the_papers_course(law: str, craft: Vehicle, build: Build, fly_from: Fly) -> None:
    """Nine seconds: 10 m up, the first second of them at all the thrust there is, turning 30 deg at once."""
    state = make_state(euler=(0.0, 0.0, math.radians(30.0)))
    flight = fly_from(build(law, craft), craft, state, periods=185)
    log = flight.control
    assert flight.reason is None
    error = log.truth[-1, [0, 2, 4, 10]] - log.reference[-1]
    assert np.abs(error[:3]).max() < 0.25
    assert abs(error[3]) < 0.05
    assert np.isfinite(log.speeds).all()
    assert log.speeds.min() >= craft.speed_min
    assert log.speeds.max() <= craft.speed_max


def test_a_flight_repeats_itself_with_the_same_controller(
    law: str, vehicle: Vehicle, build: Build, fly_from: Fly
) -> None:
    """What the first flight left behind is forgotten, in the middle of its climb as it ended."""
    controller = build(law, vehicle)
    flights = [fly_from(controller, vehicle, make_state(euler=(0.0, 0.0, 0.5)), periods=30) for _ in range(2)]
    np.testing.assert_array_equal(flights[0].control.speeds, flights[1].control.speeds)


@pytest.mark.representative("baselines")
def test_half_a_turn_is_turned_while_flying_sideways(law: str, vehicle: Vehicle, build: Build, fly_from: Fly) -> None:
    state = make_state(euler=(0.0, 0.0, math.pi))
    log = fly_from(build(law, vehicle), vehicle, state, periods=160, course=np.array([1.0, 1.0, 0.0, 0.0])).control
    assert abs(math.remainder(log.truth[-1, INDEX["yaw"]], 2.0 * math.pi)) < 0.05
    assert np.abs(log.truth[-1, [0, 2]] - 1.0).max() < 0.1


def test_slow_rotors_and_a_heavier_vehicle_are_survived(
    law: str, vehicle: Vehicle, build: Build, fly_from: Fly
) -> None:
    effects = Effects(rotors=RotorDynamics(rise=0.02, fall=0.02), load=Load(mass_factor=1.2))
    log = fly_from(build(law, vehicle), vehicle, make_state(), periods=160, effects=effects)
    assert log.reason is None
    assert np.abs(log.control.truth[-1, [6, 8]]).max() < 0.02
    assert abs(log.control.truth[-1, 4] - log.control.reference[-1, 2]) < 1.5


@pytest.mark.slow("baselines")
@pytest.mark.parametrize(("law", "others"), [("pid", {}), ("geometric", {"integral": True})])
def test_integrals_lift_a_heavier_vehicle_to_its_height(
    law: str, others: dict[str, Any], vehicle: Vehicle, build: Build, fly_from: Fly
) -> None:
    effects = Effects(load=Load(mass_factor=1.2))
    log = fly_from(
        build(law, vehicle, **others), vehicle, make_state(), periods=350, course=np.zeros(4), effects=effects
    ).control
    assert np.abs(log.truth[:, 4]).max() > 0.2
    assert abs(log.truth[-1, 4]) < 0.02
