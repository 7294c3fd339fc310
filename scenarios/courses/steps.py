"""Piecewise constant courses.  Eq. (30)."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from quadsim.state import Array


@dataclass(frozen=True, kw_only=True)
class Window:
    """A value held strictly between two instants, as in Eq. (30)."""

    start: float  # [s], excluded; at the instant itself the reference is elsewhere's value
    stop: float  # [s], excluded
    value: float  # [m], or [rad] for yaw


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
    """Where a piecewise constant reference steps: time [s], value before and value after, in order of time.

    Of windows that overlap, the last holds; the first step is counted from `initial`, where the output is at time 0.
    """
    instants = sorted({max(0.0, instant) for window in windows for instant in (window.start, window.stop)} | {0.0})
    held = [[window.value for window in windows if window.start <= t < window.stop] for t in instants]
    values = [initial, *(values[-1] if values else elsewhere for values in held)]
    found = zip(instants, itertools.pairwise(values), strict=True)
    return [(time, before, after) for time, (before, after) in found if before != after]
