"""`[initial]` and `[plant]`: where the flight starts, and in what simulation."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, model_validator

from scenarios.spec.base import Spec, Triple


class InitialSpec(Spec):
    """Where the flight starts, at rest; the command before the first is hover."""

    position: Triple = Field(default=[0.0, 0.0, 0.0], description="x, y, z [m], world")
    euler: Triple = Field(default=[0.0, 0.0, 0.0], description="roll, pitch, yaw [deg]")

    @model_validator(mode="after")
    def _check(self) -> InitialSpec:
        if any(abs(angle) >= 90.0 for angle in self.euler[:2]):
            raise ValueError(f"euler must have roll and pitch within +-90 deg; got {self.euler}")
        return self


class PlantSpec(Spec):
    """The simulated vehicle."""

    timestep: Annotated[float, Field(ge=1e-6, le=0.01, description="physics step [s]")] = 1e-3
    limit_speeds: bool = Field(default=False, description="whether rotors saturate at the vehicle's speed range")
