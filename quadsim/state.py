"""The 12-state of the paper: order, names and units.

The state vector is xi = [x vx y vy z vz roll roll_rate pitch pitch_rate yaw yaw_rate] (Sec. 2.3), positions and
velocities in the world frame (z up), attitude as Z-Y-X Euler angles (body_to_world = Rz(yaw) Ry(pitch) Rx(roll)),
and **Euler-angle rates**, not body rates; `quadsim.rotation` converts between them.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

STATE_NAMES: Final = (
    "x", "vx", "y", "vy", "z", "vz",
    "roll", "roll_rate", "pitch", "pitch_rate", "yaw", "yaw_rate",
)  # fmt: skip
STATE_UNITS: Final = ("m", "m/s") * 3 + ("rad", "rad/s") * 3
INDEX: Final = {name: i for i, name in enumerate(STATE_NAMES)}
N_STATES: Final = len(STATE_NAMES)

POSITION: Final = (0, 2, 4)
VELOCITY: Final = (1, 3, 5)
EULER: Final = (6, 8, 10)
EULER_RATE: Final = (7, 9, 11)

POSITIONS: Final = slice(0, 6, 2)
VELOCITIES: Final = slice(1, 6, 2)
ANGLES: Final = slice(6, 12, 2)
ANGLE_RATES: Final = slice(7, 12, 2)
"""The same entries as slices, by which NumPy finds them in a fifth of the time."""

_SHOWN: Final = {"rad": ("deg", math.degrees(1.0)), "rad/s": ("deg/s", math.degrees(1.0))}

REFERENCE_NAMES: Final = ("x", "y", "z", "yaw")
REFERENCE_UNITS: Final = ("m", "m", "m", "rad")
REFERENCE_STATES: Final = tuple(INDEX[name] for name in REFERENCE_NAMES)


def shown_unit(unit: str) -> tuple[str, float]:
    """The unit in which people read an SI quantity, and the factor to it: angles are shown in degrees."""
    return _SHOWN.get(unit, (unit, 1.0))


def tilt(states: Array) -> Array:
    """(M,) angle between the thrust axis and the vertical [rad] of states (M, 12)."""
    cosine = np.cos(states[:, INDEX["roll"]]) * np.cos(states[:, INDEX["pitch"]])
    angle: Array = np.arccos(np.clip(cosine, -1.0, 1.0))
    return angle


class YawTurns:
    """Keeps count of a yaw's whole turns, sample by sample.

    Past the vertical, Euler's yaw turns by 180 deg either way: upside down it is nearest to the last one, and upright
    again nearest to the last upright one.  A loop so leaves the yaw as it was.
    """

    def __init__(self, yaw: float) -> None:
        self._last = self._upright = yaw

    def unwrapped(self, euler: Array) -> float:
        """The yaw [rad] of roll, pitch, yaw (3,), with its turns; where not finite, as it is."""
        roll, pitch, yaw = euler.tolist()
        if math.isfinite(roll + pitch + yaw):
            upright = math.cos(roll) * math.cos(pitch) >= 0.0
            yaw += 2.0 * math.pi * round(((self._upright if upright else self._last) - yaw) / (2.0 * math.pi))
            self._last = yaw
            self._upright = yaw if upright else self._upright
        return float(yaw)


def make_state(
    *,
    position: tuple[float, float, float] = (0.0, 0.0, 0.0),
    euler: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> Array:
    """A state at rest at `position` [m, world] with attitude roll, pitch, yaw `euler` [rad]."""
    state = np.zeros(N_STATES)
    state[list(POSITION)] = position
    state[list(EULER)] = euler
    return state


def all_true(flags: NDArray[np.bool_]) -> bool:
    """`flags.all()`, of few flags in a third of the time."""
    return np.count_nonzero(flags) == flags.size


def read_only(array: Array) -> Array:
    """The same array, marked read-only: what is stored is never changed afterwards."""
    array.flags.writeable = False
    return array
