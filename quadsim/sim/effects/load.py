"""The actual mass properties: errors of mass and inertia, a shifted centre of mass, payloads."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

import mujoco
import numpy as np
from annotated_types import Ge, Le, Len, MaxLen, doc

from quadsim.errors import ParameterError
from quadsim.fields import Instant, Kilograms, Vector
from quadsim.state import Array
from quadsim.vehicle import Vehicle


@dataclass(frozen=True, kw_only=True)
class Payload:
    """A point mass fixed to the vehicle."""

    mass: Annotated[Kilograms, doc("[kg]")]
    position: Annotated[Vector, doc("[m] in the body frame")] = (0.0, 0.0, 0.0)


@dataclass(frozen=True, kw_only=True)
class PayloadPickup(Payload):
    """The vehicle picks up a point mass, which moves with it from then on."""

    at: Instant
    type: Annotated[Literal["payload_pickup"], doc("kind of event: payload_pickup")] = "payload_pickup"

    def text(self) -> str:
        """Describe the event."""
        return f"{self.mass:g} kg are picked up"


@dataclass(frozen=True, kw_only=True)
class PayloadDrop:
    """The vehicle drops its payloads."""

    at: Instant
    type: Annotated[Literal["payload_drop"], doc("kind of event: payload_drop")] = "payload_drop"

    def text(self) -> str:
        """Describe the event."""
        return "the payloads are dropped"


Factor = Annotated[float, Ge(0.05), Le(20.0)]


@dataclass(frozen=True, kw_only=True)
class MassChange:
    """The vehicle's mass, without payloads, changes."""

    at: Instant
    type: Annotated[Literal["mass"], doc("kind of event: mass")] = "mass"
    factor: Annotated[Factor, doc("[-] mass over the vehicle's from then on, instead of load.mass_factor")]

    def text(self) -> str:
        """Describe the event."""
        return f"the mass is {self.factor:g} times the file's"


@dataclass(frozen=True, kw_only=True)
class Load:
    """Differences of the actual vehicle from its file, which the controller still assumes."""

    mass_factor: Annotated[Factor, doc("[-] true mass over the mass in [actual], or else in [vehicle]")] = 1.0
    inertia_factor: Annotated[
        tuple[Factor, ...], Len(3, 3), doc("[-] as mass_factor, for the moments of inertia about body x, y, z")
    ] = (1.0, 1.0, 1.0)
    centre_of_mass: Annotated[Vector, doc("[m] its actual position, body frame")] = (0.0, 0.0, 0.0)
    payloads: Annotated[tuple[Payload, ...], MaxLen(1000), doc("payloads from the start")] = ()


@dataclass(frozen=True, kw_only=True)
class MassProperties:
    """A rigid body's mass [kg], centre of mass (3,) [m] and inertia (3, 3) about that centre [kg m^2]; body axes."""

    mass: float
    centre: Array
    inertia: Array


def mass_properties(vehicle: Vehicle, load: Load, payloads: Sequence[Payload]) -> MassProperties:
    """Return the vehicle with its errors and payloads as one body.

    The parallel-axis theorem: I = sum_i (I_i + m_i (|r_i|^2 1 - r_i r_i')), r_i from the common centre of mass to that
    of each part.

    Raises:
        ParameterError: no rigid body has these moments of inertia.
    """
    factor = np.sqrt(load.inertia_factor)
    moments = vehicle.inertia_matrix * np.outer(factor, factor)
    np.fill_diagonal(moments, np.array(vehicle.inertia) * load.inertia_factor)
    if 2.0 * np.linalg.eigvalsh(moments).max() > np.trace(moments) * (1.0 + 1e-12):
        rule = f"such that no moment of {np.diagonal(moments).tolist()} kg m^2 exceeds the sum of the other two"
        raise ParameterError("effects.load", "inertia_factor", list(load.inertia_factor), rule)
    of_parts = [vehicle.mass * load.mass_factor]
    places = [load.centre_of_mass]
    for payload in payloads:
        of_parts.append(payload.mass)
        places.append(payload.position)
    masses = np.array(of_parts)
    positions = np.array(places, float)
    total = float(masses.sum())
    centre = masses @ positions / total
    inertia = moments
    for mass, arm in zip(masses, positions - centre, strict=True):
        inertia = inertia + mass * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    return MassProperties(mass=total, centre=centre, inertia=inertia)


def apply_mass(model: mujoco.MjModel, body: str, properties: MassProperties) -> None:
    """Set the mass of a body in a compiled model; velocities stay those of the moment."""
    i = model.body(body).id
    moments, axes = np.linalg.eigh(properties.inertia)
    axes[:, 2] *= np.sign(np.linalg.det(axes))  # a rotation, not a reflection
    model.body_mass[i] = properties.mass
    model.body_ipos[i] = properties.centre
    model.body_inertia[i] = moments
    mujoco.mju_mat2Quat(model.body_iquat[i], axes.ravel())
    mujoco.mj_setConst(model, mujoco.MjData(model))
