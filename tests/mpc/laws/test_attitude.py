"""Attitude errors: against rotations built in other ways, and against finite differences."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy_geometric import attitude_error, quaternion_of, unit_derivatives, vee
from scipy.spatial.transform import Rotation

from quadsim.mpc.laws.parts.attitude import attitude_for, hat, limit_force, prioritised_error

SEEDS = st.integers(0, 2**32 - 1)


def psi_of(R: np.ndarray, R_d: np.ndarray) -> float:
    """Psi(R, R_d) = tr(I - R_d' R) / 2, in [0, 2].  Lee, Leok, McClamroch (2010)."""
    return 0.5 * (3.0 - float(np.trace(R_d.T @ R)))


def rotations(seed: int, count: int = 2) -> list[np.ndarray]:
    return list(Rotation.random(count, random_state=seed).as_matrix())


@given(seed=SEEDS)
def test_the_error_function_is_a_distance_and_e_r_its_gradient(seed: int) -> None:
    """Psi >= 0, zero at R_d alone, symmetric; its change along R hat(eta) is e_R . eta; |e_R|^2 = Psi (2 - Psi)."""
    R, R_d = rotations(seed)
    psi = psi_of(R, R_d)
    e_R = attitude_error(R, R_d)
    assert -1e-12 <= psi <= 2.0 + 1e-12
    assert psi_of(R_d, R) == pytest.approx(psi, abs=1e-12)
    assert psi_of(R, R) == pytest.approx(0.0, abs=1e-12)
    eta = np.random.default_rng(seed).normal(size=3)
    h = 1e-6
    ends = [psi_of(R @ Rotation.from_rotvec(s * h * eta).as_matrix(), R_d) for s in (1.0, -1.0)]
    assert (ends[0] - ends[1]) / (2.0 * h) == pytest.approx(float(e_R @ eta), abs=1e-8)
    assert float(e_R @ e_R) == pytest.approx(psi * (2.0 - psi), abs=1e-9)


def test_half_a_turn_is_the_largest_error_and_has_no_gradient() -> None:
    R = np.diag([1.0, -1.0, -1.0])
    assert psi_of(R, np.eye(3)) == pytest.approx(2.0)
    np.testing.assert_allclose(attitude_error(R, np.eye(3)), 0.0, atol=1e-15)


@given(seed=SEEDS)
def test_with_full_yaw_weight_the_prioritised_error_is_the_quaternion_error(seed: int) -> None:
    R, R_d = rotations(seed)
    quaternion = Rotation.from_matrix(R.T @ R_d).as_quat(canonical=True, scalar_first=True)
    error = prioritised_error(R, R_d, 1.0)
    sign = 1.0 if error @ quaternion[1:] >= 0.0 else -1.0  # at half a turn both quaternions are as short
    np.testing.assert_allclose(error, 2.0 * sign * quaternion[1:], atol=1e-7)
    assert sign > 0.0 or quaternion[0] < 1e-7


@pytest.mark.parametrize("weight", [0.1, 0.4, 1.0])
def test_small_errors_of_all_axes_count_alike_whatever_the_weight(weight: float) -> None:
    turn = np.array([1e-4, -2e-4, 3e-4])
    R = Rotation.from_euler("ZYX", [1.0, 0.3, -0.2]).as_matrix()
    error = prioritised_error(R, R @ Rotation.from_rotvec(turn).as_matrix(), weight)
    np.testing.assert_allclose(error, turn, atol=1e-7)


def test_tilt_goes_the_shortest_way_before_heading() -> None:
    """Half a turn of heading wanted and 60 deg of roll: a weight near zero leaves the rotation of body z alone."""
    desired = Rotation.from_euler("ZYX", [math.pi - 0.01, 0.0, 0.0]).as_matrix()
    R = Rotation.from_euler("ZYX", [0.0, 0.0, math.radians(60.0)]).as_matrix()
    error = prioritised_error(R, desired, 1e-6)
    np.testing.assert_allclose(error[:2], [-2.0 * math.sin(math.radians(30.0)), 0.0], atol=1e-5)


def test_upside_down_rolls_over() -> None:
    error = prioritised_error(np.diag([1.0, -1.0, -1.0]), np.eye(3), 0.4)
    assert abs(error[0]) == pytest.approx(2.0)


@given(seed=SEEDS)
def test_the_wanted_attitude_points_its_thrust_and_its_heading(seed: int) -> None:
    rng = np.random.default_rng(seed)
    force = rng.normal(size=3)
    yaw = rng.uniform(-3.0, 3.0)
    force[2] = abs(force[2]) + 0.1
    R = attitude_for(force, yaw)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1.0)
    np.testing.assert_allclose(R[:, 2], force / np.linalg.norm(force), atol=1e-12)
    assert math.atan2(R[1, 0], R[0, 0]) == pytest.approx(yaw, abs=1e-9)


def test_a_force_is_leant_no_further_than_allowed() -> None:
    np.testing.assert_allclose(limit_force(np.array([0.0, 1.0, 10.0]), least=1.0, tilt=0.5), [0.0, 1.0, 10.0])
    held = limit_force(np.array([30.0, 40.0, 10.0]), least=1.0, tilt=math.radians(45.0))
    np.testing.assert_allclose(held, [6.0, 8.0, 10.0])
    np.testing.assert_allclose(limit_force(np.array([0.0, 0.0, -5.0]), least=2.0, tilt=0.5), [0.0, 0.0, 2.0])


def test_vee_undoes_hat_which_is_the_cross_product() -> None:
    a = np.array([1.0, -2.0, 3.0])
    b = np.array([0.3, 0.2, 0.1])
    np.testing.assert_allclose(hat(a) @ b, np.cross(a, b))
    np.testing.assert_allclose(vee(hat(a)), a)


def test_derivatives_of_a_direction_match_finite_differences() -> None:
    def v(t: float) -> np.ndarray:
        return np.array([1.0 + t, 2.0 - t**2, 3.0 + t + 2.0 * t**2])

    def direction(t: float) -> np.ndarray:
        return v(t) / np.linalg.norm(v(t))

    h = 1e-4
    u, u1, u2 = unit_derivatives(v(0.0), np.array([1.0, 0.0, 1.0]), np.array([0.0, -2.0, 4.0]))
    np.testing.assert_allclose(u, direction(0.0))
    np.testing.assert_allclose(u1, (direction(h) - direction(-h)) / (2.0 * h), atol=1e-7)
    np.testing.assert_allclose(u2, (direction(h) - 2.0 * direction(0.0) + direction(-h)) / h**2, atol=1e-6)


@given(seed=SEEDS)
def test_the_quaternion_of_a_matrix_is_that_of_its_rotation(seed: int) -> None:
    """Up to its sign; also of half turns, whose scalar part vanishes."""
    random = rotations(seed, 1)[0]
    for R in (random, np.eye(3), random @ np.diag([1.0, -1.0, -1.0]) @ random.T, np.diag([-1.0, -1.0, 1.0])):
        q = quaternion_of(R)
        assert np.linalg.norm(q) == pytest.approx(1.0)
        np.testing.assert_allclose(Rotation.from_quat(np.roll(q, -1)).as_matrix(), R, atol=1e-12)
