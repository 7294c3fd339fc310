"""The filter between a course and the controller, Eq. (31), and the smoothing of rounded tables."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.linalg import solveh_banded

from quadsim.state import Array, read_only

_ORDER: Final = 4  # of the minimised differences: those that determine a torque, and so a rotor's speed
_WEIGHTS: Final = tuple(10.0**exponent for exponent in range(6, -3, -1))
"""Weights of smoothness that are tried, the largest first."""


def smooth(values: Array, *, initial: float, response_time: float, period: float) -> Array:
    """First-order filter F(x(k)) = x(k) + exp(-3 tau_s / tau_r) (F(x(k-1)) - x(k)) of values (M,).  Eq. (31).

    The paper prints x(k-1) on the right; a first-order lag needs the previous *filtered* value there, which before the
    first sample is `initial`.  The response time tau_r [s] is 95 % of a step; 0 for no filter.
    """
    if response_time == 0.0:
        return values.copy()
    decay = math.exp(-3.0 * period / response_time)
    filtered = np.empty_like(values)
    last = initial
    for k, value in enumerate(values):
        last = value + decay * (last - value)
        filtered[k] = last
    return filtered


def within_rounding(values: Array, resolution: float, breaks: NDArray[np.bool_]) -> Array:
    """Return the smoothest values that round to the samples y (M,) at a resolution; 0: not rounded.

    Whittaker-Henderson smoothing (Eilers 2003), min |z - y|^2 + w |D z|^2 with D the fourth differences, piece by
    piece, with the largest weight w of `_WEIGHTS` that leaves every value within the resolution of what it was.  Breaks
    (M - 1,) mark where a corner or a jump between a sample and the next stays.
    """
    smoothed = values.copy()
    if resolution == 0.0:
        return smoothed
    for piece in np.split(np.arange(values.size), np.flatnonzero(breaks) + 1):
        if piece.size > 2 * _ORDER:
            smoothed[piece] = _smoothest(values[piece], resolution)
    return smoothed


def _smoothest(values: Array, resolution: float) -> Array:
    """Return the smoothest values within the resolution of one piece (M,); the piece itself where no weight suits."""
    roughness = _roughness(values.size)
    identity = np.zeros_like(roughness)
    identity[-1] = 1.0
    for weight in _WEIGHTS:
        smoother: Array = solveh_banded(identity + weight * roughness, values)
        if np.abs(smoother - values).max() <= resolution:
            return smoother
    return values


@lru_cache(maxsize=16)
def _roughness(size: int) -> Array:
    """(5, size) the upper bands of D'D, the diagonal last, as scipy's solver takes them."""
    stencil = [(-1.0) ** k * math.comb(_ORDER, k) for k in range(_ORDER + 1)]
    differences = sparse.diags_array(stencil, offsets=range(_ORDER + 1), shape=(size - _ORDER, size))
    product = (differences.T @ differences).todia()
    bands = []
    for k in range(_ORDER, -1, -1):
        bands.append(np.pad(product.diagonal(k), (k, 0)))
    return read_only(np.stack(bands))
