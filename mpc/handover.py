"""What a controller takes over from the one before it, so that a change in flight makes no bump."""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np

from quadsim.state import Array

Law = TypeVar("Law")


def hand_over(law: object, previous: object) -> None:
    """Let a law take over what it can from the one before it, where it has a method `adopt`."""
    adopt = getattr(law, "adopt", None)
    if adopt is not None:
        adopt(previous)


def within(previous: object, kind: type[Law]) -> Law | None:
    """A law of the given kind, or the first such within it, as inside a fallback contract; None where there is none."""
    law: Any = previous
    while law is not None and not isinstance(law, kind):
        law = getattr(law, "inner", None)
    return law


def observed(previous: object) -> Array | None:
    """(6,) what the law before, or one within it, estimates to disturb: accelerations [m/s^2] and angular ones."""
    law: Any = previous
    while law is not None:
        estimate: Any = getattr(law, "disturbance", None)
        if isinstance(estimate, np.ndarray) and estimate.shape == (6,):
            return estimate
        law = getattr(law, "inner", None)
    return None


def resized(rows: Array, count: int) -> Array:
    """A plan (N, ...) as one of `count` steps: cut, or its last row held."""
    return rows[np.minimum(np.arange(count), len(rows) - 1)]
