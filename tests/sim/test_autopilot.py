"""The autopilot: its mixer, its loops, its default gains, and the lags identified by a step."""

from __future__ import annotations

import copy
import math
import pickle
from dataclasses import replace

import numpy as np
import pytest
from numpy_laws import NumpyAutopilot, mix
from scipy.spatial.transform import Rotation
from uneven import uneven

from quadsim.assets import vehicle_path
from quadsim.rotation import exponential
from quadsim.sim.autopilot import RATE_LOOP_DAMPING, Autopilot, AutopilotSettings, identify_lags
from quadsim.sim.effects import Disturbance, Effects
from quadsim.sim.effects.rotors import RotorDynamics
from quadsim.sim.plant import Plant
from quadsim.state import N_STATES, Array, make_state, tilt
from quadsim.vehicle import Vehicle, load_vehicle

NONE = (0.0, 0.0, 0.0)


@pytest.fixture(scope="module", params=["hummingbird", "crazyflie2", "uneven"])
def vehicle(request: pytest.FixtureRequest) -> Vehicle:
    return uneven() if request.param == "uneven" else load_vehicle(vehicle_path(request.param))


def wrench_of(vehicle: Vehicle, thrusts: Array) -> Array:
    return np.asarray(vehicle.allocation / vehicle.coefficients @ thrusts)


def fly(vehicle: Vehicle, autopilot: Autopilot, target: Array, seconds: float, effects: Effects | None = None) -> Array:
    """(M, 14) the physics of a flight from hover that holds a target."""
    effects = effects or Effects(rotors=RotorDynamics().resolved(vehicle))
    with Plant(vehicle, effects=effects, limit_speeds=True) as plant:
        plant.reset(np.zeros(N_STATES))
        autopilot.reset()
        rows = []
        for _ in range(round(seconds * 1e3)):
            attitude, rates = plant.attitude
            rows.append(
                plant.advance(autopilot.speeds(plant.time, target, rates, plant.speeds, attitude), 1)["physics"]
            )
        return np.concatenate(rows)


def hover(vehicle: Vehicle, *rates: float) -> Array:
    return np.array([vehicle.mass * vehicle.gravity, *(rates or NONE)])


@pytest.mark.parametrize("airmode", [True, False])
def test_the_mixer_gives_what_fits_and_says_what_it_cut(vehicle: Vehicle, airmode: bool) -> None:
    autopilot = Autopilot(vehicle, AutopilotSettings(airmode=airmode))
    rng = np.random.default_rng(1)
    lowest, top = vehicle.thrusts(np.array([[vehicle.speed_min], [vehicle.speed_max]]))
    lift = 4.0 * vehicle.thrust_shares
    least = 4.0 * float((lowest / lift).max())
    most = vehicle.level_thrust(vehicle.speed_max)
    reach = np.abs(vehicle.allocation[1:] / vehicle.coefficients) @ top
    for _ in range(300):
        thrust = most * rng.uniform(-0.1, 1.1)
        torque = reach * rng.normal(size=3) * rng.choice([0.05, 0.3, 1.0])
        thrusts, cut = mix(vehicle, autopilot.settings, float(thrust), torque)
        assert np.all(thrusts >= lowest * (1.0 - 1e-12))
        assert np.all(thrusts <= top * (1.0 + 1e-12))
        given, *turning = wrench_of(vehicle, thrusts)
        kept = np.array(turning) == pytest.approx(torque, abs=1e-9 * reach.max())
        assert kept or cut.any()
        for axis in np.flatnonzero(~cut):
            assert turning[axis] == pytest.approx(torque[axis], abs=1e-9 * reach.max())
        for axis in np.flatnonzero(cut):  # less of it, never the wrong way
            assert -1e-9 <= turning[axis] / torque[axis] < 1.0
        if not airmode:
            assert given == pytest.approx(np.clip(thrust, least, most))
        elif not cut.any():  # thrust moves no further than the torques need
            parts = np.linalg.inv(vehicle.allocation / vehicle.coefficients)[:, 1:] @ torque
            ends = 4.0 * float(((lowest - parts) / lift).max()), 4.0 * float(((top - parts) / lift).min())
            assert given == pytest.approx(np.clip(np.clip(thrust, least, most), *ends))


def test_yaw_is_cut_before_roll_and_pitch(vehicle: Vehicle) -> None:
    autopilot = Autopilot(vehicle)
    strong = 10.0 * np.array(vehicle.inertia)
    strong[2] = 2.0 * vehicle.drag_to_thrust * vehicle.mass * vehicle.gravity
    thrusts, cut = mix(vehicle, autopilot.settings, vehicle.mass * vehicle.gravity, strong)
    assert cut.tolist() == [False, False, True]
    assert wrench_of(vehicle, thrusts)[1:3] == pytest.approx(strong[:2])
    lowest, top = vehicle.thrusts(np.array([[vehicle.speed_min], [vehicle.speed_max]]))
    assert (thrusts - lowest).min() == pytest.approx(0.0, abs=1e-12 * top.max())
    assert (top - thrusts).min() == pytest.approx(0.0, abs=1e-12 * top.max())
    full = vehicle.level_thrust(vehicle.speed_max)
    some = np.array([0.0, 0.0, 0.1 * vehicle.drag_to_thrust * full])  # the collective thrust yields to it
    thrusts, cut = mix(vehicle, autopilot.settings, full, some)
    assert not cut.any()
    assert wrench_of(vehicle, thrusts)[1:] == pytest.approx(some, abs=1e-12)


def test_default_gains_follow_the_rule(vehicle: Vehicle) -> None:
    settings = AutopilotSettings().resolved(vehicle)
    assert settings.p is not None
    assert settings.d is not None
    lag = (vehicle.rotor_rise or 0.0) + 1.0 / (math.tau * 100.0) + 1.5e-3
    if settings.d[0] > 0.0:  # lag s^2 + (1 + d) s + p
        assert (1.0 + settings.d[0]) / (2.0 * math.sqrt(settings.p[0] * lag)) == pytest.approx(RATE_LOOP_DAMPING)
    else:
        assert settings.p[0] == pytest.approx(40.0 / (2.0 * RATE_LOOP_DAMPING))
    assert settings.resolved(vehicle) == settings


@pytest.mark.representative("autopilot")
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_step_of_a_body_rate_is_reached_with_little_overshoot(vehicle: Vehicle, axis: int) -> None:
    target = hover(vehicle)
    target[1 + axis] = 1.0 if axis < 2 else 0.3
    rates = fly(vehicle, Autopilot(vehicle), target, 1.5)[:, 11 + axis] / target[1 + axis]
    assert rates.max() < 1.25
    assert rates[-1] == pytest.approx(1.0, abs=0.05)


@pytest.mark.slow("autopilot")
def test_a_constant_torque_is_integrated_away(vehicle: Vehicle) -> None:
    torque = 2.0 * vehicle.inertia[0]
    effects = Effects(rotors=RotorDynamics().resolved(vehicle), disturbance=Disturbance(torque=(torque, 0.0, 0.0)))
    assert abs(fly(vehicle, Autopilot(vehicle), hover(vehicle), 8.0, effects)[-1, 11]) < 1e-3
    without = Autopilot(vehicle, AutopilotSettings(i=NONE))
    gain = without.settings.p[0] if without.settings.p else 0.0
    assert fly(vehicle, without, hover(vehicle), 3.0, effects)[-1, 11] == pytest.approx(2.0 / gain, rel=0.02)


def test_the_integral_is_limited_and_stops_where_an_axis_is_cut(vehicle: Vehicle) -> None:
    autopilot = Autopilot(vehicle, AutopilotSettings(i_max=(0.5, 0.5, 0.1)))
    still = np.zeros(3)
    level = np.array([1.0, 0.0, 0.0, 0.0])
    for _ in range(2000):
        autopilot.speeds(0.0, hover(vehicle, 0.2, 0.0, 0.0), still, still, level)
    assert list(autopilot._struct.integral) == pytest.approx([0.5, 0.0, 0.0])
    autopilot.reset()
    for _ in range(100):
        autopilot.speeds(0.0, hover(vehicle, 0.0, 0.0, 1e3), still, still, level)
    assert autopilot._struct.integral[2] == 0.0


def test_an_attitude_is_held(vehicle: Vehicle) -> None:
    attitude = np.array(exponential((math.radians(15.0), 0.0, 0.0)))
    flown = fly(vehicle, Autopilot(vehicle), np.concatenate([hover(vehicle), attitude]), 2.0)
    left = Rotation.from_quat(flown[-1, 4:8], scalar_first=True).inv() * Rotation.from_quat(attitude, scalar_first=True)
    assert left.as_rotvec() == pytest.approx(np.zeros(3), abs=2e-3)


@pytest.mark.parametrize("airmode", [True, False])
@pytest.mark.parametrize("size", [4, 8])
def test_it_answers_as_its_equations_do(vehicle: Vehicle, airmode: bool, size: int) -> None:
    """Through targets and motions of all sizes, saturated and not."""
    rng = np.random.default_rng(7)
    settings = AutopilotSettings(airmode=airmode, delay=2e-3, idle=0.05, d=(1.0, 0.5, 0.2))
    autopilot = Autopilot(vehicle, settings)
    expected = NumpyAutopilot(vehicle, settings)
    weight = vehicle.mass * vehicle.gravity
    for k in range(120):
        wild = (0.1, 1.0, 10.0)[k % 3]
        attitude, aim = ((q := rng.normal(size=4)) / np.linalg.norm(q) for _ in range(2))
        target = np.concatenate([[weight * rng.uniform(0.0, 2.5)], wild * rng.normal(size=3), aim])[:size]
        rates = wild * rng.normal(size=3)
        answer = autopilot.speeds(1e-3 * k, target, rates, np.zeros(4), attitude)
        np.testing.assert_allclose(answer, expected.speeds(target, rates, attitude), rtol=1e-9)


def test_a_copy_flies_on_by_itself(vehicle: Vehicle) -> None:
    autopilot = Autopilot(vehicle)
    still = np.array([1.0, 0.0, 0.0, 0.0])
    autopilot.speeds(0.0, hover(vehicle, 1.0, 0.0, 0.0), np.zeros(3), still, still)
    for copied in (copy.deepcopy(autopilot), pickle.loads(pickle.dumps(autopilot))):
        twin = copy.deepcopy(autopilot)
        one = []
        other = []
        for k in range(5):
            given = (1e-3 * k, hover(vehicle, 0.3, 0.1 * k, 0.0), 0.2 * np.ones(3), still, still)
            one.append(twin.speeds(*given))
            other.append(copied.speeds(*given))
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("bandwidth", [10.0, 20.0])
def test_the_lag_of_an_ideal_rate_loop_is_one_over_its_gain(vehicle: Vehicle, bandwidth: float) -> None:
    ideal = replace(vehicle, rotor_rise=None, rotor_fall=None, rotor_inertia=None)
    settings = AutopilotSettings(p=(bandwidth,) * 3, i=NONE, d=NONE, gyro_cutoff=0.0, delay=0.0)
    thrust, *rates = identify_lags(ideal, Autopilot(ideal, settings))
    assert thrust < 1e-3  # at once
    assert rates[:2] == pytest.approx([1.0 / bandwidth] * 2, rel=0.02)


def test_the_lag_of_thrust_is_that_of_the_rotors(vehicle: Vehicle) -> None:
    assert vehicle.rotor_rise is not None
    assert identify_lags(vehicle, Autopilot(vehicle))[0] == pytest.approx(vehicle.rotor_rise, rel=0.15)


def test_gyro_noise_moves_the_rotors_less_behind_the_filter(vehicle: Vehicle) -> None:
    rng = np.random.default_rng(0)
    still = np.array([1.0, 0.0, 0.0, 0.0])
    spread = []
    noise = 0.1 * rng.normal(size=(500, 3))
    for cutoff in (0.0, 100.0):
        autopilot = Autopilot(vehicle, AutopilotSettings(gyro_cutoff=cutoff, i=NONE))
        speeds = [autopilot.speeds(0.0, hover(vehicle), rates, still, still) for rates in noise]
        spread.append(np.std(speeds, axis=0).mean())
    assert spread[1] < 0.7 * spread[0]


def test_an_idle_that_hovers_is_refused(vehicle: Vehicle) -> None:
    with pytest.raises(ValueError, match=r"autopilot\.idle"):
        Autopilot(vehicle, AutopilotSettings(idle=0.95))


def test_a_loop_too_slow_for_a_lag_is_refused(vehicle: Vehicle) -> None:
    with pytest.raises(ValueError, match="step"):
        identify_lags(vehicle, Autopilot(vehicle, AutopilotSettings(p=(1.0, 1.0, 1.0), i=NONE, d=NONE)))


def test_a_delay_is_a_whole_number_of_periods(vehicle: Vehicle) -> None:
    rates = np.array([1.0, 0.0, 0.0])
    still = np.array([1.0, 0.0, 0.0, 0.0])
    autopilot = Autopilot(vehicle, AutopilotSettings(delay=3e-3))
    answers = [autopilot.speeds(0.0, hover(vehicle), rates, still, still) for _ in range(5)]
    assert [bool(np.ptp(answer - vehicle.hover_speeds) > 1.0) for answer in answers] == [
        False,
        False,
        False,
        True,
        True,
    ]
    with pytest.raises(ValueError, match=r"autopilot\.delay"):
        Autopilot(vehicle, AutopilotSettings(delay=1.5e-3))


def test_it_recovers_a_level_attitude_from_upside_down() -> None:
    vehicle = load_vehicle(vehicle_path("hummingbird"))
    autopilot = Autopilot(vehicle)
    effects = Effects(rotors=RotorDynamics().resolved(vehicle))
    with Plant(vehicle, effects=effects, limit_speeds=True) as plant:
        plant.reset(make_state(position=(0.0, 0.0, 50.0), euler=(math.radians(170.0), 0.0, 0.0)))
        target = np.array([vehicle.mass * vehicle.gravity, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
        for _ in range(2000):
            attitude, rates = plant.attitude
            plant.advance(autopilot.speeds(plant.time, target, rates, plant.speeds, attitude), 1)
        assert tilt(plant.state()[None])[0] < math.radians(1.0)
