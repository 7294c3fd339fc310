"""Clocks of a log: attitude, rates and velocity of one motion must share one.

The shift of the rates is where their correlation with the turning attitude peaks; that of the velocity, where tilt and
thrust explain its change best.  One of the checks before any fit: a shift would be taken for drag and rotor inertia.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final

import numpy as np

from quadsim.errors import InputError
from quadsim.features.identify.axes import lateral_motion, tilt_fit, turning_pairs
from quadsim.features.identify.correlation import shifts, stride, total_correlation
from quadsim.features.identify.record import Record
from quadsim.state import Array
from quadsim.vehicle import Vehicle

REFUSED_SHIFT: Final = {"rates are": 0.015, "velocity is": 0.05}
"""Shift [s] that is refused: drag and yaw reaction would be wrong, and their intervals with them."""
NOTED_SHIFT: Final = 5e-3  # [s]
# The rates' shift counts only where they follow the attitude at all.
LEAST_SIMILARITY: Final = 0.7
# Of the velocity's change, tilt and thrust must leave less than this share unexplained at the best shift,
MOST_UNEXPLAINED: Final = 0.7
# and without a shift, more by this factor and this share: below, the peak is noise.
UNEXPLAINED_RATIO: Final = 1.3
UNEXPLAINED_EXCESS: Final = 4e-3


def check_clocks(record: Record, parts: Sequence[slice], vehicle: Vehicle) -> Iterator[str]:
    """Notes on shifts between the clocks of attitude, rates and velocity, where the motion shows them clearly.

    Raises:
        InputError: a shift is above `REFUSED_SHIFT`.
    """
    ticks = shifts(record.period)
    tick = stride(record.period) * record.period
    turns = turning_pairs(record, parts)
    correlation = np.array([total_correlation(turns, shift) for shift in ticks])
    if correlation.max() > LEAST_SIMILARITY:
        yield from _note(record.name, "rates are", _peak(correlation) * tick)
    motion = lateral_motion(record, parts)
    explained = np.array([tilt_fit(motion, shift=shift)[0] for shift in ticks])
    unexplained = 1.0 - explained
    unshifted = unexplained[len(ticks) // 2]
    least = unexplained.min()
    is_clear = unshifted > UNEXPLAINED_RATIO * least and unshifted > least + UNEXPLAINED_EXCESS
    if least < MOST_UNEXPLAINED and is_clear:
        yield from _note(record.name, "velocity is", _peak(-unexplained) * tick)


def _note(name: str, signal: str, shift: float) -> Iterator[str]:
    if abs(shift) < NOTED_SHIFT:
        return
    if shift > 0.0:
        direction = "late"
    else:
        direction = "early"
    text = f"{name}: the {signal} {1e3 * abs(shift):.0f} ms {direction} against the attitude"
    if abs(shift) > REFUSED_SHIFT[signal]:
        raise InputError(
            f"{text}; at most {1e3 * REFUSED_SHIFT[signal]:.0f} ms are allowed: shift the columns onto one clock"
        )
    yield f"{text}; shift its columns onto one clock for better estimates"


def _peak(values: Array) -> float:
    """Where the parabola through the largest value and its neighbours peaks, from the middle [ticks]."""
    top = int(np.clip(np.argmax(values), 1, len(values) - 2))
    before, at, after = values[top - 1 : top + 2]
    curvature = before - 2.0 * at + after
    beside = 0.0
    if curvature < 0.0:
        beside = 0.5 * (before - after) / curvature
    return float(top - len(values) // 2 + beside)
