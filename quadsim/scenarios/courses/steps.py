"""Piecewise constant courses: an axis has the value v_i for a_i < t < b_i, and its initial one elsewhere.  Eq. (30)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Literal

import numpy as np
from annotated_types import MaxLen, doc

from quadsim.errors import ParameterError
from quadsim.fields import Number
from quadsim.flight.metrics import CourseStep
from quadsim.scenarios.courses.course import ALONG_PATH_DOC, AlongPath, Course, Headed
from quadsim.state import REFERENCE_NAMES, Array, nearest_turn


@dataclass(frozen=True, kw_only=True)
class Window:
    """A value held strictly between two instants.  Eq. (30)."""

    start: Annotated[Number, doc("[s] start, exclusive: at that instant the axis does not yet have the value")]
    stop: Annotated[Number, doc("[s] end, exclusive: at that instant the axis no longer has the value")]
    value: Annotated[Number, doc("[m], or [deg] for yaw: the value in between")]

    def __post_init__(self) -> None:
        if not self.start < self.stop:
            raise ParameterError("", "start", self.start, f"below stop = {self.stop}")


Windows = Annotated[tuple[Window, ...], MaxLen(1000)]


@dataclass(frozen=True, kw_only=True)
class Steps(Headed):
    """Steps of Eq. (30); outside its windows an axis stays at its initial position, and yaw at 0."""

    type: Annotated[Literal["steps"], doc("kind of course: values held in windows of time")] = "steps"
    x: Annotated[Windows, doc("[m] windows of the x axis, world")] = ()
    y: Annotated[Windows, doc("[m] windows of the y axis, world")] = ()
    z: Annotated[Windows, doc("[m] windows of the z axis, world")] = ()
    yaw: Annotated[Windows | AlongPath, doc(f"[deg] windows of the yaw angle; or {ALONG_PATH_DOC}")] = ()

    def build(self, initial: Array, gravity: float) -> Course:
        """As `Filtered.build`."""
        channels = self.channels(initial)
        values_elsewhere = np.array([value for _, value in channels])
        instants = set()
        for windows, value in channels:
            for time, _, _ in switches(windows, value, initial=value):
                instants.add(time)

        def sample(t: Array) -> Array:
            return np.stack([steps(t, windows, value) for windows, value in channels], axis=1)

        return Course(sample=sample, initial=values_elsewhere, jumps=tuple(sorted(instants)))

    def channels(self, initial: Array) -> list[tuple[Sequence[Window], float]]:
        """Windows of x, y, z [m] and yaw [rad], each with the value outside them."""
        x, y, z, before = initial.tolist()
        if isinstance(self.yaw, str):
            return [(self.x, x), (self.y, y), (self.z, z), ((), before)]
        yaw = []
        for window in self.yaw:
            yaw.append(replace(window, value=math.radians(1.0) * nearest_turn(window.value, turn=360.0)))
        return [(self.x, x), (self.y, y), (self.z, z), (yaw, 0.0)]

    def course_steps(self, initial: Array, *, duration: float, preview: float) -> list[CourseStep]:
        """Return the steps of each channel before the end of a flight; a start away from the course is a step at 0.

        Args:
            initial: (4,) x, y, z [m] and yaw [rad] at the start.
            duration: of the flight [s].
            preview: time [s] by which the controller knows the next step, so that it ends the one before.
        """
        result = []
        channels = zip(REFERENCE_NAMES, self.channels(initial), initial.tolist(), strict=True)
        for name, (windows, elsewhere), start in channels:
            reached = [step for step in switches(windows, elsewhere, initial=start) if step[0] < duration]
            for i, (time, before, after) in enumerate(reached):
                until = duration
                if i + 1 < len(reached):
                    time_of_next, _, _ = reached[i + 1]
                    until = time_of_next - preview
                result.append(CourseStep(channel=name, time=time, before=before, after=after, until=until))
        return result


def steps(t: Array, windows: Sequence[Window], elsewhere: float) -> Array:
    """Piecewise constant reference (M,) at times t (M,): each window's value inside it, `elsewhere` outside all.

    Eq. (30) prints strict inequalities on both sides of each switching instant; the instant itself is taken as
    outside the window.
    """
    values = np.full(t.shape, elsewhere)
    at = np.round(t, 9)
    for window in windows:
        values[(at > window.start) & (at < window.stop)] = window.value
    return values


def switches(windows: Sequence[Window], elsewhere: float, *, initial: float) -> list[tuple[float, float, float]]:
    """Return the steps of a piecewise constant reference: time [s], value before and after, in order of time.

    Of windows that overlap, the last holds; the first step is counted from `initial`, where the output is at time 0.
    """
    instants = {0.0}
    for window in windows:
        instants |= {max(0.0, window.start), max(0.0, window.stop)}
    result = []
    before = initial
    for t in sorted(instants):
        after = elsewhere
        for window in windows:
            if window.start <= t < window.stop:
                after = window.value
        if after != before:
            result.append((t, before, after))
        before = after
    return result
