"""What a controller receives, with and without an estimator."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from sensor_samples import follow

from quadsim.errors import ParameterError
from quadsim.sim.estimator import EstimatorSettings
from quadsim.sim.navigation import Navigation
from quadsim.sim.physics import physics_to_state
from quadsim.sim.plant import Plant
from quadsim.sim.sensing import FaultKind, Sensor, SensorFault, SensorName
from quadsim.state import INDEX, Array, make_state
from quadsim.vehicle import Vehicle

TIMESTEP = 1e-3
STEPS = 600
NOISE = 0.01
SENSORS = {
    SensorName.POSITION: Sensor(rate=20.0, noise=NOISE, delay=0.05),
    SensorName.ATTITUDE: Sensor(rate=100.0, noise=math.degrees(NOISE)),
    SensorName.RATES: Sensor(rate=200.0, noise=math.degrees(NOISE)),
}
NONE: dict[SensorName, Sensor] = {}


@pytest.fixture(scope="module")
def speeds(vehicle: Vehicle) -> Array:
    return vehicle.hover_speed * np.array([1.01, 0.97, 1.01, 1.02])


@pytest.fixture(scope="module")
def physics(vehicle: Vehicle, speeds: Array) -> Array:
    """(STEPS + 1, 14) of a flight that yaws through half a turn."""
    with Plant(vehicle) as plant:
        plant.reset(make_state(euler=(0.1, -0.2, math.radians(179.0))), speeds)
        return np.vstack([plant.physics, plant.advance(speeds, STEPS)["physics"]])


def observed(navigation: Navigation, physics: Array, speeds: Array, *, chunk: int = 50, yaw: float = 0.0) -> Array:
    """(K, 12) what the controller receives at the start and after each 50 steps, advanced in chunks."""
    navigation.reset(physics[0], speeds, yaw)
    states = [navigation.state()]
    for step in range(0, STEPS, chunk):
        follow(navigation, physics[step + 1 : step + chunk + 1], np.tile(speeds, (chunk, 1)), step)
        if (step + chunk) % 50 == 0:
            states.append(navigation.state())
    return np.array(states)


def build(vehicle: Vehicle, sensors: dict[SensorName, Sensor] = NONE, *, seed: int = 0, **more: Any) -> Navigation:
    return Navigation(vehicle, timestep=TIMESTEP, sensors=sensors, rng=np.random.default_rng(seed), **more)


def test_without_sensors_the_truth_is_passed_on(vehicle: Vehicle, physics: Array, speeds: Array) -> None:
    states = observed(build(vehicle), physics, speeds, yaw=math.radians(179.0))
    np.testing.assert_allclose(states, physics_to_state(physics, math.radians(179.0))[::50], atol=1e-12)
    assert states[-1, INDEX["yaw"]] > math.pi
    again = observed(build(vehicle), physics, speeds, yaw=math.radians(179.0) - 4.0 * math.pi)
    np.testing.assert_allclose(again[:, INDEX["yaw"]], states[:, INDEX["yaw"]] - 4.0 * math.pi, atol=1e-12)


@pytest.mark.parametrize("estimator", [None, EstimatorSettings()], ids=["held", "estimated"])
def test_yaw_is_counted_over_whole_turns(estimator: EstimatorSettings | None, vehicle: Vehicle) -> None:
    hover = np.full(4, vehicle.hover_speed)
    spin = 6.0 * math.pi
    with Plant(vehicle) as plant:
        start = make_state()
        start[INDEX["yaw_rate"]] = spin
        plant.reset(start, hover)
        physics = np.vstack([plant.physics, plant.advance(hover, STEPS)["physics"]])
    yaw = observed(build(vehicle, SENSORS, estimator=estimator), physics, hover)[:, INDEX["yaw"]]
    np.testing.assert_allclose(yaw, spin * 0.05 * np.arange(13), atol=0.05)  # 1.8 turns


def test_the_last_sample_to_arrive_is_held(vehicle: Vehicle, physics: Array, speeds: Array) -> None:
    late = {SensorName.POSITION: Sensor(rate=4.0, delay=0.12)}  # taken at 0, 0.25, 0.5 s
    states = observed(build(vehicle, late), physics, speeds)
    truth = physics_to_state(physics)
    taken = [0, 0, 0, 0, 0, 0, 0, 0, 250, 250, 250, 250, 250]  # the last at 0.6 s, before 0.62
    np.testing.assert_array_equal(states[:, [0, 2, 4]], truth[taken][:, [0, 2, 4]])
    np.testing.assert_allclose(states[:, [1, 3, 5]], truth[::50, [1, 3, 5]], atol=1e-12)


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize(
    ("name", "columns"),
    [
        (SensorName.POSITION, ["x", "y", "z"]),
        (SensorName.VELOCITY, ["vx", "vy", "vz"]),
        (SensorName.ATTITUDE, ["roll", "pitch", "yaw"]),
        (SensorName.RATES, None),
    ],
)
def test_nan_reaches_the_controller_where_nothing_stops_it(
    name: SensorName, columns: list[str] | None, axis: int, vehicle: Vehicle, physics: Array, speeds: Array
) -> None:
    """The sensors are perfect otherwise; what is no rate makes no Euler rate either."""
    fault = SensorFault(sensor=name, kind=FaultKind.NAN, start=0.2, stop=0.4, axes=(axis,))
    states = observed(build(vehicle, faults=(fault,)), physics, speeds)
    assert np.isfinite(states[[0, 1, 2, 3, 8, 9, 10]]).all()
    assert np.isnan(states[4:8]).any(axis=1).all()
    if columns is not None:
        expected = [INDEX[columns[axis]]]
        others = [INDEX[name] for name in ("x", "y", "z", "vx", "vy", "vz", "roll", "pitch", "yaw")]
        assert [i for i in others if np.isnan(states[4, i])] == expected
    np.testing.assert_allclose(states[8:], observed(build(vehicle), physics, speeds)[8:], atol=1e-12)


@pytest.mark.parametrize("estimator", [None, EstimatorSettings()], ids=["held", "estimated"])
def test_what_is_observed_depends_on_the_seed_alone(
    estimator: EstimatorSettings | None, vehicle: Vehicle, physics: Array, speeds: Array
) -> None:
    navigation = build(vehicle, SENSORS, estimator=estimator)
    once = observed(navigation, physics, speeds)
    assert np.array_equal(observed(navigation, physics, speeds), once)  # reset: the same again
    assert np.array_equal(observed(build(vehicle, SENSORS, estimator=estimator), physics, speeds, chunk=25), once)
    assert not np.array_equal(observed(build(vehicle, SENSORS, seed=1, estimator=estimator), physics, speeds), once)


def test_one_sensor_leaves_the_draws_of_the_others_alone(vehicle: Vehicle, physics: Array, speeds: Array) -> None:
    more = SENSORS | {SensorName.VELOCITY: Sensor(rate=20.0, noise=NOISE)}
    few, many = (observed(build(vehicle, sensors), physics, speeds) for sensors in (SENSORS, more))
    same = [i for i in range(12) if i not in (INDEX["vx"], INDEX["vy"], INDEX["vz"])]
    assert np.array_equal(few[:, same], many[:, same])
    assert not np.array_equal(few, many)


def test_the_estimate_is_near_the_truth_and_its_yaw_unwrapped(vehicle: Vehicle, physics: Array, speeds: Array) -> None:
    navigation = build(vehicle, SENSORS, estimator=EstimatorSettings())
    states = observed(navigation, physics, speeds, yaw=math.radians(179.0))
    error = states - physics_to_state(physics, math.radians(179.0))[::50]
    assert np.abs(error[-1, [0, 2, 4]]).max() < 0.05
    assert np.abs(error[-1, [6, 8, 10]]).max() < 0.02
    assert np.abs(np.diff(states[:, INDEX["yaw"]])).max() < 0.2
    assert {str(name): tally.accepted for name, tally in navigation.tallies.items()} == {
        "position": 12,  # up to the horizon, the largest delay before now
        "attitude": 56,
        "rates": 111,
    }
    assert build(vehicle).tallies == {}


@pytest.mark.parametrize("on_ground", [True, False])
def test_the_estimator_alone_minds_that_the_feet_stand(on_ground: bool, vehicle: Vehicle, physics: Array) -> None:
    cold = np.zeros((200, 4))
    ground = np.tile(physics[:1], (201, 1))
    ground[:, 4:8] = [1.0, 0.0, 0.0, 0.0]
    ground[:, 8:] = 0.0
    for estimator in (None, EstimatorSettings()):
        navigation = build(vehicle, SENSORS, estimator=estimator)
        navigation.reset(ground[0], cold[0])
        follow(navigation, ground[1:], cold, 0, on_ground=on_ground)
        falls = navigation.state()[INDEX["vz"]] < -0.3
        assert falls == (estimator is not None and not on_ground)


def test_a_fault_of_a_sensor_that_the_estimator_lacks_is_refused(vehicle: Vehicle) -> None:
    fault = SensorFault(sensor=SensorName.VELOCITY, kind=FaultKind.NAN, start=0.0)
    message = r"^fault.sensor must be on a sensor that the estimator has \(position, attitude, rates\); got 'velocity'"
    with pytest.raises(ParameterError, match=message):
        build(vehicle, SENSORS, estimator=EstimatorSettings(), faults=(fault,))


def test_an_autopilot_hears_the_gyro_less_the_bias_that_was_estimated(
    vehicle: Vehicle, physics: Array, speeds: Array
) -> None:
    bias = math.radians(5.0)
    sensors = SENSORS | {SensorName.RATES: Sensor(rate=200.0, noise=0.01, bias=5.0)}
    off = {}
    for estimator in (None, EstimatorSettings(initial_gyro_bias=5.0)):
        navigation = build(vehicle, sensors, estimator=estimator)
        observed(navigation, physics, speeds)
        off[estimator] = navigation.sensed(physics[STEPS])[1] - physics[STEPS, 11:14]
    raw, corrected = off.values()
    np.testing.assert_allclose(raw, [bias] * 3, atol=0.1 * bias)
    assert np.abs(corrected).max() < 0.3 * bias
