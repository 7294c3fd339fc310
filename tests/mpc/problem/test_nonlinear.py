"""The nonlinear model that C predicts with, in NumPy: against MuJoCo, closed forms, and C itself."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from numpy_preparation import NonlinearModel, next_state, nonlinear_model, spun, twisted
from support import derivative, linearised, robust_table

from quadsim.controller import StepInputs
from quadsim.mpc.estimate.observer import ObserverSettings
from quadsim.mpc.laws.parts.preparation import RobustPreparation
from quadsim.mpc.problem.model import hover_model
from quadsim.rotation import body_to_euler_rates, body_to_world, euler_to_body_rates
from quadsim.sim.effects import Disturbance, Effects
from quadsim.sim.effects.rotors import RotorDynamics
from quadsim.sim.plant import Plant
from quadsim.state import EULER, EULER_RATE, POSITION, VELOCITY, Array, make_state
from quadsim.vehicle import Vehicle

PERIOD = 0.05
LAG = 0.05
LAGS = [None, LAG]


def points(vehicle: Vehicle, count: int, *, lag: float | None, seed: int = 0) -> tuple[Array, Array]:
    """States up to 60 deg of tilt in any direction, at any yaw, turning at up to 3 rad/s; and commands."""
    rng = np.random.default_rng(seed)
    x = 3.0 * rng.normal(size=(count, 12))
    tilt = np.radians(60.0) * np.sqrt(rng.uniform(size=count))
    direction = rng.uniform(-np.pi, np.pi, count)
    x[:, 6] = tilt * np.cos(direction)
    x[:, 8] = tilt * np.sin(direction)
    x[:, 10] = rng.uniform(-np.pi, np.pi, count)
    x[:, EULER_RATE] = rng.uniform(-3.0, 3.0, (count, 3))
    around_hover = vehicle.hover_speed + rng.uniform(-30.0, 30.0, (2, count, 4))
    return x if lag is None else np.hstack([x, around_hover[0]]), around_hover[1]


def disturbed(vehicle: Vehicle, lag: float | None, substeps: int = 2) -> NonlinearModel:
    model = nonlinear_model(vehicle, PERIOD, substeps=substeps, rotor_lag=lag)
    push = np.array([0.7, -0.4, 1.1])
    turn = np.array([-0.5, 0.8, 0.3])
    return replace(model, acceleration=push, angular_acceleration=turn)


def flown(vehicle: Vehicle, x: Array, u: Array, *, effects: Effects, timestep: float = 1e-3) -> Array:
    """The plant's states, and rotor speeds, one period later."""
    after = np.empty((len(x), 16))
    with Plant(vehicle, timestep=timestep, effects=effects) as plant:
        for i in range(len(x)):
            plant.reset(x[i, :12], x[i, 12:] if x.shape[1] > 12 else None)
            plant.advance(u[i], round(PERIOD / timestep))
            after[i, :12] = plant.state()
            after[i, 12:] = plant.speeds
    return after


def advance(model: NonlinearModel, x: Array, u: Array) -> Array:
    return np.array([next_state(model, *one) for one in zip(x, u, strict=True)])


def test_derivative_is_that_of_a_rigid_body_at_any_attitude(vehicle: Vehicle) -> None:
    """Euler's equations in body rates, whose conversion to Euler-angle rates is differentiated along the motion."""
    model = disturbed(vehicle, None)
    x, u = points(vehicle, 50, lag=None)
    slope = derivative(model, x, u)
    wrench = np.square(u) @ vehicle.allocation.T
    inertia = np.array(vehicle.inertia)
    euler = x[:, EULER]
    rates = x[:, EULER_RATE]
    omega = euler_to_body_rates(euler, rates)
    turning = (wrench[:, 1:] - np.cross(omega, inertia * omega)) / inertia + model.angular_acceleration
    h = 1e-5
    after, before = (body_to_euler_rates(euler + s * rates, omega + s * turning) for s in (h, -h))
    np.testing.assert_allclose(slope[:, EULER_RATE], (after - before) / (2 * h), rtol=1e-6, atol=1e-5)
    thrust = body_to_world(euler)[:, :, 2] * wrench[:, :1] / vehicle.mass
    np.testing.assert_allclose(slope[:, VELOCITY], thrust + model.acceleration - [0, 0, vehicle.gravity], atol=1e-7)
    np.testing.assert_allclose(slope[:, POSITION], x[:, VELOCITY], atol=1e-7)
    np.testing.assert_allclose(slope[:, EULER], rates, atol=1e-7)


def test_integration_converges_to_the_plant_at_fourth_order(vehicle: Vehicle) -> None:
    x, u = points(vehicle, 12, lag=None)
    truth = flown(vehicle, x, u, effects=Effects())[:, :12]
    errors = [
        np.abs(advance(nonlinear_model(vehicle, PERIOD, substeps=count), x, u) - truth).max() for count in (4, 8, 16)
    ]
    assert errors[0] < 1e-3
    for coarse, fine in itertools.pairwise(errors):
        assert math.log2(coarse / fine) == pytest.approx(4.0, abs=0.4)


def test_lag_is_that_of_the_plants_rotors(vehicle: Vehicle) -> None:
    """The plant holds its thrusts over each step: second order in its step, and that is all that is left."""
    x, u = points(vehicle, 6, lag=LAG)
    model = nonlinear_model(vehicle, PERIOD, substeps=16, rotor_lag=LAG)
    effects = Effects(rotors=RotorDynamics(rise=LAG, fall=LAG))
    coarse, fine = (advance(model, x, u) - flown(vehicle, x, u, effects=effects, timestep=dt) for dt in (1e-3, 5e-4))
    np.testing.assert_allclose(coarse[:, 12:], 0.0, atol=1e-10)
    assert np.abs(coarse).max() < 2e-4
    assert np.abs(coarse).max() / np.abs(fine).max() == pytest.approx(4.0, rel=0.1)


def test_disturbance_is_the_plants(vehicle: Vehicle) -> None:
    force = (2.0, -1.0, 1.5)
    torque = (0.02, -0.03, 0.01)
    x, u = points(vehicle, 6, lag=None)
    model = replace(
        nonlinear_model(vehicle, PERIOD, substeps=16),
        acceleration=np.array(force) / vehicle.mass,
        angular_acceleration=np.array(torque) / vehicle.inertia,
    )
    truth = flown(vehicle, x, u, effects=Effects(disturbance=Disturbance(force=force, torque=torque)))
    np.testing.assert_allclose(advance(model, x, u), truth[:, :12], atol=1e-5)
    assert np.abs(advance(nonlinear_model(vehicle, PERIOD), x, u) - truth[:, :12]).max() > 1e-2


def test_at_hover_the_linear_model_is_left(vehicle: Vehicle) -> None:
    """There the Jacobian is nilpotent: Runge-Kutta's first four terms are the whole exponential."""
    hover = make_state(position=(3.0, -2.0, 10.0))
    speeds = np.full(4, vehicle.hover_speed)
    A, B, c = linearised(nonlinear_model(vehicle, PERIOD, substeps=1), hover, speeds)
    exact = hover_model(vehicle, PERIOD)
    np.testing.assert_allclose(A, exact.A, atol=1e-8)
    np.testing.assert_allclose(B, exact.B, atol=1e-8)
    np.testing.assert_allclose(c, -exact.B @ exact.u_bar, atol=1e-6)


def test_rotor_states_are_exact_whatever_the_lag(vehicle: Vehicle) -> None:
    for lag in (0.002, 0.02, 0.3):  # Runge-Kutta would be unstable for the first
        model = nonlinear_model(vehicle, PERIOD, rotor_lag=lag)
        x, u = points(vehicle, 5, lag=lag)
        decay = math.exp(-PERIOD / lag)
        np.testing.assert_allclose(advance(model, x, u)[:, 12:], u + decay * (x[:, 12:] - u), rtol=1e-14)


def test_a_vanishing_lag_leaves_the_model_without(vehicle: Vehicle) -> None:
    x, u = points(vehicle, 5, lag=LAG)
    slow = advance(nonlinear_model(vehicle, PERIOD, substeps=64, rotor_lag=1e-6), x, u)
    np.testing.assert_allclose(slow[:, :12], advance(nonlinear_model(vehicle, PERIOD), x[:, :12], u), atol=0.02)


@pytest.mark.parametrize("lag", LAGS)
def test_heading_and_place_make_no_difference(vehicle: Vehicle, lag: float | None) -> None:
    model = nonlinear_model(vehicle, PERIOD, rotor_lag=lag)
    x, u = points(vehicle, 5, lag=lag)
    turn = np.radians(130.0)
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])

    def moved(states: Array) -> Array:
        states = states.copy()
        states[:, [0, 2]] = states[:, [0, 2]] @ rotation.T + [4.0, -9.0]
        states[:, [1, 3]] = states[:, [1, 3]] @ rotation.T
        states[:, 10] += turn
        return states

    np.testing.assert_allclose(advance(model, moved(x), u), moved(advance(model, x, u)), atol=1e-12)


ESTIMATES = {"undisturbed": np.zeros(6), "disturbed": np.array([0.7, -0.4, 1.1, -0.5, 0.8, 0.3])}


@pytest.mark.parametrize("estimate", ESTIMATES)
@pytest.mark.parametrize("share", [0.3, 1.0])
@pytest.mark.parametrize("lag", LAGS)
def test_c_predicts_the_same(vehicle: Vehicle, lag: float | None, share: float, estimate: str) -> None:
    """To the instant a known delay later, at any attitude, with the disturbance that is estimated."""
    settings = robust_table(rotor_lag=lag or 0.0, delay=share * PERIOD, offset_free=ObserverSettings())
    preparation = RobustPreparation(vehicle, settings.problem(vehicle, PERIOD), settings)
    model = nonlinear_model(vehicle, PERIOD, rotor_lag=lag)
    disturbance = ESTIMATES[estimate]
    x, u = points(vehicle, 20, lag=lag)
    for state, command in zip(x, u, strict=True):
        before = state[12:] if lag else command
        preparation.reset(before)
        preparation.adopt(None, disturbance)
        query = preparation.prepare(StepInputs(), state[:12], np.zeros((50, 4)), command)
        assert query is not None
        push = disturbance[2] * body_to_world(state[list(EULER)])[:, 2] + [*disturbance[:2], 0.0]
        rotors = spun(model, before, command, (1.0 - share) * PERIOD)
        late = replace(
            model,
            period=share * PERIOD,
            effectiveness=twisted(model.effectiveness, disturbance[3:] / vehicle.gravity),
            acceleration=push,
        )
        expected = next_state(late, np.concatenate([state[:12], rotors])[: model.n], command)
        np.testing.assert_allclose(query.state, expected, rtol=0.0, atol=1e-11)
