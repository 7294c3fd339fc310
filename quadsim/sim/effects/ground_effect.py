"""The ground, and whether thrust grows near it; see `quadsim.sim.effects.forces.thrust_ratio`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from annotated_types import doc

from quadsim.errors import ParameterError
from quadsim.fields import Positive, filled
from quadsim.vehicle import Vehicle


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
