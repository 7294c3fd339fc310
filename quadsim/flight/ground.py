"""The ground: what of a vehicle may touch it, how far that stays clear of it, and take-off and touchdown in a log."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from quadsim.rotation import body_to_world
from quadsim.state import EULER, INDEX, Array, tilt

AIRBORNE: Final = 0.05  # clearance of the feet [m] above which a vehicle flies: no landing gear springs back that far
TOUCH: Final = 2e-3  # clearance [m] from which on a part touches: contacts are soft, and points stand for rounded parts


@dataclass(frozen=True, kw_only=True)
class Outline:
    """Where an airframe can touch the ground, in the body frame; at rest on its feet its origin is at z = 0."""

    feet: Array  # (4, 3) centres of the feet [m]
    foot_radius: float  # [m]
    hull: Array  # (P, 3) points of what must not touch: the rims of the rotor discs and the underside [m]
    floor: float  # height of the floor [m]
    disc: float  # height of the rotor discs above the origin [m]


def clearance(states: Array, points: Array, radius: float, floor: float) -> Array:
    """How far the lowest of several points stays clear of the floor, negative inside it.

    min over p of (position + R p)_z - radius - floor [m], (M,), of states (M, 12), points (P, 3) in the body frame [m],
    a sphere's radius around each of them and the floor's height [m].
    """
    down = body_to_world(states[:, EULER])[:, 2, :] @ points.T
    lowest: Array = states[:, INDEX["z"]] + down.min(axis=1) - radius - floor
    return lowest


def touchdown(t: Array, states: Array, clearances: Array) -> dict[str, float] | None:
    """The first touch after the vehicle has flown; None where there is none.

    Args:
        t: (M,) [s].
        states: (M, 12), at the physics rate: at the log rate the speed is that of up to a log period before.
        clearances: (M,) of what may meet the ground first [m].

    Returns:
        Of the last state before: `time` [s], `speed` downwards and `horizontal_speed` [m/s], and `tilt` [deg].
    """
    flown = np.flatnonzero(clearances > AIRBORNE)
    if not flown.size:
        return None
    met = np.flatnonzero(clearances[flown[0] :] <= TOUCH)
    if not met.size:
        return None
    last = flown[0] + met[0] - 1
    vx, vy, vz = (float(states[last, INDEX[name]]) for name in ("vx", "vy", "vz"))
    lean = float(np.degrees(tilt(states[last : last + 1])[0]))
    return {"time": float(t[last]), "speed": -vz, "horizontal_speed": math.hypot(vx, vy), "tilt": lean}


def takeoff_time(t: Array, clearances: Array) -> float | None:
    """When a vehicle that starts on the ground first flies [s]; None where it starts in the air or stays down."""
    flown = np.flatnonzero(clearances > AIRBORNE)
    return float(t[flown[0]]) if flown.size and flown[0] > 0 else None
