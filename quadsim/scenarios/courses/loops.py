"""Closed courses: circle, helix, figure eight, with a smooth start and end.

A `Loop` is a curve by an angle theta; `ramped` is theta over time, which gains its rate smoothly and loses it again.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from annotated_types import doc

from quadsim.errors import ParameterError
from quadsim.fields import Metres, NonNegative, Number, Pair
from quadsim.scenarios.courses.course import ALONG_PATH_DOC, AlongPath, Path, Speed, Started, Time, require_one
from quadsim.state import Array


@dataclass(frozen=True, kw_only=True)
class Loop:
    """A closed curve, or one that is closed seen from above, by an angle theta that grows by 2 pi per turn."""

    position: Callable[[Array], Array]  # theta (M,) [rad] -> (M, 3) [m], world


def circle(
    *, centre: Array, radius: float, angle: float = 0.0, clockwise: bool = False, climb_per_turn: float = 0.0
) -> Loop:
    """A circle c + r (cos phi, sin phi, 0), phi = angle +- theta; for a helix z grows in proportion to theta.

    Of the centre (3,) [m], z is where the curve begins; the angle is phi there [rad]; clockwise is seen from above.
    """
    sign = -1.0 if clockwise else 1.0

    def position(theta: Array) -> Array:
        phi = angle + sign * theta
        return centre + np.stack(
            [radius * np.cos(phi), radius * np.sin(phi), climb_per_turn * theta / math.tau], axis=1
        )

    return Loop(position=position)


def figure_eight(
    *, centre: Array, half_length: float, half_width: float, angle: float = 0.0, clockwise: bool = False
) -> Loop:
    """The lemniscate of Gerono, c + (a sin theta, b sin 2 theta, 0), its length turned by an angle from x [rad].

    It begins in the centre (3,) [m], where it crosses itself; clockwise, seen from above, is its first half.
    """
    sign = 1.0 if clockwise else -1.0
    cos = math.cos(angle)
    sin = math.sin(angle)

    def position(theta: Array) -> Array:
        along = half_length * np.sin(theta)
        across = sign * half_width * np.sin(2.0 * theta)
        return centre + np.stack([cos * along - sin * across, sin * along + cos * across, np.zeros_like(theta)], axis=1)

    return Loop(position=position)


def ramped(t: Array, *, rate: float, total: float, ramp: float) -> Array:
    """An angle (M,) [rad] that gains its rate [rad/s] smoothly, keeps it, and loses it in the same way at the end.

    The rate grows as S(s) = 35 s^4 - 84 s^5 + 70 s^6 - 20 s^7, s = t / ramp, so that all derivatives up to the fourth
    are continuous: no step in the torques that the course requires.  Without a ramp it jumps.  Times (M,) are within
    0 .. total / rate + ramp [s], and the angle at the end, `total` [rad], is at least rate ramp.
    """
    duration = total / rate + ramp
    from_nearer_end = np.minimum(t, duration - t)
    if ramp > 0.0:
        s = np.clip(from_nearer_end / ramp, 0.0, 1.0)
    else:
        s = np.zeros_like(t)
    gained = ramp * s**5 * (7.0 + s * (-14.0 + s * (10.0 - 2.5 * s)))  # the integral of S
    angle = rate * (gained + np.maximum(from_nearer_end - ramp, 0.0))
    return np.where(t <= 0.5 * duration, angle, total - angle)


def fly_round(loop: Loop, *, turn_time: float, turns: float, ramp: float, yaw: float) -> Path:
    """A loop flown from and to rest, one turn at full speed in `turn_time` [s], gained and lost over `ramp` [s].

    Yaw [rad] is held.
    """
    rate = math.tau / turn_time
    total = math.tau * turns

    def pose(t: Array) -> Array:
        theta = ramped(t, rate=rate, total=total, ramp=ramp)
        return np.column_stack([loop.position(theta), np.full(t.shape, yaw)])

    return Path(pose=pose, duration=total / rate + ramp)


@dataclass(frozen=True, kw_only=True)
class _Round(Started):
    period: Annotated[Time | None, doc("[s] time of one turn at full speed; either period or speed")] = None
    speed: Annotated[Speed | None, doc("[m/s] along the path at full speed; either period or speed")] = None
    turns: Annotated[Number, doc("[-] number of turns; negative: reversed")] = 1.0
    ramp: Annotated[
        NonNegative, doc("[s] time of the smooth acceleration, and of the deceleration at the end; 0: at once")
    ] = 5.0
    height: Annotated[Number | None, doc("[m] z at the start; absent: initial z")] = None
    yaw: Annotated[Number | AlongPath | None, doc(f"[deg] constant yaw; or {ALONG_PATH_DOC}; absent: initial yaw")] = (
        None
    )
    yaw_along_path: Annotated[bool, doc('true: the same as yaw = "along_path"')] = False

    def __post_init__(self) -> None:
        require_one(period=self.period, speed=self.speed)
        if self.turns == 0.0:
            raise ParameterError("", "turns", self.turns, "other than 0")
        longest = abs(self.turns) * self.turn_time
        if self.ramp > longest:
            rule = f"at most the time of all turns at full speed = {longest:g} s"
            raise ParameterError("", "ramp", self.ramp, rule)
        if self.yaw is not None and self.yaw_along_path:
            raise ParameterError("", "yaw", self.yaw, "absent where yaw_along_path is true")

    @property
    def turn_length(self) -> float:
        """Speed at full speed times the time of one turn [m]."""
        raise NotImplementedError

    @property
    def turn_time(self) -> float:
        """Time of one turn at full speed [s]."""
        return self.period or self.turn_length / (self.speed or math.inf)

    @property
    def until(self) -> float:
        """Time of its end [s]."""
        return self.start + abs(self.turns) * self.turn_time + self.ramp

    def loop(self, initial: Array, height: float) -> Loop:
        """Return the curve, starting at a height [m]; otherwise as `path`."""
        raise NotImplementedError

    def path(self, initial: Array, gravity: float) -> Path:
        """The loop, flown from and to rest."""
        height = float(initial[2])
        if self.height is not None:
            height = self.height
        yaw = float(initial[3])
        if isinstance(self.yaw, float):
            yaw = math.radians(self.yaw)
        loop = self.loop(initial, height)
        return fly_round(loop, turn_time=self.turn_time, turns=abs(self.turns), ramp=self.ramp, yaw=yaw)


@dataclass(frozen=True, kw_only=True)
class _Circular(_Round):
    radius: Annotated[Metres, doc("[m] seen from above")]
    centre: Annotated[
        Pair | None, doc("[m] x, y, world; absent: such that the course starts at the initial position")
    ] = None
    angle: Annotated[Number, doc("[deg] start on the circle, seen from the centre; 0 is +x")] = 0.0

    @property
    def climb_per_turn(self) -> float:
        """[m]."""
        return 0.0

    @property
    def turn_length(self) -> float:
        """Of the path [m]."""
        return math.hypot(2.0 * math.pi * self.radius, self.climb_per_turn)

    def loop(self, initial: Array, height: float) -> Loop:
        """A circle or a helix."""
        angle = math.radians(self.angle)
        from_centre = (self.radius * math.cos(angle), self.radius * math.sin(angle))
        x, y = initial[:2] - from_centre
        if self.centre is not None:
            x, y = self.centre
        return circle(
            centre=np.array([x, y, height]),
            radius=self.radius,
            angle=angle,
            clockwise=self.turns < 0.0,
            climb_per_turn=self.climb_per_turn,
        )


@dataclass(frozen=True, kw_only=True)
class Circle(_Circular):
    """A level circle, counter-clockwise seen from above."""

    type: Annotated[Literal["circle"], doc("kind of course: a level circle")]


@dataclass(frozen=True, kw_only=True)
class Helix(_Circular):
    """A circle that climbs in proportion to the angle flown."""

    type: Annotated[Literal["helix"], doc("kind of course: a circle that climbs")]
    climb: Annotated[Number, doc("[m] height gained per turn; negative: lost")]

    @property
    def climb_per_turn(self) -> float:
        """[m]."""
        return self.climb


@dataclass(frozen=True, kw_only=True)
class FigureEight(_Round):
    """A level lemniscate of Gerono, starting at its crossing."""

    type: Annotated[Literal["figure_eight"], doc("kind of course: a level lemniscate of Gerono")]
    length: Annotated[Metres, doc("[m] from end to end, through the crossing")]
    width: Annotated[Metres | None, doc("[m] across; absent: half the length")] = None
    speed: Annotated[Speed | None, doc("[m/s] at the crossing, where it is largest; either period or speed")] = None
    centre: Annotated[Pair | None, doc("[m] x, y of the crossing, world; absent: the initial position")] = None
    angle: Annotated[Number, doc("[deg] direction of the length; 0 is +x")] = 0.0

    @property
    def half_width(self) -> float:
        """[m]."""
        if self.width is None:
            return 0.25 * self.length
        return 0.5 * self.width

    @property
    def turn_length(self) -> float:
        """Length of a turn at the speed of the crossing, where it is largest [m]."""
        return 2.0 * math.pi * math.hypot(0.5 * self.length, 2.0 * self.half_width)

    def loop(self, initial: Array, height: float) -> Loop:
        """The lemniscate."""
        x, y = initial[:2]
        if self.centre is not None:
            x, y = self.centre
        return figure_eight(
            centre=np.array([x, y, height]),
            half_length=0.5 * self.length,
            half_width=self.half_width,
            angle=math.radians(self.angle),
            clockwise=self.turns < 0.0,
        )
