"""From `[sensors]`, `[estimator]` and the sensors' faults to the state that the controller receives."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

from quadsim.sim.navigation import Navigation
from quadsim.sim.sensing import AXES, FaultKind, Sensor, SensorFault, SensorName
from quadsim.vehicle import Vehicle
from scenarios.parts.randomness import generator
from scenarios.schema.events import SensorFaultEvent

if TYPE_CHECKING:
    from scenarios.schema.scenario import Scenario


_UNITS: Final = {
    SensorName.POSITION: 1.0,
    SensorName.VELOCITY: 1.0,
    SensorName.ATTITUDE: math.radians(1.0),
    SensorName.RATES: math.radians(1.0),
}
"""The scenario file's unit of each sensor in the testbed's."""


def build_navigation(scenario: Scenario, vehicle: Vehicle) -> Navigation | None:
    """The source of the controller's state; None where that is the true one.

    Raises:
        ParameterError: a fault of a sensor that the estimator does not have.
    """
    sensors, faults = () if scenario.sensors is None else build_sensors(scenario), build_faults(scenario)
    if not sensors and not faults and scenario.estimator is None:
        return None
    return Navigation(
        vehicle,
        timestep=scenario.plant.timestep,
        sensors=sensors,
        rng=generator(scenario.seed, "sensors"),
        faults=faults,
        estimator=scenario.estimator,
    )


def build_faults(scenario: Scenario) -> tuple[SensorFault, ...]:
    """The faults of the sensors."""
    events = (event for event in scenario.events if isinstance(event, SensorFaultEvent))
    return tuple(
        build_fault(e.sensor, e.fault, start=e.at, duration=e.duration, axes=e.axes, offset=e.offset) for e in events
    )


def build_sensors(scenario: Scenario) -> tuple[Sensor, ...]:
    """The sensors that the scenario has, in SI units."""
    found = []
    for name, spec in ({} if scenario.sensors is None else scenario.sensors.present()).items():
        of_axes = {field: _three(getattr(spec, field), _UNITS[name]) for field in ("noise", "bias", "bias_walk")}
        found.append(Sensor(name=name, **{**vars(spec), **of_axes}))
    return tuple(found)


def build_fault(
    sensor: str,
    kind: str,
    *,
    start: float,
    duration: float = math.inf,
    axes: Sequence[str] | None = None,
    offset: Sequence[float] | None = None,
) -> SensorFault:
    """A sensor's fault in the words and units of a scenario file; see `scenarios.schema.events.SensorFaultEvent`."""
    name = SensorName(sensor)
    added = _three(0.0 if offset is None else offset, _UNITS[name])
    affected = AXES if axes is None else tuple(sorted({"xyz".index(axis) for axis in axes}))
    return SensorFault(
        sensor=name, kind=FaultKind(kind), start=start, stop=start + duration, axes=affected, offset=added
    )


def _three(value: float | Sequence[float], unit: float) -> tuple[float, float, float]:
    x, y, z = [value] * 3 if isinstance(value, float | int) else value
    return unit * x, unit * y, unit * z
