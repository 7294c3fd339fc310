"""`[sensors]` and `[estimator]`: their units, and the messages for wrong ones."""

from __future__ import annotations

import math
from typing import Any

import pytest
from support import scenario_table

from quadsim.scenarios.assembly import Assembly
from quadsim.scenarios.loading import parse_scenario
from quadsim.scenarios.schema.events import SensorFaultEvent
from quadsim.scenarios.schema.scenario import Scenario
from quadsim.sim.sensing import FaultKind, Outliers, SensorFault, SensorName, in_si
from quadsim.vehicle import Vehicle

SENSORS: dict[str, Any] = {
    "position": {"rate": 20, "noise": [0.1, 0.1, 0.2], "delay": 0.11},
    "attitude": {"rate": 100.0, "noise": 1.0, "outliers": {"probability": 0.01, "size": 10.0}},
    "rates": {"rate": 200.0, "noise": 0.3, "bias": [0.5, -0.5, 0.0], "bias_walk": 0.002, "dropout": 0.1},
}
ESTIMATOR: dict[str, Any] = {"type": "error_state", "initial_attitude": 2.0}


def scenario(**tables: Any) -> Scenario:
    return parse_scenario(scenario_table() | tables)


def test_sensors_are_in_the_file_s_units_and_convert_to_si() -> None:
    sensors = Assembly(scenario(sensors=SENSORS)).sensors
    assert [*sensors] == [SensorName.POSITION, SensorName.ATTITUDE, SensorName.RATES]
    position, attitude, rates = sensors.values()
    assert (position.rate, position.delay, rates.dropout) == (20.0, 0.11, 0.1)
    assert attitude.outliers == Outliers(probability=0.01, size=10.0)
    for name, value, expected in (
        (SensorName.POSITION, position.noise, [0.1, 0.1, 0.2]),
        (SensorName.ATTITUDE, attitude.noise, [math.radians(1.0)] * 3),
        (SensorName.RATES, rates.noise, [math.radians(0.3)] * 3),
        (SensorName.RATES, rates.bias, [math.radians(0.5), math.radians(-0.5), 0.0]),
        (SensorName.RATES, rates.bias_walk, [math.radians(0.002)] * 3),
    ):
        assert in_si(name, value) == pytest.approx(expected)


def test_the_estimator_flies_by_its_table(vehicle: Vehicle) -> None:
    spec = scenario(sensors=SENSORS, estimator=ESTIMATOR).estimator
    assert spec is not None
    assert (spec.initial_attitude, spec.initial_gyro_bias) == (2.0, 0.5)
    assert (spec.acceleration_noise, spec.initial_position, spec.gate) == (0.3, 0.05, 0.9999)
    navigation = Assembly(scenario(sensors=SENSORS, estimator=ESTIMATOR)).navigation()
    assert navigation is not None


def test_faults_are_in_si_units() -> None:
    event = SensorFaultEvent(at=2.0, sensor="rates", fault="bias", duration=1.5, offset=(180.0, 0.0, 0.0))
    assert event.in_si() == SensorFault(
        sensor=SensorName.RATES, kind=FaultKind.BIAS, start=2.0, stop=3.5, offset=(math.pi, 0.0, 0.0)
    )


def test_perfect_state_stays_the_default(vehicle: Vehicle) -> None:
    assert Assembly(scenario()).navigation() is None
    assert Assembly(scenario(sensors=SENSORS)).navigation() is not None
