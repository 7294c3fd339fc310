"""`[initial]` and `[plant]`: where the flight starts, and in what simulation."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, model_validator

from scenarios.spec.base import Spec, Triple


class InitialSpec(Spec):
    """Where the flight starts, at rest."""

    position: Triple = Field(default=[0.0, 0.0, 0.0], description="[m] x, y, z in the world frame")
    euler: Triple = Field(default=[0.0, 0.0, 0.0], description="[deg] roll, pitch, yaw")
    cold: bool = Field(
        default=False, description="whether it starts on the ground with rotors at rest, u(-1) = 0; else from hover"
    )

    @model_validator(mode="after")
    def _check(self) -> InitialSpec:
        if any(abs(angle) >= 90.0 for angle in self.euler[:2]):
            raise ValueError(f"euler must have roll and pitch within +-90 deg; got {self.euler}")
        return self


class PlantSpec(Spec):
    """The simulated vehicle."""

    timestep: Annotated[float, Field(ge=1e-6, le=0.01)] = Field(default=1e-3, description="[s] physics step")
    limit_speeds: bool = Field(
        default=False, description="whether rotors saturate at the vehicle's speed_min and speed_max"
    )
