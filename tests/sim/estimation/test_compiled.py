"""The compiled filter against the equations in NumPy."""

from __future__ import annotations

import ctypes
import math
from dataclasses import replace

import numpy as np
import pytest
from numpy_filter import Estimate, difference, drive, inflate, lifts, motion_model, predict_estimate, stand, update
from scipy.spatial.transform import Rotation

from quadsim.core.mirror import core_library, fill
from quadsim.core.structs import SAMPLE, SAMPLES, TrackStruct
from quadsim.sim.estimator import ErrorStateFilter, EstimatorSettings
from quadsim.sim.sensing import KINDS, Sensor, SensorName
from quadsim.vehicle import Vehicle

TIMESTEP = 1e-3
SETTINGS = EstimatorSettings(angular_acceleration_noise=2.0, gyro_bias_walk=math.degrees(0.1), patience=0.5)
NOISE = {SensorName.POSITION: (0.1, 0.2, 0.3), SensorName.VELOCITY: (0.2, 0.1, 0.4)}
NOISE |= {name: tuple(np.degrees([0.1, 0.2, 0.3])) for name in (SensorName.ATTITUDE, SensorName.RATES)}
SENSORS = {name: Sensor(rate=100.0, noise=noise) for name, noise in NOISE.items()}


@pytest.fixture(scope="module")
def compiled(vehicle: Vehicle) -> ErrorStateFilter:
    return ErrorStateFilter(vehicle, SENSORS, SETTINGS, timestep=TIMESTEP)


def some_estimate(rng: np.random.Generator, size: float = 0.3) -> Estimate:
    factor = size * rng.normal(size=(15, 15))
    mean = rng.normal(size=16)
    mean[6:10] = Rotation.random(rng=rng).as_quat(scalar_first=True)
    return Estimate(mean=mean, covariance=factor @ factor.T)


def track_of(estimate: Estimate) -> TrackStruct:
    track = TrackStruct()
    track.refused[:] = [-1] * 4
    fill(track.mean, estimate.mean)
    fill(track.P, estimate.covariance)
    return track


def run(
    filter_: ErrorStateFilter, track: TrackStruct, samples: np.ndarray, commands: np.ndarray, grounded: np.ndarray
) -> None:
    core_library().quadsim_filter_run(
        *(filter_.struct, ctypes.byref(track), samples.ctypes.data_as(SAMPLES), len(samples)),
        *(commands.ctypes.data, grounded.ctypes.data, 0, len(commands)),
    )


def sample(name: SensorName, value: np.ndarray, taken: int = 0) -> np.ndarray:
    samples = np.empty(1, SAMPLE)
    samples["taken"] = taken
    samples["kind"] = KINDS[name]
    samples["value"] = value
    return samples


def check(track: TrackStruct, expected: Estimate) -> None:
    size = np.abs(expected.covariance).max()
    assert np.abs(difference(np.array(track.mean), expected.mean)).max() < 1e-12
    np.testing.assert_allclose(np.array(track.P), expected.covariance, atol=1e-12 * size)


def uneven(vehicle: Vehicle) -> Vehicle:
    """The same, with every number that couples its axes."""
    return replace(
        vehicle,
        **{"inertia": (0.03, 0.04, 0.05), "products_of_inertia": (0.002, -0.004, 0.003)},
        **{"rotor_moment": (1e-4, 2e-4), "inflow_moment": (0.03, -0.04), "rate_damping": (0.01, 0.02, 0.03)},
        inflow=2e-3,
    )


@pytest.mark.parametrize(("grounded", "coupled"), [(False, False), (True, False), (False, True)])
def test_it_predicts(vehicle: Vehicle, grounded: bool, coupled: bool) -> None:
    """Commands that change every 4 steps, and then hold for longer than the longest prediction, 10 ms."""
    vehicle, settings = (uneven(vehicle), replace(SETTINGS, moment=True)) if coupled else (vehicle, SETTINGS)
    compiled = ErrorStateFilter(vehicle, SENSORS, settings, timestep=TIMESTEP)
    rng = np.random.default_rng(1)
    model = motion_model(vehicle, settings)
    for _ in range(20):
        pieces = [*[4] * 5, 10, 10, 6]
        rows = vehicle.hover_speed * rng.uniform(-0.1, 1.3, (6, 4))
        commands = np.repeat(rows, [4] * 5 + [26], axis=0)
        estimate = some_estimate(rng)
        track = track_of(estimate)
        run(compiled, track, np.empty(0, SAMPLE), commands, np.full(len(commands), grounded, np.uint8))
        for i, count in enumerate(pieces):
            driven = drive(model, rows[min(i, 5)])
            if grounded and not lifts(model, driven):
                estimate = stand(model, estimate, count * TIMESTEP)
            else:
                estimate = predict_estimate(model, estimate, driven, count * TIMESTEP)
        assert track.step == len(commands)
        check(track, estimate)


@pytest.mark.parametrize("name", list(SensorName))
def test_it_uses_a_sample_within_the_gate_alone(compiled: ErrorStateFilter, name: SensorName) -> None:
    rng = np.random.default_rng(2)
    kind = KINDS[name]
    seen = set()
    variance = np.diag(np.array(compiled.struct.variance[kind]))
    gate = compiled.struct.gate
    for _ in range(60):
        estimate = some_estimate(rng, rng.choice([0.03, 0.3]))
        value = rng.choice([0.3, 3.0]) * rng.normal(size=3)
        track = track_of(estimate)
        run(compiled, track, sample(name, value), np.empty((0, 4)), np.empty(0, np.uint8))
        expected, distance = update(estimate, name, value, variance, gate)
        check(track, expected)
        used = expected is not estimate
        assert (track.accepted[kind], track.rejected[kind], track.refused[kind]) == ((1, 0, -1) if used else (0, 1, 0))
        assert track.nis[kind] == pytest.approx(distance if used else 0.0, rel=1e-9)
        seen.add(used)
    assert seen == {False, True}


@pytest.mark.parametrize("name", list(SensorName))
def test_it_believes_a_sensor_that_it_refused_for_long(compiled: ErrorStateFilter, name: SensorName) -> None:
    rng = np.random.default_rng(3)
    kind = KINDS[name]
    variance = np.diag(np.array(compiled.struct.variance[kind]))
    patience = round(SETTINGS.patience / TIMESTEP)
    value = np.array([0.4, 0.3, -2.0]) if name is SensorName.ATTITUDE else np.array([50.0, -30.0, 20.0])
    for refused in (patience - 1, patience, 2 * patience):
        estimate = some_estimate(rng, 0.01)
        track = track_of(estimate)
        track.step = refused
        track.refused[kind] = 0
        run(compiled, track, sample(name, value, refused), np.empty((0, 4)), np.empty(0, np.uint8))
        if refused < patience:
            assert track.rejected[kind] == 1
            check(track, estimate)
            continue
        expected, _ = update(
            inflate(estimate, name, value, refused * TIMESTEP), name, value, variance, compiled.struct.gate
        )
        assert track.accepted[kind] == 1
        check(track, expected)


def test_an_estimate_that_is_lost_keeps_its_mean_and_starts_anew(compiled: ErrorStateFilter) -> None:
    estimate = some_estimate(np.random.default_rng(4))
    estimate.mean[3] = 2e6
    track = track_of(estimate)
    run(compiled, track, np.empty(0, SAMPLE), np.zeros((1, 4)), np.zeros(1, np.uint8))
    check(track, Estimate(mean=estimate.mean, covariance=np.diag(np.square(compiled._initial))))
