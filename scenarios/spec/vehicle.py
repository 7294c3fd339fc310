"""`[vehicle]`: which vehicle flies."""

from __future__ import annotations

from typing import Annotated, Any

from annotated_types import Len
from pydantic import Field

from scenarios.spec.base import Quadruple, Spec, Triple


class VehicleSpec(Spec):
    """Which vehicle file, and what in it to replace; units as in the file."""

    file: str = Field(description="a shipped vehicle's name, or a path ending in .toml, relative to the scenario file")
    mass: float | None = None
    gravity: float | None = None
    inertia: Triple | None = None
    arm_length: float | None = None
    rotor_azimuths: Quadruple | None = None
    rotor_spins: Annotated[list[int], Len(4, 4)] | None = None
    thrust_coefficient: float | None = None
    drag_to_thrust: float | None = None
    speed_min: float | None = None
    speed_max: float | None = None

    def overrides(self) -> dict[str, Any]:
        """The parameters that replace the file's."""
        return self.model_dump(exclude={"file"}, exclude_none=True)
