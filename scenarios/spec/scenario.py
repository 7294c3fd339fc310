"""The whole scenario file."""

from __future__ import annotations

from typing import Annotated, Final

import tomli_w
from pydantic import Field, model_validator

from quadsim.errors import ParameterError
from quadsim.plant import steps_per_period
from scenarios.spec.base import Spec
from scenarios.spec.constraint import ConstraintSpec
from scenarios.spec.controller import ConstrainedSpec, UnconstrainedSpec
from scenarios.spec.course import ReferenceSpec
from scenarios.spec.start import InitialSpec, PlantSpec
from scenarios.spec.vehicle import VehicleSpec

LONGEST_FLIGHT: Final = 86_400.0
MOST_STEPS: Final = 10_000_000
"""Physics steps, and planned steps (periods times horizon), that one flight may take: each is held in memory."""


class Scenario(Spec):
    """A whole scenario file."""

    name: Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9._-]*$", max_length=80)]
    description: str
    duration: Annotated[float, Field(gt=0.0, le=LONGEST_FLIGHT, description="[s]")]
    control_period: Annotated[float, Field(gt=0.0, le=10.0, description="tau_s [s]")]
    seed: Annotated[int, Field(ge=0)] = 0
    log_rate: Annotated[float, Field(ge=0.01, le=1e6, description="rows of plant.parquet per second [Hz]")] = 200.0
    vehicle: VehicleSpec
    initial: InitialSpec = InitialSpec()
    plant: PlantSpec = PlantSpec()
    reference: ReferenceSpec
    controller: Annotated[UnconstrainedSpec | ConstrainedSpec, Field(discriminator="type")]
    constraints: list[ConstraintSpec] = []

    @model_validator(mode="after")
    def _check(self) -> Scenario:
        for name, value, unit in (
            ("control_period", self.control_period, self.plant.timestep),
            ("duration", self.duration, self.control_period),
            ("log_rate", 1.0 / self.log_rate, self.plant.timestep),
        ):
            try:
                steps_per_period(value, unit)
            except ParameterError as error:
                what = "the control period" if name == "duration" else "the physics step plant.timestep"
                given = self.log_rate if name == "log_rate" else value
                period = "have a period that is" if name == "log_rate" else "be"
                raise ValueError(f"{name} must {period} a whole multiple of {what} = {unit} s; got {given}") from error
        for what, count in (
            ("physics steps", self.periods * self.steps_per_period),
            ("planned steps", self.periods * self.controller.horizon),
        ):
            if count > MOST_STEPS:
                raise ValueError(f"duration must make at most {MOST_STEPS} {what}; got {count} of them")
        names = [constraint.name for constraint in self.constraints]
        if len(set(names)) < len(names):
            raise ValueError(f"constraints must have distinct names; got {names}")
        return self

    @property
    def periods(self) -> int:
        """K, control periods in the flight."""
        return steps_per_period(self.duration, self.control_period)

    @property
    def steps_per_period(self) -> int:
        """Physics steps per control period."""
        return steps_per_period(self.control_period, self.plant.timestep)

    @property
    def plant_stride(self) -> int:
        """Physics steps per row of `plant.parquet`."""
        return steps_per_period(1.0 / self.log_rate, self.plant.timestep)

    def to_toml(self) -> str:
        """The resolved file: every field, defaults included; parsing it gives this scenario again."""
        return tomli_w.dumps(self.model_dump(exclude_none=True))
