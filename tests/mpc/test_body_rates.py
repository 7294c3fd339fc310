"""The body rate loop: the torque it demands, and the first-order lag that comes of it."""

from __future__ import annotations

import numpy as np
import pytest

from mpc.answer import ActuatorBounds
from mpc.body_rates import BodyRateLoop
from quadsim.state import Array
from quadsim.vehicle import Vehicle
from scenarios.assembly import Assembly
from scenarios.loading import load_scenario

BANDWIDTH = 20.0


@pytest.fixture(scope="module")
def vehicle() -> Vehicle:
    return Assembly(load_scenario("gust")).vehicle


def make_loop(vehicle: Vehicle) -> BodyRateLoop:
    return BodyRateLoop(vehicle, rate=500.0, bandwidth=BANDWIDTH, bounds=ActuatorBounds.of_vehicle(vehicle))


def test_it_demands_thrust_and_the_torque_of_a_first_order_lag(vehicle: Vehicle) -> None:
    loop, rates, J = make_loop(vehicle), np.array([0.4, -0.3, 0.2]), np.array(vehicle.inertia)
    loop.thrust, loop.rates = 8.0, np.array([0.5, -0.2, 0.1])
    wrench = vehicle.allocation @ loop.commanded(rates) ** 2
    assert wrench[0] == pytest.approx(8.0)
    acceleration = (wrench[1:] - np.cross(rates, J * rates)) / J  # Euler's equation
    assert acceleration == pytest.approx(BANDWIDTH * (loop.rates - rates))


def test_beyond_the_rotors_limits_yaw_is_reduced_first(vehicle: Vehicle) -> None:
    loop = make_loop(vehicle)
    loop.rates = np.array([1.0, 0.0, 20.0])
    wrench: Array = vehicle.allocation @ loop.commanded(np.zeros(3)) ** 2
    assert wrench[0] == pytest.approx(loop.thrust)
    assert wrench[1] == pytest.approx(vehicle.inertia[0] * BANDWIDTH)
    assert wrench[3] < vehicle.inertia[2] * BANDWIDTH * 20.0
