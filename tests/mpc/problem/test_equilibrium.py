"""Rest against a disturbance: an equilibrium of the nonlinear model, at any heading."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from support import derivative

from quadsim.mpc.problem.equilibrium import LEAST_LIFT, equilibrium, twisted
from quadsim.mpc.problem.heading import turn_horizontally
from quadsim.mpc.problem.nonlinear_model import nonlinear_model
from quadsim.state import INDEX
from quadsim.vehicle import Vehicle


def test_the_undisturbed_equilibrium_is_hover(vehicle: Vehicle) -> None:
    rest = equilibrium(nonlinear_model(vehicle, 0.05))
    np.testing.assert_array_equal(rest.state(), 0.0)
    np.testing.assert_allclose(rest.speeds, vehicle.hover_speed, rtol=1e-12)


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
        rest = equilibrium(model)
        world = turn_horizontally(rest.state(yaw, model.n), np.array(yaw))
        world[INDEX["yaw"]] = yaw
        np.testing.assert_allclose(derivative(model, world, rest.speeds), 0.0, atol=1e-9)


def test_what_is_beyond_the_rotors_stays_finite_and_upright(vehicle: Vehicle) -> None:
    model = replace(
        nonlinear_model(vehicle, 0.05),
        acceleration=np.array([1.0, 1.0, 30.0]),
        angular_acceleration=np.array([0.0, 0.0, 500.0]),
    )
    rest = equilibrium(model)
    assert np.abs(rest.state()).max() < 0.5 * math.pi
    assert rest.speeds.min() == 0.0
    assert np.isfinite(rest.speeds).all()
    lift = math.dist((0.0, 0.0, 0.0), (1.0, 1.0, LEAST_LIFT * vehicle.gravity))
    still = replace(model, angular_acceleration=np.zeros(3))
    assert model.effectiveness[0] @ equilibrium(still).speeds ** 2 == pytest.approx(lift)


def test_a_twisted_model_turns_as_its_thrust_pushes(vehicle: Vehicle) -> None:
    twist, speeds = np.array([0.3, -0.2, 0.1]), np.array([180.0, 200.0, 190.0, 210.0])
    plain = nonlinear_model(vehicle, 0.05)
    turned = twisted(plain.effectiveness, twist) @ speeds**2 - plain.effectiveness @ speeds**2
    assert turned[0] == 0.0
    np.testing.assert_allclose(turned[1:], twist * (plain.effectiveness[0] @ speeds**2), rtol=1e-9)


def test_torque_caused_by_thrust_is_balanced_at_rest(vehicle: Vehicle) -> None:
    acceleration, twist = np.array([0.5, -1.0, 2.0]), np.array([0.3, -0.2, 0.1])
    plain = nonlinear_model(vehicle, 0.05)
    rest = equilibrium(plain, acceleration=acceleration, twist=twist)
    disturbed = replace(plain, effectiveness=twisted(plain.effectiveness, twist), acceleration=acceleration)
    np.testing.assert_allclose(derivative(disturbed, rest.state(), rest.speeds), 0.0, atol=1e-9)
    np.testing.assert_array_equal(rest.twist, twist)
