"""`[reference]`: the desired course."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Annotated, Final, Literal

from annotated_types import MaxLen
from pydantic import Discriminator, Field, Tag, model_validator

from quadsim.fields import NonNegative, Number, Positive
from scenarios.schema.base import MOST_ENTRIES, Pair, Spec, Triple

MOST_POINTS: Final = 200  # points or turns of one course; a longer one is a table, `type = "csv"`
MOST_SAMPLES: Final = 100_000  # of the phase of a ramped course: 2000 s at 50 Hz
CLOSEST: Final = 1e-3
"""Least distance [m] between points that a speed leads from one to the other, and least time [s] between points."""

Speed = Annotated[float, Field(ge=1e-3, le=1e4)]  # of travel [m/s], or of turning [deg/s]
Time = Annotated[float, Field(ge=CLOSEST, le=1e6)]


class WindowSpec(Spec):
    """A value held strictly between two instants.  Eq. (30)."""

    start: Number = Field(description="[s] when it begins; at that instant the value does not hold yet")
    stop: Number = Field(description="[s] when it ends; at that instant the value holds no longer")
    value: Number = Field(description="[m], or [deg] for yaw, held in between")

    @model_validator(mode="after")
    def _check(self) -> WindowSpec:
        if not self.start < self.stop:
            raise ValueError(f"start must be below stop = {self.stop}; got {self.start}")
        return self


Windows = Annotated[list[WindowSpec], MaxLen(MOST_ENTRIES)]


class _CourseSpec(Spec):
    response_time: NonNegative = Field(default=0.0, description="[s] tau_r of Eq. (31); 0 for no filter")


class _StartedSpec(_CourseSpec):
    start: NonNegative = Field(
        default=0.0, description="[s] when the course begins; until then it is the initial position and yaw"
    )


class StepsSpec(_CourseSpec):
    """Steps of Eq. (30); outside its windows an axis stays at its initial position, and yaw at 0."""

    type: Literal["steps"] = Field(default="steps", description="kind of course: values held in windows of time")
    x: Windows = Field(default=[], description="[m] windows of the x axis, world")
    y: Windows = Field(default=[], description="[m] windows of the y axis, world")
    z: Windows = Field(default=[], description="[m] windows of the z axis, world")
    yaw: Windows = Field(default=[], description="[deg] windows of the yaw angle")


class WaypointSpec(Spec):
    """A point to fly to in a straight line at constant speed, and how long to stay there."""

    position: Triple = Field(description="[m] x, y, z, world")
    yaw: Number | None = Field(default=None, description="[deg] yaw there; the previous one if absent")
    hold: NonNegative = Field(default=0.0, description="[s] how long to stay there")
    speed: Speed | None = Field(default=None, description="[m/s] of the leg; that of the course if absent")


class WaypointsSpec(_StartedSpec):
    """Straight legs at constant speed, from the initial position from one point to the next."""

    type: Literal["waypoints"] = Field(description="kind of course: straight legs between points")
    speed: Speed = Field(default=1.0, description="[m/s] along a leg, unless its point gives its own")
    points: list[WaypointSpec] = Field(description="the points, in order")

    @model_validator(mode="after")
    def _check(self) -> WaypointsSpec:
        _check_count("points", self.points)
        _check_apart([point.position for point in self.points], "to stay at a point give it a hold")
        return self


class SnapPointSpec(Spec):
    """A point to fly through."""

    position: Triple = Field(description="[m] x, y, z, world")
    yaw: Number | None = Field(default=None, description="[deg] yaw there; that of the point before if absent")


class MinimumSnapSpec(_StartedSpec):
    """The smoothest course through points, from rest at the initial position to rest at the last of them."""

    type: Literal["minimum_snap"] = Field(description="kind of course: least snap through points")
    points: list[SnapPointSpec] = Field(description="the points, in order")
    times: list[Time] | None = Field(
        default=None, description="[s] after start, when each point is passed; either times or speed"
    )
    speed: Speed | None = Field(
        default=None, description="[m/s] average on the straight line between points; either times or speed"
    )

    @model_validator(mode="after")
    def _check(self) -> MinimumSnapSpec:
        _check_count("points", self.points)
        _check_either(("times", self.times), ("speed", self.speed))
        if self.times is None:
            _check_apart([point.position for point in self.points], "or give times instead of speed")
        elif len(self.times) != len(self.points):
            raise ValueError(f"times must have one time for each of the {len(self.points)} points; got {self.times}")
        elif any(later - earlier < CLOSEST for earlier, later in pairwise(self.times)):
            raise ValueError(f"times must increase, by {CLOSEST} s or more; got {self.times}")
        return self


class _LoopSpec(_StartedSpec):
    period: Time | None = Field(default=None, description="[s] of one turn at full speed; either period or speed")
    speed: Speed | None = Field(default=None, description="[m/s] along the path at full speed; either period or speed")
    turns: Number = Field(default=1.0, description="[-] how many turns; negative: reversed")
    ramp: NonNegative = Field(
        default=5.0, description="[s] over which it gains its speed smoothly, and loses it at the end; 0 for at once"
    )
    height: Number | None = Field(default=None, description="[m] z where it begins; the initial one if absent")
    yaw: Number | None = Field(default=None, description="[deg] held throughout; the initial one if absent")
    yaw_along_path: bool = Field(default=False, description="whether yaw follows the direction of travel instead")

    @property
    def turn_time(self) -> float:
        """Of one turn at full speed [s]."""
        raise NotImplementedError

    @property
    def until(self) -> float:
        """When it is over [s]."""
        return self.start + abs(self.turns) * self.turn_time + self.ramp

    @model_validator(mode="after")
    def _check(self) -> _LoopSpec:
        _check_either(("period", self.period), ("speed", self.speed))
        if self.turns == 0.0:
            raise ValueError("turns must not be 0")
        longest = abs(self.turns) * self.turn_time
        if self.ramp > longest:
            raise ValueError(
                f"ramp must be at most the time of all turns at full speed = {longest:g} s; got {self.ramp}"
            )
        if self.yaw is not None and self.yaw_along_path:
            raise ValueError("yaw must be absent where yaw_along_path is true")
        return self


class _RoundSpec(_LoopSpec):
    radius: Positive = Field(description="[m] seen from above")
    centre: Pair | None = Field(
        default=None, description="[m] x, y, world; if absent, such that the course begins at the initial position"
    )
    angle: Number = Field(default=0.0, description="[deg] where on the circle it begins, seen from the centre; 0 is +x")

    @property
    def turn_time(self) -> float:
        """Of one turn at full speed [s]."""
        climb: float = getattr(self, "climb", 0.0)
        return self.period or math.hypot(2.0 * math.pi * self.radius, climb) / (self.speed or math.inf)


class CircleSpec(_RoundSpec):
    """A level circle, counter-clockwise seen from above."""

    type: Literal["circle"] = Field(description="kind of course: a level circle")


class HelixSpec(_RoundSpec):
    """A circle that climbs in proportion to the angle flown."""

    type: Literal["helix"] = Field(description="kind of course: a circle that climbs")
    climb: Number = Field(description="[m] gained per turn; negative: lost")


class FigureEightSpec(_LoopSpec):
    """A level lemniscate of Gerono, begun at its crossing."""

    type: Literal["figure_eight"] = Field(description="kind of course: a level lemniscate of Gerono")
    length: Positive = Field(description="[m] from end to end, through the crossing")
    width: Positive | None = Field(default=None, description="[m] across; half the length if absent")
    speed: Speed | None = Field(
        default=None, description="[m/s] at the crossing, where it is largest; either period or speed"
    )
    centre: Pair | None = Field(
        default=None, description="[m] x, y of the crossing, world; the initial position if absent"
    )
    angle: Number = Field(default=0.0, description="[deg] direction of the length; 0 is +x")

    @property
    def half_axes(self) -> tuple[float, float]:
        """Half the length and half the width [m]."""
        return 0.5 * self.length, 0.5 * (0.5 * self.length if self.width is None else self.width)

    @property
    def turn_time(self) -> float:
        """Of one turn at full speed [s]."""
        along, across = self.half_axes
        return self.period or 2.0 * math.pi * math.hypot(along, 2.0 * across) / (self.speed or math.inf)


class _RampedSpec(_StartedSpec):
    speed: Speed = Field(
        description="[m/s] v, the product of radius and rate that would be reached without ramps; the phase's own top "
        "rate is somewhat higher"
    )
    acceleration: Speed = Field(default=1.0, description="[m/s^2] a, along the path, of radius and phase")
    radius: Positive = Field(description="[m] r, seen from above; of a lemniscate half its length")
    ramp: Time = Field(default=2.0, description="[s] T, over which the acceleration grows; below speed / acceleration")
    heading: Literal["free", "held"] = Field(
        default="free", description="free: no rate is left about body z, and the heading drifts; held: the initial yaw"
    )
    sampling: Time = Field(default=0.02, description="[s] step of the rectangle sums that make the phase")

    @property
    def until(self) -> float:
        """When it is over [s]; see `scenarios.courses.ramped.ramped_phase`."""
        parts = (self.ramp, self.speed / self.acceleration - self.ramp)
        rising, constant, turning = (math.ceil(time / self.sampling - 1e-9) for time in (*parts, 2.0 * self.ramp))
        return self.start + self.sampling * (2 * rising + 2 * constant + turning)

    @model_validator(mode="after")
    def _check(self) -> _RampedSpec:
        if self.response_time:
            raise ValueError(f"response_time must be 0: the course is smooth by itself; got {self.response_time}")
        longest = self.speed / self.acceleration
        if self.ramp >= longest:
            raise ValueError(f"ramp must be below speed / acceleration = {longest:g} s; got {self.ramp}")
        if 2.0 * (longest + self.ramp) > MOST_SAMPLES * self.sampling:
            least = 2.0 * (longest + self.ramp) / MOST_SAMPLES
            raise ValueError(f"sampling must make at most {MOST_SAMPLES} samples, {least:.3g} s; got {self.sampling}")
        return self


class RampedCircleSpec(_RampedSpec):
    """A level circle, clockwise seen from above, from the initial position, its northernmost point, towards +x.

    Or a vertical one, from its lowest point towards the initial yaw.
    """

    type: Literal["ramped_circle"] = Field(description="kind of course: a circle flown up to a speed and back to rest")
    plane: Literal["level", "vertical"] = Field(
        default="level", description="vertical: upside down at the top, where it is fast enough; the heading is free"
    )

    @model_validator(mode="after")
    def _check_plane(self) -> RampedCircleSpec:
        if self.plane == "vertical" and self.heading == "held":
            raise ValueError("heading must be free where plane is vertical; got held")
        return self


class RampedLemniscateSpec(_RampedSpec):
    """A level lemniscate of Gerono from the initial position, its tip in +x, towards +y."""

    type: Literal["ramped_lemniscate"] = Field(
        description="kind of course: a lemniscate flown up to a speed and back to rest"
    )


class TurnSpec(Spec):
    """A turn on the spot at constant rate."""

    start: NonNegative = Field(description="[s] when it begins; a turn that is not over then ends")
    yaw: Number = Field(description="[deg] where it ends; 360 is a whole turn from 0")
    rate: Speed = Field(description="[deg/s] how fast it turns, in either direction")


class YawTurnsSpec(_CourseSpec):
    """Turns on the spot: the position stays the initial one."""

    type: Literal["yaw_turns"] = Field(description="kind of course: turns on the spot")
    turns: list[TurnSpec] = Field(description="the turns, in order")

    @model_validator(mode="after")
    def _check(self) -> YawTurnsSpec:
        _check_count("turns", self.turns)
        for i, (earlier, later) in enumerate(pairwise(self.turns), start=1):
            if later.start <= earlier.start:
                raise ValueError(f"turns.{i}.start must be above that before it = {earlier.start}; got {later.start}")
        return self


class CsvSpec(_StartedSpec):
    """A table with the header t,x,y,z,yaw or t,x,y,z,yaw,vx,vy,vz; yaw in RADIANS, as in flight.parquet."""

    type: Literal["csv"] = Field(description="kind of course: a table in a file")
    file: str = Field(
        description="path of the CSV file, relative to the scenario file; "
        "t [s] after start, x, y, z [m], yaw [rad] (radians, as ref_yaw in flight.parquet), vx, vy, vz [m/s]"
    )
    sha256: Annotated[str, Field(pattern="^[0-9a-f]{64}$")] | None = Field(
        default=None, description="hash of the file, recorded when it is read; another content is refused"
    )


def _kind(value: object) -> str:
    """The tag of a table or of what was made of one; a table without a type is one of steps."""
    given = value.get("type", "steps") if isinstance(value, dict) else getattr(value, "type", "steps")
    return given if isinstance(given, str) else repr(given)


ReferenceSpec = Annotated[
    Annotated[StepsSpec, Tag("steps")]
    | Annotated[WaypointsSpec, Tag("waypoints")]
    | Annotated[MinimumSnapSpec, Tag("minimum_snap")]
    | Annotated[CircleSpec, Tag("circle")]
    | Annotated[HelixSpec, Tag("helix")]
    | Annotated[FigureEightSpec, Tag("figure_eight")]
    | Annotated[RampedCircleSpec, Tag("ramped_circle")]
    | Annotated[RampedLemniscateSpec, Tag("ramped_lemniscate")]
    | Annotated[YawTurnsSpec, Tag("yaw_turns")]
    | Annotated[CsvSpec, Tag("csv")],
    Discriminator(_kind),
]
"""The desired course, of the kind that its field `type` names."""


def _check_count(name: str, entries: Sequence[object]) -> None:
    if not 1 <= len(entries) <= MOST_POINTS:
        raise ValueError(f"{name} must have 1 to {MOST_POINTS} entries; got {len(entries)}")


def _check_either(*fields: tuple[str, object]) -> None:
    """Refuse fields of which not exactly one is given."""
    given = [name for name, value in fields if value is not None]
    if len(given) != 1:
        first, second = (name for name, _ in fields)
        raise ValueError(f"{first} must be given, or {second}, but not both; got {' and '.join(given) or 'neither'}")


def _check_apart(positions: Sequence[list[float]], advice: str) -> None:
    """Refuse points at the place of the point before: no speed leads from one to the other."""
    for i, (earlier, later) in enumerate(pairwise(positions), start=1):
        if math.dist(earlier, later) < CLOSEST:
            rule = f"must be {CLOSEST} m or more from that before it ({advice})"
            raise ValueError(f"points.{i}.position {rule}; got {later} after {earlier}")
