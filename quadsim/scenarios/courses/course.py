"""Courses: a position and a yaw at any time; common fields of the tables `[reference]`.

A table builds a `Path`, poses from time 0 to an end. `begin` makes a `Course` of it, poses at any time of the flight,
which `quadsim.scenarios.courses.followed` samples and filters.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Annotated, Final, Literal

import numpy as np
from annotated_types import Ge, Le, doc

from quadsim.errors import ParameterError
from quadsim.fields import NonNegative, Number, Vector
from quadsim.state import TURN, Array, nearest_turn, whole_turns

EXACT: Final = (0.0, 0.0, 0.0, 0.0)
MOST_POINTS: Final = 200  # points or turns of one course; a longer one is a table, `type = "csv"`
CLOSEST: Final = 1e-3
"""Smallest distance [m] between points joined at a speed, and smallest time [s] between points."""

ALONG_PATH: Final = "along_path"
AlongPath = Literal["along_path"]
ALONG_PATH_DOC: Final = '"along_path": yaw follows the direction of travel, see docs/conventions.md'

Speed = Annotated[float, Ge(1e-3), Le(1e4)]  # of travel [m/s], or of turning [deg/s]
Time = Annotated[float, Ge(CLOSEST), Le(1e6)]
Derivatives = Callable[[Array], tuple[Array, Array]]
"""Times (M,) [s] -> velocity (M, 3) [m/s] and acceleration (M, 3) [m/s^2], world."""


@dataclass(frozen=True, kw_only=True)
class Path:
    """Poses from time 0 to an end."""

    pose: Callable[[Array], Array]  # times (M,) within [0, duration] [s] -> (M, 4) x, y, z [m], yaw [rad], world
    duration: float  # [s]
    kinks: tuple[float, ...] = ()  # times [s] at which the velocity, or its derivative, may jump
    resolution: tuple[float, ...] = EXACT  # to how much x, y, z [m], yaw [rad] were rounded; 0 where they are exact
    derivatives: Derivatives | None = None  # of the position, where they are known
    free_heading: bool = False  # whether the heading is what leaves no rate about body z; else the initial one
    notes: tuple[str, ...] = ()  # doubts about its numbers, for the user


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
    stated_heading: bool = False  # whether the reference motion has the heading of the samples, too
    free_heading: bool = False  # whether the heading is what leaves no rate about body z; else the initial one
    notes: tuple[str, ...] = ()  # doubts about its numbers, for the user


def begin(path: Path, *, start: float, initial: Array) -> Course:
    """Return the course that is `initial` (4,) until `start` [s], then follows the path and stays at its end.

    A path that begins elsewhere makes the course jump at its start, but by less than a turn.
    """
    path = _without_surplus_turns(path, float(initial[3]))

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

    jumps: tuple[float, ...] = ()
    if not np.allclose(path.pose(np.zeros(1))[0], initial, rtol=0.0, atol=1e-9):
        jumps = (start,)
    ends = {0.0, path.duration}  # a path need not begin or end at rest
    kinks = tuple(start + time for time in sorted(ends | set(path.kinks)))
    known_derivatives = None
    if path.derivatives is not None:
        known_derivatives = derivatives
    return Course(
        sample=sample,
        initial=initial,
        jumps=jumps,
        kinks=kinks,
        resolution=path.resolution,
        derivatives=known_derivatives,
        end=start + path.duration,
        free_heading=path.free_heading,
        notes=path.notes,
    )


def _without_surplus_turns(path: Path, initial_yaw: float) -> Path:
    """Return a path whose yaw begins on the turn nearest the initial one [rad]."""
    first_yaw = path.pose(np.zeros(1)).item(3)
    surplus = np.array([0.0, 0.0, 0.0, TURN * whole_turns(first_yaw - initial_yaw)])
    if not surplus.any():
        return path
    return replace(path, pose=lambda t: path.pose(t) - surplus)


def repeated(course: Course, period: float, *, until: float) -> Course:
    """Return a course that starts again every `period` [s], backwards every other time if it ends elsewhere.

    It states positions only.  Jumps and kinks are those before `until` [s].
    """
    first, last = course.sample(np.array([0.0, period]))
    distance = math.dist(first[:3], last[:3])
    turned = abs(math.remainder(last[3] - first[3], TURN))
    closed = distance < CLOSEST and turned < CLOSEST

    def sample(t: Array) -> Array:
        rounds, since = np.divmod(np.round(t, 9), period)
        if closed:
            return course.sample(since)
        is_forward = rounds % 2.0 == 0.0
        return course.sample(np.where(is_forward, since, period - since))

    def in_every_round(times: Sequence[float]) -> tuple[float, ...]:
        instants = set()
        for i in range(math.ceil(until / period)):
            is_forward = closed or i % 2 == 0
            for time in times:
                if time > period:
                    continue
                if is_forward:
                    instants.add(i * period + time)
                else:
                    instants.add(i * period + (period - time))
        return tuple(sorted(instant for instant in instants if instant < until))

    jumps = in_every_round(course.jumps)
    kinks = in_every_round((0.0, *course.kinks, period))
    return replace(course, sample=sample, jumps=jumps, kinks=kinks, derivatives=None, end=math.inf)


@dataclass(frozen=True, kw_only=True)
class Filtered:
    """A table `[reference]`, in the units of files."""

    response_time: Annotated[NonNegative, doc("[s] tau_r of Eq. (31); 0 for no filter")] = 0.0
    repeat: Annotated[
        Annotated[float, Ge(0.1), Le(1e6)] | None,
        doc("[s] time after which the course starts again, or turns back if it is elsewhere by then; absent: never"),
    ] = None

    def build(self, initial: Array, gravity: float) -> Course:
        """Return the course before its filter, from the initial pose (4,) x, y, z [m], yaw [rad]; gravity in m/s^2.

        Raises:
            InputError: its file is wrong, or it does not suit the initial pose.
        """
        raise NotImplementedError

    @property
    def looks_ahead(self) -> bool:
        """Whether the heading follows the direction of travel."""
        return False


@dataclass(frozen=True, kw_only=True)
class Headed(Filtered):
    """A course that moves, and can look where it goes."""

    yaw_rate: Annotated[
        Speed,
        doc(
            '[deg/s] at which a heading "along_path" turns at most; at corners, stops and reversals at half of it, '
            "half of the turn before them"
        ),
    ] = 180.0

    @property
    def looks_ahead(self) -> bool:
        """Whether the heading follows the direction of travel."""
        fields = vars(self)
        return fields.get("yaw") == ALONG_PATH or bool(fields.get("yaw_along_path", False))


@dataclass(frozen=True, kw_only=True)
class Started(Headed):
    """A course with a start time."""

    start: Annotated[NonNegative, doc("[s] start of the course; before it, the initial position and yaw")] = 0.0

    def build(self, initial: Array, gravity: float) -> Course:
        """As `Filtered.build`."""
        return begin(self.path(initial, gravity), start=self.start, initial=initial)

    def path(self, initial: Array, gravity: float) -> Path:
        """Return the path that starts at `start`; arguments and errors as in `build`."""
        raise NotImplementedError


@dataclass(frozen=True, kw_only=True)
class Travelled(Started):
    """A course with a heading of its own."""

    yaw: Annotated[AlongPath | None, doc(f"{ALONG_PATH_DOC}; absent: the course's own heading")] = None


@dataclass(frozen=True, kw_only=True)
class Point:
    """A point to fly through."""

    position: Annotated[Vector, doc("[m] x, y, z, world")]
    yaw: Annotated[Number | None, doc("[deg] yaw there; absent: yaw of the point before")] = None


def poses_of(points: Sequence[Point], initial: Array) -> Array:
    """Return x, y, z [m], yaw [rad] of points (n, 4), yaw on the turn nearest that of the point before, or that yaw."""
    poses = []
    yaw = float(initial[3])
    for point in points:
        if point.yaw is not None:
            yaw = nearest_turn(math.radians(point.yaw), yaw)
        poses.append([*point.position, yaw])
    return np.array(poses)


def require_free_yaw(points: Sequence[Point], yaw: str | None) -> None:
    """Refuse a yaw at a point of a course that looks where it goes."""
    if yaw is None:
        return
    for i, point in enumerate(points):
        if point.yaw is not None:
            raise ParameterError("", f"points.{i}.yaw", point.yaw, f'absent where yaw = "{yaw}"')


def require_one(**fields: object) -> None:
    """Refuse two fields unless exactly one is given."""
    first, second = fields
    present = {name: value for name, value in fields.items() if value is not None}
    if len(present) != 1:
        raise ParameterError("", first, present, f"given, or {second}, but not both")


def require_apart(points: Sequence[Point], advice: str) -> None:
    """Refuse consecutive points at the same position, which no speed can join."""
    for i, (before, after) in enumerate(pairwise(points), start=1):
        if math.dist(before.position, after.position) < CLOSEST:
            rule = f"{CLOSEST} m or more from {list(before.position)}, the point before it ({advice})"
            raise ParameterError("", f"points.{i}.position", list(after.position), rule)
