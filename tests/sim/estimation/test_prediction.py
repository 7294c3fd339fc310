"""The prediction: its mean against MuJoCo, its Jacobian against finite differences, its noise against Van Loan."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy_filter import (
    Estimate,
    MotionModel,
    difference,
    drive,
    motion_model,
    predict_estimate,
    retract,
)
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from quadsim.sim.estimator import EstimatorSettings
from quadsim.sim.plant import Plant
from quadsim.state import Array, make_state
from quadsim.vehicle import Vehicle

QUIET = EstimatorSettings(acceleration_noise=0.0, angular_acceleration_noise=0.0, gyro_bias_walk=0.0)


@pytest.fixture
def model(vehicle: Vehicle) -> MotionModel:
    return motion_model(vehicle, QUIET)


def tumbling(rng: np.random.Generator) -> Array:
    quaternion = Rotation.random(rng=rng).as_quat(scalar_first=True)
    return np.concatenate([rng.normal(size=6), quaternion, 2.0 * rng.normal(size=3), 0.1 * rng.normal(size=3)])


def mean_of(physics: Array) -> Array:
    return np.concatenate([physics[1:4], physics[8:11], physics[4:8], physics[11:14], np.zeros(3)])


def test_the_mean_follows_the_plant_to_second_order(vehicle: Vehicle, model: MotionModel) -> None:
    speeds = vehicle.hover_speed * np.array([1.02, 1.01, 0.99, 0.97])
    start = make_state(euler=(0.5, -0.7, 2.0))
    with Plant(vehicle) as plant:
        plant.reset(start, speeds)
        first = mean_of(plant.physics)
        plant.advance(speeds, 400)
        last = mean_of(plant.physics)
    errors = []
    for h in (0.02, 0.01, 0.005):
        estimate = Estimate(mean=first, covariance=np.eye(15))
        for _ in range(round(0.4 / h)):
            estimate = predict_estimate(model, estimate, drive(model, speeds), h)
        errors.append(np.abs(difference(estimate.mean, last)).max())
    assert errors[-1] < 2e-4
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2.0, abs=0.2)
    assert np.log2(errors[1] / errors[2]) == pytest.approx(2.0, abs=0.2)


def test_the_covariance_moves_by_the_jacobian_of_the_mean(vehicle: Vehicle, model: MotionModel) -> None:
    rng = np.random.default_rng(0)
    driven = drive(model, vehicle.hover_speed * np.array([1.2, 1.0, 0.9, 1.0]))
    h = 0.005
    step = 1e-6
    for _ in range(5):
        mean = tumbling(rng)
        after = predict_estimate(model, Estimate(mean=mean, covariance=np.eye(15)), driven, h)
        J = np.empty((15, 15))
        for i in range(15):
            ends = [
                predict_estimate(
                    model, Estimate(mean=retract(mean, s * step * np.eye(15)[i]), covariance=np.eye(15)), driven, h
                )
                for s in (1.0, -1.0)
            ]
            J[:, i] = difference(ends[0].mean, ends[1].mean) / (2.0 * step)
        # Both drop terms of third order, with constants of the thrust (10 m/s^2) and the squared rates.
        np.testing.assert_allclose(after.covariance, J @ J.T, atol=3e-5)
        assert np.abs(after.covariance - np.eye(15)).max() > 1e-2  # what the step changes is far more


def test_the_noise_that_gathers_is_van_loans(vehicle: Vehicle) -> None:
    settings = EstimatorSettings(
        acceleration_noise=0.3, angular_acceleration_noise=2.0, gyro_bias_walk=math.degrees(0.1)
    )
    model = motion_model(vehicle, settings)
    rest = np.zeros(16)
    rest[6] = 1.0
    h = 0.01
    result = predict_estimate(
        model, Estimate(mean=rest, covariance=np.zeros((15, 15))), drive(model, np.zeros(4)), h
    ).covariance
    # Without thrust at rest: two double integrators and a walk.  Van Loan, IEEE TAC 23 (1978).
    A = np.zeros((15, 15))
    Q = np.zeros((15, 15))
    A[0:3, 3:6] = A[6:9, 9:12] = np.eye(3)
    Q[3:6, 3:6] = 0.09 * np.eye(3)
    Q[9:12, 9:12] = 4.0 * np.eye(3)
    Q[12:, 12:] = 0.01 * np.eye(3)
    both = expm(h * np.block([[-A, Q], [np.zeros((15, 15)), A.T]]))
    np.testing.assert_allclose(result, both[15:, 15:].T @ both[:15, 15:], rtol=1e-9, atol=1e-18)


def test_rotors_do_not_turn_backwards(vehicle: Vehicle, model: MotionModel) -> None:
    assert drive(model, np.full(4, -100.0)).acceleration == 0.0
    hover = drive(model, np.full(4, vehicle.hover_speed))
    assert hover.acceleration == pytest.approx(vehicle.gravity, rel=1e-12)
    assert hover.torque == pytest.approx((0.0, 0.0, 0.0), abs=1e-12)
