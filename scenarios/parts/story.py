"""What happened in flight, in words: for the summary, and so for pages, recordings and films."""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import groupby
from typing import TYPE_CHECKING, Any, Final

from quadsim.errors import printable
from quadsim.state import REFERENCE_NAMES
from scenarios.parts.neutral import neutral
from scenarios.schema.events import (
    ControllerEvent,
    Event,
    GustEvent,
    MassEvent,
    PayloadDropEvent,
    PayloadPickupEvent,
    PushEvent,
    RotorLagEvent,
    RotorLossEvent,
    SensorFaultEvent,
    SetpointEvent,
    StallEvent,
    WindEvent,
)

if TYPE_CHECKING:
    from scenarios.schema.scenario import Scenario

_MOST: Final = 3  # events of one kind in a row that are reported one by one; more of them in one entry
_LONGEST: Final = 200
_FAULTS: Final = {"dropout": "gives no samples", "freeze": "is frozen", "nan": "gives no numbers", "bias": "is offset"}


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
    return printable("".join(_parts(event)))[:_LONGEST]


def _parts(event: Event) -> Iterator[str]:
    match event:
        case RotorLossEvent():
            yield f"rotor {event.rotor} loses {100.0 * event.loss:.3g} %"
        case RotorLagEvent():
            fall = "" if event.fall in (None, event.rise) else f", {event.fall:g} s downwards"
            yield f"rotors lag by {event.rise:g} s{fall}"
        case MassEvent():
            yield f"the mass is {event.factor:g} times the file's"
        case PayloadPickupEvent():
            yield f"{event.mass:g} kg are taken up"
        case PayloadDropEvent():
            yield "what is carried is dropped"
        case PushEvent():
            yield f"a push of {math.hypot(*event.force):.3g} N"
        case GustEvent():
            yield f"a gust of {math.hypot(*event.velocity):.3g} m/s"
        case WindEvent():
            yield f"the mean wind is {math.hypot(*event.velocity):.3g} m/s"
        case SensorFaultEvent():
            yield f"the {event.sensor} sensor {_FAULTS[event.fault]}"
        case StallEvent():
            yield "the computer stalls"
        case SetpointEvent():
            units = {name: "deg" if name == "yaw" else "m" for name in REFERENCE_NAMES}
            given = [f"{name} {getattr(event, name):g} {units[name]}" for name in event.values]
            yield f"set-point {', '.join(given)}"
        case ControllerEvent():
            yield f"controller: {', '.join(f'{name} = {value}' for name, value in event.fields.items())}"
    duration = getattr(event, "duration", None)
    if duration is not None:
        yield f" for {duration:g} s"
