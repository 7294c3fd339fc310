"""Which sensors are allowed, and the message for all others."""

from __future__ import annotations

import math
from typing import Any

import pytest

from quadsim.errors import ParameterError
from quadsim.sim.sensing.sensor import FaultKind, Outliers, Sensor, SensorFault, SensorName

RIGHT: dict[str, Any] = {"name": SensorName.POSITION, "rate": 20.0}
FAULT: dict[str, Any] = {"sensor": SensorName.RATES, "kind": FaultKind.NAN, "start": 1.0, "stop": 2.0}


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"rate": 0.0}, "sensors.position.rate must be positive; got 0.0"),
        ({"rate": -1.0}, "sensors.position.rate must be at least 0, and finite; got -1.0"),
        ({"rate": math.nan}, "sensors.position.rate must be at least 0, and finite; got nan"),
        ({"noise": (1.0, -1.0, 1.0)}, "sensors.position.noise must be at least 0, and finite; got -1.0"),
        ({"noise": (1.0, 1.0)}, r"sensors.position.noise must be three numbers; got \(1.0, 1.0\)"),
        ({"bias": (math.inf, 0.0, 0.0)}, "sensors.position.bias must be a finite number; got inf"),
        ({"bias_walk": (-1.0, 0.0, 0.0)}, "sensors.position.bias_walk must be at least 0, and finite; got -1.0"),
        ({"delay": -0.1}, "sensors.position.delay must be at least 0, and finite; got -0.1"),
        ({"dropout": 1.5}, "sensors.position.dropout must be at least 0 and at most 1, and finite; got 1.5"),
    ],
)
def test_a_wrong_sensor_is_refused_with_its_field(wrong: dict[str, Any], message: str) -> None:
    Sensor(**RIGHT)
    with pytest.raises(ParameterError, match=f"^{message}$"):
        Sensor(**(RIGHT | wrong))


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"stop": 1.0}, "fault.stop must be after start = 1.0 s; got 1.0"),
        ({"stop": math.nan}, "fault.stop must be after start = 1.0 s; got nan"),
        ({"start": math.nan}, "fault.start must be a finite number; got nan"),
        ({"axes": (3,)}, r"fault.axes must be one or more of 0, 1, 2; got \(3,\)"),
        ({"axes": ()}, r"fault.axes must be one or more of 0, 1, 2; got \(\)"),
        ({"offset": (1.0, 2.0, math.nan)}, "fault.offset must be a finite number; got nan"),
    ],
)
def test_a_wrong_fault_is_refused_with_its_field(wrong: dict[str, Any], message: str) -> None:
    SensorFault(**FAULT)
    with pytest.raises(ParameterError, match=f"^{message}$"):
        SensorFault(**(FAULT | wrong))


def test_wrong_outliers_are_refused() -> None:
    with pytest.raises(
        ParameterError, match=r"^outliers\.probability must be at least 0 and at most 1, and finite; got 2"
    ):
        Outliers(probability=2.0, size=10.0)
    with pytest.raises(ParameterError, match=r"^outliers\.size must be at least 1, and finite; got 0\.5$"):
        Outliers(probability=0.1, size=0.5)


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
