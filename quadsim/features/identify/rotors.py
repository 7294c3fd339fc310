"""Rotor speeds over a log, as they follow the commands or as they were measured: what the model's forces depend on.

A command c is held for a period and comes a dead time late.  The speed then follows it with a first-order lag, exact
within each piece: w(t) = c + (w_0 - c) exp(-t / tau), tau = rise where c > w_0 and fall elsewhere.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.interpolate import make_smoothing_spline
from scipy.linalg.lapack import dtbtrs

from quadsim.features.identify.series import interpolated
from quadsim.fields import FLOORS
from quadsim.state import Array, Indices
from quadsim.vehicle import N_ROTORS, Vehicle

_TYPICAL_LAG: Final = 0.03  # [s] of small rotors: where a search starts if the start file has none
_MAX_PASSES: Final = 12  # until every piece knows whether its rotor speeds up
_ROUGHNESS: Final = 0.3  # of a smoothing spline per sample: what takes less than 5 samples is noise


@dataclass(frozen=True, kw_only=True)
class RotorMotion:
    """Four rotors over the N - 1 periods between N samples."""

    speeds: Array  # (N, 4) at the samples [rad/s]
    mean: Array  # (N - 1, 4) of the speed in each period [rad/s]
    square: Array  # (N - 1, 4) mean of its square [rad^2/s^2]

    @property
    def change(self) -> Array:
        """(N - 1, 4) of the speed over each period [rad/s]."""
        return self.speeds[1:] - self.speeds[:-1]

    def during(self, periods: Indices) -> RotorMotion:
        """The same in some periods alone, as if one followed the other."""
        change = self.change[periods]
        speeds = np.zeros((len(periods) + 1, N_ROTORS))
        np.cumsum(change, axis=0, out=speeds[1:])
        return RotorMotion(speeds=speeds, mean=self.mean[periods], square=self.square[periods])


def start_lag(vehicle: Vehicle) -> float:
    """The rotors' time constant by the start [s], or a typical one."""
    return vehicle.rotor_rise or vehicle.rotor_fall or _TYPICAL_LAG


def lagged_rotors(commands: Array, period: float, *, rise: float, fall: float, delay: float) -> RotorMotion:
    """Rotors that follow commands (N, 4) [rad/s], each held for a period [s] from `delay` [s] after its sample.

    A time constant of 0 is for at once.  They start at the first command.
    """
    rise = max(rise, FLOORS["s"])
    fall = max(fall, FLOORS["s"])
    targets, held = _pieces(commands, period, delay)
    pieces = len(held)
    rising = np.diff(targets, prepend=targets[:, :1]) >= 0.0
    fall_decay, rise_decay = np.exp(-np.outer([1.0 / fall, 1.0 / rise], held))
    # Of all rotors one lower triangular system, one after the other: w_{i+1} - decay_i w_i = (1 - decay_i) target_i.
    bands = np.zeros((2, N_ROTORS, pieces + 1))
    bands[0] = 1.0
    sides = np.empty((N_ROTORS, pieces + 1))
    sides[:, 0] = commands[0]
    for _ in range(_MAX_PASSES):  # a speed never passes its command: the side that it starts from holds for the piece
        decay = np.where(rising, rise_decay, fall_decay)
        bands[1, :, :-1] = -decay
        sides[:, 1:] = (1.0 - decay) * targets
        solution, _ = dtbtrs(bands.reshape(2, -1), sides.reshape(-1, 1), uplo="L")
        speeds = solution.reshape(N_ROTORS, pieces + 1)
        before = rising
        rising = targets >= speeds[:, :-1]
        if np.array_equal(before, rising):
            break
    tau = np.where(before, rise, fall)
    gap = speeds[:, :-1] - targets
    lost = gap * tau * (1.0 - decay)
    area = targets * held + lost  # integral of the speed over each piece, and of its square
    energy = targets**2 * held + 2.0 * targets * lost + 0.5 * gap**2 * tau * (1.0 - decay**2)
    return RotorMotion(
        speeds=np.ascontiguousarray(speeds[:, ::2].T),
        mean=(area[:, ::2] + area[:, 1::2]).T / period,
        square=(energy[:, ::2] + energy[:, 1::2]).T / period,
    )


def _pieces(commands: Array, period: float, delay: float) -> tuple[Array, Array]:
    """Commands (4, P) in force in each half of N - 1 periods, before and after the new one comes, and how long (P,)."""
    n = len(commands)
    whole = int(np.floor(delay / period + 1e-9))
    late = delay - whole * period
    sent = np.arange(n - 1)[:, None] - whole + [-1, 0]
    held = np.tile([late, period - late], n - 1)
    rows = commands[np.clip(sent, 0, n - 1)]
    return rows.reshape(len(held), N_ROTORS).T, held


def measured_rotors(speeds: Array, period: float, *, delay: float) -> RotorMotion:
    """Rotors whose speeds (N, 4) [rad/s] were logged `delay` [s] after they were turning so; linear in between."""
    samples = np.arange(len(speeds))
    at_samples = interpolated(samples + delay / period, samples, speeds)
    before = at_samples[:-1]
    after = at_samples[1:]
    square = (before**2 + before * after + after**2) / 3.0
    return RotorMotion(speeds=at_samples, mean=0.5 * (before + after), square=square)


def smoothed_speeds(speeds: Array) -> Array:
    """Measured speeds (N, 4) [rad/s] without their noise, which would make torques look larger than they are."""
    samples = np.arange(len(speeds), dtype=float)
    columns = []
    for column in speeds.T:
        spline = make_smoothing_spline(samples, column, lam=_ROUGHNESS)
        columns.append(spline(samples))
    return np.stack(columns, axis=1)
