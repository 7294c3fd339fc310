"""What acts on the plant beyond the paper's model; each effect is off unless a scenario sizes it."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Annotated, Protocol

import numpy as np
from annotated_types import doc

from quadsim.errors import ParameterError
from quadsim.fields import NonNegative, Vector
from quadsim.sim.effects.ground_effect import Ground
from quadsim.sim.effects.load import Factor, Load, Payload
from quadsim.sim.effects.push import Push
from quadsim.sim.effects.rotors import RotorDynamics
from quadsim.sim.effects.thrust_noise import ThrustNoise
from quadsim.sim.effects.wind import Air
from quadsim.state import Array
from quadsim.vehicle import N_ROTORS, Vehicle

__all__ = [
    "Air",
    "Change",
    "Disturbance",
    "Effects",
    "Ground",
    "LagChange",
    "Load",
    "MassChange",
    "Payload",
    "PayloadChange",
    "Push",
    "PushChange",
    "RotorChange",
    "RotorDynamics",
    "ThrustNoise",
]


@dataclass(frozen=True, kw_only=True)
class Disturbance:
    """An unmodelled force and torque, constant and random."""

    force: Annotated[Vector, doc("[N] world frame")] = (0.0, 0.0, 0.0)
    torque: Annotated[Vector, doc("[N m] body frame")] = (0.0, 0.0, 0.0)
    force_noise: Annotated[
        NonNegative, doc("[N s^0.5] root of the two-sided spectral density of white noise, each axis")
    ] = 0.0
    torque_noise: Annotated[NonNegative, doc("[N m s^0.5] the same of the torque")] = 0.0

    def draw(self, steps: int, timestep: float, rng: np.random.Generator) -> Array:
        """(steps, 6) force, world [N], and torque, body [N m], over each step of `timestep` [s]."""
        constant = np.array([*self.force, *self.torque])
        density = np.repeat([self.force_noise, self.torque_noise], 3)
        if not density.any():
            return np.tile(constant, (steps, 1))
        drawn: Array = constant + density / math.sqrt(timestep) * rng.standard_normal((steps, 6))
        return drawn


@dataclass(frozen=True, kw_only=True)
class RotorChange:
    """From `time` [s] on, a rotor gives the share `efficiency` of the thrust and torque that its speed would give.

    At 0 it has lost its propeller: it drags no more either, and carries no momentum.
    """

    time: float
    rotor: int
    efficiency: float

    def __post_init__(self) -> None:
        if self.rotor not in range(1, N_ROTORS + 1):
            raise ParameterError("events", "rotor", self.rotor, f"1 to {N_ROTORS}")
        if not 0.0 <= self.efficiency <= 1.0:
            raise ParameterError("events", "efficiency", self.efficiency, "between 0 and 1")


@dataclass(frozen=True, kw_only=True)
class PayloadChange:
    """From `time` [s] on, the vehicle carries this payload, or with None lets go of all it carries."""

    time: float
    payload: Payload | None


@dataclass(frozen=True, kw_only=True)
class MassChange:
    """From `time` [s] on, the vehicle's mass is `factor` times its own, whatever it carries besides."""

    time: float
    factor: Factor


@dataclass(frozen=True, kw_only=True)
class LagChange:
    """From `time` [s] on, rotors have these time constants of speeding up and slowing down [s]; 0 for at once."""

    time: float
    rise: float
    fall: float


@dataclass(frozen=True, kw_only=True)
class PushChange:
    """From `time` [s] on, these pushes act and no others."""

    time: float
    pushes: tuple[Push, ...]


Change = RotorChange | PayloadChange | MassChange | LagChange | PushChange  # what happens to the vehicle on the way
LOADING = (PayloadChange, MassChange)
"""The changes of what the vehicle weighs, for which its model is compiled another way."""


@dataclass(frozen=True, kw_only=True)
class Effects:
    """What acts on the plant beyond the paper's model; a table that is absent is an effect that is off."""

    rotors: Annotated[RotorDynamics | None, doc("rotor lag, limits, inertia, wear")] = None
    air: Annotated[Air | None, doc("drag and wind")] = None
    ground: Annotated[Ground | None, doc("a floor")] = None
    load: Annotated[Load | None, doc("errors of mass and inertia, payload")] = None
    disturbance: Annotated[Disturbance | None, doc("unmodelled force and torque")] = None
    thrust_noise: Annotated[ThrustNoise | None, doc("thrust that is lost and fluctuates")] = None

    def resolved(self, vehicle: Vehicle) -> Effects:
        """With every size that is left to the vehicle.

        Raises:
            ParameterError: a size is needed that neither gives, or a combination is not possible.
        """
        return replace(
            self,
            rotors=self.rotors and self.rotors.resolved(vehicle),
            air=self.air and self.air.resolved(vehicle),
            ground=self.ground and self.ground.resolved(vehicle),
        )

    @property
    def follows_state(self) -> bool:
        """Whether a force depends on how the vehicle moves, so that each physics step has to be taken by itself."""
        spinning = self.rotors is not None and bool(self.rotors.inertia)
        dragged = self.air is not None and self.air.drags
        lifted = self.ground is not None and self.ground.effect
        return spinning or dragged or lifted or self.disturbance is not None


class Force(Protocol):
    """A user-defined force on the vehicle: called once per physics step, at its begin.

    What has memory may have a method `reset()`, called before a flight.
    """

    def __call__(self, time: float, state: Array) -> Array:
        """Force x, y, z in the world frame [N] and torque in the body frame [N m], (6,), at a time [s] and state (12,).

        The yaw of the state is within +-pi.
        """
        ...
