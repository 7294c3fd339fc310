"""Samples: their statistics against what the sensor states, their times, and what draws what."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from sensor_samples import follow, sampler_of, taken

from quadsim.rotation import euler_to_quaternion
from quadsim.sim.navigation import Navigation
from quadsim.sim.sensing import KINDS, FaultKind, Outliers, Sensor, SensorFault, SensorName, truth
from quadsim.state import Array
from quadsim.vehicle import Vehicle

TIMESTEP = 1e-3
STEPS = 20_000


@pytest.fixture(scope="module")
def physics() -> Array:
    """(STEPS + 1, 14) states of a vehicle that moves, and is tilted far."""
    t = TIMESTEP * np.arange(STEPS + 1)
    rows = np.empty((STEPS + 1, 14))
    rows[:, 0] = t
    rows[:, 1:4] = np.stack([t, t**2, np.sin(t)], 1)
    rows[:, 8:11] = np.stack([t, 2 * t, -t], 1)
    rows[:, 4:8] = euler_to_quaternion(np.stack([1.2 * np.sin(t), 1.4 * np.cos(t), 0.5 * t], 1))
    rows[:, 11:14] = np.stack([np.cos(t), np.sin(2 * t), 0.1 * t], 1)
    return rows


def sampled(name: SensorName, sensor: Sensor, *faults: SensorFault, of: Array, seed: int = 0) -> NDArray[np.void]:
    return taken(sampler_of(name, sensor, *faults, seed=seed), of)


def errors(samples: NDArray[np.void], physics: Array) -> Array:
    """(n, 3) what samples say beyond the truth; rotation vectors for attitude."""
    at = samples["taken"]
    values = samples["value"]
    name = list(SensorName)[samples["kind"][0]]
    if name is not SensorName.ATTITUDE:
        return np.asarray(values - truth(name, physics[at]))
    measured = Rotation.from_euler("ZYX", values[:, ::-1])
    return np.asarray((Rotation.from_quat(physics[at, 4:8], scalar_first=True).inv() * measured).as_rotvec())


@pytest.mark.parametrize("name", list(SensorName))
def test_a_perfect_sensor_reports_the_truth(name: SensorName, physics: Array) -> None:
    samples = sampled(name, Sensor(rate=100.0), of=physics)
    assert samples["taken"].tolist() == list(range(0, STEPS + 1, 10))
    assert np.abs(errors(samples, physics)).max() < 1e-12


@pytest.mark.parametrize("name", list(SensorName))
def test_noise_and_bias_are_as_stated_on_each_axis(name: SensorName, physics: Array) -> None:
    noise = np.array([0.01, 0.02, 0.05])
    bias = np.array([0.1, -0.2, 0.05])
    stated = [np.degrees(v) if name in ("attitude", "rates") else v for v in (noise, bias)]
    sensor = Sensor(rate=1000.0, noise=tuple(stated[0]), bias=tuple(stated[1]))
    result = errors(sampled(name, sensor, of=physics), physics)
    np.testing.assert_allclose(result.mean(0), bias, atol=4 * noise.max() / np.sqrt(STEPS))
    np.testing.assert_allclose(result.std(0), noise, rtol=4 / np.sqrt(2 * STEPS))  # of a standard deviation, 4 sigma
    corr = np.corrcoef(result[1:].T, result[:-1].T)
    assert np.abs(corr - np.eye(6)).max() < 5 / np.sqrt(STEPS)  # white, and the axes independent


def test_the_variance_of_a_walking_bias_grows_as_time() -> None:
    rest = np.zeros((101, 14))
    sensor = Sensor(rate=20.0, bias=(0.3, 0.0, 0.0), bias_walk=(0.1, 0.2, 0.4))
    walks = np.array([sampled(SensorName.VELOCITY, sensor, seed=seed, of=rest)["value"] for seed in range(1000)])
    assert walks[:, 0].tolist() == [[0.3, 0.0, 0.0]] * 1000
    t = 0.05 * np.arange(1, walks.shape[1])
    expected = np.outer(t, np.square(sensor.bias_walk))
    np.testing.assert_allclose(walks[:, 1:].var(axis=0) / expected, 1.0, atol=5 * np.sqrt(2 / 1000))


def test_rates_and_delays_are_exact(physics: Array) -> None:
    samples = sampled(SensorName.POSITION, Sensor(rate=40.0, delay=0.11), of=physics[:101])
    assert samples["taken"].tolist() == [25 * i for i in range(5)]
    assert sampler_of(SensorName.POSITION, Sensor(rate=40.0, delay=0.11)).latency == 110


def test_the_share_lost_is_as_stated(physics: Array) -> None:
    samples = sampled(SensorName.RATES, Sensor(rate=1000.0, dropout=0.3), of=physics)
    assert len(samples) / STEPS == pytest.approx(0.7, abs=4 * np.sqrt(0.3 * 0.7 / STEPS))
    assert not len(sampled(SensorName.RATES, Sensor(rate=1000.0, dropout=1.0), of=physics))


def test_outliers_widen_the_noise_of_their_share_of_samples(physics: Array) -> None:
    sensor = Sensor(rate=1000.0, noise=0.1, outliers=Outliers(probability=0.1, size=20.0))
    name = SensorName.POSITION
    result = errors(sampled(name, sensor, of=physics), physics)
    clean = errors(sampled(name, replace(sensor, outliers=None), of=physics), physics)
    widened = np.isclose(result, 20.0 * clean, rtol=1e-6, atol=1e-9)
    assert np.all(widened | np.isclose(result, clean, rtol=1e-6, atol=1e-9))
    assert np.all(widened.all(axis=1) == widened.any(axis=1))  # all axes of a sample together
    assert widened[:, 0].mean() == pytest.approx(0.1, abs=4 * np.sqrt(0.1 * 0.9 / STEPS))


@pytest.mark.parametrize("name", [SensorName.POSITION, SensorName.ATTITUDE])
@pytest.mark.parametrize("cuts", [(1,), (7,), (50,), (13, 200, 1)])
def test_the_core_hears_each_sample_when_it_arrives_however_time_is_cut(
    name: SensorName, cuts: tuple[int, ...], physics: Array, vehicle: Vehicle
) -> None:
    sensor = Sensor(
        rate=200.0,
        noise=0.1,
        bias_walk=0.1,
        dropout=0.2,
        delay=0.02,
        outliers=Outliers(probability=0.2, size=5.0),
    )
    freeze = SensorFault(sensor=name, kind=FaultKind.FREEZE, start=0.1, stop=0.2)
    blank = SensorFault(sensor=name, kind=FaultKind.NAN, start=0.3, stop=0.35, axes=(1,))
    lost = SensorFault(sensor=name, kind=FaultKind.DROPOUT, start=0.15, stop=0.25)
    faults = freeze, blank, lost
    navigation = Navigation(
        vehicle, timestep=TIMESTEP, sensors={name: sensor}, rng=np.random.default_rng(0), faults=faults
    )
    generators = np.random.default_rng(0).spawn(1 + len(SensorName))
    expected = taken(sampler_of(name, sensor, *faults, rng=generators[1 + KINDS[name]]), physics[:401])
    for _ in range(2):  # and the same again after a reset
        navigation.reset(physics[0], np.zeros(4))
        first = 0
        at = 0
        while first < 400:
            count = min(cuts[at % len(cuts)], 400 - first)
            follow(navigation, physics[first + 1 : first + 1 + count], np.zeros((count, 4)), first)
            first = first + count
            at = at + 1
            heard = expected[expected["taken"] + 20 <= first]
            state = navigation.state()[[0, 2, 4] if name is SensorName.POSITION else [6, 8, 10]]
            if len(heard):
                value = heard["value"][-1]
                turns = np.array([0.0, 0.0, 2.0 * math.pi * round((state[2] - value[2]) / (2.0 * math.pi))])
                if name is SensorName.POSITION:
                    turns[:] = 0.0
                np.testing.assert_allclose(state, value + turns, atol=1e-12)


@pytest.mark.parametrize(
    "change",
    [{"noise": 1.0}, {"bias_walk": (1.0, 1.0, 1.0)}, {"outliers": Outliers(probability=0.5, size=3.0)}],
)
def test_one_imperfection_leaves_the_draws_of_the_others_alone(change: dict[str, Any], physics: Array) -> None:
    sensor = Sensor(rate=100.0, dropout=0.5)
    name = SensorName.POSITION
    plain = sampled(name, sensor, of=physics)
    assert np.array_equal(sampled(name, replace(sensor, **change), of=physics)["taken"], plain["taken"])


# --- faults --------------------------------------------------------------------------------------------------------


def befallen(physics: Array, kind: FaultKind, **more: Any) -> dict[int, Array]:
    fault = SensorFault(sensor=SensorName.POSITION, kind=kind, start=0.1, stop=0.2, **more)
    samples = sampled(SensorName.POSITION, Sensor(rate=100.0), fault, of=physics[:301])
    return dict(zip(samples["taken"].tolist(), samples["value"], strict=True))


def test_faults_hold_from_their_start_until_before_their_end(physics: Array) -> None:
    inside = set(range(100, 200, 10))
    outside = set(range(0, 301, 10)) - inside
    gone = befallen(physics, FaultKind.DROPOUT)
    assert set(gone) == outside
    frozen = befallen(physics, FaultKind.FREEZE)
    assert all(np.array_equal(frozen[step], physics[90, 1:4]) for step in inside)
    blank = befallen(physics, FaultKind.NAN, axes=(1,))
    assert all(np.isnan(blank[step]).tolist() == [False, True, False] for step in inside)
    moved = befallen(physics, FaultKind.BIAS, offset=(1.0, 0.0, -2.0))
    assert all(np.allclose(moved[step] - physics[step, 1:4], [1.0, 0.0, -2.0]) for step in inside)
    for values in (frozen, blank, moved):
        assert all(np.array_equal(values[step], physics[step, 1:4]) for step in outside)


def test_a_sensor_frozen_from_the_start_repeats_its_first_sample(physics: Array) -> None:
    fault = SensorFault(sensor=SensorName.POSITION, kind=FaultKind.FREEZE, start=0.0)
    samples = sampled(SensorName.POSITION, Sensor(rate=100.0), fault, of=physics[:301])
    assert np.array_equal(samples["value"], np.tile(physics[0, 1:4], (31, 1)))


def test_the_fault_of_another_sensor_changes_nothing(physics: Array) -> None:
    fault = SensorFault(sensor=SensorName.VELOCITY, kind=FaultKind.NAN, start=0.0)
    samples = sampled(SensorName.POSITION, Sensor(rate=100.0), fault, of=physics[:301])
    assert len(samples) == 31
    assert np.abs(errors(samples, physics)).max() == 0.0


def test_windows_begin_and_end_at_the_steps_meant() -> None:
    def window(start: float, stop: float) -> tuple[int, int | None]:
        return SensorFault(sensor=SensorName.RATES, kind=FaultKind.NAN, start=start, stop=stop).window(1e-3)

    assert window(0.3, 0.7) == (300, 700)  # 0.7 / 1e-3 is 700.0000000000001 in binary
    assert window(0.0001, 0.0009) == (1, 1)  # between two steps: none
    assert window(0.0, math.inf) == (0, None)
