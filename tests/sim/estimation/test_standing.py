"""On the ground: the closed form of standing, and the filter from standing to flight."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy_filter import (
    STILL_RATE,
    STILL_TIME,
    STILL_VELOCITY,
    Estimate,
    MotionModel,
    drive,
    lifts,
    motion_model,
    stand,
)

from quadsim.sim.estimator import EstimatorSettings
from quadsim.sim.sensing import Sensor, SensorName
from quadsim.state import Array
from quadsim.vehicle import Vehicle

SETTINGS = EstimatorSettings(acceleration_noise=0.1, angular_acceleration_noise=0.5, gyro_bias_walk=math.degrees(1e-3))
SENSORS = {
    SensorName.POSITION: Sensor(rate=100.0, noise=0.01),
    SensorName.ATTITUDE: Sensor(rate=100.0, noise=math.degrees(0.005)),
    SensorName.RATES: Sensor(rate=500.0, noise=math.degrees(0.0075)),
}
REST = 900
"""Steps on the ground in the flights below."""
FLIGHT = 600


@pytest.fixture
def model(vehicle: Vehicle) -> MotionModel:
    return motion_model(vehicle, SETTINGS)


@pytest.fixture
def estimate() -> Estimate:
    rng = np.random.default_rng(2)
    factor = rng.normal(size=(15, 15))
    return Estimate(mean=rng.normal(size=16), covariance=factor @ factor.T)


@pytest.fixture(scope="module")
def takeoff(vehicle: Vehicle, simulate_motion: Callable[..., Any]) -> Any:
    """At rest with half of the thrust to hover, then up with a tenth more than that."""
    up = np.full((FLIGHT, 4), math.sqrt(1.1) * vehicle.hover_speed)
    flight = simulate_motion(SETTINGS, up, seeds=3, rng=np.random.default_rng(4))
    ground = np.repeat(flight.physics[:, :1], REST, axis=1)
    physics = np.concatenate([ground, flight.physics], axis=1)
    return replace(flight, physics=physics, commands=np.concatenate([np.full((REST, 4), 0.7 * up[0, 0]), up]))


def test_who_stands_keeps_the_pose_and_has_no_motion(model: MotionModel, estimate: Estimate) -> None:
    h = 0.004
    after = stand(model, estimate, h)
    retained = [0, 1, 2, 6, 7, 8, 9, 13, 14, 15]
    assert np.array_equal(after.mean[retained], estimate.mean[retained])
    assert np.array_equal(np.delete(after.mean, retained), np.zeros(6))

    pose = [0, 1, 2, 6, 7, 8, 12, 13, 14]
    motion = [3, 4, 5, 9, 10, 11]
    assert np.array_equal(
        after.covariance[np.ix_(motion, motion)], np.diag(np.repeat([STILL_VELOCITY**2, STILL_RATE**2], 3))
    )
    assert not after.covariance[np.ix_(pose, motion)].any()
    walks = [STILL_VELOCITY * math.sqrt(STILL_TIME * h), STILL_RATE * math.sqrt(STILL_TIME * h), 1e-3 * math.sqrt(h)]
    grown = (after.covariance - estimate.covariance)[np.ix_(pose, pose)]
    np.testing.assert_allclose(grown, np.diag(np.repeat(np.square(walks), 3)), rtol=1e-6, atol=1e-14)


def test_standing_is_the_same_in_one_step_and_in_many(model: MotionModel, estimate: Estimate) -> None:
    once = stand(model, estimate, 0.5)
    often = estimate
    for _ in range(50):
        often = stand(model, often, 0.01)
    assert np.array_equal(often.mean, once.mean)
    np.testing.assert_allclose(often.covariance, once.covariance, rtol=1e-12, atol=1e-12)


def test_rotors_lift_what_they_could_hold_in_hover(vehicle: Vehicle, model: MotionModel) -> None:
    assert not lifts(model, drive(model, np.full(4, 0.999 * vehicle.hover_speed)))
    assert lifts(model, drive(model, np.full(4, 1.001 * vehicle.hover_speed)))


def test_it_is_assumed_to_stand_and_the_gyros_bias_is_found(takeoff: Any, run_filter: Callable[..., Any]) -> None:
    assumed = replace(SETTINGS, initial_gyro_bias=2.0)
    for seed in range(3):
        filter_, errors, deviations, _ = run_filter(takeoff, SENSORS, assumed, seed=seed, standing=range(REST))
        ground = slice(1, REST // 50)
        assert np.abs(errors[ground, 0:3]).max() < 0.02
        assert np.abs(errors[ground, 3:6]).max() < 1e-12  # a sample of position shows no motion
        assert np.degrees(np.abs(errors[REST // 50, 12:15])).max() < 0.15
        assert np.all(np.abs(errors[ground.stop :]) < 5.0 * deviations[ground.stop :])  # and in flight
        assert sum(tally.rejected for tally in filter_.tallies.values()) < 5


def test_without_the_land_detector_the_estimate_falls(takeoff: Any, run_filter: Callable[..., Any]) -> None:
    filter_, errors, _, _ = run_filter(takeoff, SENSORS, SETTINGS, seed=0)
    assert errors[REST // 50 - 1, 5] > 2.0
    assert filter_.tallies[SensorName.POSITION].rejected > 50


def test_thrust_beyond_the_weight_lifts_before_a_detector_notices(takeoff: Any, run_filter: Callable[..., Any]) -> None:
    prompt, late = (run_filter(takeoff, SENSORS, SETTINGS, seed=0, standing=range(REST + more))[1] for more in (0, 200))
    assert np.array_equal(prompt, late)


def test_at_a_late_horizon_each_step_knows_whether_it_stood(takeoff: Any, run_filter: Callable[..., Any]) -> None:
    """The same samples with and without a horizon, which standing and flying reach late; then the way back."""
    still = np.repeat(takeoff.physics[:, -1:], REST, axis=1)
    still[:, :, 8:] = 0.0
    landing = replace(
        takeoff,
        physics=np.concatenate([takeoff.physics[:, REST:], still], axis=1),
        commands=np.concatenate([takeoff.commands[REST:], takeoff.commands[:REST]]),
    )
    far = Sensor(rate=0.1, noise=1e6, delay=0.2)
    for motion, standing in ((takeoff, range(REST)), (landing, range(FLIGHT, FLIGHT + REST))):
        result: list[Array] = []
        for horizon in (replace(far, delay=0.0), far):
            _, errors, deviations, _ = run_filter(
                motion, SENSORS | {SensorName.VELOCITY: horizon}, SETTINGS, seed=1, standing=standing
            )
            result.append(np.hstack([errors, deviations]))
        np.testing.assert_allclose(result[1], result[0], atol=1e-9)
        stood = np.all(result[0][:, 3:6] == 0.0, axis=1)
        assert np.array_equal(np.flatnonzero(stood), np.arange(standing.start, standing.stop, 50) // 50)


def test_estimates_do_not_depend_on_how_time_on_the_ground_is_cut(takeoff: Any, run_filter: Callable[..., Any]) -> None:
    late = {name: replace(sensor, delay=0.03) for name, sensor in SENSORS.items()}
    whole, cut = (
        run_filter(takeoff, late, SETTINGS, seed=0, chunk=chunk, standing=range(REST))[1] for chunk in (300, 12)
    )
    assert np.array_equal(cut[24::25], whole)
