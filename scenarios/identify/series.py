"""Samples of one quantity on their own clock."""

from __future__ import annotations

from dataclasses import dataclass

from quadsim.state import Array


@dataclass(frozen=True, kw_only=True)
class SampledSeries:
    """M samples of n numbers."""

    t: Array  # (M,) [s]
    values: Array  # (M, n), NaN where there is none
