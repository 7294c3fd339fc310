"""Constraints in space: obstacles, corridors and a fence; how far points keep clear of them, and which way is clear.

An obstacle is a union of convex solids, still or moving without turning.  Corridors and the fence are convex and given
by half-spaces.  The vehicle is a ball about its centre of mass (`quadsim.vehicle.Vehicle.enclosing_radius`).
"""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from typing import Annotated, Any, ClassVar, Final, Literal, NamedTuple

import numpy as np
from annotated_types import Len, MaxLen, doc

from quadsim.errors import InputError, ParameterError, UnknownNameError
from quadsim.fields import Metres, NonNegative, Number, Pair, Vector
from quadsim.state import Array

MAX_POSITIONS: Final = 1000  # of one obstacle's path, or half-spaces of one polytope
_NAME: Final = {"pattern": "^[A-Za-z][A-Za-z0-9_-]*$"}
_PARALLEL: Final = 1e-9  # determinant of three unit normals below which their planes are taken to have no common point

_ROUNDING: Final = 1e-9  # of lengths along a path [m]

ReportName = Annotated[str, doc("name in reports")]
Sizes = Annotated[tuple[Metres, ...], Len(3, 3)]  # along x, y, z


def _clearance(kind: str, size: Array, centre: Array, turn: Array, points: Array) -> tuple[Array, Array]:
    """See `Solid.clearance`; s solids of a kind, with sizes and centres (s, 1, 3), turns (s, 3, 3), at (s, K, 3)."""
    over, ways = _excess(kind, size, (points - centre) @ turn)
    outside = np.maximum(over, 0.0)
    far = np.linalg.norm(outside, axis=-1)
    nearest = np.take_along_axis(ways, over.argmax(axis=-1)[..., None, None], axis=-2)[..., 0, :]
    away = (outside[..., None] * ways).sum(axis=-2) / np.where(far > 0.0, far, 1.0)[..., None]
    normal = np.where((far > 0.0)[..., None], away, nearest) @ np.swapaxes(turn, -1, -2)
    return far + np.minimum(over.max(axis=-1), 0.0), normal


def _excess(kind: str, size: Array, local: Array) -> tuple[Array, Array]:
    """How far points exceed each of the surfaces (..., K, j), orthogonal to each other, and the ways out."""
    a = size[..., 0]
    b = size[..., 1]
    sides = np.where(local < 0.0, -1.0, 1.0)
    if kind == "box":
        return np.abs(local) - size, sides[..., None] * np.eye(3)
    core = local.copy()
    if kind == "capsule":
        core[..., 2] -= np.clip(core[..., 2], -b, b)
    elif kind == "cylinder":
        core[..., 2] = 0.0
    radius = np.linalg.norm(core, axis=-1)
    core[radius == 0.0] = (1.0, 0.0, 0.0)
    out = core / np.where(radius > 0.0, radius, 1.0)[..., None]
    if kind != "cylinder":
        return (radius - a)[..., None], out[..., None, :]
    along = sides[..., 2, None] * np.array([0.0, 0.0, 1.0])
    return np.stack([radius - a, np.abs(local[..., 2]) - b], axis=-1), np.stack([out, along], axis=-2)


class Solid(NamedTuple):
    """A convex part of an obstacle."""

    kind: Literal["sphere", "capsule", "box", "cylinder"]  # as MuJoCo calls it
    size: tuple[float, float, float]
    """As MuJoCo has it [m]: radius; radius and half length along z; half edges; radius and half height."""
    centre: Array  # (3,) from the obstacle's position, world [m]
    turn: Array  # (3, 3) from its own axes to the world's

    def clearance(self, points: Array) -> tuple[Array, Array]:
        """Signed distance (K,) and outward normal (K, 3) of points (K, 3) relative to the obstacle's position [m].

        Both are exact, outside and inside; the nearest point of the surface is p - distance * normal.
        """
        return _clearance(self.kind, np.array(self.size), self.centre, self.turn, points)

    def support(self, ways: Array) -> Array:
        """(n, 3) its support points along directions `ways` (n, 3), relative to the obstacle's position [m]."""
        local = ways @ self.turn
        a, b, _ = self.size
        sides = np.where(local < 0.0, -1.0, 1.0)
        if self.kind == "box":
            return self.centre + (sides * self.size) @ self.turn.T
        core = local.copy()
        if self.kind == "cylinder":
            core[:, 2] *= 0.0
        length = np.linalg.norm(core, axis=1, keepdims=True)
        farthest = a * core / np.where(length > 0.0, length, 1.0)
        farthest[:, 2] += b * sides[:, 2]
        return self.centre + farthest @ self.turn.T

    @property
    def quaternion(self) -> Array:
        """(4,) of `turn`, scalar first."""
        x, y, z = self.turn.T
        w = math.sqrt(max(0.0, 1.0 + x[0] + y[1] + z[2]))
        if w > 1e-6:
            return np.array([w * w, y[2] - z[1], z[0] - x[2], x[1] - y[0]]) / (2.0 * w)
        axis = np.sqrt(np.maximum(0.0, 1.0 + np.array([x[0], y[1], z[2]])) / 2.0)  # for half turns
        first = int(axis.argmax())
        signs = np.where(self.turn[first] < 0.0, -1.0, 1.0)
        signs[first] = 1.0
        return np.array([0.0, *(signs * axis)])


@dataclass(frozen=True, kw_only=True)
class Place:
    """The position of a moving obstacle at an instant."""

    time: Annotated[Number, doc("[s]")]
    position: Annotated[Vector, doc("[m] x, y, z of its centre, world")]


@dataclass(frozen=True, kw_only=True)
class Obstacle:
    """An object that the vehicle must not touch; fixed, or moving along a stated path without turning."""

    name: ReportName = field(metadata=_NAME)
    position: Annotated[Vector, doc("[m] x, y, z of its centre, world; if it moves, its position until then")]
    start: Annotated[NonNegative, doc("[s] when it starts to move")] = 0.0
    velocity: Annotated[Vector, doc("[m/s] from start on")] = (0.0, 0.0, 0.0)
    acceleration: Annotated[Vector, doc("[m/s^2] from start on, as of a thrown ball")] = (0.0, 0.0, 0.0)
    path: Annotated[
        tuple[Place, ...],
        MaxLen(MAX_POSITIONS),
        doc("instead of velocity: in straight lines from position at start to each place at its time"),
    ] = ()

    def __post_init__(self) -> None:
        if self.path and (any(self.velocity) or any(self.acceleration)):
            raise InputError(
                f"path must be absent where velocity or acceleration is given; got {len(self.path)} positions"
            )
        times = self._times
        if any(later <= earlier for earlier, later in itertools.pairwise(times)):
            raise InputError(f"path must have rising times, all after start = {self.start}; got {times[1:]}")

    @property
    def moves(self) -> bool:
        """Whether it moves."""
        return bool(self.path) or any(self.velocity) or any(self.acceleration)

    @cached_property
    def solids(self) -> tuple[Solid, ...]:
        """Its convex parts."""
        raise NotImplementedError

    def positions(self, t: Array) -> Array:
        """(K, 3) its position at times (K,) [m]."""
        since = np.maximum(t - self.start, 0.0)[:, None]
        if not self.path:
            moved = since * np.array(self.velocity) + 0.5 * since**2 * np.array(self.acceleration)
            return np.array(self.position) + moved
        places = [self.position]
        for place in self.path:
            places.append(place.position)
        columns = [np.interp(t, self._times, column) for column in np.array(places).T]
        return np.stack(columns, axis=1)

    @property
    def _times(self) -> list[float]:
        """When it starts to move, and when it is at each place of its path [s]."""
        times = [self.start]
        for place in self.path:
            times.append(place.time)
        return times

    def clearances(self, t: Array, points: Array) -> tuple[Array, Array]:
        """Signed distances (s, K) [m] of points (K, 3) at times (K,) to its s solids, and normals (s, K, 3)."""
        return Solids([self]).clearances(t, points)

    def clearance(self, t: Array, points: Array) -> Array:
        """(K,) signed distance [m]; inside a wall, whose solids overlap, the depth is a lower bound."""
        return self.clearances(t, points)[0].min(axis=0)


class Solids:
    """The solids of several obstacles, in their order, evaluated together."""

    def __init__(self, obstacles: Sequence[Obstacle]) -> None:
        self._obstacles = tuple(obstacles)
        positions = [obstacle.position for obstacle in obstacles]
        self._still = np.array(positions, float).reshape(-1, 1, 3)
        # Of each kind of solid, its solids, their numbers among all, and the numbers of their obstacles.
        by_kind: dict[str, tuple[list[Solid], list[int], list[int]]] = {}
        self.count = 0
        for i, obstacle in enumerate(obstacles):
            for solid in obstacle.solids:
                solids, numbers, owners = by_kind.setdefault(solid.kind, ([], [], []))
                solids.append(solid)
                numbers.append(self.count)
                owners.append(i)
                self.count += 1
        self._groups = []
        for kind, (solids, numbers, owners) in sorted(by_kind.items()):
            size = np.array([solid.size for solid in solids])
            centre = np.array([solid.centre for solid in solids])
            turn = np.array([solid.turn for solid in solids])
            self._groups.append((kind, np.array(numbers), np.array(owners), size[:, None], centre[:, None], turn))

    def clearances(self, t: Array, points: Array) -> tuple[Array, Array]:
        """Signed distances (s, K) [m] and normals (s, K, 3); see `Obstacle.clearances`."""
        origins = np.repeat(self._still, len(t), axis=1)
        for i, obstacle in enumerate(self._obstacles):
            if obstacle.moves:
                origins[i] = obstacle.positions(t)
        distance = np.empty((self.count, len(t)))
        normal = np.empty((self.count, len(t), 3))
        for kind, at, owners, size, centre, turn in self._groups:
            distance[at], normal[at] = _clearance(kind, size, centre, turn, points - origins[owners])
        return distance, normal


def _upright(yaw: float) -> Array:
    """(3, 3) turn by a yaw [deg]."""
    c = math.cos(math.radians(yaw))
    s = math.sin(math.radians(yaw))
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


@dataclass(frozen=True, kw_only=True)
class Sphere(Obstacle):
    """A sphere."""

    type: Annotated[Literal["sphere"], doc("kind of obstacle: sphere")] = "sphere"
    radius: Annotated[Metres, doc("[m]")]

    @cached_property
    def solids(self) -> tuple[Solid, ...]:
        """The sphere."""
        return (Solid("sphere", (self.radius, 0.0, 0.0), np.zeros(3), np.eye(3)),)


@dataclass(frozen=True, kw_only=True)
class Capsule(Obstacle):
    """All points within a radius of a straight axis."""

    type: Annotated[Literal["capsule"], doc("kind of obstacle: capsule")] = "capsule"
    axis: Annotated[Vector, doc("[m] from one end of its axis to the other")]
    radius: Annotated[Metres, doc("[m] about its axis")]

    def __post_init__(self) -> None:
        super().__post_init__()
        if not math.hypot(*self.axis) > 0.0:
            raise InputError(f"axis must not be 0; a sphere has none; got {list(self.axis)}")

    @cached_property
    def solids(self) -> tuple[Solid, ...]:
        """The capsule, its axis along z."""
        axis = np.array(self.axis, float)
        length = float(np.linalg.norm(axis))
        z = axis / length
        x = np.cross(z, np.eye(3)[np.abs(z).argmin()])
        x /= np.linalg.norm(x)
        turn = np.stack([x, np.cross(z, x), z], axis=1)
        return (Solid("capsule", (self.radius, 0.5 * length, 0.0), np.zeros(3), turn),)


@dataclass(frozen=True, kw_only=True)
class Box(Obstacle):
    """An upright box."""

    type: Annotated[Literal["box"], doc("kind of obstacle: box")] = "box"
    size: Annotated[Sizes, doc("[m] lengths of its edges along its x, y, z axes")]
    yaw: Annotated[Number, doc("[deg] direction of its x axis, from the world's")] = 0.0

    @cached_property
    def solids(self) -> tuple[Solid, ...]:
        """The box."""
        x, y, z = self.size
        return (Solid("box", (0.5 * x, 0.5 * y, 0.5 * z), np.zeros(3), _upright(self.yaw)),)


@dataclass(frozen=True, kw_only=True)
class Cylinder(Obstacle):
    """A vertical cylinder."""

    type: Annotated[Literal["cylinder"], doc("kind of obstacle: cylinder")] = "cylinder"
    radius: Annotated[Metres, doc("[m]")]
    height: Annotated[Metres, doc("[m]")]

    @cached_property
    def solids(self) -> tuple[Solid, ...]:
        """The cylinder."""
        return (Solid("cylinder", (self.radius, 0.5 * self.height, 0.0), np.zeros(3), np.eye(3)),)


@dataclass(frozen=True, kw_only=True)
class Wall(Obstacle):
    """An upright wall with a rectangular window."""

    type: Annotated[Literal["wall"], doc("kind of obstacle: wall")] = "wall"
    size: Annotated[Sizes, doc("[m] thickness along its x axis, width along y, height along z")]
    yaw: Annotated[Number, doc("[deg] angle from the world's x axis to its x axis, which is normal to the wall")] = 0.0
    window: Annotated[Annotated[tuple[Metres, ...], Len(2, 2)], doc("[m] width and height of the opening")]
    window_centre: Annotated[Pair, doc("[m] along its y and z axes, from its centre")] = (0.0, 0.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        for opening, middle, size in zip(self.window, self.window_centre, self.size[1:], strict=True):
            if not abs(middle) + 0.5 * opening < 0.5 * size:
                raise InputError(
                    f"window must lie within the wall's width and height = {list(self.size[1:])}; got "
                    f"{list(self.window)} about {list(self.window_centre)}"
                )

    @cached_property
    def solids(self) -> tuple[Solid, ...]:
        """The wall left and right of the window, as high as the wall, and above and below it, as wide."""
        turn = _upright(self.yaw)
        thickness, width, height = self.size
        solids = []
        for i, (opening, middle) in enumerate(zip(self.window, self.window_centre, strict=True)):
            reach = 0.5 * (width, height)[i]
            for low, high in ((-reach, middle - 0.5 * opening), (middle + 0.5 * opening, reach)):
                half = np.array([thickness, width, height]) / 2.0
                centre = np.zeros(3)
                half[1 + i] = 0.5 * (high - low)
                centre[1 + i] = 0.5 * (high + low)
                solids.append(Solid("box", (half[0], half[1], half[2]), turn @ centre, turn))
        return tuple(solids)


AnyObstacle = Sphere | Capsule | Box | Cylinder | Wall


@dataclass(frozen=True, kw_only=True)
class Region:
    """A convex region to stay in: an upright box, or half-spaces."""

    position: Annotated[Vector | None, doc("[m] x, y, z of a box's centre, world")] = None
    size: Annotated[Sizes | None, doc("[m] lengths of the box's edges along its x, y, z axes")] = None
    yaw: Annotated[Number, doc("[deg] angle from the world's x axis to the box's")] = 0.0
    rows: Annotated[
        Annotated[tuple[Vector, ...], Len(1, MAX_POSITIONS)] | None,
        doc("instead of a box: a list of three numbers a for each half-space a . (x, y, z) <= upper"),
    ] = None
    upper: Annotated[tuple[Number, ...] | None, doc("[m, times the length of a] upper bounds, one per row")] = None
    tolerance: Annotated[NonNegative, doc("[m] violation that the audit accepts")] = 0.0
    required: Annotated[bool, doc("false: reported only, without effect on the verdict")] = True

    def __post_init__(self) -> None:
        box = (self.position is not None, self.size is not None)
        polytope = (self.rows is not None, self.upper is not None)
        is_box = all(box) and not any(polytope)
        is_polytope = all(polytope) and not any(box)
        if not is_box and not is_polytope:
            raise InputError("position must be given with size, or rows with upper, and not both")
        if self.rows is not None and self.upper is not None:
            if len(self.rows) != len(self.upper):
                raise InputError(f"upper must have one number per row, {len(self.rows)}; got {list(self.upper)}")
            for row in self.rows:
                if not any(row):
                    raise InputError(f"rows must be lists of 3 numbers, not all 0; got {list(row)}")

    @cached_property
    def half_spaces(self) -> tuple[Array, Array]:
        """A (m, 3), rows of unit length, and b (m,) [m]: inside is A p <= b."""
        if self.rows is not None:
            rows = np.array(self.rows, float)
            upper = np.array(self.upper, float)
            lengths = np.linalg.norm(rows, axis=1)
            return rows / lengths[:, None], upper / lengths
        axes = _upright(self.yaw).T
        rows = np.concatenate([axes, -axes])
        return rows, rows @ np.array(self.position, float) + 0.5 * np.tile(np.array(self.size, float), 2)

    def clearance(self, t: Array, points: Array) -> Array:
        """(K,) distance of points (K, 3) to the nearest bounding plane [m]; negative outside, there at most as far."""
        rows, upper = self.half_spaces
        return (upper - points @ rows.T).min(axis=1)

    def edges(self, low: Array, high: Array) -> Array:
        """(E, 2, 3) the edges of what of it lies between two corners [m], for drawing."""
        rows, upper = self.half_spaces
        rows = np.concatenate([rows, np.eye(3), -np.eye(3)])
        upper = np.concatenate([upper, high, -np.asarray(low)])
        corners: dict[tuple[float, ...], set[int]] = {}
        for planes in itertools.combinations(range(len(rows)), 3):
            chosen = rows[list(planes)]
            if abs(chosen[0] @ np.cross(chosen[1], chosen[2])) > _PARALLEL:
                corner = np.linalg.solve(chosen, upper[list(planes)])
                if (rows @ corner <= upper + 1e-9).all():
                    corners.setdefault(tuple((corner.round(6) + 0.0).tolist()), set()).update(planes)
        edges = []
        for (a, of_a), (b, of_b) in itertools.combinations(corners.items(), 2):
            shared = rows[sorted(of_a & of_b)]  # two at least that are not parallel, as where a face is cut off
            if len(shared) > 1 and np.linalg.norm(np.cross(shared[0], shared), axis=1).max() > _PARALLEL:
                edges.append((a, b))
        return np.array(edges).reshape(-1, 2, 3)


@dataclass(frozen=True, kw_only=True)
class Corridor(Region):
    """A convex region to stay in during a window of time, or of the reference's path."""

    name: ReportName = field(metadata=_NAME)
    start: Annotated[Number, doc("[s] start of the time window")] = 0.0
    stop: Annotated[Number, doc("[s] end of the time window; absent: the end of the flight")] = math.inf
    path: Annotated[
        Annotated[tuple[NonNegative, ...], Len(2, 2)] | None,
        doc("[m] instead of start and stop: window of distances travelled by the reference along its path"),
    ] = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.path is not None:
            if (self.start, self.stop) != (0.0, math.inf):
                raise InputError(f"path must be absent where start or stop is given; got {list(self.path)}")
            if not self.path[0] < self.path[1]:
                raise InputError(f"path must be where it begins, and farther on where it ends; got {list(self.path)}")
        if not self.start <= self.stop:
            raise ParameterError(f"corridors.{self.name}", "stop", self.stop, f"at least start = {self.start}")

    def timed(self, t: Array, positions: Array) -> Corridor:
        """The same with its window along the path as one of time; itself where it has none.

        Args:
            t: (K,) rising times [s].
            positions: (K, 3) of the reference then, in straight lines in between [m].

        Raises:
            ParameterError: the path is over before the window begins.
        """
        if self.path is None:
            return self
        steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
        gone = np.concatenate([[0.0], np.cumsum(steps)])
        path_start, end = self.path
        if gone[-1] < path_start - _ROUNDING:
            rule = f"within the {gone[-1]:.4g} m of the reference's path that are flown"
            raise ParameterError(f"corridors.{self.name}", "path", list(self.path), rule)
        # Where the reference rests at the window's begin or end, the window has all of that rest.
        first = np.searchsorted(gone, path_start - _ROUNDING)
        last = np.searchsorted(gone, end + _ROUNDING, "right") - 1

        def passed(k: np.intp, at: float) -> float:
            return float(t[k] + (at - gone[k]) / steps[k] * (t[k + 1] - t[k]))

        start = float(t[0])
        stop = math.inf
        if first > 0:
            start = passed(first - 1, path_start)
        if last < len(steps):
            stop = passed(last, end)
        return replace(self, path=None, start=start, stop=stop)


@dataclass(frozen=True, kw_only=True)
class Fence(Region):
    """A convex region to stay in throughout."""

    name: ClassVar[str] = "keep_in"
    start: ClassVar[float] = 0.0
    stop: ClassVar[float] = math.inf


Constraining = AnyObstacle | Corridor | Fence
SHAPES: Final[dict[str, type[Any]]] = {
    kind.__name__.lower(): kind for kind in (Sphere, Capsule, Box, Cylinder, Wall, Corridor, Fence)
}


def shape_to_json(shape: Constraining) -> dict[str, Any]:
    """A shape's fields, less those that are absent, and its kind as `type`."""
    stated: dict[str, Any] = {"type": type(shape).__name__.lower()}
    for name, value in asdict(shape).items():
        if value is not None and value != math.inf:
            stated[name] = value
    written: dict[str, Any] = json.loads(json.dumps(stated))
    return written  # with lists for tuples, as it is read


def shape_from_json(entry: Mapping[str, Any]) -> Constraining:
    """The shape that `shape_to_json` wrote.

    Raises:
        InputError, TypeError, ValueError: it did not.
    """
    if entry.get("type") not in SHAPES:
        raise UnknownNameError("shape", str(entry.get("type")), SHAPES)
    kind = SHAPES[entry["type"]]
    values = {}
    for name, value in entry.items():
        if name != "type":
            values[name] = _frozen(value)
    if "path" in values and issubclass(kind, Obstacle):
        places = []
        for place in entry["path"]:
            places.append(Place(time=place["time"], position=tuple(place["position"])))
        values["path"] = tuple(places)
    shape: Constraining = kind(**values)
    points = np.zeros((1, 3))
    if not np.isfinite(shape.clearance(np.zeros(1), points)).all():
        raise InputError(f"{entry['type']} must be of finite numbers; got {entry}")
    return shape


def _frozen(value: Any) -> Any:
    if isinstance(value, list):
        return tuple(map(_frozen, value))
    return value


def footprint(solid: Solid) -> Array:
    """(n, 2) outline of a solid from above, relative to its obstacle."""
    around = np.linspace(0.0, 2.0 * np.pi, 65)[:-1]
    return solid.support(np.stack([np.cos(around), np.sin(around), np.zeros(around.size)], axis=1))[:, :2]
