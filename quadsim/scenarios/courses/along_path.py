"""`yaw = "along_path"`: the heading of a course that looks where it goes.

psi = (f + b) / 2, with f the direction of travel d limited to a rate r forwards in time, and b the same backwards.
`along_path` gives a course this heading, before `quadsim.scenarios.courses.followed` filters it.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Final

import numpy as np
from scipy.signal import lfilter

from quadsim.scenarios.courses.course import Course
from quadsim.state import Array, unwrapped

_INTERVAL: Final = 0.02  # between the samples that the direction is taken from [s]
_MOST_SAMPLES: Final = 200_000  # of a course; a longer one has longer intervals
_APART: Final = 2  # samples on either side, whose difference is the velocity
_SLOW_SHARE: Final = 0.02
"""Speed below which the heading is held, over the largest."""
_SLOW: Final = 0.02  # least such speed [m/s]
_AVERAGED: Final = 0.2  # time of each of the three moving averages [s]
_BLOCK: Final = 64.0  # of a course without an end, the time that is looked at first [s]
_AHEAD: Final = 8.0  # time at the end of what is looked at that is not used, as turns begin before their corners [s]


def along_path(course: Course, *, response_time: float, rate: float) -> Course:
    """Return a course whose heading is the direction of travel, and its own before there is any.

    The direction of travel is that of the filtered positions, seen from above.  It is held where there is hardly any
    speed, and taken on the turn nearest the one before, half a turn to the left.  It jumps at corners, at stops and at
    reversals; the heading turns there at half the stated rate at most, half of the turn before the jump and half after
    it.  Where d turns at less than r both f and b are d itself, so that bends are followed exactly.  Three moving
    averages then round the corners of psi off, and a flight starts with the heading that the vehicle has.

    The filter of Eq. (31) acts on the heading as on the positions; its samples lead by tau_r / 3 psi', so that what is
    followed is psi.

    Args:
        course: gives the positions; its heading counts at the start alone.
        response_time: tau_r of the filter that follows [s]; 0 for none.
        rate: at which the heading turns at most [rad/s].
    """
    headings = _Headings(course, response_time=response_time, rate=rate)

    def sample(t: Array) -> Array:
        poses = course.sample(t)
        return np.column_stack([poses[:, :3], headings.at(t)])

    jumps = np.array(course.jumps)
    if jumps.size:
        moved = course.sample(jumps + 1e-6) - course.sample(np.maximum(jumps - 1e-6, 0.0))
    else:
        moved = np.empty((0, 4))
    has_moved = np.abs(moved[:, :3]).max(axis=1, initial=0.0) > 1e-4
    still_jumps = tuple(jumps[has_moved].tolist())
    return replace(course, sample=sample, jumps=still_jumps, free_heading=False, stated_heading=True)


class _Headings:
    """The headings of a course, computed for as long as they are asked for."""

    def __init__(self, course: Course, *, response_time: float, rate: float) -> None:
        self._course = course
        self._response_time = response_time
        self._rate = rate
        self._t = np.zeros(0)
        self._yaw = np.zeros(0)

    def at(self, t: Array) -> Array:
        """Return the headings (M,) [rad] at times (M,) [s], before the filter."""
        latest = float(t.max(initial=0.0))
        if not self._t.size or (latest > self._t[-1] - _AHEAD and math.isinf(self._course.end)):
            self._compute(latest)
        return np.interp(t, self._t, self._yaw)

    def _compute(self, latest: float) -> None:
        """Compute the headings up to a time [s], and those of a course with an end up to that and some time."""
        span = self._course.end + _AHEAD
        if math.isinf(span):
            span = _BLOCK * 2.0 ** max(math.ceil(math.log2((latest + _AHEAD) / _BLOCK)), 0)
        count = min(math.ceil(span / _INTERVAL), _MOST_SAMPLES) + 1
        t, step = np.linspace(0.0, span, count, retstep=True)
        interval = float(step)
        positions = self._course.sample(t)[:, :3]
        if self._response_time:
            decay = math.exp(-3.0 * interval / self._response_time)
            start = decay * self._course.initial[None, :3]
            positions, _ = lfilter([1.0 - decay], [1.0, -decay], positions, axis=0, zi=start)
        before = float(self._course.initial[3])
        largest_change = self._rate * interval
        heading = turned(directions(positions, interval, before), largest_change, before)
        heading = _rounded_off(heading, max(round(_AVERAGED / interval), 1))
        heading = limited(heading, largest_change, before)
        self._t = t
        self._yaw = heading + self._response_time / 3.0 * np.gradient(heading, interval)


def directions(positions: Array, interval: float, before: float) -> Array:
    """Return the directions of travel (M,) [rad], seen from above, held where there is hardly any speed.

    Args:
        positions: (M, 3) at equal intervals [m], world.
        interval: between them [s].
        before: heading held before there is any speed [rad].
    """
    padded = np.pad(positions[:, :2], ((_APART, _APART), (0, 0)), mode="edge")
    velocity = (padded[2 * _APART :] - padded[: -2 * _APART]) / (2.0 * _APART * interval)
    speed = np.hypot(velocity[:, 0], velocity[:, 1])
    moving = speed > max(_SLOW, _SLOW_SHARE * float(speed.max()))
    if not moving.any():
        return np.full(len(positions), before)
    along = unwrapped(np.arctan2(velocity[moving, 1], velocity[moving, 0]), before)
    latest = np.cumsum(moving)  # how many samples have moved so far
    return np.concatenate([[before], along])[latest]


def limited(values: Array, most: float, before: float) -> Array:
    """Return values (M,) that change by `most` at most from one to the next, the first of them `before`."""
    result = np.empty_like(values)
    last = before
    for k, value in enumerate(values.tolist()):
        if k > 0:
            last += min(max(value - last, -most), most)
        result[k] = last
    return result


def turned(direction: Array, most: float, before: float) -> Array:
    """Return headings (M,) that turn half before and half after each jump of a direction; see the module."""
    forwards = limited(direction, most, before)
    backwards = limited(direction[::-1], most, float(direction[-1]))[::-1]
    return 0.5 * (forwards + backwards)


def _rounded_off(values: Array, width: int) -> Array:
    """Return three moving averages of values (M,), over an odd number of samples each."""
    size = width + 1 - width % 2
    window = np.full(size, 1.0 / size)
    for _ in range(3):
        values = np.convolve(np.pad(values, size // 2, mode="edge"), window, mode="valid")
    return values
