"""Events that change nothing, with which a flight is started so that more may happen in it; and events in words.

A model is compiled, sensors are sampled and forces are evaluated in one way where something may happen to them, and in
another where nothing can, with other last bits.  An event that changes nothing decides: it is in the scenario of a
live flight and in the one that is saved of it, whether or not anything of its kind happened.
"""

from __future__ import annotations

from itertools import groupby
from typing import TYPE_CHECKING, Any, Final, get_args

from quadsim.errors import printable
from quadsim.sim.effects import LOADING, Push
from quadsim.sim.effects.load import Load, MassChange
from quadsim.sim.effects.wind import Air, Gust, WindChange
from quadsim.vehicle import Vehicle
from scenarios.parts.vehicle import actual_effects
from scenarios.schema.events import Event, SensorFaultEvent, SensorText

if TYPE_CHECKING:
    from scenarios.schema.scenario import Scenario

_MOST: Final = 3  # events of one kind in a row that are reported one by one; more of them in one entry
_LONGEST: Final = 200


def prepared(scenario: Scenario, vehicle: Vehicle) -> Scenario:
    """A scenario in whose flight anything may happen that can happen to its vehicle.

    Wind needs drag to push; with the integrator rk4 the mass is fixed, and with an estimator there are the sensors that
    it has.
    """
    air = actual_effects(scenario, vehicle).air
    sensed = {} if scenario.sensors is None else scenario.sensors.present()
    names = [*sensed] if scenario.estimator is not None else [*get_args(SensorText)]
    possible: list[Event] = [
        _push(scenario),
        *([_mass(scenario)] if scenario.plant.integrator == "mujoco" else []),
        *([_wind(scenario)] if air is not None and air.drags else []),
        *(_fault(scenario, name) for name in get_args(SensorText) if name in names),
    ]
    added = [event for event in possible if event not in scenario.events]
    return scenario.model_copy(update={"events": [*added, *scenario.events]})  # what the file has at 0 comes after


def neutral(scenario: Scenario, event: Event) -> Event | None:
    """An event at the start that changes nothing, and prepares a flight for one; None where it needs no preparing."""
    if isinstance(event, Push):
        return _push(scenario)
    if isinstance(event, LOADING):
        return _mass(scenario)
    if isinstance(event, Gust | WindChange):
        return _wind(scenario)
    return _fault(scenario, event.sensor) if isinstance(event, SensorFaultEvent) else None


def _push(scenario: Scenario) -> Push:
    return Push(at=0.0, duration=scenario.plant.timestep, force=(0.0, 0.0, 0.0))


def _mass(scenario: Scenario) -> MassChange:
    return MassChange(at=0.0, factor=(scenario.effects.load or Load()).mass_factor)


def _wind(scenario: Scenario) -> WindChange:
    return WindChange(at=0.0, velocity=(scenario.effects.air or Air()).wind)


def _fault(scenario: Scenario, sensor: SensorText) -> SensorFaultEvent:
    step = scenario.plant.timestep
    return SensorFaultEvent(at=0.0, sensor=sensor, fault="bias", offset=(0.0, 0.0, 0.0), duration=step)


def story(scenario: Scenario, duration: float) -> list[dict[str, Any]]:
    """`events` of a summary: `time` [s] and `text` of what happened in so long [s], in order of time.

    What changes nothing, as at a live flight's beginning, is left out.
    """
    events = sorted((event for event in scenario.events if event.at < duration), key=lambda event: event.at)
    happened = [event for event in events if event != neutral(scenario, event)]
    entries = []
    for _, group in groupby(happened, key=lambda event: event.type):
        alike = list(group)
        if len(alike) <= _MOST:
            entries += [{"time": event.at, "text": _text(event)} for event in alike]
        else:
            text = f"{len(alike)} times until {alike[-1].at:g} s: {_text(alike[0])} first, {_text(alike[-1])} last"
            entries.append({"time": alike[0].at, "text": text})
    return entries


def _text(event: Event) -> str:
    duration = getattr(event, "duration", None)
    lasting = "" if duration is None else f" for {duration:g} s"
    return printable(f"{event.text()}{lasting}")[:_LONGEST]
