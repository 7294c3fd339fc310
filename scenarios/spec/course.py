"""`[reference]`: what the vehicle is asked to do."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, model_validator

from scenarios.spec.base import Number, Spec


class WindowSpec(Spec):
    """A value held strictly between two instants.  Eq. (30)."""

    start: Number = Field(description="[s]")
    stop: Number = Field(description="[s]")
    value: Number = Field(description="[m], or [deg] for yaw")

    @model_validator(mode="after")
    def _check(self) -> WindowSpec:
        if not self.start < self.stop:
            raise ValueError(f"start must be below stop = {self.stop}; got {self.start}")
        return self


class ReferenceSpec(Spec):
    """The desired course; outside its windows an axis stays at its initial position, and yaw at 0."""

    response_time: Annotated[float, Field(ge=0.0, description="tau_r [s] of Eq. (31); 0 for no filter")] = 0.0
    x: list[WindowSpec] = []
    y: list[WindowSpec] = []
    z: list[WindowSpec] = []
    yaw: list[WindowSpec] = []
