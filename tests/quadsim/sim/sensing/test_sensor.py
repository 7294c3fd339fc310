"""Which sensors are allowed, and the message for all others."""

from __future__ import annotations

import math
from typing import Any

import pytest

from quadsim.errors import ParameterError
from quadsim.sim.sensing import FaultKind, Sensor, SensorFault, SensorName

RIGHT: dict[str, Any] = {"name": SensorName.POSITION, "rate": 20.0}
FAULT: dict[str, Any] = {"sensor": SensorName.RATES, "kind": FaultKind.NAN, "start": 1.0, "stop": 2.0}


def test_times_are_whole_physics_steps() -> None:
    sensor = Sensor(name=SensorName.RATES, rate=200.0, delay=0.11)
    assert (sensor.stride(1e-3), sensor.latency(1e-3)) == (5, 110)
    with pytest.raises(
        ParameterError, match=r"^sensors\.rates\.rate must be a divisor of the physics rate of 1000 Hz; got 3"
    ):
        Sensor(name=SensorName.RATES, rate=300.0).stride(1e-3)
    with pytest.raises(ParameterError, match=r"^sensors\.rates\.rate must be a divisor .*; got 2000"):
        Sensor(name=SensorName.RATES, rate=2000.0).stride(1e-3)
    with pytest.raises(
        ParameterError, match=r"^sensors\.rates\.delay must be a whole multiple of the physics step of 0\.001 s"
    ):
        Sensor(name=SensorName.RATES, rate=200.0, delay=0.0005).latency(1e-3)


def test_windows_begin_and_end_at_the_steps_meant() -> None:
    def window(start: float, stop: float) -> tuple[int, int | None]:
        return SensorFault(**(FAULT | {"start": start, "stop": stop})).window(1e-3)

    assert window(0.3, 0.7) == (300, 700)  # 0.7 / 1e-3 is 700.0000000000001 in binary
    assert window(0.0001, 0.0009) == (1, 1)  # between two steps: none
    assert window(0.0, math.inf) == (0, None)
