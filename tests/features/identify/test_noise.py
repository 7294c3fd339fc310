"""What is not modelled: its innovations, forecasts and intervals, and what they are worth in a prediction."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from flown_logs import COLUMNS, NOISE, fly_eight
from scipy.linalg import expm, solve_discrete_are
from scipy.signal import lfilter

import quadsim
from quadsim.assets import vehicle_path
from quadsim.errors import InputError
from quadsim.features.identify.estimate import Identification
from quadsim.features.identify.fit import identify_records
from quadsim.features.identify.noise import AxisNoise, identify_noise
from quadsim.features.identify.prediction import HORIZONS, predict
from quadsim.features.identify.record import Record
from quadsim.features.identify.vehicle_file import vehicle_text
from quadsim.rollout.flown import Flight
from quadsim.rotation import euler_to_body_rates, euler_to_quaternion
from quadsim.sim.effects import Disturbance
from quadsim.state import ANGLE_RATES, ANGLES, POSITIONS, VELOCITIES, Array

pytestmark = pytest.mark.slow("identification")

PERIOD = 0.01
NOISES = (
    AxisNoise(deviation=5.0, time=0.1, sensor=0.03),
    AxisNoise(deviation=1.0, time=0.5, sensor=0.05),
    AxisNoise(deviation=8.0, time=0.02, sensor=0.001),
)
TRUE = quadsim.load_vehicle("hummingbird")
TORQUE = tuple((np.array([5.0, 4.0, 2.0]) * np.array(TRUE.inertia)).tolist())  # [N m]
FORCE = tuple((np.array([0.6, 0.5, 0.4]) * TRUE.mass).tolist())  # [N]
DISTURBANCE = Disturbance(
    force_deviation=FORCE, force_time=(0.2, 0.3, 0.15), torque_deviation=TORQUE, torque_time=(0.1, 0.2, 0.15)
)


def drawn(noise: AxisNoise, samples: int, seed: int) -> Array:
    """(N,) misfits: the acceleration in steps of a tenth of a period, and differences of the sensor's noise."""
    rng = np.random.default_rng(seed)
    step = PERIOD / 10.0
    kept = np.exp(-step / noise.time)
    drive = noise.deviation * np.sqrt(1.0 - kept**2) * rng.standard_normal(10 * samples + 5000)
    acceleration = lfilter([1.0], [1.0, -kept], drive)[5000:]
    increments = step * acceleration.reshape(samples, 10).sum(axis=1)
    return increments + np.diff(noise.sensor * rng.standard_normal(samples + 1))


@pytest.mark.parametrize("noise", NOISES)
def test_forecasts_are_those_of_a_kalman_filter(noise: AxisNoise) -> None:
    """Of rate and acceleration, in state space: transition by the matrix exponential, covariances by Van Loan."""
    s = noise.deviation
    T = noise.time
    r = noise.sensor
    continuous = np.array([[0.0, 1.0], [0.0, -1.0 / T]])
    intensity = np.diag([0.0, 2.0 * s**2 / T])
    loan = expm(np.block([[-continuous, intensity], [np.zeros((2, 2)), continuous.T]]) * PERIOD)
    F = loan[2:, 2:].T
    Q = F @ loan[:2, 2:]
    H = np.array([[1.0, 0.0]])
    P = solve_discrete_are(F.T, H.T, Q, [[r**2]])
    gain = P @ H.T / (P[0, 0] + r**2)
    misfit = drawn(noise, 600, 0)
    measured = np.concatenate([[0.0], np.cumsum(misfit)])
    state = np.zeros(2)
    for y in measured:
        state = F @ state if y is not measured[0] else state
        state = state + gain[:, 0] * (y - state[0])
    expected = [(np.linalg.matrix_power(F, j) @ state)[0] - measured[-1] for j in range(1, 21)]
    forecast = noise.forecast(misfit, PERIOD, np.array([len(misfit)]), 20)
    np.testing.assert_allclose(np.cumsum(forecast[0]), expected, rtol=1e-6, atol=1e-9)
    _, variance = noise.innovations(misfit, PERIOD)
    assert variance == pytest.approx(P[0, 0] + r**2, rel=1e-8)


def test_a_forecast_knows_nothing_of_what_comes_after_it() -> None:
    noise = NOISES[0]
    misfit = drawn(noise, 400, 1)
    later = misfit.copy()
    later[250:] += 1.0
    starts = np.array([0, 1, 100, 250])
    np.testing.assert_array_equal(noise.forecast(misfit, PERIOD, starts, 50), noise.forecast(later, PERIOD, starts, 50))
    assert not noise.forecast(misfit, PERIOD, starts[:1], 50).any()
    assert not AxisNoise().forecast(misfit, PERIOD, starts, 50).any()


@pytest.mark.parametrize("noise", NOISES)
def test_random_forecast_errors_have_the_spread_of_what_a_forecast_misses(noise: AxisNoise) -> None:
    misfit = drawn(noise, 20_000, 2)
    starts = np.arange(500, 19_900, 50)
    missed = misfit[starts[:, None] + np.arange(25)] - noise.forecast(misfit, PERIOD, starts, 25)
    errors = noise.forecast_errors(np.random.default_rng(3).standard_normal((4000, 25)), PERIOD)
    for horizon in (1, 10, 25):
        spread = [of[:, :horizon].sum(axis=1).std() for of in (missed, errors)]
        assert spread[0] == pytest.approx(spread[1], rel=0.15)


@pytest.mark.parametrize("noise", NOISES)
def test_noise_is_found_with_its_deviations(noise: AxisNoise) -> None:
    """Over ten draws, within three standard deviations of their mean, and as scattered as it says."""
    found = []
    for seed in range(10):
        misfit = drawn(noise, 1600, seed)
        found.append(identify_noise([misfit], [PERIOD], [np.array_split(np.arange(1600), 6)]))
    logarithms = np.log([[fit.noise.deviation / noise.deviation, fit.noise.time / noise.time] for fit in found])
    explained = np.mean([fit.explained for fit in found], axis=0)
    assert (np.abs(logarithms.mean(axis=0)) < 3.0 * explained / np.sqrt(10)).all()
    assert (logarithms.std(axis=0) < 2.0 * explained).all()
    assert min(fit.gain for fit in found) > 50.0


def test_noise_of_the_sensor_alone_is_no_disturbance() -> None:
    misfit = np.diff(0.03 * np.random.default_rng(0).standard_normal(1601))
    found = identify_noise([misfit], [PERIOD], [np.array_split(np.arange(1600), 6)])
    assert found.gain < 5.0
    assert found.noise.sensor == pytest.approx(0.03, rel=0.1)


@cache
def disturbed() -> Record:
    """A figure eight of 18 s that is disturbed, as its sensors show it."""
    return record_of(
        fly_eight(
            "hummingbird",
            **{"effects.disturbance": vars(DISTURBANCE), "seed": 4, "reference.turns": 4.0},
        )
    )


def record_of(flight: Flight, seed: int = 0) -> Record:
    log = flight.log.control
    angles = log.state[:, ANGLES]
    noise = dict(zip(COLUMNS.split(","), NOISE, strict=True))
    rng = np.random.default_rng(seed)

    def noisy(rows: Array, name: str) -> Array:
        return rows + noise[name] * rng.standard_normal(rows.shape)

    return Record(
        name="eight",
        t=log.t,
        position=noisy(log.state[:, POSITIONS], "x"),
        velocity=noisy(log.state[:, VELOCITIES], "vx"),
        attitude=euler_to_quaternion(angles),
        rates=noisy(euler_to_body_rates(angles, log.state[:, ANGLE_RATES]), "wx"),
        commands=log.speeds,
    )


@cache
def identified() -> Identification:
    record = disturbed()
    return identify_records([record], [[slice(0, round(0.75 * len(record.t)))]], TRUE)


def test_the_intervals_of_a_disturbance_hold_the_truth() -> None:
    truth = [*zip(TORQUE, DISTURBANCE.torque_time or (), strict=True)]
    truth += zip(FORCE, DISTURBANCE.force_time or (), strict=True)
    estimates = identified().disturbance
    assert [estimate.kind + estimate.axis for estimate in estimates] == [
        f"{k}{a}" for k in ("torque", "force") for a in "xyz"
    ]
    missed = []
    for estimate, (deviation, time) in zip(estimates, truth, strict=True):
        assert not estimate.refused
        low, high = estimate.deviation_interval
        shortest, longest = estimate.time_interval
        missed += [] if low <= deviation <= high else [estimate]
        missed += [] if shortest <= time <= longest else [estimate]
    assert not missed


def test_a_prediction_that_starts_from_the_disturbance_is_better_and_near_the_floor() -> None:
    record = disturbed()
    known = identified()
    found = predict([record], [[slice(round(0.75 * len(record.t)), len(record.t))]], known, TRUE)
    at = [HORIZONS.index(horizon) for horizon in (0.1, 0.25)]
    errors = {name: of[at] for name, of in found.errors.items()}
    ratios = errors["identified"][:, 1:] / errors["undisturbed"][:, 1:]
    assert (ratios < [[0.85], [0.98]]).all()
    ratio = errors["identified"][:, 3] / errors["floor"][:, 3]
    assert (ratio > 0.6).all()
    assert (ratio < 1.6).all()
    unknown = predict([record], [[slice(0, 400)]], replace(known, noise=()), TRUE)
    assert unknown.errors["identified"] == pytest.approx(unknown.errors["undisturbed"], rel=1e-12)
    assert unknown.errors["floor"].max() < 1e-12


def test_the_true_vehicle_may_lose_to_rates_that_are_held() -> None:
    """After half a second of a disturbed hover, by a factor of two: at the floor, and beyond what is judged."""
    first = quadsim.scenario(vehicle="hummingbird", controller="geometric").scenario
    hover = {"control_period": 0.01, "duration": 12.0, "constraints": [], "effects.disturbance": vars(DISTURBANCE)}
    record = record_of(quadsim.fly(first.replace(hover), progress=False))
    deviations = np.concatenate([np.array(TORQUE) / TRUE.inertia, np.array(FORCE) / TRUE.mass])
    times = (*(DISTURBANCE.torque_time or ()), *(DISTURBANCE.force_time or ()))
    noise = [
        AxisNoise(deviation=deviation, time=time, sensor=1e-2)
        for deviation, time in zip(deviations.tolist(), times, strict=True)
    ]
    true = Identification(estimates=(), vehicle=TRUE, delay=0.0, offset=(0.0, 0.0), noise=tuple(noise))
    found = predict([record], [[slice(100, len(record.t))]], true, TRUE)
    assert found.errors["undisturbed"][-1, 3] > 2.0 * found.errors["rates held"][-1, 3]
    assert found.errors["identified"][-1, 3] > 1.2 * found.errors["rates held"][-1, 3]
    assert found.errors["identified"][1, 3] < 0.9 * found.errors["undisturbed"][1, 3]
    assert found.errors["identified"][:, 3] == pytest.approx(found.errors["floor"][:, 3], rel=0.2)
    assert not found.lost  # at the horizons that are judged


def test_one_window_has_no_past() -> None:
    found = predict([disturbed()], [[slice(300, 360)]], identified(), TRUE)
    assert found.windows == 1
    assert found.errors["identified"] == pytest.approx(found.errors["undisturbed"], rel=1e-9)


def test_only_what_precedes_a_window_moves_its_start() -> None:
    """Another future of rates and velocities changes no predicted state of the windows that begin before it."""
    record = disturbed()
    cut = 600
    rates = record.rates.copy()
    velocity = record.velocity.copy()
    rates[cut + 1 :] += 3.0
    velocity[cut + 1 :] -= 2.0
    other = replace(record, rates=rates, velocity=velocity)
    span = slice(cut - 250, cut + 51)
    before, after = (
        predict([of], [[span]], identified(), TRUE).trace.predicted["identified"] for of in (record, other)
    )
    assert len(before) > 4
    np.testing.assert_array_equal(before, after)


def test_the_first_scenario_of_the_file_is_disturbed_as_its_flights_were(tmp_path: Path) -> None:
    file = tmp_path / "mine.toml"
    file.write_text(vehicle_text(identified(), vehicle_path("hummingbird"), ["eight.csv"]), encoding="utf-8")
    first = quadsim.scenario(vehicle=file, course="figure-eight", controller="geometric")
    stated = first.scenario.effects.disturbance
    assert stated is not None
    for estimate in identified().disturbance:
        place = "xyz".index(estimate.axis)
        assert getattr(stated, f"{estimate.kind}_deviation")[place] == pytest.approx(estimate.deviation, rel=5e-3)
        assert getattr(stated, f"{estimate.kind}_time")[place] == pytest.approx(estimate.time, rel=5e-3)
    flight = quadsim.fly(first.scenario.replace({"duration": 4.0}), progress=False)
    calm = quadsim.fly(first.scenario.replace({"duration": 4.0, "effects.disturbance": None}), progress=False)
    spread = [of.log.control.state[:, ANGLE_RATES].std() for of in (flight, calm)]
    assert spread[0] > 1.05 * spread[1]
    again = quadsim.scenario(vehicle="hummingbird").scenario
    assert again.effects.disturbance is None


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ("torque_deviation = [1.0, 1.0, 1.0]\nsource = 'a guess'", "torque_time must be three time constants"),
        ("torque_deviation = [1.0, 1.0]\nsource = 'a guess'", "torque_deviation"),
        ("torque = [1.0, 1.0, 1.0]", "a table with a source"),
        ("torques = 1.0\nsource = 'a guess'", "torques"),
    ],
)
def test_a_disturbance_of_a_file_that_cannot_be_is_refused(tmp_path: Path, table: str, message: str) -> None:
    file = tmp_path / "mine.toml"
    text = vehicle_path("hummingbird").read_text(encoding="utf-8")
    file.write_text(f"{text}\n[disturbance]\n{table}\n", encoding="utf-8")
    with pytest.raises(InputError, match=message):
        quadsim.scenario(vehicle=file)
