"""Targets of an inner loop as inputs, thrust and body rates: the model, flights, bounds, fallback and refusals."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from mpc.nonlinear.rigidbody import (
    N_BODY,
    RATE_SCALE,
    Inputs,
    Q,
    RigidBody,
    V,
    W,
    advance_nodes,
    linearise_nodes,
    rigid_body,
    rotation,
)
from quadsim.assets import vehicle_path
from quadsim.state import Array
from quadsim.vehicle import load_vehicle

VEHICLE = load_vehicle(vehicle_path("hummingbird"))
LAG = (0.02, 0.035, 0.035, 0.1)
LAGS = [LAG, (0.0, 0.035, 0.0, 0.1), (0.072, 0.0, 0.01, 0.0), (0.0, 0.0, 0.0, 0.0)]
OTHERS: list[dict[str, Any]] = [
    {},
    {"drag": np.array([0.3, 0.2, 0.1]), "quadratic_drag": np.array([0.08, 0.05, 0.02]), "thrust_scale": 0.8},
    {"acceleration": np.array([0.3, -0.2, 0.5])},
]


def model_of(step: float = 0.05, lag: tuple[float, ...] = LAG, **others: Any) -> RigidBody:
    return rigid_body(VEHICLE, step, inputs=Inputs.RATES, lag=lag, **others)


def points(count: int = 6) -> tuple[Array, Array]:
    """States (count, 14) at any attitude, and targets as shares (count, 4)."""
    rng = np.random.default_rng(0)
    x, u = rng.normal(size=(count, 14)), 0.2 * rng.normal(size=(count, 4))
    x[:, Q] /= np.linalg.norm(x[:, Q], axis=1, keepdims=True)
    x[:, N_BODY], u[:, 0] = rng.uniform(0.1, 0.9, (2, count))
    return x, u


# --- the model -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("lag", "substeps", "others"), [*itertools.product(LAGS, (1, 3), OTHERS)])
def test_derivatives_are_those_of_finite_differences(
    lag: tuple[float, ...], substeps: int, others: dict[str, Any]
) -> None:
    model = model_of(0.1, lag, substeps=substeps, **others)
    x, u = points()
    A, B, end = linearise_nodes(model, x, u)
    np.testing.assert_allclose(end, advance_nodes(model, x, u), rtol=1e-12, atol=1e-12)
    for result, width in ((A, 14), (B, 4)):
        for j in range(width):
            d = 1e-5 * np.eye(width)[j]
            pairs = ((x + d, u), (x - d, u)) if width == 14 else ((x, u + d), (x, u - d))
            above, below = (advance_nodes(model, *pair) for pair in pairs)
            expected = (above - below) / 2e-5
            np.testing.assert_allclose(result[:, :, j], expected, rtol=1e-6, atol=1e-6 * np.abs(expected).max())


def test_derivatives_in_frames_are_those_of_multiplied_quaternions() -> None:
    model, (x, u) = model_of(), points(3)
    frames = np.linalg.qr(np.random.default_rng(1).normal(size=(4, 4, 4)))[0]
    (A, B, end), (plain, inputs, same) = linearise_nodes(model, x, u, frames), linearise_nodes(model, x, u)
    np.testing.assert_array_equal(end, same)
    for i in range(3):
        before, after = np.eye(14), np.eye(14)
        before[Q, Q], after[Q, Q] = frames[i], frames[i + 1]
        np.testing.assert_allclose(A[i], after @ plain[i] @ before.T, atol=1e-12)
        np.testing.assert_allclose(B[i], after @ inputs[i], atol=1e-12)


@pytest.mark.parametrize("step", [1e-3, 0.05, 1.0, 30.0])
def test_rates_and_thrust_follow_exactly_whatever_the_step(step: float) -> None:
    """A Runge-Kutta step of more than 2.8 time constants would diverge."""
    x, u = points()
    end = advance_nodes(model_of(step), x, u)
    left = np.exp(-step / np.array(LAG))
    np.testing.assert_allclose(end[:, W], RATE_SCALE * u[:, 1:] + left[1:] * (x[:, W] - RATE_SCALE * u[:, 1:]))
    np.testing.assert_allclose(end[:, N_BODY], u[:, 0] + left[0] * (x[:, N_BODY] - u[:, 0]))


@pytest.mark.parametrize("others", OTHERS)
def test_it_moves_by_the_equations_of_the_rigid_body_and_four_lags(others: dict[str, Any]) -> None:
    """A variable-step integrator of the equations as they are written; lags of 0 act at once."""
    (x, u), model = points(1), model_of(0.05, substeps=50, **others)
    target = model.scale * u[0]

    def slopes(_: float, y: Array) -> Array:
        q, v, omega, T = y[Q], y[V], y[W], y[N_BODY]
        R, (w, *vector) = rotation(q), q
        air = R.T @ v
        drag = -(model.drag + model.quadratic_drag * np.abs(air)) * air
        force = np.array([0.0, 0.0, model.thrust_scale * T]) + drag
        turn = 0.5 * np.array([-np.dot(vector, omega), *(w * omega + np.cross(vector, omega))])
        v_slope = R @ force / VEHICLE.mass + model.acceleration - [0.0, 0.0, VEHICLE.gravity]
        return np.concatenate([v, turn, v_slope, (target[1:] - omega) / LAG[1:], [(target[0] - T) / LAG[0]]])

    start = x[0] * np.array([*[1.0] * N_BODY, model.scale[0]])
    end = solve_ivp(slopes, (0.0, 0.05), start, rtol=1e-11, atol=1e-12).y[:, -1]
    np.testing.assert_allclose(advance_nodes(model, x, u)[0, :N_BODY], end[:N_BODY], atol=1e-7)
