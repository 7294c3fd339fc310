"""The filter over time: late samples, lost ones, wrong ones, and large angles."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from quadsim.core.structs import SAMPLE
from quadsim.errors import ParameterError
from quadsim.sim.estimator import ErrorStateFilter, EstimatorSettings
from quadsim.sim.sensing import FaultKind, Outliers, Sensor, SensorFault, SensorName, in_si
from quadsim.vehicle import Vehicle

SETTINGS = EstimatorSettings(acceleration_noise=0.1, angular_acceleration_noise=0.5)
SENSORS = {
    SensorName.POSITION: Sensor(rate=20.0, noise=0.05),
    SensorName.VELOCITY: Sensor(rate=20.0, noise=0.05),
    SensorName.ATTITUDE: Sensor(rate=50.0, noise=math.degrees(0.01)),
    SensorName.RATES: Sensor(rate=100.0, noise=math.degrees(0.01)),
}
SIMULATE = Callable[..., Any]


def without(*names: SensorName) -> dict[SensorName, Sensor]:
    return {name: sensor for name, sensor in SENSORS.items() if name not in names}


def hover(vehicle: Vehicle, steps: int) -> np.ndarray:
    return np.full((steps, 4), vehicle.hover_speed)


@pytest.fixture(scope="module")
def gentle(vehicle: Vehicle, simulate_motion: SIMULATE) -> Any:
    """Three seconds, shaken as the filter assumes, from level."""
    return simulate_motion(SETTINGS, hover(vehicle, 3000), seeds=12, rng=np.random.default_rng(5))


def rms(errors: list[np.ndarray], block: slice) -> float:
    return float(np.sqrt(np.mean([np.square(e[:, block]) for e in errors])))


@pytest.mark.slow("estimator")
def test_without_disturbance_and_with_little_noise_the_estimate_becomes_the_truth(
    vehicle: Vehicle, simulate_motion: SIMULATE, run_filter: SIMULATE
) -> None:
    still = EstimatorSettings(acceleration_noise=0.0, angular_acceleration_noise=0.0, gyro_bias_walk=0.0)
    commands = np.repeat(vehicle.hover_speed + np.random.default_rng(0).standard_normal((40, 4)), 50, axis=0)
    motion = simulate_motion(still, commands, seeds=1, rng=np.random.default_rng(0))
    fine = {
        name: replace(sensor, noise=1e-4 if name in ("position", "velocity") else math.degrees(1e-4))
        for name, sensor in SENSORS.items()
    }
    assumed = replace(still, acceleration_noise=1e-3, angular_acceleration_noise=1e-2)
    _, errors, _, _ = run_filter(motion, fine, assumed, seed=0)
    assert np.abs(errors[0]).max() > 1e-3  # the gyro's bias at first
    assert np.abs(errors[-1]).max() < 3e-4


@pytest.mark.slow("estimator")
@pytest.mark.representative("estimator")
def test_the_estimate_is_better_than_the_samples(gentle: Any, run_filter: SIMULATE) -> None:
    errors = [run_filter(gentle, SENSORS, SETTINGS, seed=seed)[1][20:] for seed in range(4)]
    assert rms(errors, slice(0, 3)) < 0.5 * in_si(SensorName.POSITION, SENSORS[SensorName.POSITION].noise)[0]
    assert rms(errors, slice(6, 9)) < 0.5 * in_si(SensorName.ATTITUDE, SENSORS[SensorName.ATTITUDE].noise)[0]


@pytest.mark.slow("estimator")
def test_late_samples_are_weighted_by_their_time_stamp(
    vehicle: Vehicle, simulate_motion: SIMULATE, run_filter: SIMULATE
) -> None:
    """Falling, a tenth of a second is worth many times the noise; the naive filter does not know the delay."""
    motion = simulate_motion(SETTINGS, 0.9 * hover(vehicle, 2000), seeds=2, rng=np.random.default_rng(2))
    late = SENSORS | {name: replace(SENSORS[name], delay=0.1) for name in (SensorName.POSITION, SensorName.VELOCITY)}
    prompt, fused, naive = (
        rms([run_filter(motion, sensors, SETTINGS, seed=s, assumed=assumed)[1][20:] for s in range(2)], slice(0, 3))
        for sensors, assumed in ((SENSORS, SENSORS), (late, late), (late, SENSORS))
    )
    assert fused < 1.5 * prompt
    assert naive > 5.0 * fused


def test_a_filter_at_a_late_horizon_finds_what_a_prompt_one_does(gentle: Any, run_filter: SIMULATE) -> None:
    """The same samples with and without a horizon: only the order of the computation differs."""
    far = Sensor(rate=0.1, noise=1e6, delay=0.2)  # no information, moves the horizon
    (_, prompt, deviations, _), (_, late, same, _) = (
        run_filter(gentle, SENSORS | {SensorName.VELOCITY: last}, SETTINGS, seed=0)
        for last in (replace(far, delay=0.0), far)
    )
    np.testing.assert_allclose(late, prompt, atol=1e-9)
    np.testing.assert_allclose(same, deviations, atol=1e-9)


@pytest.mark.parametrize("delay", [0.0, 0.03])
def test_estimates_do_not_depend_on_how_time_is_cut(delay: float, gentle: Any, run_filter: SIMULATE) -> None:
    sensors = {name: replace(sensor, delay=delay) for name, sensor in SENSORS.items()}
    _, whole, _, _ = run_filter(gentle, sensors, SETTINGS, seed=0, chunk=300)
    _, cut, _, _ = run_filter(gentle, sensors, SETTINGS, seed=0, chunk=12)
    assert np.array_equal(cut[24::25], whole)


@pytest.mark.parametrize("attitude", [(0.0, 0.0, 178.0), (75.0, 0.0, 0.0), (0.0, -88.0, 90.0), (170.0, 40.0, -179.0)])
def test_any_attitude_is_as_good_as_level(
    attitude: tuple[float, float, float], vehicle: Vehicle, simulate_motion: SIMULATE, run_filter: SIMULATE
) -> None:
    motion = simulate_motion(
        SETTINGS,
        hover(vehicle, 500),
        seeds=4,
        rng=np.random.default_rng(5),
        attitude=attitude,
        rates=(0.0, 0.0, 0.5),
    )
    filters, errors, deviations, _ = zip(
        *[run_filter(motion, SENSORS, SETTINGS, seed=s) for s in range(4)], strict=True
    )
    assert sum(tally.rejected for filter_ in filters for tally in filter_.tallies.values()) == 0
    assert rms(list(errors), slice(6, 9)) < 1.3 * rms(list(deviations), slice(6, 9)) < 0.01


def test_without_samples_the_covariance_grows_and_comes_back(gentle: Any, run_filter: SIMULATE) -> None:
    gone = tuple(
        SensorFault(sensor=name, kind=FaultKind.DROPOUT, start=1.0, stop=2.0)
        for name in (SensorName.POSITION, SensorName.VELOCITY)
    )
    filter_, errors, deviations, _ = run_filter(gentle, SENSORS, SETTINGS, seed=1, faults=gone)
    x = deviations[:, 0]  # after 0.05, 0.1 .. 3 s
    assert np.all(np.diff(x[19:39]) > 0.0)
    assert x[38] > 2.0 * x[18]
    assert x[-1] < 1.2 * x[18]
    assert np.all(np.abs(errors[:, :3]) < 5.0 * deviations[:, :3])
    assert filter_.tallies[SensorName.POSITION].rejected == 0


def test_outliers_are_refused_and_do_no_harm(gentle: Any, run_filter: SIMULATE) -> None:
    outliers = Outliers(probability=0.1, size=100.0)
    wild = {name: replace(sensor, outliers=outliers) for name, sensor in SENSORS.items()}
    rejected = 0
    total = 0
    clean = []
    dirty = []
    for seed in range(4):
        clean.append(run_filter(gentle, SENSORS, SETTINGS, seed=seed)[1][20:])
        filter_, errors, _, _ = run_filter(gentle, wild, SETTINGS, seed=seed)
        dirty.append(errors[20:])
        rejected += sum(tally.rejected for tally in filter_.tallies.values())
        total += sum(tally.rejected + tally.accepted for tally in filter_.tallies.values())
    assert 0.07 < rejected / total < 0.11  # some outliers are small enough to pass
    assert rms(dirty, slice(0, 3)) < 1.3 * rms(clean, slice(0, 3))


def test_samples_that_are_no_numbers_are_refused_and_counted(gentle: Any, run_filter: SIMULATE) -> None:
    blank = tuple(
        SensorFault(sensor=name, kind=FaultKind.NAN, start=1.0, stop=2.0, axes=(axis,))
        for name, axis in zip(SensorName, (0, 1, 2, 0), strict=True)
    )
    filter_, errors, deviations, _ = run_filter(gentle, SENSORS, SETTINGS, seed=2, faults=blank)
    assert {str(name): tally.rejected for name, tally in filter_.tallies.items()} == {
        "position": 20,
        "velocity": 20,
        "attitude": 50,
        "rates": 100,
    }
    assert np.isfinite(errors).all()
    assert np.all(np.abs(errors[-1]) < 5.0 * deviations[-1])


def test_a_sensor_rejected_for_long_is_used_again(gentle: Any, run_filter: SIMULATE) -> None:
    moved = SensorFault(sensor=SensorName.POSITION, kind=FaultKind.BIAS, start=0.5, offset=(10.0, 0.0, 0.0))
    for patience, used_again in ((1.0, True), (0.0, False)):
        settings = replace(SETTINGS, patience=patience)
        filter_, errors, _, _ = run_filter(gentle, SENSORS, settings, seed=3, faults=(moved,))
        assert abs(errors[28, 0]) < 0.3  # at 1.45 s
        assert bool(abs(errors[-1, 0] + 10.0) < 0.3) is used_again
        tally = filter_.tallies[SensorName.POSITION]
        assert tally.rejected == (20 if used_again else 51)


def test_a_velocity_far_off_is_found_again(gentle: Any, run_filter: SIMULATE) -> None:
    """A collision at 1 s that no model knows of; from positions alone, once they have been refused for 0.5 s."""
    physics = gentle.physics.copy()
    after = np.arange(2000)[:, None] * 1e-3
    physics[:, 1001:, 8:11] += [5.0, 0.0, -7.0]
    physics[:, 1001:, 1:4] += after * [5.0, 0.0, -7.0]
    settings = replace(SETTINGS, patience=0.5)
    sensors = without(SensorName.VELOCITY)
    filter_, errors, deviations, _ = run_filter(replace(gentle, physics=physics), sensors, settings, seed=0)
    assert np.abs(errors[28, 3:6]).max() > 4.0  # at 1.45 s, still unassumed
    assert np.all(np.abs(errors[42:, :6]) < 5.0 * deviations[42:, :6])  # from 2.15 s on
    assert np.abs(errors[-1, 3:6]).max() < 0.3
    assert filter_.tallies[SensorName.POSITION].rejected <= 11


def test_a_gyro_that_comes_to_be_far_off_is_found_out(gentle: Any, run_filter: SIMULATE) -> None:
    """20 times the assumed bias: it is the attitude that is refused, as the rates follow the gyro."""
    shifted = SensorFault(
        sensor=SensorName.RATES, kind=FaultKind.BIAS, start=0.0, offset=tuple(np.radians([10.0, -10.0, 10.0]))
    )
    stubborn, patient = (
        run_filter(gentle, SENSORS, replace(SETTINGS, patience=patience), seed=1, faults=(shifted,))
        for patience in (0.0, 0.5)
    )
    assert np.degrees(np.abs(stubborn[1][-1, 6:9])).max() > 10.0
    assert np.degrees(np.abs(patient[1][-20:, 6:9])).max() < 2.0
    result = patient[1][-1, 12:15] + shifted.offset  # what is left of the bias and the fault's together
    assert np.degrees(np.abs(result)).max() < 0.5


def test_it_never_fails_nor_answers_with_nan(vehicle: Vehicle) -> None:
    """Samples of any size, and a vehicle driven into a spin that no rotor could give it."""
    rng = np.random.default_rng(0)
    filter_ = ErrorStateFilter(vehicle, SENSORS, replace(SETTINGS, patience=0.1), timestep=1e-3)
    for wild in (1.0, 1e3, 1e5, 1e300, math.inf, math.nan):
        mean = np.zeros(16)
        mean[6] = 1.0
        filter_.reset(mean, np.zeros(4), rng)
        for k in range(15):
            samples = np.empty(20, SAMPLE)
            samples["taken"] = np.repeat(range(50 * k + 10, 50 * k + 51, 10), 4)
            samples["kind"] = np.tile(range(4), 5)
            samples["value"] = wild * rng.standard_normal((20, 3))
            filter_.advance(rng.uniform(0.0, 5e3, (50, 4)), [samples])
            mean, covariance = filter_.estimate()
            assert np.isfinite(mean).all()
            assert np.isfinite(covariance).all()


@pytest.mark.parametrize(
    ("sensors", "message"),
    [
        (
            without(SensorName.POSITION, SensorName.RATES),
            r"estimator\.sensors must be such that position is among them; got \['velocity', 'attit",
        ),
        (
            without(SensorName.VELOCITY, SensorName.ATTITUDE),
            r"estimator\.sensors must be such that attitude is among them; got \['position', 'rates'\]",
        ),
    ],
)
def test_sensors_it_cannot_work_with_are_refused(
    sensors: dict[SensorName, Sensor], message: str, vehicle: Vehicle
) -> None:
    with pytest.raises(ParameterError, match=f"^{message}"):
        ErrorStateFilter(vehicle, sensors, SETTINGS, timestep=1e-3)
