"""A vehicle: mass, inertia, four rotors and their limits, read from one TOML file."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any, Final, NoReturn, get_type_hints

import numpy as np
from annotated_types import DocInfo, Len, doc

from quadsim.assets import read_toml
from quadsim.errors import FileError, ParameterError, UnknownNameError
from quadsim.fields import Number, Vector
from quadsim.state import Array

N_ROTORS: Final = 4
AUTOPILOT: Final = "autopilot"  # table of a vehicle file; see `quadsim.sim.autopilot.AutopilotSettings`
PerAxis = Annotated[tuple[Number, ...], Len(2, 2)]
OfRotors = Annotated[tuple[Number, ...], Len(N_ROTORS, N_ROTORS)]
SMALLEST, LARGEST = 1e-12, 1e6
"""Allowed magnitudes of a vehicle's numbers; MuJoCo refuses smaller inertias, and larger numbers overflow."""
SLOWEST_ROTOR: Final = 1.0
"""Longest time constant of a rotor [s]; propellers of 30 inch have some 0.3 s."""


@dataclass(frozen=True, kw_only=True)
class Vehicle:
    """A rigid body carried by four fixed rotors, thrust along body +z; validated on construction.

    Body frame: x forward, y left, z up, origin at the centre of mass.  Rotor i gives the thrust
    f_i = b w_i^2 [N] and the reaction torque spin_i d w_i^2 [N m] about body +z (Sec. 2.2).

    Linear drag is a force -rotor_drag w v_perp on a rotor, v_perp its velocity through the air in the rotor's plane
    (Martin and Salaun, 2010; Furrer et al., 2016).  The same velocity v turns the vehicle, by (rotor_moment[0] w v_y,
    -rotor_moment[1] w v_x, 0) for each rotor: its disc flaps, and its drag acts above the centre of mass.  Turning is
    damped by -rate_damping times the body rates.  What is in `OPTIONAL_PARAMETERS` is None where its file does not
    give it.

    Raises:
        ParameterError: a value is not finite or impossible, or the vehicle cannot hover within its rotors' range.

    Examples:
        >>> from dataclasses import replace
        >>> import quadsim
        >>> heavier = replace(quadsim.load_vehicle("hummingbird"), mass=0.8)  # [kg]
        >>> round(heavier.hover_speed)  # [rad/s]
        479
    """

    name: Annotated[str, doc("short name")]
    description: Annotated[str, doc("one line for `quadsim list`")] = ""
    mass: Annotated[float, doc("[kg] at take-off")]
    gravity: Annotated[float, doc("[m/s^2] where it flies")]
    inertia: Annotated[Vector, doc("[kg m^2] Ixx, Iyy, Izz, body axes")]
    arm_length: Annotated[float, doc("[m] L, centre of mass to rotor axis")]
    rotor_azimuths: Annotated[
        OfRotors, doc("[deg] direction of each arm from body +x, counter-clockwise seen from above")
    ]
    rotor_spins: Annotated[
        tuple[int, ...],
        Len(N_ROTORS, N_ROTORS),
        doc("[-] 1 or -1, sign of each rotor's reaction torque about body +z"),
    ]
    thrust_coefficient: Annotated[float, doc("[N s^2/rad^2] b, thrust b w^2")]
    drag_to_thrust: Annotated[float, doc("[m] d / b, reaction torque d w^2")]
    speed_min: Annotated[float, doc("[rad/s] lowest speed that a rotor holds")]
    speed_max: Annotated[float, doc("[rad/s] highest speed that a rotor holds")]
    rotor_rise: Annotated[float | None, doc("[s] time constant of a rotor's speed when it rises")] = None
    rotor_fall: Annotated[float | None, doc("[s] time constant of a rotor's speed when it falls")] = None
    rotor_inertia: Annotated[float | None, doc("[kg m^2] of one rotor about its axis")] = None
    rotor_radius: Annotated[float | None, doc("[m] R, of a propeller")] = None
    rotor_drag: Annotated[float | None, doc("[N s^2/(m rad)] linear drag of one rotor")] = None
    rotor_moment: Annotated[
        PerAxis | None, doc("[N m s^2/(m rad)] of one rotor about its hub's x and y, per speed and air speed across it")
    ] = None
    rate_damping: Annotated[Vector | None, doc("[N m s/rad] of the whole vehicle about body x, y, z")] = None
    body_drag: Annotated[Vector | None, doc("[m^2] C_d A along body x, y, z")] = None
    extent: Annotated[float | None, doc("[m] radius of the ball about the centre of mass that holds all of it")] = None

    def __post_init__(self) -> None:
        for name in VEHICLE_UNITS:
            value, length = getattr(self, name), _LENGTHS.get(name)
            if value is None and name in OPTIONAL_PARAMETERS:
                continue
            if length is not None:
                if not isinstance(value, (tuple, list)) or len(value) != length:
                    self._refuse(name, f"a list of {length} numbers")
                object.__setattr__(self, name, tuple(value))
            for number in (value,) if length is None else value:
                _check_number(name, number, positive=name not in _ANY_SIGN)
        if min(self.rate_damping or (0.0,)) < 0.0:
            self._refuse("rate_damping", ">= 0 N m s/rad about each axis")
        if self.speed_min < 0.0:
            self._refuse("speed_min", ">= 0 rad/s")
        if self.speed_min >= self.speed_max:
            self._refuse("speed_min", f"below speed_max = {self.speed_max}")
        for name in ("rotor_rise", "rotor_fall"):
            if (getattr(self, name) or 0.0) > SLOWEST_ROTOR:
                self._refuse(name, f"above 0 and at most {SLOWEST_ROTOR:g} s, usually 0.01 to 0.3 s")
        if any(abs(spin) != 1 for spin in self.rotor_spins):
            self._refuse("rotor_spins", "four values, each 1 or -1")
        if 2.0 * max(self.inertia) > sum(self.inertia) * (1.0 + 1e-12):
            self._refuse("inertia", "such that no moment exceeds the sum of the other two")
        self._check_layout()
        self._check_hover()

    def _refuse(self, name: str, rule: str) -> NoReturn:
        raise ParameterError("vehicle", name, getattr(self, name), rule)

    def _check_layout(self) -> None:
        rule = self._layout_problem(self.rotor_spins)
        if rule is None:
            return
        alternating = np.empty(N_ROTORS, int)
        alternating[np.argsort(np.mod(self.rotor_azimuths, 360.0), kind="stable")] = (1, -1, 1, -1)
        alternating *= alternating[0] * int(self.rotor_spins[0])
        if self._layout_problem(alternating) is None:
            expected = tuple(alternating.tolist())
            self._refuse("rotor_spins", f"alternating around the airframe, so that yaw is controlled: {expected}")
        self._refuse("rotor_azimuths", rule)

    def _layout_problem(self, spins: Sequence[float] | Array) -> str | None:
        """Return the missing property of the layout with these spins; None if it is complete."""
        x, y, _ = self.rotor_positions.T / self.arm_length
        unit_allocation = np.stack([np.ones(N_ROTORS), y, -x, np.array(spins, float)])
        if abs(np.linalg.det(unit_allocation)) < 1e-9:
            return "a layout that controls roll, pitch, yaw and thrust"
        if np.abs(unit_allocation[1:].sum(axis=1)).max() > 1e-9:
            return "a layout whose torques cancel when all rotors turn alike, so that it can hover"
        return None

    def _check_hover(self) -> None:
        hover, weight = self.hover_speed, self.mass * self.gravity
        for name, sign, side in (("speed_max", 1.0, "no lower than"), ("speed_min", -1.0, "no higher than")):
            speed = getattr(self, name)
            if sign * (hover - speed) > 0.0:
                lift = N_ROTORS * self.thrust_coefficient * speed**2
                self._refuse(
                    name,
                    f"{side} its hover speed, {hover:.6g} rad/s, or it cannot hover (rotors hold {self.speed_min:g} to "
                    f"{self.speed_max:g} rad/s; {self.mass:g} kg weigh {weight:.4g} N, the rotors lift {lift:.4g} N at "
                    f"{speed:g} rad/s)",
                )

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
    def enclosing_radius(self) -> float:
        """Radius of the vehicle's bounding ball [m]: its extent, or the distance to the propellers' tips.

        An extent within the propellers' tips does not count.  Without either, the propellers are assumed as large as
        possible: neighbours almost touch.
        """
        if self.extent is not None:
            return max(self.extent, self.arm_length + (self.rotor_radius or 0.0))
        apart = np.linalg.norm(self.rotor_positions[:, None] - self.rotor_positions[None], axis=2)
        widest = 0.5 * float(apart[~np.eye(N_ROTORS, dtype=bool)].min())
        return self.arm_length + (widest if self.rotor_radius is None else self.rotor_radius)

    @property
    def allocation(self) -> Array:
        """(4, 4) matrix that maps squared rotor speeds to [U, tau_x, tau_y, tau_z], in N and N m (Sec. 2.2)."""
        b, d = self.thrust_coefficient, self.drag_coefficient
        x, y, _ = self.rotor_positions.T
        return np.stack([np.full(N_ROTORS, b), b * y, -b * x, d * np.array(self.rotor_spins, float)])


def _check_number(name: str, value: object, *, positive: bool) -> None:
    if isinstance(value, int) and abs(value) > LARGEST:  # it may be too long for a float, or a text
        value = math.copysign(math.inf, value > 0 or -1)
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        raise ParameterError("vehicle", name, value, "a finite number")
    if positive and value <= 0.0:
        raise ParameterError("vehicle", name, value, "positive")
    if abs(value) > LARGEST or (positive and value < SMALLEST):
        raise ParameterError("vehicle", name, value, f"between {SMALLEST:g} and {LARGEST:g}")


def load_vehicle(path: Path, overrides: Mapping[str, Any] | None = None) -> Vehicle:
    """Read a vehicle file: `name`, `description` and one table `{value, unit, source}` per parameter.

    `overrides` are parameter values that replace the file's.

    Raises:
        FileError: the file is missing, is not TOML, lacks a parameter, or has an impossible value.
        ParameterError: it is impossible with these overrides.
        UnknownNameError: the file or an override names an unknown parameter.
    """
    with _naming(path):
        texts, entries = _read_entries(path)
    values: dict[str, Any] = {**texts, **{key: entry["value"] for key, entry in entries.items()}}
    for key, value in (overrides or {}).items():
        if key not in VEHICLE_UNITS:
            raise UnknownNameError("vehicle parameter", key, VEHICLE_UNITS, meant=MEANT.get(key, ()))
        values[key] = value
    missing = [name for name in ("name", *VEHICLE_UNITS) if name not in values and name not in OPTIONAL_PARAMETERS]
    if missing:
        raise FileError(path, f"lacks {', '.join(missing)}")
    with nullcontext() if overrides else _naming(path):
        return Vehicle(**values)


@contextmanager
def _naming(path: Path) -> Iterator[None]:
    """Name the file whose number is refused."""
    try:
        yield
    except ParameterError as error:
        raise FileError(path, str(error)) from error


def vehicle_sources(path: Path) -> dict[str, str]:
    """Return the source of each parameter, in the vehicle file's order; arguments and errors as `load_vehicle`."""
    return {key: entry["source"] for key, entry in _read_entries(path)[1].items()}


def vehicle_autopilot(path: Path) -> dict[str, Any]:
    """Return the fields of a vehicle file's `[autopilot]` but its `source`; empty if it has no such table.

    Raises:
        FileError: as `load_vehicle`.
        ParameterError: it is not a table, or does not say where its numbers are from.
    """
    table = read_toml(path).get(AUTOPILOT, {"source": "none"})
    if not isinstance(table, dict) or not isinstance(table.get("source"), str) or not table["source"].strip():
        raise ParameterError("vehicle", AUTOPILOT, table, "a table with a source, a text saying where it is from")
    return {name: value for name, value in table.items() if name != "source"}


def _read_entries(path: Path) -> tuple[dict[str, str], dict[str, dict[str, Any]]]:
    """Return a vehicle file's description and parameters, each with value, unit and source."""
    texts: dict[str, str] = {}
    entries: dict[str, dict[str, Any]] = {}
    for key, entry in read_toml(path).items():
        if key == AUTOPILOT:
            continue
        if key in ("name", "description"):
            if not isinstance(entry, str):
                raise ParameterError("vehicle", key, entry, "a text")
            texts[key] = entry
            continue
        if key not in VEHICLE_UNITS:
            hint, meant = f"in {path}", MEANT.get(key, ())
            raise UnknownNameError("vehicle parameter", key, VEHICLE_UNITS, hint=hint, meant=meant)
        if not isinstance(entry, dict) or set(entry) != {"value", "unit", "source"}:
            raise ParameterError("vehicle", key, entry, "a table with exactly value, unit and source")
        if entry["unit"] != VEHICLE_UNITS[key]:
            raise ParameterError("vehicle", f"{key}.unit", entry["unit"], f"{VEHICLE_UNITS[key]!r}")
        if not isinstance(entry["source"], str) or not entry["source"].strip():
            raise ParameterError("vehicle", f"{key}.source", entry["source"], "a text saying where the number is from")
        entries[key] = entry
    return texts, entries


VEHICLE_UNITS: Final[dict[str, str]] = {
    name: note.documentation.partition("]")[0].removeprefix("[")
    for name, hint in get_type_hints(Vehicle, include_extras=True).items()
    for note in hint.__metadata__
    if isinstance(note, DocInfo) and note.documentation.startswith("[")
}
"""The parameters of a vehicle file and their units."""
MEANT: Final[dict[str, tuple[str, ...]]] = {"rotor_lag": ("rotor_rise", "rotor_fall")}
"""Parameters by other common names, where a spelling guess would name the wrong one."""
OPTIONAL_PARAMETERS: Final = tuple(field.name for field in fields(Vehicle) if field.default is None)
"""Parameters that a vehicle file may leave out."""
_LENGTHS: Final = {
    **{"inertia": 3, "rotor_azimuths": N_ROTORS, "rotor_spins": N_ROTORS},
    **{"rotor_moment": 2, "rate_damping": 3, "body_drag": 3},
}
_ANY_SIGN: Final = ("rotor_azimuths", "rotor_spins", "speed_min", "rotor_moment", "rate_damping")
