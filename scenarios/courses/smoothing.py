"""The filter between a course and the controller.  Eq. (31)."""

from __future__ import annotations

import math

import numpy as np

from quadsim.state import Array


def smooth(values: Array, *, initial: float, response_time: float, period: float) -> Array:
    """First-order filter F(x(k)) = x(k) + exp(-3 tau_s / tau_r) (F(x(k-1)) - x(k)).  Eq. (31).

    The paper prints x(k-1) on the right; a first-order lag needs the previous *filtered* value there.

    Args:
        values: (M,) the unfiltered reference.
        initial: filtered value before the first sample; the paper's flights start from the initial position.
        response_time: tau_r [s], 95 % of a step; 0 for no filter.
        period: tau_s [s].
    """
    if response_time == 0.0:
        return values.copy()
    keep = math.exp(-3.0 * period / response_time)
    filtered = np.empty_like(values)
    last = initial
    for k, value in enumerate(values):
        last = value + keep * (last - value)
        filtered[k] = last
    return filtered
