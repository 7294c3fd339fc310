"""`[vehicle]`: which vehicle flies."""

from __future__ import annotations

from typing import Annotated, Any

from annotated_types import Len
from pydantic import Field

from scenarios.spec.base import Quadruple, Spec, Triple


class VehicleSpec(Spec):
    """Which vehicle file, and what in it to replace; units as in the file."""

    file: str = Field(description="a shipped vehicle's name, or a path ending in .toml, relative to the scenario file")
    mass: float | None = Field(default=None, description="[kg]")
    gravity: float | None = Field(default=None, description="[m/s^2]")
    inertia: Triple | None = Field(default=None, description="[kg m^2] Ixx, Iyy, Izz, body axes")
    arm_length: float | None = Field(default=None, description="[m] L, centre of mass to rotor axis")
    rotor_azimuths: Quadruple | None = Field(
        default=None, description="[deg] direction of each arm from body +x, counter-clockwise seen from above"
    )
    rotor_spins: Annotated[list[int], Len(4, 4)] | None = Field(
        default=None, description="[-] 1 or -1, sign of each rotor's reaction torque about body +z"
    )
    thrust_coefficient: float | None = Field(default=None, description="[N s^2/rad^2] b, thrust b w^2")
    drag_to_thrust: float | None = Field(default=None, description="[m] d / b, reaction torque d w^2")
    speed_min: float | None = Field(default=None, description="[rad/s] lowest speed that a rotor holds")
    speed_max: float | None = Field(default=None, description="[rad/s] highest speed that a rotor holds")
    rotor_rise: float | None = Field(default=None, description="[s] time constant of a rotor's speed when it rises")
    rotor_fall: float | None = Field(default=None, description="[s] time constant of a rotor's speed when it falls")
    rotor_inertia: float | None = Field(default=None, description="[kg m^2] of one rotor about its axis")
    rotor_radius: float | None = Field(default=None, description="[m] R")
    rotor_drag: float | None = Field(default=None, description="[N s^2/(m rad)] linear drag of one rotor")
    body_drag: Triple | None = Field(default=None, description="[m^2] C_d A along body x, y, z")

    def overrides(self) -> dict[str, Any]:
        """The parameters that replace the file's."""
        return self.model_dump(exclude={"file"}, exclude_none=True)
