"""The disturbance observer: the Kalman filter's gains, its answer to steps, noise, frames and limits."""

from __future__ import annotations

import math

import numpy as np
import pytest

from quadsim.mpc.estimate.observer import DisturbanceObserver, ObserverSettings, observer_gain, thrust_axis
from quadsim.rotation import body_to_euler_rates, body_to_world
from quadsim.state import EULER, EULER_RATE, VELOCITY, Array, make_state

PERIOD = 0.05
LEVEL = make_state()


def answer(settings: ObserverSettings, pushed: Array, periods: int) -> Array:
    """Estimates (periods, 6) for a level vehicle that a constant disturbance (6,) moves as it would."""
    observer = DisturbanceObserver(settings, PERIOD)
    estimates = np.empty((periods, 6))
    for k in range(periods):
        measured = LEVEL.copy()
        measured[[*VELOCITY, *EULER_RATE]] = PERIOD * (pushed - observer.estimate)
        observer.update(measured, LEVEL)
        estimates[k] = observer.estimate
    return estimates


# Gains


def test_gains_are_those_the_filters_covariance_recursion_converges_to() -> None:
    noise, walk, change = 0.07, 0.05, 0.2
    A, C, P = np.array([[1.0, PERIOD], [0.0, 1.0]]), np.array([1.0, 0.0]), np.eye(2)
    K = np.zeros(2)
    for _ in range(5000):
        P = A @ P @ A.T + np.diag([walk**2, change**2])
        K = P @ C / (C @ P @ C + noise**2)
        P = P - np.outer(K, C @ P)
    np.testing.assert_allclose(observer_gain(PERIOD, noise=noise, walk=walk, change=change), K, rtol=1e-6)


def test_gains_know_only_ratios() -> None:
    once = observer_gain(PERIOD, noise=0.07, walk=0.05, change=0.2)
    assert observer_gain(PERIOD, noise=0.7, walk=0.5, change=2.0) == pytest.approx(once, rel=1e-9)


def test_gain_of_the_disturbance_is_larger_the_faster_it_changes_and_the_smaller_the_noise() -> None:
    _, gain = observer_gain(PERIOD, noise=0.07, walk=0.05, change=0.2)
    assert observer_gain(PERIOD, noise=0.07, walk=0.05, change=0.3)[1] > gain
    assert observer_gain(PERIOD, noise=0.14, walk=0.05, change=0.2)[1] < gain
    assert observer_gain(PERIOD, noise=0.07, walk=0.10, change=0.2)[1] < gain


# Steps


def test_constant_disturbance_is_found_at_the_rate_of_the_gain() -> None:
    settings = ObserverSettings()
    pushed = np.array([0.4, -0.3, 1.0, 2.0, -1.0, 0.5])
    estimates = answer(settings, pushed, 200)
    doubled = math.sqrt(2.0)
    force = observer_gain(PERIOD, noise=doubled * 0.05, walk=0.05, change=settings.force_walk)[1]
    torque = observer_gain(PERIOD, noise=doubled * 0.05, walk=0.05, change=settings.torque_walk)[1]
    left = 1.0 - PERIOD * np.repeat([force, torque], 3)
    expected = pushed * (1.0 - left ** np.arange(1, 201)[:, None])
    np.testing.assert_allclose(estimates, expected, rtol=1e-9)
    np.testing.assert_allclose(estimates[-1], pushed, rtol=1e-3)


def test_defaults_find_nine_tenths_in_the_time_that_they_claim() -> None:
    estimates = answer(ObserverSettings(), np.ones(6), 200)
    times = PERIOD * (1 + np.argmax(estimates >= 0.9, axis=0))
    np.testing.assert_allclose(times, [2.4, 2.4, 2.4, 1.25, 1.25, 1.25])


def test_expected_motion_leaves_the_estimate_unchanged() -> None:
    observer = DisturbanceObserver(ObserverSettings(), PERIOD)
    state = np.arange(12.0) / 10.0
    observer.update(state, state)
    np.testing.assert_array_equal(observer.estimate, np.zeros(6))


# Noise, frames, limits


def test_noise_of_the_stated_size_moves_the_estimate_by_little() -> None:
    """d(k+1) = d(k) + g (n(k+1) - n(k) - tau d(k)): with p = 1 - g tau its variance is 2 g^2 sigma^2 / (1 + p)."""
    rng = np.random.default_rng(0)
    settings = ObserverSettings()
    observer = DisturbanceObserver(settings, PERIOD)
    moving, noise = [*VELOCITY, *EULER_RATE], settings.velocity_noise
    assert settings.rate_noise == noise
    before, estimates = LEVEL, np.empty((20_000, 6))
    for k in range(len(estimates)):
        measured = LEVEL.copy()
        measured[moving] = noise * rng.normal(size=6)
        expected = before.copy()
        expected[moving] += PERIOD * observer.estimate
        observer.update(measured, expected)
        before, estimates[k] = measured, observer.estimate
    doubled = math.sqrt(2.0)
    gains = [
        observer_gain(PERIOD, noise=doubled * noise, walk=0.05, change=change)[1]
        for change in (settings.force_walk, settings.torque_walk)
    ]
    g = np.repeat(gains, 3)
    stationary = np.sqrt(2.0 * g**2 * noise**2 / (2.0 - g * PERIOD))
    np.testing.assert_allclose(estimates[500:].std(axis=0), stationary, rtol=0.1)


def test_torque_is_about_the_bodys_axes_at_any_attitude() -> None:
    euler = np.array([0.4, -0.5, 2.0])
    before, after = make_state(), make_state()
    before[list(EULER)] = after[list(EULER)] = euler
    before[list(EULER_RATE)] = body_to_euler_rates(euler, np.zeros(3))
    after[list(EULER_RATE)] = body_to_euler_rates(euler, np.array([0.0, 0.01, 0.0]))
    observer = DisturbanceObserver(ObserverSettings(), PERIOD)
    observer.update(after, before)
    assert observer.estimate[4] > 0.0
    np.testing.assert_allclose(np.delete(observer.estimate, 4), 0.0, atol=1e-12)


def test_thrust_that_is_other_than_believed_pushes_along_its_axis() -> None:
    """However the vehicle is tilted: what a wrong mass does is no force sideways."""
    euler = np.array([0.2, -0.3, 2.0])
    axis = body_to_world(euler)[:, 2]
    observer = DisturbanceObserver(ObserverSettings(), PERIOD)
    before = make_state(euler=(0.2, -0.3, 2.0))
    np.testing.assert_allclose(thrust_axis(before), axis, atol=1e-12)
    after = before.copy()
    after[list(VELOCITY)] += 0.01 * axis
    observer.update(after, before)
    assert observer.estimate[2] > 0.0
    np.testing.assert_allclose(np.delete(observer.estimate, 2), 0.0, atol=1e-12)


def test_a_lateral_force_is_estimated_in_world_axes() -> None:
    before = make_state(euler=(0.2, -0.3, 2.0))
    after = before.copy()
    after[list(VELOCITY)] += 0.01 * np.array([1.0, -2.0, 0.0])
    observer = DisturbanceObserver(ObserverSettings(), PERIOD)
    observer.update(after, before)
    np.testing.assert_allclose(observer.estimate[:3] / observer.estimate[0], [1.0, -2.0, 0.0], atol=1e-9)


def test_no_more_is_believed_than_the_largest() -> None:
    settings = ObserverSettings(largest_force=0.5, largest_torque=2.0)
    estimate = answer(settings, np.array([9.0, -9.0, 9.0, 90.0, -90.0, 90.0]), 400)[-1]
    np.testing.assert_array_equal(estimate, [0.5, -0.5, 0.5, 2.0, -2.0, 2.0])


def test_reset_forgets() -> None:
    observer = DisturbanceObserver(ObserverSettings(), PERIOD)
    observer.update(np.full(12, 0.1), LEVEL)
    assert observer.estimate.any()
    observer.reset()
    assert not observer.estimate.any()
