"""The 12-state of the paper: order, names and units; and the turns of its yaw.

The state vector is xi = [x vx y vy z vz roll roll_rate pitch pitch_rate yaw yaw_rate] (Sec. 2.3), positions and
velocities in the world frame (z up), attitude as Z-Y-X Euler angles (body_to_world = Rz(yaw) Ry(pitch) Rx(roll)),
and **Euler-angle rates**, not body rates; `quadsim.rotation` converts between them.

A yaw is not limited to one turn: after a whole turn it is 2 pi.  A difference of yaws is `wrapped` to (-pi, pi].
"""

from __future__ import annotations

import difflib
import math
from typing import Any, Final, TypeVar

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

# The unit that is shown for an SI unit, and the factor to it; other units are shown as they are.
_SHOWN: Final = {"rad": ("deg", math.degrees(1.0)), "rad/s": ("deg/s", math.degrees(1.0))}

REFERENCE_NAMES: Final = ("x", "y", "z", "yaw")
REFERENCE_UNITS: Final = ("m", "m", "m", "rad")
REFERENCE_STATES: Final = tuple(INDEX[name] for name in REFERENCE_NAMES)
REFERENCE_RATES: Final = (*VELOCITY, INDEX["yaw_rate"])
"""The states that are the rates of change of `REFERENCE_STATES`."""


def shown_unit(unit: str) -> tuple[str, float]:
    """Return the display unit of an SI quantity, and the factor to it: angles are shown in degrees."""
    return _SHOWN.get(unit, (unit, 1.0))


def tilt(states: Array) -> Array:
    """Return the angle (M,) between thrust axis and vertical [rad] of states (M, 12)."""
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
        guess = ""
        near = difflib.get_close_matches(name, STATE_NAMES, n=1)
        if near:
            guess = f"; did you mean {near[0]!r}?"
        raise AttributeError(f"a state has no {name!r}{guess} (there are: {', '.join(STATE_NAMES)})")

    def __dir__(self) -> list[str]:
        return [*STATE_NAMES, *super().__dir__()]

    def __getitem__(self, key: Any) -> Any:
        part = super().__getitem__(key)
        if isinstance(part, State):
            return part.view(np.ndarray)
        return part

    def __array_wrap__(self, array: Any, context: Any = None, return_scalar: bool = False) -> Any:
        """Return a result of NumPy as a plain array, or as a scalar where it makes one."""
        if return_scalar:
            return array[()]
        return array.view(np.ndarray)


_Angle = TypeVar("_Angle", float, Array)
TURN: Final = 2.0 * math.pi
_TIE: Final = 1e-6  # [turns] an angle this close to -1/2 turn counts as +1/2 turn, so that rounding does not decide
KEPT: Final = math.radians(190.0)
"""Distance from the vehicle's yaw up to which a reference keeps its turn [rad]; see `ReferenceTurns`."""


def wrapped(angle: _Angle) -> _Angle:
    """Wrap a difference of angles to (-pi, pi] [rad]."""
    # The second remainder is for a tiny negative number, whose first remainder rounds to TURN itself.
    return math.pi - (math.pi - angle) % TURN % TURN


def whole_turns(angle: _Angle, turn: float = TURN) -> _Angle:
    """Return the whole turns n for which angle - n turn is in (-turn / 2, turn / 2], up to rounding."""
    turns = angle / turn
    return -((0.5 + _TIE - turns) // 1.0)  # the ceiling of turns - 1/2


def nearest_turn(angle: _Angle, to: float = 0.0, turn: float = TURN) -> _Angle:
    """Change an angle by whole turns to the one nearest `to`."""
    return angle - turn * whole_turns(angle - to, turn)


def unwrapped(angles: Array, before: float) -> Array:
    """Change each of the angles (K,) by whole turns to be nearest the one before it; the first to `before`.

    Where nothing changes, the same array is returned.
    """
    steps = np.empty_like(angles)
    steps[:1] = angles[:1] - before  # an empty slice of no angles
    np.subtract(angles[1:], angles[:-1], out=steps[1:])
    turns = whole_turns(steps)
    if np.count_nonzero(turns) == 0:
        return angles
    return angles - TURN * turns.cumsum()


class ReferenceTurns:
    """Changes the yaw of a reference by whole turns, so that a vehicle does not turn the long way round.

    - The first reference of a flight starts at most half a turn from the vehicle's yaw.
    - Each later sample is at most half a turn from the one before, within a preview and from period to period.
    - Where the vehicle is more than `KEPT` from the reference, it starts at most half a turn from the vehicle again.

    `KEPT` is more than half a turn.  At half a turn, both ways round are equally long, and the noise of the measured
    yaw would otherwise choose one anew in every period.
    """

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Restart: the next reference is a flight's first."""
        self._last_start = math.nan  # the first yaw of the reference a period ago; NaN before a flight

    def follow(self, reference: Array, yaw: float) -> Array:
        """Return a period's reference (N, 4) on the turn of the vehicle's yaw [rad]; the same array if it is already.

        Call it once per control period.
        """
        yaws = reference[:, 3]
        start = yaws.item(0)
        is_first = math.isnan(self._last_start)
        if not is_first:
            start = nearest_turn(start, self._last_start)
        if not math.isfinite(start + yaw):
            return reference
        if is_first or abs(yaw - start) > KEPT:
            start += TURN * whole_turns(yaw - start)
        self._last_start = start
        followed = unwrapped(yaws, start)
        if followed is yaws:
            return reference
        moved = reference.copy()
        moved[:, 3] = followed
        return moved


def follow_turns(references: Array, yaws: Array, firsts: Array) -> Array:
    """Return the references (M, N, 4) of M vehicles on the turns of their yaws (M,), as `ReferenceTurns` does for one.

    Args:
        references: rows a period apart; they are not changed.
        yaws: of the vehicles [rad].
        firsts: (M,) each flight's first row's yaw in the period before [rad], NaN before the first; updated in place.
    """
    headings = references[:, :, 3]
    first = headings[:, 0]
    # Headings so near the vehicle differ by less than half a turn among themselves.
    near = np.abs(headings - yaws[:, None]) < 0.2 * TURN
    if near.all() and (np.abs(first - firsts) < 0.4 * TURN).all():
        firsts[:] = first
        return references
    known = ~np.isnan(firsts)
    last_start = np.where(known, firsts, first)
    start = first - TURN * np.where(known, whole_turns(first - last_start), 0.0)
    restarts = ~known | (np.abs(yaws - start) > KEPT)
    start = start + TURN * np.where(restarts, whole_turns(yaws - start), 0.0)
    finite = np.isfinite(start + yaws)
    start = np.where(finite, start, first)
    firsts[finite] = start[finite]
    steps = np.diff(headings, axis=1, prepend=start[:, None])
    turns = whole_turns(steps)
    turns[~finite] = 0.0
    if not turns.any():
        return references
    moved = references.copy()
    moved[:, :, 3] -= TURN * turns.cumsum(axis=1)
    return moved


class YawUnwrapper:
    """Counts a yaw's whole turns, sample by sample.

    Where the nose passes the vertical, the yaw of Euler angles jumps by 180 deg, one way or the other.  An upside-down
    vehicle's yaw is unwrapped to the last yaw, an upright one's to the last upright yaw: a loop leaves it unchanged.
    """

    def __init__(self, yaw: float) -> None:
        self._last = yaw
        self._last_upright = yaw

    def unwrapped(self, euler: Array) -> float:
        """Return the unwrapped yaw [rad] of roll, pitch, yaw (3,); a yaw that is not finite is returned unchanged."""
        roll, pitch, yaw = euler.tolist()
        if math.isfinite(roll + pitch + yaw):
            upright = math.cos(roll) * math.cos(pitch) >= 0.0
            if upright:
                yaw = nearest_turn(yaw, self._last_upright)
                self._last_upright = yaw
            else:
                yaw = nearest_turn(yaw, self._last)
            self._last = yaw
        return float(yaw)


def make_state(
    *,
    position: tuple[float, float, float] = (0.0, 0.0, 0.0),
    euler: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> Array:
    """Return the state (12,) at rest at a position [m, world], with roll, pitch, yaw `euler` [rad]."""
    state = np.zeros(N_STATES)
    state[list(POSITION)] = position
    state[list(EULER)] = euler
    return state


def by_group(position: float, velocity: float, angle: float, rate: float) -> Array:
    """Return (12,) with one value each for positions, velocities, Euler angles and their rates."""
    channels = np.empty(N_STATES)
    channels[POSITIONS] = position
    channels[VELOCITIES] = velocity
    channels[ANGLES] = angle
    channels[ANGLE_RATES] = rate
    return read_only(channels)


def all_true(flags: NDArray[np.bool_]) -> bool:
    """Return `flags.all()`; for few flags in a third of the time."""
    return np.count_nonzero(flags) == flags.size


def read_only(array: Array) -> Array:
    """Return the same array, marked read-only: stored data never changes."""
    array.flags.writeable = False
    return array
