"""Rest against a disturbance, as C finds it: an equilibrium of the nonlinear model, at any heading."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy_preparation import NonlinearModel, equilibrium, nonlinear_model, twisted
from support import derivative, robust_table

from quadsim.mpc.estimate.observer import ObserverSettings
from quadsim.mpc.laws.parts.preparation import RobustPreparation
from quadsim.mpc.problem.equilibrium import LEAST_LIFT, Trim
from quadsim.mpc.problem.heading import turn_horizontally
from quadsim.state import INDEX, Array
from quadsim.vehicle import Vehicle


def rest_under(vehicle: Vehicle, estimate: Array) -> tuple[Trim, Array]:
    """Where the vehicle rests under an estimate (6,), of any size, and the disturbance (6,) there."""
    settings = robust_table(offset_free=ObserverSettings(largest_force=100.0, largest_torque=1000.0))
    preparation = RobustPreparation(vehicle, settings.problem(vehicle, 0.05), settings)
    preparation.adopt(None, estimate)
    return preparation.trim, preparation.disturbance


def disturbed(vehicle: Vehicle, estimate: Array, rotor_lag: float | None = None) -> NonlinearModel:
    """The model under an estimate at rest: a force along the thrust there, and a torque that thrust causes."""
    model = nonlinear_model(vehicle, 0.05, rotor_lag=rotor_lag)
    axis = np.array([-estimate[0], -estimate[1], vehicle.gravity])
    push = estimate[2] * axis / np.linalg.norm(axis) + [*estimate[:2], 0.0]
    effectiveness = twisted(model.effectiveness, estimate[3:] / vehicle.gravity)
    return replace(model, acceleration=push, effectiveness=effectiveness)


def test_the_undisturbed_equilibrium_is_hover(vehicle: Vehicle) -> None:
    rest, disturbance = rest_under(vehicle, np.zeros(6))
    np.testing.assert_array_equal(rest.state(), 0.0)
    np.testing.assert_allclose(rest.speeds, vehicle.hover_speed, rtol=1e-12)
    np.testing.assert_array_equal(disturbance, 0.0)


@pytest.mark.parametrize("yaw", [0.0, 2.0, -3.0])
@pytest.mark.parametrize("rotor_lag", [None, 0.03])
def test_the_nonlinear_model_rests_there(vehicle: Vehicle, yaw: float, rotor_lag: float | None) -> None:
    rng = np.random.default_rng(4)
    for _ in range(20):
        estimate = np.concatenate([rng.uniform(-4.0, 4.0, 3), rng.uniform(-1.0, 1.0, 3)])
        rest, _ = rest_under(vehicle, estimate)
        model = disturbed(vehicle, estimate, rotor_lag)
        world = turn_horizontally(rest.state(yaw, model.n), np.array(yaw))
        world[INDEX["yaw"]] = yaw
        np.testing.assert_allclose(derivative(model, world, rest.speeds), 0.0, atol=1e-9)


def test_it_is_that_of_numpy(vehicle: Vehicle) -> None:
    """And the disturbance is what acts there: a force, and the torque that the thrust causes."""
    estimate = np.array([0.5, -1.0, 2.0, 0.3, -0.2, 0.1])
    rest, disturbance = rest_under(vehicle, estimate)
    model = disturbed(vehicle, estimate)
    plain = replace(nonlinear_model(vehicle, 0.05), acceleration=model.acceleration)
    expected = equilibrium(plain, estimate[3:] / vehicle.gravity)
    for name in ("speeds", "lift", "twist"):
        np.testing.assert_allclose(getattr(rest, name), getattr(expected, name), rtol=1e-12)
    np.testing.assert_allclose(disturbance[:3], model.acceleration, atol=1e-12)
    thrust = plain.effectiveness[0] @ rest.speeds**2
    np.testing.assert_allclose(disturbance[3:], thrust * rest.twist, rtol=1e-12)


def test_what_is_beyond_the_rotors_stays_finite_and_upright(vehicle: Vehicle) -> None:
    rest, _ = rest_under(vehicle, np.array([1.0, 1.0, 30.0, 0.0, 0.0, 500.0]))
    assert np.abs(rest.state()).max() < 0.5 * math.pi
    assert rest.speeds.min() == 0.0
    assert np.isfinite(rest.speeds).all()
    still, _ = rest_under(vehicle, np.array([1.0, 1.0, 30.0, 0.0, 0.0, 0.0]))
    assert still.lift[2] == pytest.approx(LEAST_LIFT * vehicle.gravity)
    model = nonlinear_model(vehicle, 0.05)
    assert model.effectiveness[0] @ still.speeds**2 == pytest.approx(float(np.linalg.norm(still.lift)))
