"""Courses of straight legs: waypoints, and turns on the spot."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from quadsim.state import Array
from scenarios.courses.course import Path


@dataclass(frozen=True, kw_only=True)
class Waypoint:
    """A pose to reach in a straight line, and how long to stay there."""

    pose: Array  # (4,) x, y, z [m], yaw [rad]
    speed: float  # of the leg [m/s]
    hold: float = 0.0  # how long to stay there [s]


@dataclass(frozen=True, kw_only=True)
class Turn:
    """A turn at constant rate."""

    start: float  # when it begins [s]
    yaw: float  # where it ends [rad]
    rate: float  # magnitude [rad/s]


def polyline(t: Array, poses: Array) -> Path:
    """Straight lines through poses (n, 4) at increasing times t (n,), the first of them 0."""

    def pose(times: Array) -> Array:
        return np.stack([np.interp(times, t, column) for column in poses.T], axis=1)

    return Path(pose=pose, duration=float(t[-1]), kinks=tuple(t.tolist()))


def waypoints(start: Array, points: Sequence[Waypoint]) -> Path:
    """Straight legs at constant speed from a pose (4,) through the points, yaw turning evenly along each leg.

    A first point at the place of `start` takes no time to reach.
    """
    times, poses = [0.0], [start]
    for point in points:
        length = float(np.linalg.norm(point.pose[:3] - poses[-1][:3]))
        if length > 0.0:
            times.append(times[-1] + length / point.speed)
            poses.append(point.pose)
        else:
            poses[-1] = point.pose
        if point.hold > 0.0:
            times.append(times[-1] + point.hold)
            poses.append(point.pose)
    return polyline(np.array(times), np.array(poses))


def yaw_turns(start: Array, turns: Sequence[Turn]) -> Path:
    """Turns on the spot from a pose (4,), in order of their starts; a turn cuts off one that is not over."""
    times, yaws = [0.0], [float(start[3])]
    for turn in turns:
        yaw = float(np.interp(turn.start, times, yaws))
        while times and times[-1] >= turn.start:
            times.pop()
            yaws.pop()
        times.append(turn.start)
        yaws.append(yaw)
        if turn.yaw != yaw:
            times.append(turn.start + abs(turn.yaw - yaw) / turn.rate)
            yaws.append(turn.yaw)
    poses = np.tile(start, (len(times), 1))
    poses[:, 3] = yaws
    return polyline(np.array(times), poses)
