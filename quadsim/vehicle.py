"""What a vehicle is: mass, inertia, four rotors and their limits; read from one TOML file."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Final

import numpy as np

from quadsim.assets import read_toml
from quadsim.errors import FileError, ParameterError, UnknownNameError
from quadsim.state import Array

N_ROTORS: Final = 4
SMALLEST, LARGEST = 1e-12, 1e6
"""Magnitudes that a vehicle's numbers may have; MuJoCo refuses smaller inertias, and arithmetic larger ones."""


@dataclass(frozen=True, kw_only=True)
class Vehicle:
    """A rigid body carried by four fixed rotors, thrust along body +z; validated when made.

    Body frame: x forward, y left, z up, origin at the centre of mass.  Rotor i gives the thrust
    f_i = b w_i^2 [N] and the reaction torque spin_i d w_i^2 [N m] about body +z (Sec. 2.2).

    Attributes:
        name: short name.
        description: one line for `quadsim list`.
        mass: m [kg].
        gravity: g [m/s^2].
        inertia: (Ixx, Iyy, Izz) [kg m^2], principal and along the body axes.
        arm_length: L [m], centre of mass to rotor axis.
        rotor_azimuths: direction of each arm from body +x, counter-clockwise seen from above [deg].
        rotor_spins: +1 or -1, sign of each reaction torque about body +z.
        thrust_coefficient: b [N s^2/rad^2].
        drag_to_thrust: d / b [m].
        speed_min: lowest rotor speed the actuators can hold [rad/s].
        speed_max: highest rotor speed the actuators can hold [rad/s].

    Raises:
        ParameterError: a value is not finite or not possible.
    """

    name: str
    description: str = ""
    mass: float
    gravity: float
    inertia: tuple[float, float, float]
    arm_length: float
    rotor_azimuths: tuple[float, float, float, float]
    rotor_spins: tuple[int, int, int, int]
    thrust_coefficient: float
    drag_to_thrust: float
    speed_min: float
    speed_max: float

    def __post_init__(self) -> None:
        for name in ("mass", "gravity", "arm_length", "thrust_coefficient", "drag_to_thrust", "speed_max"):
            self._check_number(name, getattr(self, name), positive=True)
        self._check_number("speed_min", self.speed_min, positive=False)
        if self.speed_min < 0.0:
            raise ParameterError("vehicle", "speed_min", self.speed_min, ">= 0 rad/s")
        if self.speed_min >= self.speed_max:
            raise ParameterError("vehicle", "speed_min", self.speed_min, f"below speed_max = {self.speed_max}")
        self._check_vector("inertia", 3, positive=True)
        self._check_vector("rotor_azimuths", N_ROTORS, positive=False)
        self._check_vector("rotor_spins", N_ROTORS, positive=False)
        if any(abs(spin) != 1 for spin in self.rotor_spins):
            raise ParameterError("vehicle", "rotor_spins", self.rotor_spins, "four values, each 1 or -1")
        ixx, iyy, izz = self.inertia
        if 2.0 * max(self.inertia) > (ixx + iyy + izz) * (1.0 + 1e-12):
            raise ParameterError(
                "vehicle", "inertia", self.inertia, "such that no moment exceeds the sum of the other two"
            )
        b, d = self.thrust_coefficient, self.drag_coefficient
        scale = np.array([b, b * self.arm_length, b * self.arm_length, d])
        unit_allocation = self.allocation / scale[:, None]
        if abs(np.linalg.det(unit_allocation)) < 1e-9:
            raise ParameterError(
                "vehicle", "rotor_azimuths", self.rotor_azimuths, "a layout that controls roll, pitch, yaw and thrust"
            )
        if np.abs(unit_allocation[1:].sum(axis=1)).max() > 1e-9:
            layout = {"rotor_azimuths": self.rotor_azimuths, "rotor_spins": self.rotor_spins}
            rule = "a layout whose torques cancel when all rotors turn alike, so that it can hover"
            raise ParameterError("vehicle", "rotor_azimuths, rotor_spins", layout, rule)

    def _check_number(self, name: str, value: object, *, positive: bool) -> None:
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
            raise ParameterError("vehicle", name, value, "a finite number")
        if positive and value <= 0.0:
            raise ParameterError("vehicle", name, value, "positive")
        if abs(value) > LARGEST or (positive and value < SMALLEST):
            raise ParameterError("vehicle", name, value, f"between {SMALLEST:g} and {LARGEST:g}")

    def _check_vector(self, name: str, length: int, *, positive: bool) -> None:
        value = getattr(self, name)
        if not isinstance(value, (tuple, list)) or len(value) != length:
            raise ParameterError("vehicle", name, value, f"a list of {length} numbers")
        for item in value:
            self._check_number(name, item, positive=positive)
        object.__setattr__(self, name, tuple(value))

    @property
    def drag_coefficient(self) -> float:
        """Drag coefficient d [N m s^2/rad^2]."""
        return self.drag_to_thrust * self.thrust_coefficient

    @property
    def hover_speed(self) -> float:
        """omega_bar [rad/s]: the speed at which four rotors carry the weight, 4 b omega_bar^2 = m g."""
        return math.sqrt(self.mass * self.gravity / (N_ROTORS * self.thrust_coefficient))

    @property
    def rotor_positions(self) -> Array:
        """(4, 3) rotor centres in the body frame [m]."""
        azimuth = np.radians(self.rotor_azimuths)
        directions = np.stack([np.cos(azimuth), np.sin(azimuth), np.zeros(N_ROTORS)], axis=1)
        return self.arm_length * directions.round(15)  # an arm along an axis lies on it exactly

    @property
    def allocation(self) -> Array:
        """(4, 4) matrix taking squared rotor speeds to [U, tau_x, tau_y, tau_z] [N, N m] (Sec. 2.2)."""
        b, d = self.thrust_coefficient, self.drag_coefficient
        x, y, _ = self.rotor_positions.T
        return np.stack([np.full(N_ROTORS, b), b * y, -b * x, d * np.array(self.rotor_spins, float)])


def load_vehicle(path: Path, overrides: Mapping[str, Any] | None = None) -> Vehicle:
    """Read a vehicle file.

    Args:
        path: a TOML file with `name`, `description` and one table `{value, unit, source}` per parameter.
        overrides: parameter values that replace the file's.

    Raises:
        FileError: the file is missing, is not TOML, or lacks or misnames a parameter.
        ParameterError: a value is not possible.
        UnknownNameError: an override names no parameter.
    """
    data = read_toml(path)
    units = VEHICLE_UNITS
    values: dict[str, Any] = {}
    for key, entry in data.items():
        if key in ("name", "description"):
            if not isinstance(entry, str):
                raise ParameterError("vehicle", key, entry, "a text")
            values[key] = entry
            continue
        if key not in units:
            raise UnknownNameError("vehicle parameter", key, units, hint=f"in {path}")
        if not isinstance(entry, dict) or set(entry) != {"value", "unit", "source"}:
            raise ParameterError("vehicle", key, entry, "a table with exactly value, unit and source")
        if entry["unit"] != units[key]:
            raise ParameterError("vehicle", f"{key}.unit", entry["unit"], f"{units[key]!r}")
        if not isinstance(entry["source"], str) or not entry["source"].strip():
            raise ParameterError("vehicle", f"{key}.source", entry["source"], "a text saying where the number is from")
        values[key] = entry["value"]
    for key, value in (overrides or {}).items():
        if key not in units:
            raise UnknownNameError("vehicle parameter", key, units)
        values[key] = value
    missing = [name for name in ("name", *units) if name not in values]
    if missing:
        raise FileError(path, f"lacks {', '.join(missing)}")
    return Vehicle(**values)


VEHICLE_UNITS: Final[dict[str, str]] = {
    "mass": "kg",
    "gravity": "m/s^2",
    "inertia": "kg m^2",
    "arm_length": "m",
    "rotor_azimuths": "deg",
    "rotor_spins": "-",
    "thrust_coefficient": "N s^2/rad^2",
    "drag_to_thrust": "m",
    "speed_min": "rad/s",
    "speed_max": "rad/s",
}
assert set(VEHICLE_UNITS) == {field.name for field in fields(Vehicle)} - {"name", "description"}
