"""What effects did in a flight, as curves to draw; only what is there."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from quadsim.flightlog import FlightLog
from quadsim.state import Array

_VISIBLE_SPEED: Final = 1e-3
"""Difference between commanded and acting rotor speeds from which on they are two curves [rad/s]."""


@dataclass(frozen=True, kw_only=True)
class EffectCurves:
    """One quantity along x, y and z at the plant's instants.

    Attributes:
        key: short name, e.g. `wind`.
        title: what it is.
        unit: its unit.
        values: (M, 3).
    """

    key: str
    title: str
    unit: str
    values: Array


def effect_curves(log: FlightLog) -> list[EffectCurves]:
    """External force and torque, and the wind, each where it is not zero throughout."""
    wrench = np.zeros((1, 6)) if log.plant.wrench is None else log.plant.wrench
    wind = np.zeros((1, 3)) if log.plant.wind is None else log.plant.wind
    curves = [
        EffectCurves(key="force", title="external force, world", unit="N", values=wrench[:, :3]),
        EffectCurves(key="torque", title="external torque, body", unit="N m", values=wrench[:, 3:]),
        EffectCurves(key="wind", title="wind, world", unit="m/s", values=wind),
    ]
    return [entry for entry in curves if np.any(entry.values)]


def commanded_speeds(log: FlightLog) -> Array | None:
    """(M, 4) the commands in force at the plant's instants [rad/s]; None where the rotors turn just as commanded.

    They differ where rotors lag or saturate, and where commands take time to compute.
    """
    plant, control = log.plant, log.control
    if not control.t.size:
        return None
    period = np.searchsorted(control.t, plant.t, side="right") - 1
    commanded: Array = control.speeds[period]
    return commanded if np.abs(commanded - plant.speeds).max() > _VISIBLE_SPEED else None
