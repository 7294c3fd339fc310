"""`[initial]`: where a flight starts, and how it moves there."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from annotated_types import Len, doc

from quadsim.errors import ParameterError
from quadsim.fields import NonNegative, Vector
from quadsim.vehicle import N_ROTORS


@dataclass(frozen=True, kw_only=True)
class Initial:
    """State at the start of the flight."""

    position: Annotated[Vector, doc("[m] x, y, z in the world frame")] = (0.0, 0.0, 0.0)
    euler: Annotated[Vector, doc("[deg] roll, pitch, yaw")] = (0.0, 0.0, 0.0)
    velocity: Annotated[Vector, doc("[m/s] in the world frame")] = (0.0, 0.0, 0.0)
    body_rates: Annotated[Vector, doc("[deg/s] about the body axes")] = (0.0, 0.0, 0.0)
    rotor_speeds: Annotated[
        Annotated[tuple[NonNegative, ...], Len(N_ROTORS, N_ROTORS)] | None,
        doc("[rad/s] rotor speeds, and the command u(-1) before the first; absent: those of hover"),
    ] = None
    cold: Annotated[bool, doc("true: start on the ground with rotors at rest, u(-1) = 0; false: start from hover")] = (
        False
    )
    on_reference: Annotated[
        bool,
        doc(
            "true: start with the velocity, attitude and body rates of the reference at t = 0; only for courses that "
            "define them (ramped_circle, ramped_lemniscate)"
        ),
    ] = False

    def __post_init__(self) -> None:
        if abs(self.euler[0]) > 180.0 or abs(self.euler[1]) >= 90.0:
            raise ParameterError("", "euler", list(self.euler), "within +-180 deg of roll and below +-90 deg of pitch")
        if self.on_reference and any(self.euler[:2]):
            raise ParameterError("", "euler", list(self.euler), "of roll and pitch 0 where on_reference is true")
        if self.cold:
            self._refuse_fields_stated_by("cold", ("velocity", "body_rates", "rotor_speeds"))
        elif self.on_reference:
            self._refuse_fields_stated_by("on_reference", ("velocity", "body_rates"))

    def _refuse_fields_stated_by(self, switch: str, names: tuple[str, ...]) -> None:
        """Refuse values of fields that the switch gives instead."""
        for name in names:
            values = getattr(self, name)
            is_stated = values is not None and (name == "rotor_speeds" or any(values))
            if is_stated:
                raise ParameterError("", name, list(values), f"absent where {switch} is true, which states it")
