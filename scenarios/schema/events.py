"""`[[events]]`: what happens in flight, "at t = 12 s rotor 2 loses 20 %"."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Any, Final, Literal

from annotated_types import Len, doc
from pydantic import Field, model_validator

from quadsim.fields import Fraction, Instant, NonNegative, Number, Positive
from quadsim.sim.computation import Stall
from quadsim.sim.effects import Push
from quadsim.sim.effects.load import Factor, Payload
from quadsim.sim.effects.wind import Gust, WindChange
from quadsim.state import REFERENCE_NAMES
from scenarios.schema.base import Spec, Triple
from scenarios.schema.plugin import is_plain

MOST_EVENTS: Final = 20_000  # of one flight: a person's hand for a quarter of an hour, 20 times a second


class _Event(Spec):
    at: Instant = Field(description="[s] when it happens")


class RotorLossEvent(_Event):
    """A rotor loses thrust, permanently or for a time."""

    type: Literal["rotor_loss"] = Field(description="kind of event: rotor_loss")
    rotor: Annotated[int, Field(ge=1, le=4)] = Field(description="which rotor, 1 to 4")
    loss: Annotated[Fraction, Field(gt=0.0)] = Field(description="[-] share of thrust and torque lost; 1 is all of it")
    duration: Positive | None = Field(
        default=None, description="[s] after which the rotor is whole again; absent: never"
    )


@dataclass(frozen=True, kw_only=True)
class PayloadPickupEvent(Payload):
    """The vehicle takes up a point mass, which moves with it from then on."""

    at: Instant
    type: Annotated[Literal["payload_pickup"], doc("kind of event: payload_pickup")]


class PayloadDropEvent(_Event):
    """The vehicle lets go of all it carries."""

    type: Literal["payload_drop"] = Field(description="kind of event: payload_drop")


class MassEvent(_Event):
    """The vehicle's mass becomes another one, whatever it carries besides."""

    type: Literal["mass"] = Field(description="kind of event: mass")
    factor: Factor = Field(description="[-] mass over the vehicle's from then on, instead of load.mass_factor")


class RotorLagEvent(_Event):
    """The rotors follow their commands more quickly or more slowly."""

    type: Literal["rotor_lag"] = Field(description="kind of event: rotor_lag")
    rise: NonNegative = Field(description="[s] time constant while speeding up; 0: at once")
    fall: NonNegative | None = Field(default=None, description="[s] time constant while slowing down; absent: the same")


@dataclass(frozen=True, kw_only=True)
class PushEvent(Push):
    """Something pushes the vehicle."""

    type: Annotated[Literal["push"], doc("kind of event: push")]


class SetpointEvent(_Event):
    """The reference leaves the course: an axis that is given holds its value until it is given another one.

    It is not known ahead: the reference goes there by its filter from the next control sample on.
    """

    type: Literal["setpoint"] = Field(description="kind of event: setpoint")
    x: Number | None = Field(default=None, description="[m] world; absent: as before")
    y: Number | None = Field(default=None, description="[m] world; absent: as before")
    z: Number | None = Field(default=None, description="[m] world, upwards; absent: as before")
    yaw: Number | None = Field(default=None, description="[deg]; absent: as before")

    @model_validator(mode="after")
    def _check(self) -> SetpointEvent:
        if not self.values:
            raise ValueError("x must be given, or y, z or yaw")
        return self

    @property
    def values(self) -> dict[str, float]:
        """What is given, by the names of the axes; [m] and [rad]."""
        given = {name: getattr(self, name) for name in REFERENCE_NAMES}
        scales = {"yaw": math.radians(1.0)}
        return {name: scales.get(name, 1.0) * value for name, value in given.items() if value is not None}


class ControllerEvent(_Event):
    """The controller becomes another one, which goes on from what the one before it has learnt and planned."""

    type: Literal["controller"] = Field(description="kind of event: controller")
    fields: Annotated[dict[str, Any], Len(1, 1000)] = Field(
        description="fields of [controller], dotted, and their values from then on; with a type among them, all of it"
    )

    @model_validator(mode="after")
    def _check(self) -> ControllerEvent:
        for name, value in self.fields.items():
            if not is_plain(value):
                rule = "a finite number, a text, true or false, or a list or table of them"
                raise ValueError(f"fields.{name} must be {rule}; got {value}")
        return self


@dataclass(frozen=True, kw_only=True)
class GustEvent(Gust):
    """A gust of the 1-cosine shape."""

    type: Annotated[Literal["gust"], doc("kind of event: gust")]


@dataclass(frozen=True, kw_only=True)
class WindEvent(WindChange):
    """The mean wind changes."""

    type: Annotated[Literal["wind"], doc("kind of event: wind")]


class SensorFaultEvent(_Event):
    """A sensor fails for a while."""

    type: Literal["sensor_fault"] = Field(description="kind of event: sensor_fault")
    sensor: Literal["position", "velocity", "attitude", "rates"] = Field(description="which sensor")
    fault: Literal["dropout", "freeze", "nan", "bias"] = Field(
        description="no samples, the last one again and again, samples that are no numbers, or an offset"
    )
    duration: Positive = Field(description="[s] how long")
    axes: Annotated[list[Literal["x", "y", "z"]], Len(1, 3)] | None = Field(
        default=None, description="of nan: which of its three numbers; absent: all"
    )
    offset: Triple | None = Field(
        default=None, description="of a bias: [m], [m/s], [deg] or [deg/s], by axis, world frame or body axes"
    )

    @model_validator(mode="after")
    def _check(self) -> SensorFaultEvent:
        if (self.offset is not None) != (self.fault == "bias"):
            raise ValueError(f"offset must be given where fault is 'bias', and nowhere else; got {self.offset}")
        if self.axes is not None and self.fault != "nan":
            raise ValueError(f"axes must be absent where fault is not 'nan'; got {self.axes}")
        if self.axes is not None and len(set(self.axes)) < len(self.axes):
            raise ValueError(f"axes must be different ones; got {self.axes}")
        return self


@dataclass(frozen=True, kw_only=True)
class StallEvent(Stall):
    """The computer answers nothing for a while; a command being computed waits for its end."""

    type: Annotated[Literal["stall"], doc("kind of event: stall")]


Event = Annotated[
    RotorLossEvent
    | RotorLagEvent
    | MassEvent
    | PayloadPickupEvent
    | PayloadDropEvent
    | PushEvent
    | GustEvent
    | WindEvent
    | SensorFaultEvent
    | StallEvent
    | SetpointEvent
    | ControllerEvent,
    Field(discriminator="type"),
]
"""One entry of the list, distinguished by its type."""
