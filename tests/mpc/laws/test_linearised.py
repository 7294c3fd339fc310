"""The sampled closed loops at hover: every eigenvalue inside the unit circle, for every vehicle, with lag to spare."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import scipy.linalg

from quadsim.errors import ParameterError
from quadsim.mpc.laws.geometric import GeometricController, Integrals
from quadsim.mpc.laws.lqr import lqr_gain
from quadsim.mpc.laws.parts.attitude import motion_of
from quadsim.mpc.laws.parts.preview import Target
from quadsim.mpc.laws.pid import CascadedPID, Memory
from quadsim.mpc.pilot.allocation import allocate
from quadsim.mpc.problem.model import continuous_model, discretise, hover_model
from quadsim.mpc.problem.ocp import Objective
from quadsim.state import Array
from quadsim.vehicle import Vehicle

PERIOD = 0.05
AT_REST = Target(
    position=np.zeros(3), velocity=np.zeros(3), acceleration=np.zeros(3), yaw=0.0, yaw_rate=0.0, yaw_acceleration=0.0
)
NO_BOUNDS = np.zeros(4), np.full(4, 1e6)

Law = Callable[[Array, Array], tuple[Array, Array]]
"""(12,) state and (m,) memory -> (4,) speeds and (m,) memory."""


def pid_law(controller: CascadedPID) -> Law:
    def law(state: Array, memory: Array) -> tuple[Array, Array]:
        before = Memory(
            velocity_integral=memory[:3], rate_integral=memory[3:6], velocity=memory[6:9], rates=memory[9:12]
        )
        speeds, after = controller.fly(before, state, AT_REST, *NO_BOUNDS)
        return speeds, np.concatenate([after.velocity_integral, after.rate_integral, after.velocity, after.rates])

    return law


def geometric_law(controller: GeometricController, allocation: Any) -> Law:
    def law(state: Array, memory: Array) -> tuple[Array, Array]:
        integrals = Integrals(translation=memory[:3], rotation=memory[3:])
        motion = motion_of(state)
        wrench, desired = controller.wrench(motion, AT_REST, integrals)
        after = controller.integrate(integrals, motion, AT_REST, desired)
        return allocate(allocation, wrench, *NO_BOUNDS), np.concatenate([after.translation, after.rotation])

    return law


def jacobian(law: Law, size: int) -> tuple[Array, Array]:
    """(4, size) and (size - 12, size): how speeds and memory follow state and memory, at hover."""
    h = 1e-5
    columns = []
    for direction in np.eye(size):
        ends = [np.concatenate(law(s * h * direction[:12], s * h * direction[12:])) for s in (1.0, -1.0)]
        columns.append((ends[0] - ends[1]) / (2.0 * h))
    whole = np.stack(columns, axis=1)
    return whole[:4], whole[4:]


def spectral_radius(vehicle: Vehicle, law: Law, memory: int, *, lag: float = 0.0, delay: float = 0.0) -> float:
    """Of one period of the linear model, rotors of first-order `lag` [s], commands late by `delay` [s], and the law."""
    A, B = continuous_model(vehicle)
    if lag:
        A = np.block([[A, B], [np.zeros((4, 12)), -np.eye(4) / lag]])
        B = np.concatenate([np.zeros((12, 4)), np.eye(4) / lag])
    n = len(A)
    A_old, B_old = discretise(A, B, delay)  # while the command before still acts
    A_new, B_new = discretise(A, B, PERIOD - delay)
    K, M = jacobian(law, 12 + memory)
    seen = np.zeros((12 + memory, n + 4 + memory))  # what the law sees of [state and rotors, last command, memory]
    seen[:12, :12] = np.eye(12)
    seen[12:, n + 4 :] = np.eye(memory)
    period = np.zeros((n + 4 + memory,) * 2)
    period[:n, :n] = A_new @ A_old
    period[:n, n : n + 4] = A_new @ B_old
    period[:n] += B_new @ K @ seen
    period[n : n + 4] = K @ seen
    period[n + 4 :] = M @ seen
    return float(np.abs(np.linalg.eigvals(period)).max())


def law_of(name: str, vehicle: Vehicle, build: Callable[..., Any]) -> tuple[Law, int]:
    if name == "pid":
        return pid_law(build("pid", vehicle)), 12
    if name == "lqr":
        gain = build("lqr", vehicle).gain
        return (lambda state, memory: (-gain @ state, memory)), 0
    controller = build("geometric", vehicle, integral=name == "geometric with integrals")
    law = geometric_law(controller, build("pid", vehicle).allocation)
    allocation = 6
    if name == "geometric with integrals":
        return law, allocation
    return (lambda state, memory: (law(state, np.zeros(6))[0], memory)), 0


@pytest.mark.parametrize("name", ["lqr", "pid", "geometric", "geometric with integrals"])
def test_every_loop_is_stable_at_20_hz_with_rotor_lag(name: str, craft: Vehicle, build: Callable[..., Any]) -> None:
    law, memory = law_of(name, craft, build)
    assert spectral_radius(craft, law, memory) < 0.995
    assert spectral_radius(craft, law, memory, lag=0.02) < 0.995
    assert spectral_radius(craft, law, memory, lag=max(0.05, craft.rotor_rise or 0.0)) < 1.0
    assert spectral_radius(craft, law, memory, delay=0.02) < 1.0


def test_the_feed_forward_separates_position_from_attitude(craft: Vehicle, build: Callable[..., Any]) -> None:
    """(s^2 + k_Omega s + k_R)(s^2 + k_v s + k_x): fed back continuously, both pairs are where their gains put them."""
    controller = build("geometric", craft)
    law = geometric_law(controller, build("pid", craft).allocation)
    gains = controller.gains
    K, _ = jacobian(lambda state, memory: (law(state, np.zeros(6))[0], memory), 12)
    A, B = continuous_model(craft)
    poles = np.linalg.eigvals(A + B @ K)
    pairs = [(gains.k_v, gains.k_x)] * 3 + list(zip(controller.k_Omega, controller.k_R, strict=True))
    expected = np.concatenate([np.roots([1.0, *pair]) for pair in pairs])
    np.testing.assert_allclose(np.sort_complex(poles.round(6)), np.sort_complex(expected.round(6)), atol=1e-3)


def test_the_cascade_has_the_characteristic_ratios_of_its_design(vehicle: Vehicle, build: Callable[..., Any]) -> None:
    """Without integrals and derivatives: s^4 + k1 s^3 + k1 k2 s^2 + k1 k2 k3 s + k1 k2 k3 k4 for x and for y."""
    none = dict.fromkeys(("velocity_integral", "rate_integral", "velocity_derivative", "rate_derivative"), 0.0)
    controller = build("pid", vehicle)
    controller.gains = replace(controller.gains, **none)
    law = pid_law(controller)
    k = controller.gains.bandwidths
    K, _ = jacobian(lambda state, memory: (law(state, np.zeros(12))[0], memory), 12)
    A, B = continuous_model(vehicle)
    poles = np.linalg.eigvals(A + B @ K)
    horizontal = np.cumprod([1.0, k.rate, k.attitude, k.velocity, k.position])
    vertical = np.cumprod([1.0, k.velocity, k.position])
    heading = np.cumprod([1.0, k.yaw_rate, k.yaw])
    expected = np.polymul(np.polymul(horizontal, horizontal), np.polymul(vertical, heading))
    np.testing.assert_allclose(np.poly(poles).real, expected, rtol=1e-5)


def test_the_gain_solves_the_riccati_equation(vehicle: Vehicle, build: Callable[..., Any]) -> None:
    """P = Q + A' P (A - B K), with P found by summing the cost of the closed loop, not by the solver."""
    controller = build("lqr", vehicle)
    model = controller.model
    objective = controller.objective
    A = model.A
    B = model.B
    K = controller.gain
    closed = A - B @ K
    P = scipy.linalg.solve_discrete_lyapunov(closed.T, objective.Q_y + K.T @ objective.Q_u @ K)
    np.testing.assert_allclose(K, np.linalg.solve(objective.Q_u + B.T @ P @ B, B.T @ P @ A), rtol=1e-6, atol=1e-9)


def test_weights_that_leave_the_vehicle_adrift_are_refused(vehicle: Vehicle) -> None:
    adrift = Objective(C_r=np.eye(12)[[0, 2, 4]], Q_y=np.eye(3), Q_u=np.eye(4))
    with pytest.raises(ParameterError, match=r"controller\.output_weights"):
        lqr_gain(hover_model(vehicle, PERIOD), adrift)
