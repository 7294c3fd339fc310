"""What acts on the plant beyond the paper's model; each effect is off unless a scenario sizes it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from quadsim.errors import ParameterError
from quadsim.sim.effects.load import Load, Payload
from quadsim.sim.effects.rotors import RotorDynamics
from quadsim.state import Array
from quadsim.vehicle import N_ROTORS

__all__ = [
    "SEA_LEVEL_DENSITY",
    "Disturbance",
    "Effects",
    "Load",
    "Payload",
    "PayloadChange",
    "RotorChange",
    "RotorDynamics",
]

SEA_LEVEL_DENSITY: Final = 1.225
"""Density of air [kg/m^3] at sea level in the International Standard Atmosphere (ISO 2533)."""


_AS_THE_FILE_SAYS: Final = Load()


@dataclass(frozen=True, kw_only=True)
class Disturbance:
    """An unmodelled force and torque: constant parts, and white noise.

    Attributes:
        force: (x, y, z) in the world frame [N].
        torque: (x, y, z) in the body frame, about its origin [N m].
        force_noise: square root of the two-sided spectral density of each axis [N s^0.5].
        torque_noise: the same [N m s^0.5].
    """

    force: tuple[float, float, float] = (0.0, 0.0, 0.0)
    torque: tuple[float, float, float] = (0.0, 0.0, 0.0)
    force_noise: float = 0.0
    torque_noise: float = 0.0

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
class Effects:
    """Every effect of one flight but the wind, which is a field of its own.

    Attributes:
        rotors: how rotors follow their commands; None for at once.
        efficiency: share of its thrust and torque that each rotor gives.
        rotor_drag: k [kg/rad]: rotor i is held back by k w_i times its air speed across its axis [N].
        body_drag: drag areas C_d A along the body axes [m^2], or None.
        air_density: [kg/m^3].
        rotor_radius: R [m] of the ground effect, or None for no ground effect.
        contact: whether there is a ground to stand on.
        load: what the vehicle really weighs.
        disturbance: unmodelled force and torque, or None.
        changes: what happens to rotors and payload on the way, in any order.
    """

    rotors: RotorDynamics | None = None
    efficiency: tuple[float, float, float, float] = (1.0, 1.0, 1.0, 1.0)
    rotor_drag: float = 0.0
    body_drag: tuple[float, float, float] | None = None
    air_density: float = SEA_LEVEL_DENSITY
    rotor_radius: float | None = None
    contact: bool = False
    load: Load = _AS_THE_FILE_SAYS
    disturbance: Disturbance | None = None
    changes: tuple[RotorChange | PayloadChange, ...] = ()

    def __post_init__(self) -> None:
        if len(self.efficiency) != N_ROTORS or not all(0.0 <= share <= 1.0 for share in self.efficiency):
            raise ParameterError("effects.rotors", "efficiency", self.efficiency, "four numbers between 0 and 1")
        if not 0.0 <= self.rotor_drag < math.inf:
            raise ParameterError("effects.air", "rotor_drag", self.rotor_drag, "at least 0 and finite")
        if self.body_drag is not None and not all(0.0 < area < math.inf for area in self.body_drag):
            raise ParameterError("effects.air", "body_drag", self.body_drag, "three positive and finite numbers")
        if not 0.0 < self.air_density < math.inf:
            raise ParameterError("effects.air", "density", self.air_density, "positive and finite")

    @property
    def reweighs(self) -> bool:
        """Whether the vehicle ever has another mass than its file says."""
        return self.load != _AS_THE_FILE_SAYS or any(isinstance(change, PayloadChange) for change in self.changes)

    @property
    def follows_state(self) -> bool:
        """Whether a force depends on how the vehicle moves, so that each physics step has to be taken by itself."""
        spinning = self.rotors is not None and self.rotors.inertia > 0.0
        aerodynamic = self.rotor_drag > 0.0 or self.body_drag is not None or self.rotor_radius is not None
        return spinning or aerodynamic or self.disturbance is not None
