"""What is determined once per control period: the phase of the flight, and whether its vehicle is lost."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np

from quadsim.controller import Phase
from quadsim.errors import LostError
from quadsim.flight.ground import AIRBORNE, TOUCH, Outline, clearance
from quadsim.space import Obstacle, Solids
from quadsim.state import INDEX, POSITION, REFERENCE_NAMES, Array, tilt

TAKEOFF_RISE: Final = 0.05  # how far above the resting height a reference has to rise to require flight [m]
REST: Final = 0.2  # how long the feet have to touch the ground without a break for the vehicle to have landed [s]
CAPSIZED: Final = 60.0  # tilt [deg] beyond which a vehicle that touches the ground has crashed

CRITERIA: Final = {
    "tilt": ("the thrust axis is tilted by", "deg"),
    "distance": ("the distance from the reference is", "m"),
    "depth": ("the depth below the lowest of start and reference is", "m"),
    "speed": ("the speed is", "m/s"),
}
"""Each criterion by its name in `[lost]`, with its unit; the first that is met is the reason."""


class PhaseMonitor:
    """Determines, once per control period, whether the vehicle stands, is about to take off, flies or has crashed.

    - The first state decides: `landed` up to a clearance of `AIRBORNE`, else `flying`.
    - On the ground it is `armed` while the previewed reference rises more than `TAKEOFF_RISE` above the resting height,
      else `landed`; from `armed` it is `flying` as soon as the clearance exceeds `AIRBORNE`.
    - From `flying` it is `landed` once the feet have touched for `REST` and the whole preview stays on the ground.
    - From any phase, it has `crashed`, permanently, when anything but the feet touches the ground, or the feet do with
      the vehicle tilted beyond `CAPSIZED`, or when the vehicle's bounding ball touches an obstacle.

    Args:
        outline: what may touch the ground, and where that is; None where there is no ground.
        period: the control period [s].
        obstacles: what must not be touched.
        radius: of the vehicle's bounding ball [m].
    """

    def __init__(
        self, outline: Outline | None, *, period: float, obstacles: Sequence[Obstacle] = (), radius: float = 0.0
    ) -> None:
        self._outline, self._obstacles, self._radius = outline, Solids(obstacles), radius
        if outline is not None:
            self._takeoff_height = outline.floor + outline.foot_radius - float(outline.feet[:, 2].min()) + TAKEOFF_RISE
            self._reach = float(np.linalg.norm(outline.hull, axis=1).max()) + TOUCH  # higher up nothing can touch
            self._periods_of_rest = math.ceil(REST / period - 1e-9)
        self.reset()

    def reset(self) -> None:
        """Forget the flight: the next state is the first."""
        self._phase: Phase | None = None
        self._touched = 0

    def advance(self, t: Array, states: Array, preview: Array) -> Phase:
        """The phase of the control period that starts now.

        Of true states (M, 12) at times (M,) [s] since the last period began, the last of them now, and of the reference
        (N, 4) that the controller is about to see.
        """
        if (self._obstacles.clearances(t, states[:, POSITION])[0] <= self._radius).any():
            self._phase = Phase.CRASHED
        if self._outline is None:
            return self._phase or Phase.FLYING
        gap = float(clearance(states[-1:], self._outline.feet, self._outline.foot_radius, self._outline.floor)[0])
        self._touched = self._touched + 1 if gap <= TOUCH else 0
        wanted = bool(preview[:, REFERENCE_NAMES.index("z")].max() > self._takeoff_height)
        if self._phase is None:
            self._phase = Phase.FLYING if gap > AIRBORNE else Phase.LANDED
        if self._crashed(self._outline, states):
            self._phase = Phase.CRASHED
        elif self._phase is Phase.FLYING:
            if self._touched >= self._periods_of_rest and not wanted:
                self._phase = Phase.LANDED
        elif self._phase is Phase.ARMED and gap > AIRBORNE:
            self._phase = Phase.FLYING
        elif self._phase is not Phase.CRASHED:
            self._phase = Phase.ARMED if wanted else Phase.LANDED
        return self._phase

    def _crashed(self, outline: Outline, states: Array) -> bool:
        if self._touched and np.degrees(tilt(states[-1:])[0]) > CAPSIZED:
            return True
        if states[:, INDEX["z"]].min() - outline.floor > self._reach:
            return False
        return float(clearance(states, outline.hull, 0.0, outline.floor).min()) <= TOUCH


def check_loss(limits: Mapping[str, float], time: float, state: Array, reference: Array, lowest: float) -> None:
    """End the flight where its vehicle is lost.

    Args:
        limits: the largest value of each of `CRITERIA`; one that is left out is not checked.
        time: of the sample [s].
        state: (12,) the true one.
        reference: (4,) x, y, z [m], yaw [rad] at the same time.
        lowest: height of the lowest of the start and the reference so far [m].

    Raises:
        LostError: a criterion is met.
    """
    x, vx, y, vy, z, vz, roll, _, pitch, *_ = state.tolist()  # of so few numbers floats are quicker than arrays
    tilt = math.degrees(math.acos(math.cos(roll) * math.cos(pitch)))
    distance = math.dist((x, y, z), reference[:3].tolist())
    values = (tilt, distance, lowest - z, math.hypot(vx, vy, vz))
    for (name, (quantity, unit)), value in zip(CRITERIA.items(), values, strict=True):
        limit = limits.get(name, math.inf)
        if value > limit:
            raise LostError(name, quantity, unit, value=value, limit=limit, time=time)
