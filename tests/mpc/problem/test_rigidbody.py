"""The rigid body with a quaternion: derivatives by finite differences, closed forms, and the Euler-angle model."""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy_preparation import nonlinear_model
from scipy.integrate import solve_ivp
from support import advance_nodes, derivative, frame, linearise_nodes

from quadsim.assets import vehicle_path
from quadsim.mpc.problem.rigidbody import (
    N_BODY,
    Inputs,
    P,
    Q,
    RigidBody,
    V,
    W,
    rigid_body,
    rotation,
    thrust_axis,
)
from quadsim.rotation import (
    body_to_euler_rates,
    body_to_world,
    euler_to_body_rates,
    euler_to_quaternion,
    quaternion_to_euler,
)
from quadsim.state import ANGLE_RATES, ANGLES, N_STATES, POSITIONS, VELOCITIES, Array, tilt
from quadsim.vehicle import load_vehicle

VEHICLE = replace(
    load_vehicle(vehicle_path("lopes2011")),
    **{"rotor_moment": (2e-5, -3e-5), "inflow_moment": (3e-3, -4e-3), "rate_damping": (0.01, 0.02, 0.03)},
    inflow=4e-4,
)
DRAG = {"drag": np.array([0.3, 0.2, 0.1]), "quadratic_drag": np.array([0.08, 0.05, 0.02])}
DISTURBED = {"acceleration": np.array([0.3, -0.2, 0.5]), "angular_acceleration": np.array([1.0, -2.0, 0.5])}


def points(model: RigidBody, rng: np.random.Generator, count: int = 10) -> tuple[Array, Array]:
    """States of any attitude, their quaternions of any length, and inputs about hover."""
    x = rng.normal(size=(count, model.n))
    x[:, Q] *= rng.uniform(0.2, 1.2, (count, 1)) / np.linalg.norm(x[:, Q], axis=1, keepdims=True)
    u = model.shares(np.full(4, VEHICLE.mass * VEHICLE.gravity / 4.0)) + 0.02 * rng.normal(size=(count, 4))
    u[-1, 0] = 0.003  # a rotor that hardly turns
    x[:, N_BODY:] = u[:, : model.n - N_BODY] + 0.02 * rng.normal(size=(count, model.n - N_BODY))
    return x, u


OTHERS = ({}, DRAG, DISTURBED, {"moment": True}, DRAG | DISTURBED | {"moment": True})
CASES = [*itertools.product((Inputs.THRUST, Inputs.SPEED), (None, 0.03), (1, 3), OTHERS)]


@pytest.mark.parametrize(("inputs", "lag", "substeps", "others"), CASES)
def test_derivatives_are_those_of_the_map(
    inputs: Inputs, lag: float | None, substeps: int, others: dict[str, Any]
) -> None:
    model = rigid_body(VEHICLE, 0.1, inputs=inputs, rotor_lag=lag, substeps=substeps, **others)
    x, u = points(model, np.random.default_rng(0))
    A, B, end = linearise_nodes(model, x, u)
    np.testing.assert_allclose(end, advance_nodes(model, x, u), rtol=1e-12, atol=1e-12)
    step = 1e-6
    for result, width, moved in (
        (A, model.n, lambda d: (advance_nodes(model, x + d, u), advance_nodes(model, x - d, u))),
        (B, 4, lambda d: (advance_nodes(model, x, u + d), advance_nodes(model, x, u - d))),
    ):
        for j in range(width):
            above, below = moved(step * np.eye(width)[j])
            expected = (above - below) / (2.0 * step)
            np.testing.assert_allclose(result[:, :, j], expected, rtol=1e-7, atol=1e-7 * np.abs(expected).max() + 1e-9)


def test_derivatives_in_frames_are_those_of_multiplied_quaternions() -> None:
    model = rigid_body(VEHICLE, 0.1)
    rng = np.random.default_rng(1)
    x, u = points(model, rng, 3)
    frames = rng.normal(size=(4, 4))
    frames /= np.linalg.norm(frames, axis=1, keepdims=True)
    A, B, end = linearise_nodes(model, x, u, frames)
    plain, inputs, same = linearise_nodes(model, x, u)
    np.testing.assert_array_equal(end, same)
    for i in range(3):
        before = np.eye(model.n)
        after = np.eye(model.n)
        before[Q, Q] = frame(frames[i])
        after[Q, Q] = frame(frames[i + 1])
        np.testing.assert_allclose(A[i], after @ plain[i] @ before.T, atol=1e-12)
        np.testing.assert_allclose(B[i], after @ inputs[i], atol=1e-12)


@pytest.mark.parametrize("inputs", [Inputs.THRUST, Inputs.SPEED])
def test_it_moves_by_the_equations_of_a_rigid_body_in_air(inputs: Inputs) -> None:
    """A variable-step integrator of the equations as they are written, with drag and the air's torque."""
    model = rigid_body(VEHICLE, 0.1, inputs=inputs, substeps=50, moment=True, thrust_scale=0.9, **DRAG, **DISTURBED)
    x, u = points(model, np.random.default_rng(5), 3)
    x[:, Q] /= np.linalg.norm(x[:, Q], axis=1, keepdims=True)
    thrusts = model.thrusts(u)
    wrenches = 0.9 * thrusts @ (VEHICLE.allocation / VEHICLE.mean_coefficient).T
    turning = np.sqrt(thrusts / VEHICLE.mean_coefficient).sum(axis=1)

    def slopes(_: float, y: Array, wrench: Array, turning: float) -> Array:
        (w, *vector), v, omega = y[Q], y[V], y[W]
        R = rotation(y[Q])
        air = R.T @ v
        lost = VEHICLE.inflow * turning * air[2]
        force = np.array([0.0, 0.0, wrench[0] - lost]) - (model.drag + model.quadratic_drag * np.abs(air)) * air
        turn = 0.5 * np.array([-np.dot(vector, omega), *(w * omega + np.cross(vector, omega))])
        v_slope = R @ force / VEHICLE.mass + model.acceleration - [0.0, 0.0, VEHICLE.gravity]
        damped = VEHICLE.lost_to_inflow(VEHICLE.hover_speeds, np.zeros(3), omega)[1:]  # as in hover
        torque = (
            wrench[1:] + VEHICLE.air_moment(turning, air, omega) - damped - np.cross(omega, VEHICLE.momentum(omega))
        )
        return np.concatenate([v, turn, v_slope, VEHICLE.angular_acceleration(torque) + model.angular_acceleration])

    ends = [
        solve_ivp(slopes, (0.0, 0.1), x[i], args=(wrenches[i], turning[i]), rtol=1e-11, atol=1e-12).y[:, -1]
        for i in range(2)
    ]
    np.testing.assert_allclose(advance_nodes(model, x, u)[:2], ends, atol=1e-8)


@pytest.mark.parametrize("others", [{}, DRAG])
def test_the_integrator_is_of_fourth_order(others: dict[str, Any]) -> None:
    x, u = points(rigid_body(VEHICLE, 0.2), np.random.default_rng(2))

    def end(substeps: int) -> Array:
        return advance_nodes(rigid_body(VEHICLE, 0.2, substeps=substeps, **others), x, u)

    errors = [np.abs(end(count) - end(64)).max() for count in (4, 8)]
    assert 3.5 < np.log2(errors[0] / errors[1]) < 4.7


def test_it_moves_as_the_model_in_euler_angles() -> None:
    rng = np.random.default_rng(3)
    state = 0.3 * rng.normal(size=(5, N_STATES))
    speeds = VEHICLE.hover_speed + 5.0 * rng.normal(size=(5, 4))
    model = rigid_body(VEHICLE, 1e-4, inputs=Inputs.SPEED)
    x = np.empty((5, N_BODY))
    x[:, P] = state[:, POSITIONS]
    x[:, V] = state[:, VELOCITIES]
    x[:, Q] = euler_to_quaternion(state[:, ANGLES])
    x[:, W] = euler_to_body_rates(state[:, ANGLES], state[:, ANGLE_RATES])
    moved = (advance_nodes(model, x, speeds / VEHICLE.speed_max) - x) / model.step
    expected = derivative(nonlinear_model(VEHICLE, 0.05), state, speeds)
    np.testing.assert_allclose(moved[:, V], expected[:, VELOCITIES], atol=2e-2)
    ends = x + model.step * moved
    rates = body_to_euler_rates(quaternion_to_euler(ends[:, Q]), ends[:, W])
    np.testing.assert_allclose((rates - state[:, ANGLE_RATES]) / model.step, expected[:, ANGLE_RATES], atol=2e-2)


def test_a_spin_about_an_axis_keeps_its_rate_and_turns_by_it() -> None:
    model = rigid_body(VEHICLE, 0.05, substeps=4)
    x = np.zeros(N_BODY)
    x[3] = 1.0
    x[12] = 2.0
    hover = np.full(4, VEHICLE.mass * VEHICLE.gravity / 4.0)
    for _ in range(10):
        x = advance_nodes(model, x, model.shares(hover))
    np.testing.assert_allclose(x[Q], [np.cos(0.5), 0.0, 0.0, np.sin(0.5)], atol=1e-8)
    np.testing.assert_allclose(x[[*range(3), *range(7, 13)]], [0, 0, 0, 0, 0, 0, 0, 0, 2.0], atol=1e-12)


def test_the_angle_of_the_thrust_axis_is_the_tilt_of_euler_angles_at_any_attitude() -> None:
    q = np.random.default_rng(4).normal(size=(200, 4))
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    states = np.zeros((200, N_STATES))
    states[:, ANGLES] = quaternion_to_euler(q)
    np.testing.assert_allclose(tilt(states), np.arccos(thrust_axis(q)[:, 2]), atol=1e-6)
    np.testing.assert_allclose(rotation(q), body_to_world(states[:, ANGLES]), atol=1e-7)
