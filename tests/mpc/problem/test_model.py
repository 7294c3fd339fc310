"""Eq. (1): the linear model, against the nonlinear equations and against MuJoCo."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from quadsim.mpc.problem.model import continuous_model, discretise, hover_model
from quadsim.sim.airframe import compile_model
from quadsim.sim.effects import Effects
from quadsim.sim.effects.wind import Air
from quadsim.sim.plant import Plant
from quadsim.state import Array, make_state
from quadsim.vehicle import Vehicle

PERIOD = 0.05
MUJOCO_ORDER = [0, 6, 1, 7, 2, 8, 3, 9, 4, 10, 5, 11]
"""Where the paper's states are among MuJoCo's tangent coordinates (positions, rotations, then their rates)."""


def paper_dynamics(vehicle: Vehicle, state: Array, speeds: Array) -> Array:
    """The nonlinear model exactly as printed in Sec. 2.2."""
    _, vx, _, vy, _, vz, phi, p, theta, q, psi, r = state
    b = vehicle.thrust_coefficient
    d = vehicle.drag_to_thrust * vehicle.thrust_coefficient
    L = vehicle.arm_length
    w1, w2, w3, w4 = speeds**2
    U = b * (w1 + w2 + w3 + w4)
    tau = b * L * (w4 - w2), b * L * (w3 - w1), d * (w1 - w2 + w3 - w4)
    ixx, iyy, izz = vehicle.inertia
    s = np.sin
    c = np.cos
    ax = (c(psi) * s(theta) * c(phi) + s(psi) * s(phi)) * U / vehicle.mass
    ay = (s(psi) * s(theta) * c(phi) - s(phi) * c(psi)) * U / vehicle.mass
    az = -vehicle.gravity + c(theta) * c(phi) * U / vehicle.mass
    dp = (iyy - izz) / ixx * r * q + tau[0] / ixx
    dq = (izz - ixx) / iyy * r * p + tau[1] / iyy
    dr = (ixx - iyy) / izz * q * p + tau[2] / izz
    return np.array([vx, ax, vy, ay, vz, az, p, dp, q, dq, r, dr])


def mujoco_transition(vehicle: Vehicle, timestep: float) -> tuple[Array, Array]:
    """A and B over one control period by `mjd_transitionFD` at hover, in the paper's coordinates.

    MuJoCo does not differentiate its Runge-Kutta steps, so these are of its first-order Euler integrator.
    """
    model = compile_model(vehicle, timestep=timestep)
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_EULER
    data = mujoco.MjData(model)
    data.ctrl[:] = vehicle.thrusts(np.full(4, vehicle.hover_speed))
    A = np.zeros((12, 12))
    B = np.zeros((12, 4))
    mujoco.mjd_transitionFD(model, data, 1e-6, True, A, B, None, None)
    A = A[np.ix_(MUJOCO_ORDER, MUJOCO_ORDER)]
    B = B[MUJOCO_ORDER] * 2.0 * vehicle.thrust_coefficient * vehicle.hover_speed  # thrust slope dT/dw = 2 b w
    whole_A = np.eye(12)
    whole_B = np.zeros((12, 4))
    for _ in range(round(PERIOD / timestep)):
        whole_A = A @ whole_A
        whole_B = A @ whole_B + B
    return whole_A, whole_B


def transition_difference(vehicle: Vehicle) -> float:
    """Largest difference of A and B from MuJoCo's, in the limit of a vanishing step (Richardson extrapolation)."""
    exact = hover_model(vehicle, PERIOD)
    coarse = mujoco_transition(vehicle, 1e-3)
    fine = mujoco_transition(vehicle, 5e-4)
    limits = (2.0 * two - one for one, two in zip(coarse, fine, strict=True))
    return float(max(np.abs(limit - part).max() for limit, part in zip(limits, (exact.A, exact.B), strict=True)))


def test_jacobians_match_finite_differences_of_the_printed_model(vehicle: Vehicle) -> None:
    A, B = continuous_model(vehicle)
    state = make_state(position=(3.0, -2.0, 10.0))
    speeds = np.full(4, vehicle.hover_speed)
    h = 1e-6
    for i, column in enumerate(np.eye(12)):
        slope = (
            paper_dynamics(vehicle, state + h * column, speeds) - paper_dynamics(vehicle, state - h * column, speeds)
        ) / (2 * h)
        np.testing.assert_allclose(A[:, i], slope, atol=1e-8)
    h = 1e-3
    for i, column in enumerate(np.eye(4)):
        slope = (
            paper_dynamics(vehicle, state, speeds + h * column) - paper_dynamics(vehicle, state, speeds - h * column)
        ) / (2 * h)
        np.testing.assert_allclose(B[:, i], slope, atol=1e-8)


def test_discretisation_is_exact_for_a_double_integrator() -> None:
    A, B = discretise(np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[0.0], [1.0]]), 0.3)
    np.testing.assert_allclose(A, [[1.0, 0.3], [0.0, 1.0]], atol=1e-15)
    np.testing.assert_allclose(B, [[0.045], [0.3]], atol=1e-15)


def test_two_half_periods_make_a_whole_one(vehicle: Vehicle) -> None:
    whole = hover_model(vehicle, PERIOD)
    half = hover_model(vehicle, PERIOD / 2)
    np.testing.assert_allclose(half.A @ half.A, whole.A, atol=1e-13)
    np.testing.assert_allclose(half.A @ half.B + half.B, whole.B, atol=1e-13)


def test_discretisation_is_the_limit_of_mujocos_transition_derivatives(vehicle: Vehicle) -> None:
    exact = hover_model(vehicle, PERIOD)
    coarse = mujoco_transition(vehicle, 1e-3)
    fine = mujoco_transition(vehicle, 5e-4)
    for one, two, reference in zip(coarse, fine, (exact.A, exact.B), strict=True):
        error_one = np.abs(one - reference).max()
        error_two = np.abs(two - reference).max()
        assert error_one < 2e-2
        assert error_two == pytest.approx(error_one / 2, rel=0.05)  # first order, as the integrator
    assert transition_difference(vehicle) < 1e-6  # 2 fine - coarse, in which the first order cancels


def test_discretisation_matches_central_differences_of_the_plant_itself(vehicle: Vehicle) -> None:
    exact = hover_model(vehicle, PERIOD)
    hover = make_state(position=(0.0, 0.0, 10.0))
    speeds = np.full(4, vehicle.hover_speed)
    with Plant(vehicle) as plant:

        def after(state: Array, speeds: Array) -> Array:
            plant.reset(state)
            plant.advance(speeds, 50)
            return plant.state()

        for i, column in enumerate(np.eye(12)):
            slope = (after(hover + 1e-4 * column, speeds) - after(hover - 1e-4 * column, speeds)) / 2e-4
            np.testing.assert_allclose(exact.A[:, i], slope, atol=1e-7)
        for i, column in enumerate(np.eye(4)):
            slope = (after(hover, speeds + 1e-2 * column) - after(hover, speeds - 1e-2 * column)) / 2e-2
            np.testing.assert_allclose(exact.B[:, i], slope, atol=1e-7)


def test_with_the_moment_it_matches_central_differences_of_the_plant_in_air(vehicle: Vehicle) -> None:
    """The plant also has `inflow_moment`, a product of two velocities, which is 0 to first order."""
    moments = {"rotor_moment": (2e-4, -3e-4), "inflow_moment": (0.02, 0.03), "rate_damping": (0.02, 0.03, 0.01)}
    vehicle = replace(vehicle, **moments, inflow=4e-4)
    known, ignorant = (hover_model(vehicle, PERIOD, moment=moment) for moment in (True, False))
    hover = make_state(position=(0.0, 0.0, 10.0))
    speeds = np.full(4, vehicle.hover_speed)
    effects = Effects(air=Air(**moments, inflow=4e-4))
    with Plant(vehicle, effects=effects, integrator="rk4") as plant:

        def after(state: Array) -> Array:
            plant.reset(state)
            plant.advance(speeds, 50)
            return plant.state()

        slopes = [(after(hover + 1e-4 * unit) - after(hover - 1e-4 * unit)) / 2e-4 for unit in np.eye(12)]
    np.testing.assert_allclose(known.A, np.transpose(slopes), atol=1e-6)
    assert np.abs(ignorant.A - np.transpose(slopes)).max() > 0.05


def test_hover_anywhere_is_an_equilibrium_of_deviations_only(vehicle: Vehicle) -> None:
    """Erratum of Eq. (1): with absolute speeds, the printed equation, hover would climb."""
    model = hover_model(vehicle, PERIOD)
    hover = make_state(position=(4.0, -7.0, 10.0))
    np.testing.assert_allclose(model.A @ hover, hover, atol=1e-14)
    as_printed = model.A @ hover + model.B @ model.u_bar
    assert as_printed[5] == pytest.approx(2 * vehicle.gravity * PERIOD)  # climbing at twice g after one period
