"""The followed reference: a filtered course, which set-points may replace in flight.

r(k) = y(k) + exp(-3 tau_s / tau_r) (r(k-1) - y(k)).  Eq. (31).  The closed loop previews its rows for the controller.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np

from quadsim.scenarios.courses.course import Course
from quadsim.scenarios.courses.smoothing import smooth
from quadsim.state import REFERENCE_NAMES, Array, nearest_turn, unwrapped

_YAW: Final = REFERENCE_NAMES.index("yaw")
_BLOCK: Final = 256  # rows that the course is sampled for, and filtered, at a time


class FollowedCourse:
    """Rows r(k) of a course's samples y(k), see the module.

    A set-point is not known ahead: given at t_k, it takes the place of the samples from k+1 on, axis by axis, and the
    filter runs on from row k.  An axis keeps its set-point until it is given another one.

    Each heading, of a sample or a set-point, is on the turn nearest the one before, and reached the shorter way round.
    """

    def __init__(self, course: Course, *, response_time: float, period: float) -> None:
        """Set up at t = 0, with tau_r [s], 0 for no filter, and tau_s [s]."""
        self._course = course
        self._response_time = response_time
        self._period = period
        self._samples = self._rows = np.empty((0, len(REFERENCE_NAMES)))
        self._setpoint: dict[int, float] = {}

    def first(self, count: int) -> Array:
        """(count, 4) x, y, z [m], yaw [rad] at t_0 and later."""
        self._extend(count)
        rows: Array = self._rows[:count]
        return rows

    def row(self, k: int) -> Array:
        """(4,) x, y, z [m], yaw [rad] at t_k."""
        self._extend(k + 1)
        row: Array = self._rows[k]
        return row

    def preview(self, k: int, n: int) -> Array:
        """Return x, y, z [m], yaw [rad] (n, 4) at t_{k+1} .. t_{k+n}, as known at t_k."""
        self._extend(k + 1 + n)
        rows: Array = self._rows[k + 1 : k + 1 + n]
        return rows

    def flown(self, count: int, setpoints: Sequence[tuple[int, Mapping[str, float]]]) -> tuple[Array, Array]:
        """Return the (count, 4) samples and rows of a flight with set-points (k, values) in order; as `set` makes them.

        Samples are those before the filter.  Nothing here changes.
        """
        self._extend(count)
        samples = self._samples[:count].copy()
        places = np.arange(count)
        for channel, name in enumerate(REFERENCE_NAMES):
            set_at = []
            targets = []
            for k, values in setpoints:
                if name in values:
                    set_at.append(k)
                    targets.append(values[name])
            if not targets:
                continue
            latest = np.searchsorted(set_at, places, side="left") - 1  # from the row after the set-point on
            target = np.array(targets)[np.maximum(latest, 0)]
            samples[:, channel] = np.where(latest < 0, samples[:, channel], target)
        return samples, self._filtered(samples, self._course.initial)

    def set(self, k: int, values: Mapping[str, float]) -> None:
        """Apply a set-point at t_k, by the names of its axes [m, rad]."""
        self._extend(k + 1)
        for name, value in values.items():
            if name == "yaw":
                self._setpoint[_YAW] = nearest_turn(value, float(self._rows[k, _YAW]))
            else:
                self._setpoint[REFERENCE_NAMES.index(name)] = value
        self._rows = self._rows[: k + 1]

    def _extend(self, count: int) -> None:
        """Compute at least that many rows."""
        while len(self._samples) < count:
            t = self._period * np.arange(len(self._samples), len(self._samples) + _BLOCK, dtype=np.float64)
            samples = self._course.sample(t)
            if len(self._samples):
                before = self._samples[-1]
            else:
                before = self._course.initial
            samples[:, _YAW] = unwrapped(samples[:, _YAW], float(before[_YAW]))
            self._samples = np.concatenate([self._samples, samples])
        if len(self._rows) >= count:
            return
        known = len(self._rows)
        samples = self._samples[known : -(-count // _BLOCK) * _BLOCK].copy()
        for channel, value in self._setpoint.items():
            samples[:, channel] = value
        if known:
            before = self._rows[-1]
        else:
            before = self._course.initial
        self._rows = np.concatenate([self._rows, self._filtered(samples, before)])

    def _filtered(self, samples: Array, before: Array) -> Array:
        """Filter samples (M, 4) that follow a row (4,)."""
        columns = []
        for values, last in zip(samples.T, before.tolist(), strict=True):
            columns.append(smooth(values, initial=last, response_time=self._response_time, period=self._period))
        return np.stack(columns, axis=1)
