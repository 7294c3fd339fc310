"""The disturbance observer: the Kalman filter's gains, its answer to steps, noise, frames and limits."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy_preparation import NumpyPreparation
from support import robust_table

from quadsim.controller import StepInputs
from quadsim.mpc.estimate.observer import ObserverSettings, observer_gain
from quadsim.mpc.laws.parts.preparation import RobustPreparation
from quadsim.rotation import body_to_euler_rates, body_to_world
from quadsim.state import EULER, EULER_RATE, VELOCITY, Array, make_state
from quadsim.vehicle import Vehicle

PERIOD = 0.05
LEVEL = make_state()


class Observed:
    """The observer of a robust law in C, at hover, told how states differ from those that its model expects."""

    def __init__(self, vehicle: Vehicle, settings: ObserverSettings | None = None) -> None:
        table = robust_table(offset_free=settings or ObserverSettings())
        self._preparation = RobustPreparation(vehicle, table.problem(vehicle, PERIOD), table)
        self._twin = NumpyPreparation(vehicle, self._preparation.problem, table)
        self._hover = vehicle.hover_speeds
        self.estimate = np.zeros(6)

    def update(self, surprise: Array, state: Array = LEVEL) -> None:
        """A period from a state (12,) on, whose end is off what is expected by this.

        Args:
            surprise: (6,) velocities along world x, y and the thrust [m/s], body rates [rad/s].
            state: the first one.
        """
        self._twin.estimate = self.estimate
        measured = self._twin.after(PERIOD, state, self._hover, self._hover)
        euler = measured[list(EULER)]
        measured[list(VELOCITY)] += surprise[2] * body_to_world(euler)[:, 2] + [*surprise[:2], 0.0]
        measured[list(EULER_RATE)] += body_to_euler_rates(euler, surprise[3:])
        self._preparation.reset(self._hover)
        self._preparation.adopt(None, self.estimate)
        for time, seen in ((0.0, state), (PERIOD, measured)):
            self._preparation.prepare(StepInputs(time=time), seen, np.zeros((50, 4)), self._hover)
        estimate = self._preparation.memory.estimate
        assert estimate is not None
        self.estimate = estimate


def answer(vehicle: Vehicle, settings: ObserverSettings, pushed: Array, periods: int) -> Array:
    """Estimates (periods, 6) for a level vehicle that a constant disturbance (6,) moves as it would."""
    observer = Observed(vehicle, settings)
    estimates = np.empty((periods, 6))
    for k in range(periods):
        observer.update(PERIOD * (pushed - observer.estimate))
        estimates[k] = observer.estimate
    return estimates


# Gains


def test_gains_are_those_the_filters_covariance_recursion_converges_to() -> None:
    noise = 0.07
    walk = 0.05
    change = 0.2
    A = np.array([[1.0, PERIOD], [0.0, 1.0]])
    C = np.array([1.0, 0.0])
    P = np.eye(2)
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


def test_constant_disturbance_is_found_at_the_rate_of_the_gain(vehicle: Vehicle) -> None:
    settings = ObserverSettings()
    pushed = np.array([0.4, -0.3, 1.0, 2.0, -1.0, 0.5])
    estimates = answer(vehicle, settings, pushed, 200)
    doubled = math.sqrt(2.0)
    force = observer_gain(PERIOD, noise=doubled * 0.05, walk=0.05, change=settings.force_walk)[1]
    torque = observer_gain(PERIOD, noise=doubled * 0.05, walk=0.05, change=settings.torque_walk)[1]
    left = 1.0 - PERIOD * np.repeat([force, torque], 3)
    expected = pushed * (1.0 - left ** np.arange(1, 201)[:, None])
    np.testing.assert_allclose(estimates, expected, rtol=1e-9)
    np.testing.assert_allclose(estimates[-1], pushed, rtol=1e-3)


def test_defaults_find_nine_tenths_in_the_time_that_they_claim(vehicle: Vehicle) -> None:
    estimates = answer(vehicle, ObserverSettings(), np.ones(6), 60)
    times = PERIOD * (1 + np.argmax(estimates >= 0.9, axis=0))
    np.testing.assert_allclose(times, [2.4, 2.4, 2.4, 1.25, 1.25, 1.25])


def test_expected_motion_leaves_the_estimate_unchanged(vehicle: Vehicle) -> None:
    observer = Observed(vehicle)
    observer.update(np.zeros(6), np.arange(12.0) / 10.0)
    np.testing.assert_allclose(observer.estimate, 0.0, atol=1e-12)


# Noise, frames, limits


def test_noise_of_the_stated_size_moves_the_estimate_by_little(vehicle: Vehicle) -> None:
    """d(k+1) = d(k) + g (n(k+1) - n(k) - tau d(k)): with p = 1 - g tau its variance is 2 g^2 sigma^2 / (1 + p)."""
    rng = np.random.default_rng(0)
    settings = ObserverSettings()
    observer = Observed(vehicle, settings)
    noise = settings.velocity_noise
    assert settings.rate_noise == noise
    before = np.zeros(6)
    estimates = np.empty((1200, 6))
    for k in range(len(estimates)):
        measured = noise * rng.normal(size=6)
        observer.update(measured - before - PERIOD * observer.estimate)
        before = measured
        estimates[k] = observer.estimate
    doubled = math.sqrt(2.0)
    gains = [
        observer_gain(PERIOD, noise=doubled * noise, walk=0.05, change=change)[1]
        for change in (settings.force_walk, settings.torque_walk)
    ]
    g = np.repeat(gains, 3)
    stationary = np.sqrt(2.0 * g**2 * noise**2 / (2.0 - g * PERIOD))
    np.testing.assert_allclose(estimates[200:].std(axis=0), stationary, rtol=0.2)


@pytest.mark.parametrize("component", range(6))
def test_frames_are_those_of_the_world_the_thrust_and_the_body_at_any_attitude(
    vehicle: Vehicle, component: int
) -> None:
    """What a wrong mass does is no force sideways, however the vehicle is tilted, and torques are about body axes."""
    observer = Observed(vehicle)
    surprise = np.zeros(6)
    surprise[component] = 0.01
    observer.update(surprise, make_state(euler=(0.4, -0.5, 2.0)))
    assert observer.estimate[component] > 0.0
    np.testing.assert_allclose(np.delete(observer.estimate, component), 0.0, atol=1e-12)


def test_estimates_are_clipped_to_the_largest(vehicle: Vehicle) -> None:
    settings = ObserverSettings(largest_force=0.5, largest_torque=2.0)
    estimate = answer(vehicle, settings, np.array([9.0, -9.0, 9.0, 90.0, -90.0, 90.0]), 100)[-1]
    np.testing.assert_array_equal(estimate, [0.5, -0.5, 0.5, 2.0, -2.0, 2.0])
