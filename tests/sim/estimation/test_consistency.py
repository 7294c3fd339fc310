"""Consistency over seeds: does the filter's covariance match its errors?

Truth is a rigid body disturbed by white force and torque of the very densities that the filter assumes; the first
estimate is wrong by a draw of the stated covariance, the gyro's bias too.  Then the normalised estimation error squared
(NEES) is chi-square with 15 degrees of freedom, and the normalised innovation squared (NIS) of each sample with 3.
Bar-Shalom, Li and Kirubarajan, "Estimation with Applications to Tracking and Navigation", 2001, Sec. 5.4.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2

from quadsim.sim.estimator import EstimatorSettings
from quadsim.sim.sensing import Sensor, SensorName
from quadsim.vehicle import Vehicle

SEEDS = 30
FEW = 20
"""That are enough to see a noise that is wrong by half."""
STEPS = 1000
SETTINGS = EstimatorSettings(acceleration_noise=0.3, angular_acceleration_noise=1.0, gate=1.0 - 1e-12)
SENSORS = {
    SensorName.POSITION: Sensor(rate=20.0, noise=(0.05, 0.05, 0.1)),
    SensorName.VELOCITY: Sensor(rate=20.0, noise=0.1),
    SensorName.ATTITUDE: Sensor(rate=50.0, noise=tuple(np.degrees([0.01, 0.01, 0.02]))),
    SensorName.RATES: Sensor(rate=100.0, noise=math.degrees(0.01)),
}
LATE = {
    name: replace(sensor, delay={"position": 0.11, "velocity": 0.11, "attitude": 0.02}.get(name, 0.0))
    for name, sensor in SENSORS.items()
}


@pytest.fixture(scope="module")
def motion(vehicle: Vehicle, simulate_motion: Callable[..., Any]) -> Any:
    """Flights that start tilted by 70 deg, near the turn of yaw, and are shaken."""
    rng = np.random.default_rng(1)
    commands = np.repeat(vehicle.hover_speed + 4.0 * rng.standard_normal((STEPS // 50, 4)), 50, axis=0)
    return simulate_motion(SETTINGS, commands, seeds=SEEDS, rng=rng, attitude=(70.0, 20.0, 175.0))


def within(total: float, count: int) -> bool:
    """Whether a sum of `count` squared standard normals is inside its interval of 99.9 %."""
    lower, upper = chi2.ppf([0.0005, 0.9995], count)
    return bool(lower < total < upper)


@pytest.mark.parametrize("sensors", [SENSORS, LATE], ids=["prompt", "late"])
def test_errors_and_innovations_match_the_filters_covariance(
    sensors: dict[SensorName, Sensor], motion: Any, run_filter: Callable[..., Any]
) -> None:
    last = []
    middle = []
    nis = dict.fromkeys(sensors, 0.0)
    counts = dict.fromkeys(nis, 0)
    for seed in range(SEEDS):
        filter_, _, _, nees = run_filter(motion, sensors, SETTINGS, seed=seed, chunk=250)
        last.append(nees[-1])
        middle.append(nees[len(nees) // 2])
        for name, tally in filter_.tallies.items():
            assert tally.rejected == 0
            nis[name] += tally.nis
            counts[name] += 3 * tally.accepted
    assert within(sum(last), 15 * SEEDS)
    assert within(sum(middle), 15 * SEEDS)
    for name, total in nis.items():
        assert counts[name] >= 3 * SEEDS * 17
        assert within(total, counts[name]), name


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_a_filter_with_the_wrong_noise_fails_the_same_test(
    factor: float, motion: Any, run_filter: Callable[..., Any]
) -> None:
    assumed = {name: replace(s, noise=tuple(np.sqrt(factor) * np.ones(3) * s.noise)) for name, s in SENSORS.items()}
    runs = [run_filter(motion, SENSORS, SETTINGS, seed=seed, assumed=assumed, chunk=250) for seed in range(FEW)]
    assert not within(sum(nees[-1] for *_, nees in runs), 15 * FEW)
    for name in (SensorName.POSITION, SensorName.ATTITUDE):
        tallies = [filter_.tallies[name] for filter_, *_ in runs]
        assert not within(sum(tally.nis for tally in tallies), 3 * sum(tally.accepted for tally in tallies))
