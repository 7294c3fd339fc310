"""The observer of changing forces: exact on ramps, and the drag that it fits to them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from mpc.baselines.attitude import hat
from mpc.disturbance import RampObserver, RampSettings
from quadsim.state import Array
from quadsim.vehicle import Vehicle

PERIOD = 0.02
Force = Callable[[float, Array, Array], Array]
"""Of time, attitude (3, 3) and velocity (3,): a disturbing acceleration, world."""


def fly(
    vehicle: Vehicle, observer: RampObserver, force: Force, angular: Array, periods: int, *, lag: float = 0.0
) -> list[tuple[float, Array, Array]]:
    """A body under commands that shake it, with exact integration; instants, attitudes and velocities measured."""
    J, g, hover = np.array(vehicle.inertia), np.array([0.0, 0.0, vehicle.gravity]), vehicle.hover_speed
    spin = (vehicle.rotor_inertia or 0.0) * np.array(vehicle.rotor_spins)
    x = np.concatenate([np.eye(3).ravel(), [2.0, -1.0, 0.5], [0.1, -0.2, 0.3], np.full(4, hover)])
    shake = np.array([[1, -1, 1, -1], [1, 0, -1, 0], [0, 1, 0, -1]]) * 0.03 * hover
    seen, speeds = [], np.full(4, hover)
    for k in range(periods):
        time, R, v = k * PERIOD, x[:9].reshape(3, 3), x[9:12]
        observer.update(time, v, R, x[12:15], speeds)
        seen.append((time, R.copy(), v.copy()))
        speeds = hover + shake.T @ np.sin([3.0 * time, 5.0 * time, 4.0 * time + 1.0])

        def slope(t: float, x: Array, speeds: Array = speeds) -> Array:
            R, v, Omega = x[:9].reshape(3, 3), x[9:12], x[12:15]
            rotors = x[15:] if lag else speeds
            thrust, *torque = vehicle.allocation @ rotors**2
            dv = thrust / vehicle.mass * R[:, 2] - g + force(t, R, v)
            spinning = (speeds - x[15:]) / lag if lag else np.zeros(4)
            torque[2] += spin @ spinning
            momentum = J * Omega - [0.0, 0.0, spin @ rotors]
            turning = (torque - np.cross(Omega, momentum)) / J + angular
            return np.concatenate([(R @ hat(Omega)).ravel(), dv, turning, spinning])

        x = solve_ivp(slope, (time, time + PERIOD), x, rtol=1e-9, atol=1e-10).y[:, -1]
    return seen


@pytest.mark.parametrize("lag", [0.0, 0.03])
def test_a_force_that_changes_steadily_is_foreseen_without_lag(vehicle: Vehicle, lag: float) -> None:
    start, change = np.array([0.5, -0.3, 0.2]), np.array([1.0, 2.0, -0.5])
    angular = np.array([0.0, 0.0, 0.0])
    observer = RampObserver(RampSettings(rotor_lag=lag), vehicle, PERIOD)
    observer.reset(np.full(4, vehicle.hover_speed))
    seen = fly(vehicle, observer, lambda t, R, v: start + t * change, angular, 60, lag=lag)
    acceleration, rate, turning = observer.foreseen(0.1)
    np.testing.assert_allclose(acceleration, start + (seen[-1][0] + 0.1) * change, atol=0.01)
    np.testing.assert_allclose(rate, change, atol=0.05)
    np.testing.assert_allclose(turning, 0.0, atol=0.02)


def test_torque_that_spins_the_rotors_up_is_no_disturbance(vehicle: Vehicle) -> None:
    lag, heavy = 0.03, replace(vehicle, rotor_inertia=0.005 * vehicle.inertia[2])
    settings, angular = RampSettings(rotor_lag=lag), np.zeros(3)
    result = []
    for modelled in (heavy, vehicle):
        observer = RampObserver(settings, modelled, PERIOD)
        observer.reset(np.full(4, vehicle.hover_speed))
        fly(heavy, observer, lambda t, R, v: np.zeros(3), angular, 60, lag=lag)
        result.append(np.abs(observer.foreseen(0.0)[2]).max())
    assert result[0] < 0.02
    assert result[1] > 0.2


def test_rotors_that_lag_after_a_large_step_are_no_disturbance(vehicle: Vehicle) -> None:
    lag, hover, commanded = 0.03, vehicle.hover_speed, 0.7 * vehicle.hover_speed
    observer = RampObserver(RampSettings(rotor_lag=lag), vehicle, PERIOD)
    observer.reset(np.full(4, hover))

    def climb(t: float, _: Array) -> list[float]:
        rotors = commanded + (hover - commanded) * np.exp(-t / lag)
        return [vehicle.gravity * ((rotors / hover) ** 2 - 1.0)]

    times = PERIOD * np.arange(10)
    velocities = solve_ivp(climb, (0.0, times[-1]), [0.0], t_eval=times, rtol=1e-10, atol=1e-12).y[0]
    for time, velocity in zip(times, velocities, strict=True):
        measured = np.array([0.0, 0.0, velocity])
        observer.update(float(time), measured, np.eye(3), np.zeros(3), np.full(4, commanded if time else hover))
        np.testing.assert_allclose(observer.foreseen(0.0)[0], 0.0, atol=1e-4)


def test_a_constant_torque_is_estimated(vehicle: Vehicle) -> None:
    angular = np.array([0.2, -0.1, 0.15])
    observer = RampObserver(RampSettings(), vehicle, PERIOD)
    fly(vehicle, observer, lambda t, R, v: np.zeros(3), angular, 60)
    np.testing.assert_allclose(observer.foreseen(0.0)[2], angular, atol=0.01)
    assert np.abs(observer.foreseen(0.0)[0]).max() < 0.02


def test_known_drag_is_no_disturbance_and_unknown_drag_is_fitted(vehicle: Vehicle) -> None:
    linear, quadratic = np.array([0.6, 0.4, 0.2]), np.array([0.05, 0.1, 0.0])

    def drag(t: float, R: Array, v: Array) -> Array:
        v_b = R.T @ v
        return -R @ ((linear + quadratic * np.abs(v_b)) * v_b)

    knowing = RampObserver(RampSettings(), vehicle, PERIOD, drag=linear, quadratic_drag=quadratic)
    fly(vehicle, knowing, drag, np.zeros(3), 60)
    np.testing.assert_allclose(knowing.foreseen(0.0)[0], 0.0, atol=2e-3)
    fitting = RampObserver(RampSettings(), vehicle, PERIOD)
    quadratic[:] = 0.0
    seen = fly(vehicle, fitting, drag, np.zeros(3), 60)
    time, R, v = seen[-1]
    np.testing.assert_allclose(fitting.foreseen(0.0)[0], drag(time, R, v), rtol=0.02, atol=0.02)
    assert (fitting.drag <= linear).all()
    assert (fitting.drag > 0.3 * linear)[:2].all()


def test_estimates_stay_within_their_limits_and_gaps_teach_nothing(vehicle: Vehicle) -> None:
    observer = RampObserver(RampSettings(largest_force=0.5, largest_torque=0.1), vehicle, PERIOD)
    hover, rest = np.full(4, vehicle.hover_speed), np.zeros(3)
    for k in range(20):
        observer.update(k * PERIOD, np.array([k * PERIOD * 5.0, 0.0, 0.0]), np.eye(3), rest, hover)
    np.testing.assert_allclose(observer.foreseen(0.3)[0], [0.5, 0.0, 0.0], atol=1e-9)
    observer.reset(hover)
    observer.update(0.0, rest, np.eye(3), rest, hover)
    observer.update(5.0 * PERIOD, np.ones(3), np.eye(3), rest, hover)
    assert not any(each.any() for each in observer.foreseen(0.0))
