"""Clocks of a log: attitude, rates and velocity of one motion must tell one time."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final

import numpy as np

from quadsim.errors import InputError
from quadsim.features.identify.axes import lateral_motion, tilt_fit, turning_pairs
from quadsim.features.identify.correlation import likeness, shifts, stride
from quadsim.features.identify.record import Record
from quadsim.state import Array
from quadsim.vehicle import Vehicle

REFUSED_SHIFT: Final = {"rates are": 0.015, "velocity is": 0.05}
"""Shift [s] that is refused: drag and yaw reaction would be wrong, and their intervals with them."""
SHOWN: Final = 5e-3  # [s] of shift


def check_clocks(record: Record, parts: Sequence[slice], vehicle: Vehicle) -> Iterator[str]:
    """Notes on shifts between the clocks of attitude, rates and velocity, where the motion shows them clearly.

    Raises:
        InputError: a shift is above `REFUSED_SHIFT`.
    """
    ticks = shifts(record.period)
    tick = stride(record.period) * record.period
    turns = turning_pairs(record, parts)
    like = np.array([likeness(turns, shift) for shift in ticks])
    if like.max() > 0.7:
        yield from _note(record.name, "rates are", _peak(like) * tick)
    lateral = lateral_motion(record, parts)
    unlike = 1.0 - np.array([tilt_fit(lateral, shift=shift)[0] for shift in ticks])
    now = unlike[len(ticks) // 2]
    least = unlike.min()
    if least < 0.7 and now > 1.3 * least and now > least + 4e-3:
        yield from _note(record.name, "velocity is", _peak(-unlike) * tick)


def _note(name: str, late: str, shift: float) -> Iterator[str]:
    if abs(shift) < SHOWN:
        return
    text = f"{name}: the {late} {1e3 * abs(shift):.0f} ms {'late' if shift > 0.0 else 'early'} against the attitude"
    if abs(shift) > REFUSED_SHIFT[late]:
        raise InputError(
            f"{text}; at most {1e3 * REFUSED_SHIFT[late]:.0f} ms are allowed: shift the columns onto one clock"
        )
    yield f"{text}; shift its columns onto one clock for better estimates"


def _peak(values: Array) -> float:
    """Where the parabola through the largest value and its neighbours peaks, from the middle [ticks]."""
    top = int(np.clip(np.argmax(values), 1, len(values) - 2))
    before, at, after = values[top - 1 : top + 2]
    bend = before - 2.0 * at + after
    return float(top - len(values) // 2 + (0.5 * (before - after) / bend if bend < 0.0 else 0.0))
