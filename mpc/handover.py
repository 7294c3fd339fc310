"""Bumpless transfer: the state that a controller takes over from its predecessor."""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np

from quadsim.state import Array

Law = TypeVar("Law")


def hand_over(law: object, previous: object) -> None:
    """Let a law take over state from its predecessor, if it has a method `adopt`."""
    adopt = getattr(law, "adopt", None)
    if adopt is not None:
        adopt(previous)


def within(previous: object, kind: type[Law]) -> Law | None:
    """Return a law of a kind, or the first one inside it, as in a fallback contract; None if there is none."""
    law: Any = previous
    while law is not None and not isinstance(law, kind):
        law = getattr(law, "inner", None)
    return law


def observed(previous: object) -> Array | None:
    """(6,) disturbance estimate of the previous law, or of one inside it: accelerations [m/s^2] and angular ones."""
    law: Any = previous
    while law is not None:
        estimate: Any = getattr(law, "disturbance", None)
        if isinstance(estimate, np.ndarray) and estimate.shape == (6,):
            return estimate
        law = getattr(law, "inner", None)
    return None


def resized(rows: Array, count: int) -> Array:
    """A plan (N, ...) cut to `count` steps, or extended by its last row."""
    return rows[np.minimum(np.arange(count), len(rows) - 1)]
