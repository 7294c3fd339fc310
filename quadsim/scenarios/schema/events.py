"""`[[events]]`: timed events during the flight, "at t = 12 s rotor 2 loses 20 %".

Here are the events outside the plant, of reference, controller and sensors; those of the plant and the computer are
declared beside the effects that they change. `quadsim.scenarios.assembly` sorts them by what they change.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Annotated, Any, Final, Literal, TypeVar

from annotated_types import Len, doc
from pydantic import Field

from quadsim.errors import ParameterError
from quadsim.fields import Instant, Number, Seconds, Vector, is_plain
from quadsim.sim.computation import Stall
from quadsim.sim.effects import Push
from quadsim.sim.effects.load import MassChange, PayloadDrop, PayloadPickup
from quadsim.sim.effects.rotors import LagChange, RotorLoss
from quadsim.sim.effects.wind import Gust, WindChange
from quadsim.sim.sensing import AXES, FaultKind, SensorFault, SensorName, in_si
from quadsim.state import REFERENCE_NAMES

EventType = TypeVar("EventType")

MOST_EVENTS: Final = 20_000  # of one flight: a person's hand for a quarter of an hour, 20 times a second
SensorText = Literal["position", "velocity", "attitude", "rates"]
_UNITS: Final = {"x": "m", "y": "m", "z": "m", "yaw": "deg"}
_FAULTS: Final = {"dropout": "gives no samples", "freeze": "is frozen", "nan": "gives no numbers", "bias": "is offset"}


def first_period(at: float, period: float) -> int:
    """Return the first control period in which an event at a time [s] acts outside the plant."""
    return math.ceil(at / period - 1e-6)


@dataclass(frozen=True, kw_only=True)
class SetpointEvent:
    """The reference leaves the course: each axis given here keeps its value until a later set-point.

    The controller does not know it in advance: the reference moves there through its filter from the next sample on.
    """

    at: Instant
    type: Annotated[Literal["setpoint"], doc("kind of event: setpoint")] = "setpoint"
    x: Annotated[Number | None, doc("[m] world; absent: unchanged")] = None
    y: Annotated[Number | None, doc("[m] world; absent: unchanged")] = None
    z: Annotated[Number | None, doc("[m] world, upwards; absent: unchanged")] = None
    yaw: Annotated[Number | None, doc("[deg]; absent: unchanged")] = None

    def __post_init__(self) -> None:
        if not self.values:
            raise ParameterError("", "x", None, "given, or y, z or yaw")

    @property
    def values(self) -> dict[str, float]:
        """New values by axis [m, rad]."""
        values: dict[str, float] = {}
        for name in REFERENCE_NAMES:
            value = getattr(self, name)
            if value is None:
                continue
            if name == "yaw":
                values[name] = math.radians(1.0) * value
            else:
                values[name] = value
        return values

    def text(self) -> str:
        """Return the event in words."""
        targets = ", ".join(f"{name} {getattr(self, name):g} {_UNITS[name]}" for name in self.values)
        return f"set-point {targets}"


@dataclass(frozen=True, kw_only=True)
class ControllerEvent:
    """The controller changes; the new one continues from the estimates and the plan of the one before."""

    at: Instant
    type: Annotated[Literal["controller"], doc("kind of event: controller")] = "controller"
    fields: Annotated[
        dict[str, Any],
        Len(1, 1000),
        doc("new values of fields of [controller], by dotted path; a type among them replaces the whole table"),
    ]

    def __post_init__(self) -> None:
        for name, value in self.fields.items():
            if not is_plain(value):
                rule = "a finite number, a text, true or false, or a list or table of them"
                raise ParameterError("", f"fields.{name}", value, rule)

    def text(self) -> str:
        """Return the event in words."""
        changes = ", ".join(f"{name} = {value}" for name, value in self.fields.items())
        return f"controller: {changes}"


@dataclass(frozen=True, kw_only=True)
class SensorFaultEvent:
    """A sensor fails for a while."""

    at: Instant
    type: Annotated[Literal["sensor_fault"], doc("kind of event: sensor_fault")] = "sensor_fault"
    sensor: Annotated[SensorText, doc("which sensor")]
    fault: Annotated[
        Literal["dropout", "freeze", "nan", "bias"],
        doc("no samples, the last sample repeated, NaN samples, or an offset"),
    ]
    duration: Annotated[Seconds, doc("[s] duration of the fault")]
    axes: Annotated[
        Annotated[tuple[Literal["x", "y", "z"], ...], Len(1, 3)] | None,
        doc("for nan: affected axes; absent: all"),
    ] = None
    offset: Annotated[
        Vector | None, doc("for bias: [m], [m/s], [deg] or [deg/s], by axis, world frame or body axes")
    ] = None

    def __post_init__(self) -> None:
        if (self.offset is not None) != (self.fault == "bias"):
            raise ParameterError("", "offset", self.offset, "given where fault is 'bias', and nowhere else")
        if self.axes is not None and self.fault != "nan":
            raise ParameterError("", "axes", list(self.axes), "absent where fault is not 'nan'")
        if self.axes is not None and len(set(self.axes)) < len(self.axes):
            raise ParameterError("", "axes", list(self.axes), "different ones")

    def text(self) -> str:
        """Return the event in words."""
        return f"the {self.sensor} sensor {_FAULTS[self.fault]}"

    def in_si(self) -> SensorFault:
        """Return the fault in SI units."""
        name = SensorName(self.sensor)
        axes: tuple[int, ...] = AXES
        if self.axes is not None:
            axes = tuple(sorted("xyz".index(axis) for axis in self.axes))
        return SensorFault(
            sensor=name,
            kind=FaultKind(self.fault),
            start=self.at,
            stop=self.at + self.duration,
            axes=axes,
            offset=in_si(name, self.offset or 0.0),
        )


Event = Annotated[
    RotorLoss
    | LagChange
    | MassChange
    | PayloadPickup
    | PayloadDrop
    | Push
    | Gust
    | WindChange
    | SensorFaultEvent
    | Stall
    | SetpointEvent
    | ControllerEvent,
    Field(discriminator="type"),
]
"""One entry of the list, distinguished by its type."""


def events_of(events: Iterable[Event], kind: type[EventType]) -> tuple[EventType, ...]:
    """Return the events of one kind, in the order of the file."""
    return tuple(event for event in events if isinstance(event, kind))
