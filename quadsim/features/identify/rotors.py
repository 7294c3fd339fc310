"""Rotor speeds from commands (a dead time, then a first-order lag, exact between held commands) or as measured."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.interpolate import make_smoothing_spline
from scipy.linalg import solve_banded

from quadsim.fields import FLOORS
from quadsim.state import Array, Indices
from quadsim.vehicle import N_ROTORS

_PASSES: Final = 12  # until every step knows whether its rotor speeds up
_ROUGHNESS: Final = 0.3  # of a smoothing spline per sample: what takes less than 5 samples is noise


@dataclass(frozen=True, kw_only=True)
class Turning:
    """Four rotors over the N - 1 periods between N samples."""

    speeds: Array  # (N, 4) at the samples [rad/s]
    mean: Array  # (N - 1, 4) of the speed in each period [rad/s]
    square: Array  # (N - 1, 4) mean of its square [rad^2/s^2]

    @property
    def change(self) -> Array:
        """(N - 1, 4) of the speed over each period [rad/s]."""
        return self.speeds[1:] - self.speeds[:-1]

    def during(self, periods: Indices) -> Turning:
        """The same in some periods alone, as if one followed the other."""
        change, speeds = self.change[periods], np.zeros((len(periods) + 1, N_ROTORS))
        np.cumsum(change, axis=0, out=speeds[1:])
        return Turning(speeds=speeds, mean=self.mean[periods], square=self.square[periods])


def lagging(commands: Array, period: float, *, rise: float, fall: float, delay: float) -> Turning:
    """Rotors that follow commands (N, 4) [rad/s], each held for a period [s] from `delay` [s] after its sample.

    Between two commands w(t) = c + (w_0 - c) exp(-t / tau), tau = `rise` where c > w_0 and `fall` elsewhere [s], 0 for
    at once.  They start at the first command.
    """
    rise = max(rise, FLOORS["s"])
    fall = max(fall, FLOORS["s"])
    n = len(commands)
    whole = int(np.floor(delay / period + 1e-9))
    late = delay - whole * period
    sent = np.arange(n - 1)[:, None] - whole + [-1, 0]  # which command is in force, before and after the new one comes
    held = np.repeat([[late, period - late]], n - 1, axis=0).ravel()
    pieces = 2 * (n - 1)
    at, mean, square = np.empty((n, N_ROTORS)), np.empty((n - 1, N_ROTORS)), np.empty((n - 1, N_ROTORS))
    for rotor in range(N_ROTORS):
        target = commands[np.clip(sent, 0, n - 1), rotor].ravel()
        rising = np.diff(target, prepend=target[0]) >= 0.0
        for _ in range(_PASSES):  # a speed never passes its command: the side that it starts from holds for the piece
            tau = np.where(rising, rise, fall)
            decay = np.exp(-held / tau)
            bands = np.ones((2, pieces + 1))
            bands[1, :-1] = -decay
            speed = solve_banded((1, 0), bands, np.append(commands[0, rotor], (1.0 - decay) * target))
            before, rising = rising, target >= speed[:-1]
            if np.array_equal(before, rising):
                break
        gap = speed[:-1] - target
        lost = gap * tau * (1.0 - decay)
        area = target * held + lost
        energy = target**2 * held + 2.0 * target * lost + 0.5 * gap**2 * tau * (1.0 - decay**2)
        at[:, rotor] = speed[::2]
        mean[:, rotor] = area.reshape(-1, 2).sum(axis=1) / period
        square[:, rotor] = energy.reshape(-1, 2).sum(axis=1) / period
    return Turning(speeds=at, mean=mean, square=square)


def measured(speeds: Array, period: float, *, delay: float) -> Turning:
    """Rotors whose speeds (N, 4) [rad/s] were logged `delay` [s] after they were turning so; linear in between."""
    n = len(speeds)
    when = np.arange(n) + delay / period
    at = np.stack([np.interp(when, np.arange(n), column) for column in speeds.T], axis=1)
    before, after = at[:-1], at[1:]
    square = (before**2 + before * after + after**2) / 3.0
    return Turning(speeds=at, mean=0.5 * (before + after), square=square)


def smoothed(speeds: Array) -> Array:
    """Measured speeds (N, 4) [rad/s] without their noise, which would make torques look larger than they are."""
    when = np.arange(len(speeds), dtype=float)
    return np.stack([make_smoothing_spline(when, column, lam=_ROUGHNESS)(when) for column in speeds.T], axis=1)
