"""The 12-state of the paper: order, names and units.

The state vector is xi = [x vx y vy z vz roll roll_rate pitch pitch_rate yaw yaw_rate] (Sec. 2.3), positions and
velocities in the world frame (z up), attitude as Z-Y-X Euler angles (body_to_world = Rz(yaw) Ry(pitch) Rx(roll)),
and **Euler-angle rates**, not body rates; `quadsim.rotation` converts between them.
"""

from __future__ import annotations

import difflib
import math
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

STATE_NAMES: Final = (
    "x", "vx", "y", "vy", "z", "vz",
    "roll", "roll_rate", "pitch", "pitch_rate", "yaw", "yaw_rate",
)  # fmt: skip
"""The states in their order; units: `quadsim.state.STATE_UNITS`."""
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
"""The same entries as slices, which NumPy indexes in a fifth of the time."""

_SHOWN: Final = {"rad": ("deg", math.degrees(1.0)), "rad/s": ("deg/s", math.degrees(1.0))}

REFERENCE_NAMES: Final = ("x", "y", "z", "yaw")
REFERENCE_UNITS: Final = ("m", "m", "m", "rad")
REFERENCE_STATES: Final = tuple(INDEX[name] for name in REFERENCE_NAMES)


def shown_unit(unit: str) -> tuple[str, float]:
    """Return the display unit of an SI quantity, and the factor to it: angles are shown in degrees."""
    return _SHOWN.get(unit, (unit, 1.0))


def tilt(states: Array) -> Array:
    """(M,) angle between the thrust axis and the vertical [rad] of states (M, 12)."""
    cosine = np.cos(states[:, INDEX["roll"]]) * np.cos(states[:, INDEX["pitch"]])
    angle: Array = np.arccos(np.clip(cosine, -1.0, 1.0))
    return angle


class State(np.ndarray[tuple[int], np.dtype[np.float64]]):
    """A state (12,) whose entries also have the names of `STATE_NAMES`: floats in m, m/s, rad and rad/s.

    Your controller receives one.  Parts of it, and what is computed from it, are plain arrays.

    Examples:
        >>> import numpy as np
        >>> import quadsim
        >>> state = np.arange(12.0).view(quadsim.State)
        >>> state.x, state.roll_rate, state[4], state[:3] + 1.0
        (0.0, 7.0, np.float64(4.0), array([1., 2., 3.]))
    """

    def __getattr__(self, name: str) -> float:
        if name in INDEX:
            return self.item(INDEX[name])
        near = difflib.get_close_matches(name, STATE_NAMES, n=1)
        guess = f"; did you mean {near[0]!r}?" if near else ""
        raise AttributeError(f"a state has no {name!r}{guess} (there are: {', '.join(STATE_NAMES)})")

    def __dir__(self) -> list[str]:
        return [*STATE_NAMES, *super().__dir__()]

    def __getitem__(self, key: Any) -> Any:
        part = super().__getitem__(key)
        return part.view(np.ndarray) if isinstance(part, State) else part

    def __array_wrap__(self, array: Any, context: Any = None, return_scalar: bool = False) -> Any:
        """What NumPy makes of a result: as of any array."""
        return array[()] if return_scalar else array.view(np.ndarray)


class YawTurns:
    """Counts a yaw's whole turns, sample by sample.

    Past the vertical, Euler's yaw turns by 180 deg either way: upside down it is unwrapped to the last one, and upright
    again to the last upright one, so a loop leaves the yaw unchanged.
    """

    def __init__(self, yaw: float) -> None:
        self._last = self._upright = yaw

    def unwrapped(self, euler: Array) -> float:
        """Return the unwrapped yaw [rad] of roll, pitch, yaw (3,); a yaw that is not finite is returned unchanged."""
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
    """Return `flags.all()`; for few flags in a third of the time."""
    return np.count_nonzero(flags) == flags.size


def read_only(array: Array) -> Array:
    """Return the same array, marked read-only: stored data never changes."""
    array.flags.writeable = False
    return array
