"""Two logged vectors a and b side by side: how alike they are, axis by axis, and by which shift in time.

Their correlation at a shift s is sum a_k b_{k+s} / sqrt(sum a_k^2 sum b_{k+s}^2), each less its mean, over all parts of
a log that fly.  The checks of axes, clocks and scales compare columns by it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Final

import numpy as np

from quadsim.features.identify.record import Record
from quadsim.state import Array

TICK: Final = 0.01  # [s] between samples that are compared, or the log's period if that is longer
LONGEST_SHIFT: Final = 0.3  # [s] between clocks that is looked for
Pairs = Sequence[tuple[Array, Array]]
"""Two vectors, (K, n) and (K, m), in each part of a log."""


def stride(period: float) -> int:
    """Samples from tick to tick."""
    return max(1, round(TICK / period))


def pairs_of(
    record: Record, parts: Sequence[slice], first: Callable[[slice], Array], second: Callable[[slice], Array]
) -> Pairs:
    """Two vectors in each part, one row per tick."""
    step = stride(record.period)
    pairs = []
    for part in parts:
        pairs.append((first(part)[::step], second(part)[::step]))
    return pairs


def shifts(period: float) -> list[int]:
    """Shifts between two clocks [ticks], 0 in the middle."""
    most = math.ceil(LONGEST_SHIFT / (stride(period) * period))
    return list(range(-most, most + 1))


def aligned(first: Array, second: Array, shift: int) -> tuple[Array, Array]:
    """Rows k of the first beside rows k + shift of the second."""
    size = len(first) - abs(shift)
    return first[max(-shift, 0) :][:size], second[max(shift, 0) :][:size]


def moments(pairs: Pairs, shift: int = 0) -> tuple[Array, Array, Array]:
    """Covariances (n, m), and variances (n,) and (m,), of all parts, the mean of each removed."""
    centred_first = []
    centred_second = []
    for first, second in pairs:
        a, b = aligned(first, second, shift)
        centred_first.append(a - a.mean(axis=0))
        centred_second.append(b - b.mean(axis=0))
    a = np.concatenate(centred_first)
    b = np.concatenate(centred_second)
    return a.T @ b, np.square(a).sum(axis=0), np.square(b).sum(axis=0)


def correlations(pairs: Pairs, shift: int = 0) -> Array:
    """Correlations (n, m) of the columns of both, all parts together."""
    covariance, first, second = moments(pairs, shift)
    scale = np.sqrt(np.maximum(np.outer(first, second), 1e-30))
    return np.asarray(covariance / scale)


def total_correlation(pairs: Pairs, shift: int = 0) -> float:
    """Correlation of two vectors, all axes and parts together."""
    covariance, first, second = moments(pairs, shift)
    scale = math.sqrt(max(float(first.sum() * second.sum()), 1e-30))
    return float(np.trace(covariance)) / scale
