"""The 12-state of the paper: order, names, units, and attitude kinematics.

The state vector is xi = [x vx y vy z vz roll roll_rate pitch pitch_rate yaw yaw_rate] (Sec. 2.3), positions and
velocities in the world frame (z up), attitude as Z-Y-X Euler angles (body_to_world = Rz(yaw) Ry(pitch) Rx(roll)),
and **Euler-angle rates**, not body rates. All functions take arrays with any leading dimensions.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Final

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


def quaternion_to_euler(quaternion: Array) -> Array:
    """Roll, pitch, yaw [rad] of unit quaternions.

    Args:
        quaternion: (..., 4), scalar first (w, x, y, z), body to world.

    Returns:
        (..., 3): roll and yaw in [-pi, pi], pitch in [-pi/2, pi/2].
    """
    w, x, y, z = _entries(quaternion)
    euler = np.empty((*x.shape, 3))
    euler[..., 0] = np.arctan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    euler[..., 1] = np.arcsin(np.minimum(np.maximum(2.0 * (w * y - z * x), -1.0), 1.0))
    euler[..., 2] = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return euler


def euler_to_quaternion(euler: Array) -> Array:
    """Unit quaternions (..., 4), scalar first, body to world, of roll, pitch, yaw (..., 3) [rad]."""
    half = 0.5 * np.asarray(euler, float)
    (cr, cp, cy), (sr, sp, sy) = np.moveaxis(np.cos(half), -1, 0), np.moveaxis(np.sin(half), -1, 0)
    return np.stack(
        [
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        ],
        axis=-1,
    )


def body_to_euler_rates(euler: Array, body_rates: Array) -> Array:
    """Euler-angle rates [rad/s] from body rates (p, q, r).

    d(roll)/dt = p + (q sin(roll) + r cos(roll)) tan(pitch), and so on; singular at pitch = +-90 deg, where the
    result grows without bound.  The paper (Sec. 2.2) takes the two sets of rates as equal, which holds at small
    angles only.
    """
    roll, pitch, _ = _entries(euler)
    p, q, r = _entries(body_rates)
    sin_roll, cos_roll = np.sin(roll), np.cos(roll)
    lateral = q * sin_roll + r * cos_roll
    rates = np.empty((*lateral.shape, 3))
    rates[..., 0] = p + lateral * np.tan(pitch)
    rates[..., 1] = q * cos_roll - r * sin_roll
    rates[..., 2] = lateral / np.cos(pitch)
    return rates


def euler_to_body_rates(euler: Array, euler_rates: Array) -> Array:
    """Body rates (p, q, r) [rad/s] from Euler-angle rates; the inverse of `body_to_euler_rates`."""
    roll, pitch = euler[..., 0], euler[..., 1]
    rates = np.moveaxis(np.asarray(euler_rates, float), -1, 0)
    return np.stack(_body_rates(np.sin(roll), np.cos(roll), np.sin(pitch), np.cos(pitch), rates), axis=-1)


def body_rates_of(state: Sequence[float]) -> tuple[float, float, float]:
    """The same of one state (12,), finite, in plain numbers: sooner done than by arrays of three."""
    roll, pitch, _ = state[ANGLES]
    return _body_rates(math.sin(roll), math.cos(roll), math.sin(pitch), math.cos(pitch), state[ANGLE_RATES])


def _body_rates(sin_roll: Any, cos_roll: Any, sin_pitch: Any, cos_pitch: Any, euler_rates: Any) -> tuple[Any, Any, Any]:
    """Body rates (p, q, r) from Euler-angle rates, arrays or plain numbers."""
    roll_rate, pitch_rate, yaw_rate = euler_rates
    return (
        roll_rate - yaw_rate * sin_pitch,
        pitch_rate * cos_roll + yaw_rate * cos_pitch * sin_roll,
        -pitch_rate * sin_roll + yaw_rate * cos_pitch * cos_roll,
    )


def body_to_world(euler: Array) -> Array:
    """Rotation matrices (..., 3, 3) from body to world for roll, pitch, yaw (..., 3) [rad]."""
    (cr, cp, cy), (sr, sp, sy) = np.moveaxis(np.cos(euler), -1, 0), np.moveaxis(np.sin(euler), -1, 0)
    rows = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


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


def _entries(vectors: Array) -> tuple[Array, ...]:
    """The entries of vectors (..., m), each of shape (...)."""
    array = np.asarray(vectors, float)
    return tuple([array[..., i] for i in range(array.shape[-1])])


def all_true(flags: NDArray[np.bool_]) -> bool:
    """`flags.all()`, of few flags in a third of the time."""
    return np.count_nonzero(flags) == flags.size


def read_only(array: Array) -> Array:
    """The same array, marked read-only: what is stored is never changed afterwards."""
    array.flags.writeable = False
    return array
