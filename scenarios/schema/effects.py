"""`[effects]`: what acts on the plant beyond the paper's model.  Each table switches one group of effects on."""

from __future__ import annotations

import math
from typing import Annotated

from annotated_types import Len, MaxLen
from pydantic import Field, model_validator

from quadsim.sim.effects import SEA_LEVEL_DENSITY
from quadsim.sim.effects.turbulence import HIGHEST, LOWEST
from scenarios.schema.base import MOST_ENTRIES, Fraction, NonNegative, Positive, Spec, Triple

SLOWEST_AIRSPEED, FASTEST_AIRSPEED = 0.01, 200.0
"""[m/s] at which turbulence may pass; at the slower one, it takes hours."""

Factor = Annotated[float, Field(ge=0.05, le=20.0)]


class RotorsSpec(Spec):
    """Rotors that take time and may be worn; see `quadsim.sim.effects.rotors`."""

    rise: Positive | None = Field(
        default=None,
        description="[s] time constant while speeding up; absent: the vehicle's, or at once where it states none",
    )
    fall: Positive | None = Field(
        default=None,
        description="[s] time constant while slowing down; absent: the vehicle's, or at once where it states none",
    )
    acceleration: Positive | None = Field(
        default=None, description="[rad/s^2] largest change of a rotor's speed; absent: no limit"
    )
    inertia: NonNegative | None = Field(
        default=None,
        description="[kg m^2] of one rotor: gyroscopic and spin-up torque; absent: the vehicle's, or 0 where it states "
        "none",
    )
    efficiency: Annotated[list[Fraction], Len(4, 4)] = Field(
        default=[1.0, 1.0, 1.0, 1.0], description="[-] share of its thrust and torque that each rotor gives"
    )


class TurbulenceSpec(Spec):
    """Dryden turbulence at low altitude; see `quadsim.sim.effects.turbulence`."""

    altitude: Annotated[float, Field(ge=LOWEST, le=HIGHEST)] = Field(
        default=10.0, description="[m] above the ground, for the scale lengths"
    )
    wind_speed_20ft: Annotated[float, Field(ge=0.0, le=100.0)] = Field(
        description="[m/s] mean wind 6.1 m above the ground, for the intensities; 7.7 is light, 15.4 moderate"
    )
    airspeed: Annotated[float, Field(ge=SLOWEST_AIRSPEED, le=FASTEST_AIRSPEED)] | None = Field(
        default=None, description="[m/s] at which the turbulence passes the vehicle; absent: the mean wind's speed"
    )


class AirSpec(Spec):
    """Drag, and the wind; see `quadsim.sim.effects.forces` and `quadsim.sim.effects.wind`."""

    density: Positive = Field(default=SEA_LEVEL_DENSITY, description="[kg/m^3] of the air, for the drag of the body")
    rotor_drag: NonNegative | None = Field(
        default=None,
        description="[kg/rad] drag of one rotor per speed and air speed in its plane; absent: the vehicle's, or 0",
    )
    body_drag: Annotated[list[Positive], Len(3, 3)] | None = Field(
        default=None, description="[m^2] drag areas C_d A along body x, y, z; absent: the vehicle's, or none"
    )
    wind: Triple = Field(default=[0.0, 0.0, 0.0], description="[m/s] mean velocity of the air, world frame")
    turbulence: TurbulenceSpec | None = Field(default=None, description="Dryden turbulence; absent: none")

    @model_validator(mode="after")
    def _check(self) -> AirSpec:
        carried = self.turbulence is None or self.turbulence.airspeed is not None
        if not carried and not SLOWEST_AIRSPEED <= math.hypot(*self.wind) <= FASTEST_AIRSPEED:
            raise ValueError(
                f"turbulence.airspeed must be given where no mean wind of {SLOWEST_AIRSPEED:g} to {FASTEST_AIRSPEED:g} "
                f"m/s carries the turbulence past; got a wind of {self.wind}"
            )
        return self


class GroundSpec(Spec):
    """A floor at the height at which the vehicle at z = 0 stands on its feet."""

    contact: bool = Field(default=True, description="whether feet and hull meet the floor")
    effect: bool = Field(default=False, description="whether thrust grows near the floor (Cheeseman and Bennett)")
    rotor_radius: Positive | None = Field(
        default=None, description="[m] for the ground effect; absent: the vehicle's rotor_radius"
    )


class PayloadSpec(Spec):
    """A point mass fixed to the vehicle."""

    mass: Positive = Field(description="[kg]")
    position: Triple = Field(default=[0.0, 0.0, 0.0], description="[m] in the body frame")


class LoadSpec(Spec):
    """How the vehicle that flies differs from its file, which the controller goes on believing."""

    mass_factor: Factor = Field(default=1.0, description="[-] real mass over the file's")
    inertia_factor: Annotated[list[Factor], Len(3, 3)] = Field(
        default=[1.0, 1.0, 1.0], description="[-] real moments of inertia over the file's, about body x, y, z"
    )
    centre_of_mass: Triple = Field(default=[0.0, 0.0, 0.0], description="[m] where it really is, body frame")
    payloads: Annotated[list[PayloadSpec], MaxLen(MOST_ENTRIES)] = Field(
        default=[], description="what it carries from the start"
    )


class DisturbanceSpec(Spec):
    """An unmodelled force and torque, constant and random."""

    force: Triple = Field(default=[0.0, 0.0, 0.0], description="[N] world frame")
    torque: Triple = Field(default=[0.0, 0.0, 0.0], description="[N m] body frame")
    force_noise: NonNegative = Field(
        default=0.0, description="[N s^0.5] root of the two-sided spectral density of white noise, each axis"
    )
    torque_noise: NonNegative = Field(default=0.0, description="[N m s^0.5] the same of the torque")


class EffectsSpec(Spec):
    """What acts on the plant beyond the paper's model; a table that is absent is an effect that is off."""

    rotors: RotorsSpec | None = Field(default=None, description="rotor lag, limits, inertia, wear")
    air: AirSpec | None = Field(default=None, description="drag and wind")
    ground: GroundSpec | None = Field(default=None, description="a floor")
    load: LoadSpec | None = Field(default=None, description="errors of mass and inertia, payload")
    disturbance: DisturbanceSpec | None = Field(default=None, description="unmodelled force and torque")


Seconds = Annotated[float, Field(ge=0.0, le=100.0)]


class ComputationSpec(Spec):
    """Time from measurement to command; a command later than the control period is dropped.  No clock is read."""

    delay: Seconds = Field(default=0.0, description="[s] fixed part")
    per_iteration: Seconds = Field(default=0.0, description="[s] for each iteration of the solver")
    plan: bool | None = Field(
        default=None,
        description="whether the last plan is continued while a command is late; else the last command is held; "
        "absent: true with a controller within the fallback contract",
    )
    jitter: Seconds = Field(default=0.0, description="[s] mean of an exponentially distributed part")
