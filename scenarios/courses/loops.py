"""Courses that go round: circle, helix, figure eight, with a smooth entry and exit."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from quadsim.state import Array
from scenarios.courses.course import Path


@dataclass(frozen=True, kw_only=True)
class Loop:
    """A closed curve, or one that is closed seen from above, by an angle theta that grows by 2 pi per turn."""

    position: Callable[[Array], Array]  # theta (M,) [rad] -> (M, 3) [m], world
    heading: Callable[[Array], Array]  # theta (M,) [rad] -> (M,) direction of travel about z [rad], without jumps


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

    return Loop(position=position, heading=lambda theta: angle + sign * (theta + 0.5 * math.pi))


def figure_eight(
    *, centre: Array, half_length: float, half_width: float, angle: float = 0.0, clockwise: bool = False
) -> Loop:
    """The lemniscate of Gerono, c + (a sin theta, b sin 2 theta, 0), its length turned by an angle from x [rad].

    It begins in the centre (3,) [m], where it crosses itself; clockwise, seen from above, is its first half.
    """
    sign = 1.0 if clockwise else -1.0
    cos, sin = math.cos(angle), math.sin(angle)

    def position(theta: Array) -> Array:
        along, across = half_length * np.sin(theta), sign * half_width * np.sin(2.0 * theta)
        return centre + np.stack([cos * along - sin * across, sin * along + cos * across, np.zeros_like(theta)], axis=1)

    def heading(theta: Array) -> Array:
        # The velocity never points along +y (b > 0): counted from -y, its angle has no jump.
        vx, vy = half_length * np.cos(theta), 2.0 * half_width * np.cos(2.0 * theta)
        return angle + sign * (np.arctan2(vx, -vy) - 0.5 * math.pi)

    return Loop(position=position, heading=heading)


def ramped(t: Array, *, rate: float, total: float, ramp: float) -> Array:
    """An angle (M,) [rad] that gains its rate [rad/s] smoothly, keeps it, and loses it in the same way at the end.

    The rate grows as S(s) = 35 s^4 - 84 s^5 + 70 s^6 - 20 s^7, s = t / ramp, so that all derivatives up to the fourth
    are continuous: no step in the torques that the course requires.  Without a ramp it jumps.  Times (M,) are within
    0 .. total / rate + ramp [s], and the angle at the end, `total` [rad], is at least rate ramp.
    """
    duration = total / rate + ramp
    from_nearer_end = np.minimum(t, duration - t)
    s = np.clip(from_nearer_end / ramp, 0.0, 1.0) if ramp > 0.0 else np.zeros_like(t)
    gained = ramp * s**5 * (7.0 + s * (-14.0 + s * (10.0 - 2.5 * s)))  # the integral of S
    angle = rate * (gained + np.maximum(from_nearer_end - ramp, 0.0))
    return np.where(t <= 0.5 * duration, angle, total - angle)


def fly_round(loop: Loop, *, turn_time: float, turns: float, ramp: float, yaw: float, along: bool) -> Path:
    """A loop flown from and to rest, one turn at full speed in `turn_time` [s], gained and lost over `ramp` [s].

    Yaw [rad] is held, or where it goes `along` the direction of travel, it starts near that.
    """
    rate, total = math.tau / turn_time, math.tau * turns
    whole_turns = math.tau * round((yaw - loop.heading(np.zeros(1))[0]) / math.tau)

    def pose(t: Array) -> Array:
        theta = ramped(t, rate=rate, total=total, ramp=ramp)
        headings = loop.heading(theta) + whole_turns if along else np.full(t.shape, yaw)
        return np.column_stack([loop.position(theta), headings])

    return Path(pose=pose, duration=total / rate + ramp)
