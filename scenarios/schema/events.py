"""`[[events]]`: what happens on the way, "at t = 12 s rotor 2 loses 20 %"."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from annotated_types import Len, doc
from pydantic import Field, model_validator

from quadsim.fields import Fraction, Instant, Positive
from quadsim.sim.computation import Stall
from quadsim.sim.effects.gust import Gust
from quadsim.sim.effects.load import Payload
from quadsim.sim.effects.wind import WindChange
from scenarios.schema.base import Spec, Triple


class _Event(Spec):
    at: Instant = Field(description="[s] when it happens")


class RotorLossEvent(_Event):
    """A rotor loses thrust, for good or for a while."""

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
    RotorLossEvent | PayloadPickupEvent | PayloadDropEvent | GustEvent | WindEvent | SensorFaultEvent | StallEvent,
    Field(discriminator="type"),
]
"""One entry of the list, distinguished by its type."""
