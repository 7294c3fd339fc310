"""Events that change nothing, with which a flight is started so that more may happen in it; and events in words.

A model is compiled, sensors are sampled and forces are evaluated in one way where something may happen to them, and in
another where nothing can, with other last bits.  An event that changes nothing decides: it is in the scenario of a
live flight and in the one that is saved of it, whether or not anything of its kind happened.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import groupby
from typing import TYPE_CHECKING, Any, Final, Literal, get_args

from quadsim.errors import printable
from quadsim.sim.effects.load import Load
from quadsim.sim.effects.wind import Air, Gust, WindChange
from quadsim.state import REFERENCE_NAMES
from quadsim.vehicle import Vehicle
from scenarios.parts.vehicle import actual_effects
from scenarios.schema import events as kinds

if TYPE_CHECKING:
    from scenarios.schema.scenario import Scenario

SensorText = Literal["position", "velocity", "attitude", "rates"]
_MOST: Final = 3  # events of one kind in a row that are reported one by one; more of them in one entry
_LONGEST: Final = 200
_FAULTS: Final = {"dropout": "gives no samples", "freeze": "is frozen", "nan": "gives no numbers", "bias": "is offset"}


def prepared(scenario: Scenario, vehicle: Vehicle) -> Scenario:
    """A scenario in whose flight anything may happen that can happen to its vehicle.

    Wind needs drag to push; with the integrator rk4 the mass is fixed, and with an estimator there are the sensors that
    it has.
    """
    air = actual_effects(scenario, vehicle).air
    sensed = {} if scenario.sensors is None else scenario.sensors.present()
    names = [*sensed] if scenario.estimator is not None else [*get_args(SensorText)]
    possible: list[kinds.Event] = [
        _push(scenario),
        *([_mass(scenario)] if scenario.plant.integrator == "mujoco" else []),
        *([_wind(scenario)] if air is not None and air.drags else []),
        *(_fault(scenario, name) for name in get_args(SensorText) if name in names),
    ]
    added = [event for event in possible if event not in scenario.events]
    return scenario.model_copy(update={"events": [*added, *scenario.events]})  # what the file has at 0 comes after


def neutral(scenario: Scenario, event: kinds.Event) -> kinds.Event | None:
    """An event at the start that changes nothing, and prepares a flight for one; None where it needs no preparing."""
    if isinstance(event, kinds.PushEvent):
        return _push(scenario)
    if isinstance(event, kinds.MassEvent | kinds.PayloadPickupEvent | kinds.PayloadDropEvent):
        return _mass(scenario)
    if isinstance(event, Gust | WindChange):
        return _wind(scenario)
    return _fault(scenario, event.sensor) if isinstance(event, kinds.SensorFaultEvent) else None


def _push(scenario: Scenario) -> kinds.PushEvent:
    return kinds.PushEvent(type="push", at=0.0, duration=scenario.plant.timestep, force=(0.0, 0.0, 0.0))


def _mass(scenario: Scenario) -> kinds.MassEvent:
    return kinds.MassEvent(type="mass", at=0.0, factor=(scenario.effects.load or Load()).mass_factor)


def _wind(scenario: Scenario) -> kinds.WindEvent:
    return kinds.WindEvent(type="wind", at=0.0, velocity=(scenario.effects.air or Air()).wind)


def _fault(scenario: Scenario, sensor: SensorText) -> kinds.SensorFaultEvent:
    nothing, step = [0.0, 0.0, 0.0], scenario.plant.timestep
    return kinds.SensorFaultEvent(
        type="sensor_fault", at=0.0, sensor=sensor, fault="bias", offset=nothing, duration=step
    )


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


def _text(event: kinds.Event) -> str:
    return printable("".join(_parts(event)))[:_LONGEST]


def _parts(event: kinds.Event) -> Iterator[str]:
    match event:
        case kinds.RotorLossEvent():
            yield f"rotor {event.rotor} loses {100.0 * event.loss:.3g} %"
        case kinds.RotorLagEvent():
            fall = "" if event.fall in (None, event.rise) else f", {event.fall:g} s downwards"
            yield f"rotors lag by {event.rise:g} s{fall}"
        case kinds.MassEvent():
            yield f"the mass is {event.factor:g} times the file's"
        case kinds.PayloadPickupEvent():
            yield f"{event.mass:g} kg are taken up"
        case kinds.PayloadDropEvent():
            yield "what is carried is dropped"
        case kinds.PushEvent():
            yield f"a push of {math.hypot(*event.force):.3g} N"
        case kinds.GustEvent():
            yield f"a gust of {math.hypot(*event.velocity):.3g} m/s"
        case kinds.WindEvent():
            yield f"the mean wind is {math.hypot(*event.velocity):.3g} m/s"
        case kinds.SensorFaultEvent():
            yield f"the {event.sensor} sensor {_FAULTS[event.fault]}"
        case kinds.StallEvent():
            yield "the computer stalls"
        case kinds.SetpointEvent():
            units = {name: "deg" if name == "yaw" else "m" for name in REFERENCE_NAMES}
            given = [f"{name} {getattr(event, name):g} {units[name]}" for name in event.values]
            yield f"set-point {', '.join(given)}"
        case kinds.ControllerEvent():
            yield f"controller: {', '.join(f'{name} = {value}' for name, value in event.fields.items())}"
    duration = getattr(event, "duration", None)
    if duration is not None:
        yield f" for {duration:g} s"
