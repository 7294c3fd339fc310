"""The ground, and thrust near it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Final

from annotated_types import doc

from quadsim.errors import ParameterError
from quadsim.fields import Positive, filled
from quadsim.vehicle import Vehicle

LOWEST_RATIO: Final = 0.5
"""Lowest height of a rotor, in rotor radii, for which the formula is used: below, the thrust grows no further."""


@dataclass(frozen=True, kw_only=True)
class Ground:
    """A floor at the height at which the vehicle at z = 0 stands on its feet."""

    contact: Annotated[bool, doc("whether feet and hull meet the floor")] = True
    effect: Annotated[bool, doc("whether thrust grows near the floor (Cheeseman and Bennett)")] = False
    rotor_radius: Annotated[Positive | None, doc("[m] for the ground effect; absent: the vehicle's rotor_radius")] = (
        None
    )

    def resolved(self, vehicle: Vehicle) -> Ground:
        """With the radius that is left to the vehicle, where there is a ground effect.

        Raises:
            ParameterError: neither states it.
        """
        if not self.effect:
            return self
        found = filled(self, rotor_radius=vehicle.rotor_radius)
        if found.rotor_radius is None:
            rule = f"given for the ground effect, as the vehicle {vehicle.name!r} states none"
            raise ParameterError("effects.ground", "rotor_radius", None, rule)
        return found


def thrust_ratio(height: float, radius: float) -> float:
    """Thrust of a hovering rotor near the ground over its thrust far from it, at the same power.

        T / T_inf = 1 / (1 - (R / (4 z))^2)

    The ground acts as an image of the rotor below it, whose outflow slows the inflow: I. C. Cheeseman, W. E. Bennett,
    "The Effect of the Ground on a Helicopter Rotor in Forward Flight", ARC R&M 3021, 1955.  Singular at z = R/4 and
    good for z > R/2 alone (J. G. Leishman, "Principles of Helicopter Aerodynamics", Sec. 5.8): lower heights are taken
    for z = R/2, where the ratio is 4/3.  Left out are forward speed, which weakens the effect, and what neighbouring
    rotors add to it; the ratio is applied at equal rotor speeds, as simulators commonly do.

    Args:
        height: z, of the rotor above the ground [m]; may be negative in a crash.
        radius: R, of the rotor [m]; positive.
    """
    image = 0.25 * radius / max(height, LOWEST_RATIO * radius)
    return 1.0 / (1.0 - image * image)
