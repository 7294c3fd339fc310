"""The effects on the plant beyond the paper's model; each is off unless a scenario sizes it."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Annotated, Literal, Protocol

import numpy as np
from annotated_types import doc

from quadsim.errors import ParameterError
from quadsim.fields import Instant, NonNegative, Positive, Vector, filled
from quadsim.sim.effects.battery import Battery
from quadsim.sim.effects.load import Load, MassChange, PayloadDrop, PayloadPickup
from quadsim.sim.effects.rotors import LagChange, RotorChange, RotorDynamics
from quadsim.sim.effects.wind import Air
from quadsim.state import Array
from quadsim.vehicle import Vehicle


@dataclass(frozen=True, kw_only=True)
class Push:
    """A push on the vehicle: a constant force at a point of the body, with its torque r x R' F."""

    at: Instant
    type: Annotated[Literal["push"], doc("kind of event: push")] = "push"
    duration: Annotated[Positive, doc("[s] length of the push")]
    force: Annotated[Vector, doc("[N] world frame")]
    point: Annotated[Vector, doc("[m] point of application, body frame")] = (0.0, 0.0, 0.0)

    def text(self) -> str:
        """Describe the event."""
        return f"a push of {math.hypot(*self.force):.3g} N"


@dataclass(frozen=True, kw_only=True)
class Ground:
    """A floor at the height at which the vehicle at z = 0 rests on its feet."""

    contact: Annotated[bool, doc("whether feet and hull meet the floor")] = True
    effect: Annotated[bool, doc("whether thrust grows near the floor (Cheeseman and Bennett)")] = False
    rotor_radius: Annotated[Positive | None, doc("[m] for the ground effect; absent: the vehicle's rotor_radius")] = (
        None
    )

    def resolved(self, vehicle: Vehicle) -> Ground:
        """Fill in the vehicle's rotor radius, if the ground effect needs it.

        Raises:
            ParameterError: neither states it.
        """
        if not self.effect:
            return self
        ground = filled(self, rotor_radius=vehicle.rotor_radius)
        if ground.rotor_radius is None:
            rule = f"given for the ground effect, as the vehicle {vehicle.name!r} states none"
            raise ParameterError("effects.ground", "rotor_radius", None, rule)
        return ground


@dataclass(frozen=True, kw_only=True)
class ThrustNoise:
    """Each rotor gives clip(u - n, 0, 1) of its largest thrust instead of u, n normal, independent.

    The mean of n is `loss` u^2 and its standard deviation is `deviation` sqrt(u), as in the simplified simulation of
    Torrente et al. 2021, "Data-Driven MPC for Quadrotors".  The reaction torque changes with the thrust.
    """

    loss: Annotated[NonNegative, doc("[-] mean of the share of thrust lost at full thrust; grows as u^2")] = 0.0
    deviation: Annotated[
        NonNegative, doc("[-] standard deviation per physics step at full thrust; proportional to sqrt(u)")
    ] = 0.0

    def applied(self, thrusts: Array, largest: float, rng: np.random.Generator) -> Array:
        """Return the actual thrusts (M, 4) [N] over M steps for commanded ones, at most `largest` [N]."""
        share = thrusts / largest
        lost = self.loss * np.square(share) + self.deviation * np.sqrt(share) * rng.standard_normal(share.shape)
        remaining: Array = largest * np.clip(share - lost, 0.0, 1.0)
        return remaining


@dataclass(frozen=True, kw_only=True)
class Disturbance:
    """An unmodelled force and torque, with a constant and a random part."""

    force: Annotated[Vector, doc("[N] world frame")] = (0.0, 0.0, 0.0)
    torque: Annotated[Vector, doc("[N m] body frame")] = (0.0, 0.0, 0.0)
    force_noise: Annotated[
        NonNegative, doc("[N s^0.5] root of the two-sided spectral density of white noise, each axis")
    ] = 0.0
    torque_noise: Annotated[NonNegative, doc("[N m s^0.5] as force_noise, for the torque")] = 0.0

    def draw(self, steps: int, timestep: float, rng: np.random.Generator) -> Array:
        """(steps, 6) force, world [N], and torque, body [N m], over each step of `timestep` [s]."""
        constant = np.array([*self.force, *self.torque])
        density = np.repeat([self.force_noise, self.torque_noise], 3)
        if not density.any():
            return np.tile(constant, (steps, 1))
        drawn: Array = constant + density / math.sqrt(timestep) * rng.standard_normal((steps, 6))
        return drawn


@dataclass(frozen=True, kw_only=True)
class PushChange:
    """From `at` [s] on, exactly these pushes act."""

    at: float
    pushes: tuple[Push, ...]


Change = RotorChange | PayloadPickup | PayloadDrop | MassChange | LagChange | PushChange
"""The changes of a vehicle in flight."""
LOADING = (PayloadPickup, PayloadDrop, MassChange)
"""The changes of mass, for which the model is compiled differently."""


@dataclass(frozen=True, kw_only=True)
class Effects:
    """The effects on the plant beyond the paper's model; an absent table means that the effect is off."""

    rotors: Annotated[RotorDynamics | None, doc("rotor lag, limits, inertia, wear")] = None
    air: Annotated[Air | None, doc("drag and wind")] = None
    ground: Annotated[Ground | None, doc("a floor")] = None
    load: Annotated[Load | None, doc("errors of mass and inertia, payload")] = None
    disturbance: Annotated[Disturbance | None, doc("unmodelled force and torque")] = None
    thrust_noise: Annotated[ThrustNoise | None, doc("loss and fluctuation of thrust")] = None
    battery: Annotated[Battery | None, doc("voltage, on which thrust depends")] = None

    def resolved(self, vehicle: Vehicle) -> Effects:
        """Fill in every size left to the vehicle.

        Raises:
            ParameterError: a required size is missing in both, or a combination is impossible.
        """
        return replace(
            self,
            rotors=self.rotors and self.rotors.resolved(vehicle),
            air=self.air and self.air.resolved(vehicle),
            ground=self.ground and self.ground.resolved(vehicle),
            battery=self.battery and self.battery.resolved(vehicle),
        )

    @property
    def follows_state(self) -> bool:
        """Whether a force depends on the motion, so that physics steps are taken one by one."""
        spinning = self.rotors is not None and bool(self.rotors.inertia)
        dragged = self.air is not None and self.air.drags
        lifted = self.ground is not None and self.ground.effect
        return spinning or dragged or lifted or self.disturbance is not None


class Force(Protocol):
    """A user-defined force on the vehicle: called once per physics step, at its start.

    An object with state may have a method `reset()`, called before a flight.
    """

    def __call__(self, time: float, state: Array) -> Array:
        """Force x, y, z in the world frame [N] and torque in the body frame [N m], (6,), at a time [s] and state (12,).

        The yaw of the state is within +-pi.
        """
        ...
