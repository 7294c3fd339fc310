"""What a flight is started with so that more may happen in it than in its scenario.

A model is compiled, sensors are sampled and forces are evaluated in one way where something may happen to them, and in
another where nothing can, with other last bits.  An event that changes nothing decides: it is in the scenario of a
live flight and in the one that is saved of it, whether or not anything of its kind happened.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal, get_args

from quadsim.sim.effects.load import Load
from quadsim.sim.effects.wind import Air, Gust, WindChange
from quadsim.vehicle import Vehicle
from scenarios.parts.vehicle import actual_effects
from scenarios.schema.events import (
    Event,
    MassEvent,
    PayloadDropEvent,
    PayloadPickupEvent,
    PushEvent,
    SensorFaultEvent,
    WindEvent,
)

if TYPE_CHECKING:
    from scenarios.schema.scenario import Scenario

SensorText = Literal["position", "velocity", "attitude", "rates"]


def prepared(scenario: Scenario, vehicle: Vehicle) -> Scenario:
    """A scenario in whose flight anything may happen that can happen to its vehicle.

    Wind needs drag to push; with the integrator rk4 the mass is fixed, and with an estimator there are the sensors that
    it has.
    """
    air = actual_effects(scenario, vehicle).air
    kinds: list[Event] = [_push(scenario)]
    if scenario.plant.integrator == "mujoco":
        kinds.append(_mass(scenario))
    if air is not None and air.drags:
        kinds.append(_wind(scenario))
    there = {} if scenario.sensors is None else scenario.sensors.present()
    names = [*there] if scenario.estimator is not None else [*get_args(SensorText)]
    kinds += [_fault(scenario, name) for name in get_args(SensorText) if name in names]
    added = [event for event in kinds if event not in scenario.events]
    return scenario.model_copy(update={"events": [*added, *scenario.events]})  # what the file has at 0 comes after


def neutral(scenario: Scenario, event: Event) -> Event | None:
    """An event at the start that changes nothing, and prepares a flight for one; None where it needs no preparing."""
    if isinstance(event, PushEvent):
        return _push(scenario)
    if isinstance(event, MassEvent | PayloadPickupEvent | PayloadDropEvent):
        return _mass(scenario)
    if isinstance(event, Gust | WindChange):
        return _wind(scenario)
    return _fault(scenario, event.sensor) if isinstance(event, SensorFaultEvent) else None


def _push(scenario: Scenario) -> PushEvent:
    return PushEvent(type="push", at=0.0, duration=scenario.plant.timestep, force=(0.0, 0.0, 0.0))


def _mass(scenario: Scenario) -> MassEvent:
    return MassEvent(type="mass", at=0.0, factor=(scenario.effects.load or Load()).mass_factor)


def _wind(scenario: Scenario) -> WindEvent:
    return WindEvent(type="wind", at=0.0, velocity=(scenario.effects.air or Air()).wind)


def _fault(scenario: Scenario, sensor: SensorText) -> SensorFaultEvent:
    nothing, step = [0.0, 0.0, 0.0], scenario.plant.timestep
    return SensorFaultEvent(type="sensor_fault", at=0.0, sensor=sensor, fault="bias", offset=nothing, duration=step)
