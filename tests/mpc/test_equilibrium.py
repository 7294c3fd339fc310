"""Rest against a disturbance: an equilibrium of the nonlinear model, at any heading."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from mpc.equilibrium import LEAST_LIFT, equilibrium
from mpc.heading import turn_horizontally
from mpc.nonlinear import derivative, nonlinear_model
from quadsim.state import INDEX
from quadsim.vehicle import Vehicle


def test_undisturbed_it_is_hover(vehicle: Vehicle) -> None:
    x, u = equilibrium(nonlinear_model(vehicle, 0.05))
    np.testing.assert_array_equal(x, 0.0)
    np.testing.assert_allclose(u, vehicle.hover_speed, rtol=1e-12)


@pytest.mark.parametrize("yaw", [0.0, 2.0, -3.0])
@pytest.mark.parametrize("rotor_lag", [None, 0.03])
def test_the_nonlinear_model_rests_there(vehicle: Vehicle, yaw: float, rotor_lag: float | None) -> None:
    rng = np.random.default_rng(4)
    for _ in range(20):
        model = replace(
            nonlinear_model(vehicle, 0.05, rotor_lag=rotor_lag),
            acceleration=rng.uniform(-4.0, 4.0, 3),
            angular_acceleration=rng.uniform(-1.0, 1.0, 3),
        )
        x, u = equilibrium(model, yaw)
        world = turn_horizontally(x, np.array(yaw))
        world[INDEX["yaw"]] = yaw
        np.testing.assert_allclose(derivative(model, world, u), 0.0, atol=1e-11)


def test_what_is_beyond_the_rotors_stays_finite_and_upright(vehicle: Vehicle) -> None:
    model = replace(
        nonlinear_model(vehicle, 0.05),
        acceleration=np.array([1.0, 1.0, 30.0]),
        angular_acceleration=np.array([0.0, 0.0, 500.0]),
    )
    x, u = equilibrium(model)
    assert np.abs(x).max() < 0.5 * math.pi
    assert u.min() == 0.0
    assert np.isfinite(u).all()
    lift = math.dist((0.0, 0.0, 0.0), (1.0, 1.0, LEAST_LIFT * vehicle.gravity))
    assert np.sum(model.effectiveness[0] * equilibrium(replace(model, angular_acceleration=np.zeros(3)))[1] ** 2) == (
        pytest.approx(lift)
    )
