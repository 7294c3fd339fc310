"""The observer of changing forces: exact on ramps, and the drag that it fits to them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy_ramp import NumpyRamp
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from quadsim.mpc.estimate.disturbance import RampObserver, RampSettings
from quadsim.mpc.laws.parts.attitude import hat
from quadsim.state import Array
from quadsim.vehicle import Vehicle

PERIOD = 0.02
Force = Callable[[float, Array, Array], Array]
"""Of time, attitude (3, 3) and velocity (3,): a disturbing acceleration, world."""


def fly(
    vehicle: Vehicle,
    observer: RampObserver,
    force: Force,
    angular: Array,
    periods: int,
    *,
    lag: float = 0.0,
    scale: float = 1.0,
) -> list[tuple[float, Array, Array]]:
    """A body under commands that shake it, with exact integration; instants, attitudes and velocities measured."""
    J = np.array(vehicle.inertia)
    g = np.array([0.0, 0.0, vehicle.gravity])
    hover = vehicle.hover_speed
    spin = (vehicle.rotor_inertia or 0.0) * np.array(vehicle.rotor_spins)
    x = np.concatenate([np.eye(3).ravel(), [2.0, -1.0, 0.5], [0.1, -0.2, 0.3], np.full(4, hover)])
    shake = np.array([[1, -1, 1, -1], [1, 0, -1, 0], [0, 1, 0, -1]]) * 0.03 * hover
    seen = []
    speeds = np.full(4, hover)
    for k in range(periods):
        time = k * PERIOD
        R = x[:9].reshape(3, 3)
        v = x[9:12]
        observer.update(time, v, R, x[12:15], speeds)
        seen.append((time, R.copy(), v.copy()))
        speeds = hover + shake.T @ np.sin([3.0 * time, 5.0 * time, 4.0 * time + 1.0])

        def slope(t: float, x: Array, speeds: Array = speeds) -> Array:
            R = x[:9].reshape(3, 3)
            v = x[9:12]
            Omega = x[12:15]
            rotors = x[15:] if lag else speeds
            thrust, *torque = scale * vehicle.allocation @ rotors**2
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
    start = np.array([0.5, -0.3, 0.2])
    change = np.array([1.0, 2.0, -0.5])
    angular = np.array([0.0, 0.0, 0.0])
    observer = RampObserver(RampSettings(rotor_lag=lag), vehicle, PERIOD)
    observer.reset(np.full(4, vehicle.hover_speed))
    seen = fly(vehicle, observer, lambda t, R, v: start + t * change, angular, 60, lag=lag)
    acceleration, rate, turning = observer.foreseen(0.1)
    np.testing.assert_allclose(acceleration, start + (seen[-1][0] + 0.1) * change, atol=0.01)
    np.testing.assert_allclose(rate, change, atol=0.05)
    np.testing.assert_allclose(turning, 0.0, atol=0.02)


def test_torque_that_spins_the_rotors_up_is_no_disturbance(vehicle: Vehicle) -> None:
    lag = 0.03
    heavy = replace(vehicle, rotor_inertia=0.005 * vehicle.inertia[2])
    settings = RampSettings(rotor_lag=lag)
    angular = np.zeros(3)
    result = []
    for modelled in (heavy, vehicle):
        observer = RampObserver(settings, modelled, PERIOD)
        observer.reset(np.full(4, vehicle.hover_speed))
        fly(heavy, observer, lambda t, R, v: np.zeros(3), angular, 60, lag=lag)
        result.append(np.abs(observer.foreseen(0.0)[2]).max())
    assert result[0] < 0.02
    assert result[1] > 0.2


def test_rotors_that_lag_after_a_large_step_are_no_disturbance(vehicle: Vehicle) -> None:
    lag = 0.03
    hover = vehicle.hover_speed
    commanded = 0.7 * vehicle.hover_speed
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
    linear = np.array([0.6, 0.4, 0.2])
    quadratic = np.array([0.05, 0.1, 0.0])

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
    hover = np.full(4, vehicle.hover_speed)
    rest = np.zeros(3)
    for k in range(20):
        observer.update(k * PERIOD, np.array([k * PERIOD * 5.0, 0.0, 0.0]), np.eye(3), rest, hover)
    np.testing.assert_allclose(observer.foreseen(0.3)[0], [0.5, 0.0, 0.0], atol=1e-9)
    observer.reset(hover)
    observer.update(0.0, rest, np.eye(3), rest, hover)
    observer.update(5.0 * PERIOD, np.ones(3), np.eye(3), rest, hover)
    assert not any(each.any() for each in observer.foreseen(0.0))


SCALED = RampSettings(thrust_scale=True)


def tilted(degrees: float) -> Array:
    """Pitched forward, (3, 3)."""
    return Rotation.from_euler("Y", degrees, degrees=True).as_matrix()


def straight(
    observer: RampObserver, vehicle: Vehicle, tilt: float, thrust: float, scale: Callable[[float], float], force: Array
) -> None:
    """70 periods at a constant tilt [deg] and commanded thrust over weight, whose scale has this integral over time."""
    g = vehicle.gravity
    R = tilted(tilt)
    rest = np.zeros(3)
    rotors = np.full(4, vehicle.hover_speed * np.sqrt(thrust))
    command = thrust * vehicle.mass * g if observer.numbers.targets else rotors
    observer.reset(command)
    for k in range(70):
        t = k * PERIOD
        velocity = scale(t) * thrust * g * R[:, 2] + t * (force - [0.0, 0.0, g])
        observer.update(t, velocity, R, rest, command)


@pytest.mark.parametrize("thrust_lag", [None, 0.03])
@pytest.mark.parametrize(
    ("tilt", "thrust", "scale", "force"),
    [
        (0.0, 1.25, 0.8, [0.0, 0.0]),
        (30.0, 1.3, 0.8, [0.7, -0.4]),
        (45.0, 1.4, 1.0, [2.0, 1.0]),
        (60.0, 1.7, 1.2, [0, 0]),
    ],
)
def test_vertical_misfit_is_the_thrusts_and_horizontal_is_a_force(
    vehicle: Vehicle, thrust_lag: float | None, tilt: float, thrust: float, scale: float, force: list[float]
) -> None:
    observer = RampObserver(SCALED, vehicle, PERIOD, thrust_lag=thrust_lag)
    straight(observer, vehicle, tilt, thrust, lambda t: scale * t, np.array([*force, 0.0]))
    assert observer.thrust_scale == pytest.approx(scale, abs=1e-9)
    acceleration, change, turning = observer.foreseen(0.1)
    np.testing.assert_allclose(acceleration, [*force, 0.0], atol=1e-8)
    np.testing.assert_allclose(change, 0.0, atol=1e-8)
    np.testing.assert_array_equal([acceleration[2], change[2], *turning], 0.0)


def test_a_force_is_never_taken_for_thrust(vehicle: Vehicle) -> None:
    observer = RampObserver(SCALED, vehicle, PERIOD, thrust_lag=0.02)
    R = tilted(45.0)
    weight = vehicle.mass * vehicle.gravity
    observer.reset(weight)
    for k in range(20):
        velocity = k * PERIOD * (vehicle.gravity * R[:, 2] + [3.0, -2.0, -vehicle.gravity])
        observer.update(k * PERIOD, velocity, R, np.zeros(3), weight)
        assert observer.thrust_scale == pytest.approx(1.0, abs=1e-9)


def test_a_battery_that_runs_down_is_followed_without_lag(vehicle: Vehicle) -> None:
    observer = RampObserver(SCALED, vehicle, PERIOD, thrust_lag=0.0)
    straight(observer, vehicle, 20.0, 1.2, lambda t: 0.9 * t - 0.0005 * t**2, np.zeros(3))
    assert observer.thrust_scale == pytest.approx(0.9 - 0.001 * 69.5 * PERIOD, abs=1e-9)


@pytest.mark.parametrize("lag", [0.0, 0.03])
def test_rotors_that_all_give_less_are_found_while_they_turn_the_body(vehicle: Vehicle, lag: float) -> None:
    """Torques too are 80 % of the commanded ones, and count as such."""
    observer = RampObserver(RampSettings(thrust_scale=True, rotor_lag=lag), vehicle, PERIOD)
    fly(vehicle, observer, lambda t, R, v: np.array([0.5, -0.3, 0.0]), np.zeros(3), 60, lag=lag, scale=0.8)
    acceleration, _, turning = observer.foreseen(0.0)
    assert observer.thrust_scale == pytest.approx(0.8, abs=2e-3)
    np.testing.assert_allclose(acceleration, [0.5, -0.3, 0.0], atol=0.02)
    np.testing.assert_allclose(turning, 0.0, atol=0.02)


def test_thrust_that_lags_after_a_large_step_is_no_disturbance(vehicle: Vehicle) -> None:
    """At half the weight from hover, v' = -0.5 g (1 - exp(-t / lag))."""
    lag = 0.03
    g = vehicle.gravity
    weight = vehicle.mass * vehicle.gravity
    for settings in (SCALED, RampSettings()):
        observer = RampObserver(settings, vehicle, PERIOD, thrust_lag=lag)
        observer.reset(weight)
        for t in PERIOD * np.arange(20):
            velocity = np.array([0.0, 0.0, -0.5 * g * (t - lag * (1.0 - np.exp(-t / lag)))])
            observer.update(float(t), velocity, np.eye(3), np.zeros(3), 0.5 * weight if t else weight)
            assert observer.thrust_scale == pytest.approx(1.0, abs=1e-9)
            np.testing.assert_allclose(observer.foreseen(0.0)[0], 0.0, atol=1e-9)


def test_the_scale_holds_in_free_fall_and_upside_down(vehicle: Vehicle) -> None:
    observer = RampObserver(SCALED, vehicle, PERIOD, thrust_lag=0.0)
    weight = vehicle.mass * vehicle.gravity
    straight(observer, vehicle, 0.0, 1.2, lambda t: 0.8 * t - 0.001 * t**2, np.zeros(3))
    before = observer.thrust_scale
    for k, (tilt, thrust) in enumerate([(0.0, 0.1)] * 20 + [(180.0, 1.0)] * 20):
        velocity = np.array([0.0, 0.0, -3.0 * k * PERIOD])
        observer.update((70 + k) * PERIOD, velocity, tilted(tilt), np.zeros(3), thrust * weight)
    assert observer.thrust_scale == pytest.approx(before, abs=1e-4)


@pytest.mark.parametrize(("scale", "limit"), [(0.1, 0.3), (2.5, 1.7)])
def test_the_scale_stays_within_its_limits(vehicle: Vehicle, scale: float, limit: float) -> None:
    observer = RampObserver(SCALED, vehicle, PERIOD, thrust_lag=0.0)
    straight(observer, vehicle, 0.0, 1.0, lambda t: scale * t, np.zeros(3))
    assert observer.thrust_scale == pytest.approx(limit)


def test_scale_and_force_do_not_drift_in_a_long_hover_with_noise(vehicle: Vehicle) -> None:
    """A minute of the loop that they close, with wind and 80 % of the thrust, and noise of 2 cm/s."""
    rng = np.random.default_rng(2)
    lag = 0.03
    m = vehicle.mass
    g = vehicle.gravity
    observer = RampObserver(SCALED, vehicle, PERIOD, thrust_lag=lag)
    wind = np.array([1.5, -0.5, 0.0])
    velocity = np.zeros(3)
    thrust = m * g
    scales = []
    forces = []
    R = np.eye(3)
    command = m * g
    observer.reset(m * g)
    left = np.exp(-PERIOD / lag)
    for k in range(3000):
        seen = velocity + rng.normal(scale=0.02, size=3)
        observer.update(k * PERIOD, seen, R, np.zeros(3), command)
        force = observer.foreseen(0.5 * PERIOD)[0]
        kappa = observer.thrust_scale
        demanded = np.array([0.0, 0.0, g]) - seen - force
        axis = demanded / np.linalg.norm(demanded)
        before = R[:, 2]
        across = np.cross([0.0, 1.0, 0.0], axis) / np.linalg.norm(np.cross([0.0, 1.0, 0.0], axis))
        R = np.stack([across, np.cross(axis, across), axis], axis=1)
        command = float(m * np.linalg.norm(demanded) / kappa)
        mean = command + (thrust - command) * lag / PERIOD * (1.0 - left)
        thrust = command + (thrust - command) * left
        velocity = velocity + PERIOD * (0.4 * mean / m * (before + axis) + wind - [0.0, 0.0, g])
        scales.append(kappa)
        forces.append(force)
    assert np.mean(scales[-1000:]) == pytest.approx(0.8, abs=0.005)
    assert np.std(scales[-1000:]) < 0.15
    np.testing.assert_allclose(np.mean(forces[-1000:], axis=0), wind, atol=0.05)


def test_with_a_scale_drag_is_fitted_along_body_x_and_y(vehicle: Vehicle) -> None:
    """While it is upright; and where the scale holds, further on in this flight, so does the fit."""
    linear = np.array([0.6, 0.4, 0.3])

    def fitted(settings: RampSettings, periods: int) -> Array:
        observer = RampObserver(settings, vehicle, PERIOD)
        fly(vehicle, observer, lambda t, R, v: -R @ (linear * (R.T @ v)), np.zeros(3), periods)
        return observer.drag

    upright = fitted(RampSettings(), 20)
    scaled = fitted(SCALED, 20)
    np.testing.assert_allclose(scaled[:2], upright[:2], rtol=0.02)
    assert upright[2] > 0.0 == scaled[2]
    np.testing.assert_array_equal(fitted(SCALED, 26), fitted(SCALED, 50))


def test_an_observer_takes_over_only_what_it_estimates_itself(vehicle: Vehicle) -> None:
    scaled = RampObserver(SCALED, vehicle, PERIOD, thrust_lag=0.03)
    straight(scaled, vehicle, 0.0, 1.3, lambda t: 0.8 * t, np.array([0.5, 0.0, 0.0]))
    turning = RampObserver(RampSettings(), vehicle, PERIOD)
    fly(vehicle, turning, lambda t, R, v: np.zeros(3), np.array([0.2, 0.0, 0.0]), 40)
    same = RampObserver(SCALED, vehicle, PERIOD, thrust_lag=0.03)
    other = RampObserver(RampSettings(), vehicle, PERIOD)
    same.adopt(scaled)
    assert same.thrust_scale == scaled.thrust_scale
    other.adopt(scaled)
    np.testing.assert_allclose(other.foreseen(0.0)[0], [0.5, 0.0, 0.0], atol=1e-8)
    same.adopt(turning)
    assert same.thrust_scale == 1.0
    np.testing.assert_array_equal(same.foreseen(0.0)[2], 0.0)


@pytest.mark.parametrize("scaled", [True, False])
@pytest.mark.parametrize(
    ("rotor_lag", "thrust_lag", "moment"),
    [(0.0, None, False), (0.03, None, True), (0.0, None, True), (None, 0.03, False), (None, 0.0, False)],
)
def test_the_core_has_the_numbers_of_the_equations(
    vehicle: Vehicle, scaled: bool, rotor_lag: float | None, thrust_lag: float | None, moment: bool
) -> None:
    """Whatever the motion: at every tenth update there was a gap, and some are upside down or beyond the limits."""
    Ixx = vehicle.inertia[0]
    products = 0.05 * vehicle.inertia[0] * np.array([1.0, -2.0, 3.0])
    vehicle = replace(
        vehicle,
        **{"inertia": (Ixx, 1.1 * Ixx, 1.5 * Ixx), "products_of_inertia": tuple(products.tolist())},
        rotor_inertia=0.01 * Ixx,
        **{"rotor_moment": (2e-5, -3e-5), "inflow_moment": (3e-3, -4e-3), "rate_damping": (0.1, 0.2, 0.3)},
        inflow=2e-3,
    )
    settings = RampSettings(thrust_scale=scaled, rotor_lag=rotor_lag, largest_force=5.0)
    rng = np.random.default_rng(5)
    weight = vehicle.mass * vehicle.gravity
    hover = vehicle.hover_speeds if thrust_lag is None else np.array([weight])
    drags = {"drag": np.array([0.3, 0.2, 0.1]), "quadratic_drag": np.array([0.02, 0.0, 0.05])}
    others = {"moment": moment, "thrust_lag": thrust_lag}
    observer = RampObserver(settings, vehicle, PERIOD, **drags, **others)  # type: ignore[arg-type]
    check = NumpyRamp(settings, vehicle, PERIOD, **drags, **others, acting=hover)  # type: ignore[arg-type]
    time = 0.0
    limited = 0
    fitted = 0
    for k in range(100):
        follows = k % 10 != 9
        time += PERIOD if follows else 3.0 * PERIOD
        v = rng.normal(size=3) * 0.1 + [1.0, 2.0, -0.5]
        Omega = rng.normal(size=3) * 0.5
        R = (Rotation.from_euler("X", 180.0 * (k % 20 == 7), degrees=True) * Rotation.from_rotvec(Omega)).as_matrix()
        command = hover * rng.uniform(0.8, 1.2, size=hover.shape)
        observer.update(time, v, R, Omega, command)
        check.update(follows, v, R, Omega, command)
        limited += bool(np.any(np.abs(check.value) == check.largest))
        fitted += bool(check.fitted.any())
        for value, expected in zip(observer.foreseen(0.1), check.foreseen(0.1), strict=True):
            np.testing.assert_allclose(value, expected, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(observer.drag, check.fitted, rtol=1e-9, atol=1e-12)
        assert observer.thrust_scale == pytest.approx(check.scale, abs=1e-12)
    assert 0 < limited < 100
    assert fitted
