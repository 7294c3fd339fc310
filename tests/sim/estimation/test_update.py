"""The update: against the linear Kalman filter, the gate, and the way back from divergence."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy_filter import OBSERVATION, Estimate, difference, inflate, innovation, retract, update
from scipy.spatial.transform import Rotation

from quadsim.sim.sensing import SensorName
from quadsim.state import Array

R = np.diag([0.01, 0.04, 0.09])
SAMPLE = np.array([0.3, -0.2, 0.1])


@pytest.fixture
def estimate() -> Estimate:
    rng = np.random.default_rng(3)
    factor = 0.1 * rng.normal(size=(15, 15))
    mean = rng.normal(size=16)
    mean[6:10] = Rotation.from_euler("ZYX", [3.1, 0.2, -2.0]).as_quat(scalar_first=True)
    return Estimate(mean=mean, covariance=factor @ factor.T)


def expected(estimate: Estimate, name: SensorName, residual: Array) -> tuple[Array, Array, float]:
    """Joseph's form of the update: error, covariance, normalised innovation squared."""
    H = OBSERVATION[name]
    P = estimate.covariance
    S = H @ P @ H.T + R
    K = np.linalg.solve(S, H @ P).T
    rest = np.eye(15) - K @ H
    return K @ residual, rest @ P @ rest.T + K @ R @ K.T, float(residual @ np.linalg.solve(S, residual))


@pytest.mark.parametrize("name", list(SensorName))
def test_the_update_is_that_of_kalman_in_josephs_form(name: SensorName, estimate: Estimate) -> None:
    value = SAMPLE
    if name is SensorName.ATTITUDE:
        turned = Rotation.from_quat(estimate.mean[6:10], scalar_first=True) * Rotation.from_rotvec(SAMPLE)
        value = turned.as_euler("ZYX")[::-1]
        residual = SAMPLE
    elif name is SensorName.RATES:
        residual = SAMPLE - estimate.mean[10:13] - estimate.mean[13:16]
    else:
        residual = SAMPLE - estimate.mean[{SensorName.POSITION: slice(0, 3), SensorName.VELOCITY: slice(3, 6)}[name]]
    np.testing.assert_allclose(innovation(name, estimate.mean, value), residual, atol=1e-12)
    after, distance = update(estimate, name, value, R, 1e9)
    error, covariance, nis = expected(estimate, name, residual)
    np.testing.assert_allclose(after.mean[:6] - estimate.mean[:6], error[:6], atol=1e-12)
    np.testing.assert_allclose(after.mean[10:] - estimate.mean[10:], error[9:], atol=1e-12)
    turn = Rotation.from_quat(estimate.mean[6:10], scalar_first=True).inv() * Rotation.from_quat(
        after.mean[6:10], scalar_first=True
    )
    np.testing.assert_allclose(turn.as_rotvec(), error[6:9], atol=1e-12)
    np.testing.assert_allclose(after.covariance, covariance, atol=1e-12)
    assert np.array_equal(after.covariance, after.covariance.T)
    assert distance == pytest.approx(nis, rel=1e-9)


def test_attitudes_across_half_a_turn_of_yaw_are_neighbours(estimate: Estimate) -> None:
    mean = estimate.mean.copy()
    mean[6:10] = Rotation.from_euler("Z", 179, degrees=True).as_quat(scalar_first=True)
    residual = innovation(SensorName.ATTITUDE, mean, np.radians([0.0, 0.0, -179.0]))
    np.testing.assert_allclose(np.degrees(residual), [0.0, 0.0, 2.0], atol=1e-12)


def test_a_sample_outside_the_gate_changes_nothing(estimate: Estimate) -> None:
    _, distance = update(estimate, SensorName.POSITION, SAMPLE, R, 1e9)
    after, same = update(estimate, SensorName.POSITION, SAMPLE, R, 0.999 * distance)
    assert after is estimate
    assert same == distance
    assert update(estimate, SensorName.POSITION, SAMPLE, R, 1.001 * distance)[0] is not estimate


@pytest.mark.parametrize("name", list(SensorName))
def test_doubt_lets_any_sample_pass_and_keeps_the_mean(name: SensorName, estimate: Estimate) -> None:
    far = np.array([0.4, 0.3, -2.0]) if name is SensorName.ATTITUDE else np.array([500.0, -300.0, 200.0])
    widened = inflate(estimate, name, far, 2.0)
    assert np.array_equal(widened.mean, estimate.mean)
    assert np.linalg.eigvalsh(widened.covariance).min() > -1e-9
    after, distance = update(widened, name, far, R, 3.0)
    assert distance < 3.0
    left = innovation(name, after.mean, far)
    assert np.linalg.norm(left) < 0.1 * np.linalg.norm(innovation(name, estimate.mean, far)) + 0.1


@pytest.mark.parametrize(
    ("name", "seen", "leading"),
    [
        (SensorName.POSITION, [0], [3]),
        (SensorName.VELOCITY, [3], []),
        (SensorName.ATTITUDE, [6], [9, 12]),
        (SensorName.RATES, [9, 12], []),
    ],
)
def test_inflation_includes_the_state_that_misled(
    name: SensorName, seen: list[int], leading: list[int], estimate: Estimate
) -> None:
    """The variance of a rate of change grows by the square of the innovation over the time it took to come about."""
    far = np.array([0.4, 0.3, -2.0])
    squares = np.square(innovation(name, estimate.mean, far))
    expected = np.zeros(15)
    for start, share in [*((i, 1.0) for i in seen), *((i, 0.25) for i in leading)]:
        expected[start : start + 3] = share * squares
    added = inflate(estimate, name, far, 2.0).covariance - estimate.covariance
    np.testing.assert_allclose(added, np.diag(expected), atol=1e-12)


means = st.integers(0, 2**32 - 1).map(
    lambda seed: np.concatenate(
        [
            (rng := np.random.default_rng(seed)).normal(size=6),
            Rotation.random(rng=rng).as_quat(scalar_first=True),
            rng.normal(size=6),
        ]
    )
)
errors = st.lists(st.floats(-1.7, 1.7), min_size=15, max_size=15).map(np.array)


@given(mean=means, error=errors)
def test_the_difference_is_the_error_that_was_applied(mean: np.ndarray, error: np.ndarray) -> None:
    moved = retract(mean, error)
    np.testing.assert_allclose(difference(moved, mean), error, atol=1e-12)
    assert np.linalg.norm(moved[6:10]) == pytest.approx(1.0, abs=1e-15)


def test_an_attitude_error_turns_the_body_about_its_own_axes() -> None:
    mean = np.zeros(16)
    error = np.zeros(15)
    mean[6:10] = Rotation.from_euler("Z", 90, degrees=True).as_quat(scalar_first=True)
    error[6] = np.radians(10.0)  # about body x, which points along world y
    expected = Rotation.from_rotvec([0.0, np.radians(10.0), 0.0]) * Rotation.from_quat(mean[6:10], scalar_first=True)
    result = Rotation.from_quat(retract(mean, error)[6:10], scalar_first=True)
    assert (result * expected.inv()).magnitude() < 1e-12
