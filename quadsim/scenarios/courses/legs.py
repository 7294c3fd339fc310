"""Courses of straight legs: waypoints, and turns on the spot."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Annotated, Literal

import numpy as np
from annotated_types import Len, doc

from quadsim.errors import ParameterError
from quadsim.fields import NonNegative, Number
from quadsim.scenarios.courses.course import (
    CLOSEST,
    MOST_POINTS,
    Course,
    Filtered,
    Path,
    Point,
    Speed,
    Time,
    Travelled,
    begin,
    poses_of,
    require_apart,
    require_free_yaw,
)
from quadsim.state import Array


@dataclass(frozen=True, kw_only=True)
class Waypoint(Point):
    """A point to fly to in a straight line at constant speed, with a time to stay."""

    hold: Annotated[NonNegative, doc("[s] time to stay there")] = 0.0
    speed: Annotated[Speed | None, doc("[m/s] speed of the leg; absent: speed of the course")] = None


@dataclass(frozen=True, kw_only=True)
class Waypoints(Travelled):
    """Straight legs at constant speed, from the initial position from one point to the next."""

    type: Annotated[Literal["waypoints"], doc("kind of course: straight legs between points")]
    speed: Annotated[Speed, doc("[m/s] speed along a leg, unless its point has one")] = 1.0
    points: Annotated[tuple[Waypoint, ...], Len(1, MOST_POINTS), doc("the points, in order")]
    times: Annotated[
        tuple[Time, ...] | None,
        doc("[s] after start, times at which the points are reached, in place of every speed; absent: by speed"),
    ] = None

    def __post_init__(self) -> None:
        require_apart(self.points, "to stay at a point give it a hold")
        require_free_yaw(self.points, self.yaw)
        if self.times is not None:
            self._check_times(self.times)

    def _check_times(self, times: tuple[float, ...]) -> None:
        """Refuse times that do not fit the points."""
        if len(times) != len(self.points):
            raise ParameterError("", "times", list(times), f"a list of {len(self.points)} times, one for each point")
        left = 0.0
        for i, (time, point) in enumerate(zip(times, self.points, strict=True)):
            if point.speed is not None:
                raise ParameterError("", f"points.{i}.speed", point.speed, "absent where times are given")
            if time - left < CLOSEST:
                rule = f"{left + CLOSEST:g} s or later, {CLOSEST} s after the point before it is left"
                raise ParameterError("", f"times.{i}", time, rule)
            left = time + point.hold

    def path(self, initial: Array, gravity: float) -> Path:
        """The legs, yaw turning evenly along each; by speed, a first point at the initial position takes no time."""
        times = [0.0]
        poses = [initial]
        for i, (point, pose) in enumerate(zip(self.points, poses_of(self.points, initial), strict=True)):
            length = float(np.linalg.norm(pose[:3] - poses[-1][:3]))
            if self.times is not None:
                times.append(self.times[i])
                poses.append(pose)
            elif length > 0.0:
                speed = self.speed
                if point.speed is not None:
                    speed = point.speed
                times.append(times[-1] + length / speed)
                poses.append(pose)
            else:
                poses[-1] = pose
            if point.hold > 0.0:
                times.append(times[-1] + point.hold)
                poses.append(pose)
        return polyline(np.array(times), np.array(poses))


@dataclass(frozen=True, kw_only=True)
class Turn:
    """A turn on the spot at constant rate."""

    start: Annotated[NonNegative, doc("[s] start of the turn, and end of an unfinished earlier one")]
    yaw: Annotated[Number, doc("[deg] final yaw; 360 is a whole turn from 0")]
    rate: Annotated[Speed, doc("[deg/s] yaw rate, in either direction")]


@dataclass(frozen=True, kw_only=True)
class YawTurns(Filtered):
    """Turns on the spot: the position stays the initial one."""

    type: Annotated[Literal["yaw_turns"], doc("kind of course: turns on the spot")]
    turns: Annotated[tuple[Turn, ...], Len(1, MOST_POINTS), doc("the turns, in order")]

    def __post_init__(self) -> None:
        for i, (before, after) in enumerate(pairwise(self.turns), start=1):
            if after.start <= before.start:
                raise ParameterError("", f"turns.{i}.start", after.start, f"above that before it = {before.start}")

    def build(self, initial: Array, gravity: float) -> Course:
        """As `Filtered.build`; a turn cuts off one that is not over."""
        times = [0.0]
        yaws = [float(initial[3])]
        for turn in self.turns:
            target = math.radians(turn.yaw)
            yaw = float(np.interp(turn.start, times, yaws))
            while times and times[-1] >= turn.start:
                times.pop()
                yaws.pop()
            times.append(turn.start)
            yaws.append(yaw)
            if target != yaw:
                times.append(turn.start + abs(target - yaw) / math.radians(turn.rate))
                yaws.append(target)
        poses = np.tile(initial, (len(times), 1))
        poses[:, 3] = yaws
        return begin(polyline(np.array(times), poses), start=0.0, initial=initial)


def polyline(t: Array, poses: Array) -> Path:
    """Straight lines through poses (n, 4) at increasing times t (n,), the first of them 0."""

    def pose(times: Array) -> Array:
        return np.stack([np.interp(times, t, column) for column in poses.T], axis=1)

    return Path(pose=pose, duration=float(t[-1]), kinks=tuple(t.tolist()))
