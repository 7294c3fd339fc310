"""Rotor speeds from their commands: a dead time, then a first-order lag, exact between held commands."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.linalg import solve_banded
from scipy.optimize import least_squares

from quadsim.state import Array
from quadsim.vehicle import N_ROTORS

_PASSES: Final = 12  # until every step knows whether its rotor speeds up


@dataclass(frozen=True, kw_only=True)
class Turning:
    """Four rotors over the N - 1 periods between N samples."""

    speeds: Array  # (N, 4) at the samples [rad/s]
    mean: Array  # (N - 1, 4) of the speed in each period [rad/s]
    square: Array  # (N - 1, 4) mean of its square [rad^2/s^2]


def lagging(commands: Array, period: float, *, rise: float, fall: float, delay: float) -> Turning:
    """Rotors that follow commands (N, 4) [rad/s], each held for a period [s] from `delay` [s] after its sample.

    Between two commands w(t) = c + (w_0 - c) exp(-t / tau), tau = `rise` where c > w_0 and `fall` elsewhere [s].  They
    start at the first command.
    """
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
    """Rotors whose speeds (N, 4) [rad/s] were measured `delay` [s] after their sample's time; linear in between."""
    n = len(speeds)
    when = np.arange(n) - delay / period
    at = np.stack([np.interp(when, np.arange(n), column) for column in speeds.T], axis=1)
    before, after = at[:-1], at[1:]
    return Turning(speeds=at, mean=0.5 * (before + after), square=(before**2 + before * after + after**2) / 3.0)


def lag_of(commands: Array, speeds: Array, period: float) -> tuple[Array, Array]:
    """Logarithms of rise and fall [s] and the delay [ms] of speeds (N, 4) that follow commands, and their slopes.

    The second are the rows (N, 3) by which a sample pulls at the three, in standard deviations of their sum.
    """
    skip = len(speeds) // 20

    def misfit(x: Array) -> Array:
        rise, fall = np.exp(x[:2])
        turning = lagging(commands, period, rise=float(rise), fall=float(fall), delay=1e-3 * float(x[2]))
        return (turning.speeds - speeds)[skip:].ravel()

    found = least_squares(
        misfit, [np.log(0.03), np.log(0.03), 0.0], x_scale=[0.1, 0.1, 1.0], diff_step=1e-4, loss="huber"
    )
    J = found.jac
    pulls = -(J * misfit(found.x)[:, None]) @ np.linalg.inv(J.T @ J)
    return found.x, pulls.reshape(-1, N_ROTORS, 3).sum(axis=1)
