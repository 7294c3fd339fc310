"""Ground contact and loss: the parts that may touch the ground, the phase of the flight, take-off, loss criteria.

`quadsim.sim.loop` asks `PhaseMonitor` for the phase of each control period, and `check_loss` ends a flight;
`quadsim.flight.metrics` summarises take-off and touchdown.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from quadsim.controller import GROUNDED, Phase
from quadsim.errors import LostError
from quadsim.rotation import body_to_world
from quadsim.space import Obstacle, Solids
from quadsim.state import EULER, INDEX, POSITION, REFERENCE_NAMES, VELOCITY, Array, tilt

AIRBORNE: Final = 0.05  # clearance of the feet [m] above which a vehicle flies; no landing gear springs back that far
TOUCH: Final = 2e-3  # clearance [m] below which a part touches: contacts are soft, and points represent rounded parts


@dataclass(frozen=True, kw_only=True)
class Outline:
    """The parts of an airframe that can touch the ground, body frame; at rest on its feet its origin is at z = 0."""

    feet: Array  # (4, 3) centres of the feet [m]
    foot_radius: float  # [m]
    hull: Array  # (P, 3) points that must not touch: the rims of the rotor discs and the underside [m]
    floor: float  # height of the floor [m]
    disc: float  # height of the rotor discs above the origin [m]


def clearance(states: Array, points: Array, radius: float, floor: float) -> Array:
    """Clearance of the lowest of several points above the floor, negative inside it.

    min over p of (position + R p)_z - radius - floor [m], (M,), for states (M, 12), points (P, 3) in the body frame
    [m], the radius of a sphere around each point, and the floor's height [m].
    """
    down = body_to_world(states[:, EULER])[:, 2, :] @ points.T
    lowest: Array = states[:, INDEX["z"]] + down.min(axis=1) - radius - floor
    return lowest


def touching_speed(state: Array, body_rates: Array, outline: Outline) -> float:
    """Return the smallest vertical speed of the parts that touch the floor [m/s], negative into it; 0 if none does.

    The state is (1, 12), body rates are (3,) [rad/s].
    """
    R = body_to_world(state[:, EULER])[0]
    smallest = 0.0
    for points, radius in ((outline.feet, outline.foot_radius), (outline.hull, 0.0)):
        heights = state[0, INDEX["z"]] + points @ R[2] - radius - outline.floor
        speeds = state[0, INDEX["vz"]] + np.cross(body_rates, points) @ R[2]
        smallest = min(smallest, float(speeds[heights <= TOUCH].min(initial=0.0)))
    return smallest


def touchdown(t: Array, states: Array, clearances: Array) -> dict[str, float] | None:
    """Return the first touch after take-off; None if there is none.

    Args:
        t: (M,) [s].
        states: (M, 12), at the physics rate; at the log rate, the speed is up to one log period old.
        clearances: (M,) of the parts that may touch first [m].

    Returns:
        From the last state before the touch: `time` [s], `speed` downwards and `horizontal_speed` [m/s], and `tilt`
            [deg].
    """
    airborne = np.flatnonzero(clearances > AIRBORNE)
    if not airborne.size:
        return None
    touching = np.flatnonzero(clearances[airborne[0] :] <= TOUCH)
    if not touching.size:
        return None
    last = airborne[0] + touching[0] - 1
    vx, vy, vz = states[last, VELOCITY].tolist()
    tilts = np.degrees(tilt(states[last : last + 1]))
    return {"time": float(t[last]), "speed": -vz, "horizontal_speed": math.hypot(vx, vy), "tilt": float(tilts[0])}


def takeoff_time(t: Array, clearances: Array) -> float | None:
    """Return when a vehicle that starts on the ground takes off [s]; None if it starts in the air or stays down."""
    airborne = np.flatnonzero(clearances > AIRBORNE)
    if airborne.size and airborne[0] > 0:
        return float(t[airborne[0]])
    return None


TAKEOFF_RISE: Final = 0.05  # rise of the reference above the resting height that calls for a take-off [m]
REST: Final = 0.2  # uninterrupted contact of the feet after which the vehicle has landed [s]
CAPSIZED: Final = 60.0  # tilt [deg] above which a vehicle that touches the ground has crashed

LEVEL: Final = 10.0  # tilt [deg] up to which a vehicle on the ground may be pushed to take off
STANDSTILL: Final = 0.5  # time [s] without more thrust or a rise after which a vehicle does not take off by itself
MORE_THRUST: Final = 1.01  # ratio of thrusts that counts as more
RISING: Final = 0.05  # vertical speed [m/s] above which a vehicle on the ground is taking off
LEAD_RATE: Final = 1.0  # [m/s] growth of the lead
LARGEST_LEAD: Final = 10.0  # [m]
FADING: Final = 0.5  # largest climb after lift-off over which the lead fades [m]
FADING_TIME: Final = 1.0  # shortest time constant of the fading [s]: that of the observer's force by default
NO_LEAD: Final = 1e-3  # [m]; a smaller lead in the air counts as none

CRITERIA: Final = {
    "tilt": ("the thrust axis is tilted by", "deg"),
    "distance": ("the distance from the reference is", "m"),
    "depth": ("the depth below the lowest of start and reference is", "m"),
    "speed": ("the speed is", "m/s"),
}
"""Criteria that end a flight, by their name in `[lost]`, with units; the first one met is the reason."""


class TakeoffLead:
    """The height to add to a controller's reference so that a vehicle takes off which is heavier than its model.

    On the ground, most controllers cannot learn a mismatch: the ground carries what thrust does not, so observers and
    integrals hold until lift-off, and a controller without them never learns.  Every controller demands more thrust for
    a higher reference, so the lead is an integral on thrust for all of them, within the controller's own bounds.

    - It stays zero until an armed, level vehicle with its course in the air has stood for `STANDSTILL` without more
      thrust.  A controller that takes off by itself never sees it.
    - It then grows at `LEAD_RATE` up to `LARGEST_LEAD`, while the vehicle does not rise and thrust follows: rotors that
      saturate stop it.
    - From lift-off at height z_0 on it fades with the climb, and never grows again:

          lead = lead_0 (1 - (z - z_0) / min(FADING, z_ref - z_0)).

      It is thus released as the controller's own estimate or integral takes over, and gone at the course.  With
      neither, the controller keeps its steady altitude error, but hovers just above the ground where it would have
      stayed on it.
    """

    def __init__(self, period: float) -> None:
        self._period = period
        self._slowest_decay = math.exp(-period / FADING_TIME)
        self.reset()

    def reset(self) -> None:
        """No lead; the next take-off is the first."""
        self.lead = 0.0
        self._at_liftoff = 0.0  # the lead there
        self._height = 0.0  # on the ground [m]
        self._largest_thrust = 0.0
        self._idle = 0.0  # time without more thrust or a rise [s]
        self._pushing = False  # whether the lead may grow

    def push(self, height: float, climb: float, thrust: float) -> float:
        """Return the lead of a period on the ground [m], from height [m], vertical speed [m/s] and thrust, any unit."""
        if thrust > MORE_THRUST * self._largest_thrust or climb > RISING:
            self._largest_thrust = max(thrust, self._largest_thrust)
            self._idle = 0.0
        else:
            self._idle += self._period
        standing = self._idle > STANDSTILL - 1e-9
        if not self._pushing:
            if standing:
                self._pushing = True
                self._idle = 0.0
        elif not standing and climb <= RISING:
            self.lead = min(self.lead + LEAD_RATE * self._period, LARGEST_LEAD)
        self._height = height
        self._at_liftoff = self.lead
        return self.lead

    def fade(self, height: float, course: float) -> float:
        """Return the lead of a period in the air [m], from the heights of the vehicle and its course [m]."""
        if self.lead > 0.0:
            span = min(FADING, course - self._height)
            if span > 0.0:
                climbed = (height - self._height) / span
            else:
                climbed = 1.0
            faded = max(1.0 - climbed, 0.0) * self._at_liftoff
            self.lead = min(self.lead, max(faded, self._slowest_decay * self.lead))
            if self.lead < NO_LEAD:
                self.lead = 0.0
        self._largest_thrust = 0.0
        self._idle = 0.0
        self._pushing = False
        return self.lead


class PhaseMonitor:
    """Determines the phase of flight once per control period.

    - The first state decides: `landed` up to a clearance of `AIRBORNE`, else `flying`.
    - On the ground it is `armed` while the previewed reference rises more than `TAKEOFF_RISE` above the resting height,
      else `landed`; from `armed` it is `flying` as soon as the clearance exceeds `AIRBORNE`.
    - From `flying` it is `landed` once the feet have touched for `REST` and the whole preview stays on the ground.
    - From any phase it becomes `crashed`, permanently, when anything but the feet touches the ground, when the feet
      touch with a tilt beyond `CAPSIZED`, or when the vehicle's bounding ball touches an obstacle.

    Args:
        outline: the parts that may touch the ground; None without ground.
        period: the control period [s].
        obstacles: objects that must not be touched.
        radius: radius of the vehicle's bounding ball [m].
    """

    def __init__(
        self, outline: Outline | None, *, period: float, obstacles: Sequence[Obstacle] = (), radius: float = 0.0
    ) -> None:
        self._outline = outline
        self._obstacles = Solids(obstacles)
        self._radius = radius
        if outline is not None:
            self._takeoff_height = outline.floor + outline.foot_radius - float(outline.feet[:, 2].min()) + TAKEOFF_RISE
            self._reach = float(np.linalg.norm(outline.hull, axis=1).max()) + TOUCH  # nothing can touch above it
            self._periods_of_rest = math.ceil(REST / period - 1e-9)
        self._takeoff = TakeoffLead(period)
        self.reset()

    def reset(self) -> None:
        """Restart: the next state is the first."""
        self._phase: Phase | None = None
        self._touched = 0
        self._takeoff.reset()

    def advance(self, t: Array, states: Array, preview: Array) -> Phase:
        """Return the phase of the control period that starts now.

        Args:
            t: (M,) times since the last period began [s], the last one now.
            states: (M, 12) true states at these times.
            preview: (N, 4) the reference that the controller is about to receive.
        """
        if (self._obstacles.clearances(t, states[:, POSITION])[0] <= self._radius).any():
            self._phase = Phase.CRASHED
        if self._outline is None:
            return self._phase or Phase.FLYING
        gap = float(clearance(states[-1:], self._outline.feet, self._outline.foot_radius, self._outline.floor)[0])
        if gap <= TOUCH:
            self._touched += 1
        else:
            self._touched = 0
        flight_required = bool(preview[:, REFERENCE_NAMES.index("z")].max() > self._takeoff_height)
        if self._crashed(self._outline, states):
            self._phase = Phase.CRASHED
        else:
            self._phase = self._next_phase(gap, flight_required)
        if self._phase in GROUNDED:
            self._takeoff.reset()
        return self._phase

    def lead(self, state: Array, course: float, thrust: float) -> float:
        """Return the height to add to the controller's reference in the period of the last `advance` [m].

        Args:
            state: (12,) the true state now.
            course: height of the reference now [m].
            thrust: of the rotors as they turn now, in any unit.
        """
        if self._outline is None:
            return 0.0
        height = float(state[INDEX["z"]])
        climb = float(state[INDEX["vz"]])
        if self._phase is Phase.FLYING and self._touched < self._periods_of_rest:
            return self._takeoff.fade(height, course)
        if course > self._takeoff_height and np.degrees(tilt(state[None])[0]) <= LEVEL:
            return self._takeoff.push(height, climb, thrust)
        self._takeoff.reset()
        return 0.0

    def _next_phase(self, gap: float, flight_required: bool) -> Phase:
        """Return the phase after the present one, where nothing crashes.

        Args:
            gap: clearance of the feet [m].
            flight_required: whether the preview leaves the ground.
        """
        phase = self._phase
        if phase is None:  # the first state
            phase = Phase.LANDED
            if gap > AIRBORNE:
                phase = Phase.FLYING
        if phase is Phase.CRASHED:
            return phase
        if phase is Phase.FLYING:
            if self._touched >= self._periods_of_rest and not flight_required:
                return Phase.LANDED
            return phase
        if phase is Phase.ARMED and gap > AIRBORNE:
            return Phase.FLYING
        if flight_required:
            return Phase.ARMED
        return Phase.LANDED

    def _crashed(self, outline: Outline, states: Array) -> bool:
        if self._touched and np.degrees(tilt(states[-1:])[0]) > CAPSIZED:
            return True
        if states[:, INDEX["z"]].min() - outline.floor > self._reach:
            return False
        return float(clearance(states, outline.hull, 0.0, outline.floor).min()) <= TOUCH


def check_loss(limits: Mapping[str, float], time: float, state: Array, reference: Array, lowest: float) -> None:
    """End the flight if its vehicle is lost.

    Args:
        limits: the largest value of each of `CRITERIA`; a missing one is not checked.
        time: sample time [s].
        state: (12,) the true state.
        reference: (4,) x, y, z [m], yaw [rad] at the same time.
        lowest: the lowest height of the start and the reference so far [m].

    Raises:
        LostError: a criterion is met.
    """
    x, vx, y, vy, z, vz, roll, _, pitch, *_ = state.tolist()  # floats are faster than arrays of so few numbers
    tilt = math.degrees(math.acos(math.cos(roll) * math.cos(pitch)))
    distance = math.dist((x, y, z), reference[:3].tolist())
    depth = lowest - z
    speed = math.hypot(vx, vy, vz)
    values = (tilt, distance, depth, speed)
    for (name, (quantity, unit)), value in zip(CRITERIA.items(), values, strict=True):
        limit = limits.get(name, math.inf)
        if value > limit:
            raise LostError(name, quantity, unit, value=value, limit=limit, time=time)
