"""What a course is: a position and a yaw at any time."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np

from quadsim.state import Array

EXACT: Final = (0.0, 0.0, 0.0, 0.0)
Derivatives = Callable[[Array], tuple[Array, Array]]
"""Times (M,) [s] -> velocity (M, 3) [m/s] and acceleration (M, 3) [m/s^2], world."""


@dataclass(frozen=True, kw_only=True)
class Path:
    """Poses from a beginning at time 0 to an end."""

    pose: Callable[[Array], Array]  # times (M,) within [0, duration] [s] -> (M, 4) x, y, z [m], yaw [rad], world
    duration: float  # [s]
    kinks: tuple[float, ...] = ()  # times [s] at which the velocity, or its derivative, may jump
    resolution: tuple[float, ...] = EXACT  # to how much x, y, z [m], yaw [rad] were rounded; 0 where they are exact
    derivatives: Derivatives | None = None  # of the position, where they are known
    free_heading: bool = False  # whether the heading is what leaves no rate about body z; else the initial one


@dataclass(frozen=True, kw_only=True)
class Course:
    """The desired poses, before the filter of Eq. (31)."""

    sample: Callable[[Array], Array]  # times (M,) >= 0 [s] of the flight -> (M, 4) x, y, z [m], yaw [rad], world
    initial: Array  # (4,) what it is before the flight, and where the filter starts
    jumps: tuple[float, ...] = ()  # times [s] at which the pose itself jumps
    kinks: tuple[float, ...] = ()  # times [s] at which the velocity, or its derivative, may jump
    resolution: tuple[float, ...] = EXACT  # to how much x, y, z [m], yaw [rad] were rounded; 0 where they are exact
    derivatives: Derivatives | None = None  # of the position, where they are known
    end: float = math.inf  # time [s] from which on it stays where it is
    free_heading: bool = False  # whether the heading is what leaves no rate about body z; else the initial one


def begin(path: Path, *, start: float, initial: Array) -> Course:
    """The course that is `initial` (4,) until `start` [s], then the path, and stays at the path's end.

    A path that begins elsewhere makes the course jump at its start.
    """

    def sample(t: Array) -> Array:
        since = t - start
        poses = path.pose(np.clip(since, 0.0, path.duration))
        # The start is on the path, whatever the rounding of a control period's multiples.
        return np.where((since < -1e-9)[:, None], initial, poses)

    def derivatives(t: Array) -> tuple[Array, Array]:
        assert path.derivatives is not None
        since = t - start
        on_way = ((since > -1e-9) & (since < path.duration + 1e-9))[:, None]
        velocity, acceleration = path.derivatives(np.clip(since, 0.0, path.duration))
        return np.where(on_way, velocity, 0.0), np.where(on_way, acceleration, 0.0)

    elsewhere = not np.allclose(path.pose(np.zeros(1))[0], initial, rtol=0.0, atol=1e-9)
    ends = {0.0, path.duration}  # a path need not begin or end at rest
    return Course(
        sample=sample,
        initial=initial,
        jumps=(start,) if elsewhere else (),
        kinks=tuple(start + time for time in sorted(ends | set(path.kinks))),
        resolution=path.resolution,
        derivatives=None if path.derivatives is None else derivatives,
        end=start + path.duration,
        free_heading=path.free_heading,
    )
