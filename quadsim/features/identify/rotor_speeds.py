"""Measured rotor speeds beside their commands, the motion, and each other: a wrong scale, or commands in their place.

In the mean over a flight the torques balance: sum spin_i b_i w_i^2 = 0, sum r_i b_i w_i^2 = r_c sum b_i w_i^2, r_c the
centre of mass.  Three of the checks before any fit.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Final

import numpy as np
from scipy.signal import filtfilt

from quadsim.errors import InputError
from quadsim.features.identify.model import Parameters, demanded_speeds
from quadsim.features.identify.record import Record, in_parts
from quadsim.features.identify.rotor_order import AGREEING, EXPLAINED, LAGS, explained_at_lag
from quadsim.state import Array
from quadsim.vehicle import Vehicle

NOTED_RATIO: Final = 1.07  # of a rotor's speed over its command to that of the others
REFUSED_RATIO: Final = 1.15
REFUSED_SCALE: Final = 1.1  # by which one rotor's speeds alone, were they wrong, balance the torques
CENTRE_LEFT: Final = 0.35  # of the centre's distance that is left where they do
LAGGING_BETTER: Final = 1.2  # what speeds leave unexplained, over what they leave behind a rotor's lag
SMOOTHING: Final = (0.0, 0.005, 0.01, 0.015, 0.03, 0.06)  # [s] of a filter without lag, which takes noise away too


def check_against_commands(record: Record, parts: Sequence[slice], vehicle: Vehicle) -> Iterator[str]:
    """Compare each rotor's measured speed with its command, relative to the other rotors.

    Raises:
        InputError: one turns at another speed than the others do at such a command.
    """
    if record.commands is None and record.throttle is None:
        return
    if record.voltage is None:
        voltage = 0.0
    else:
        voltage = float(np.nanmean(record.voltage))
    commands = demanded_speeds(record, vehicle, Parameters.of(vehicle, voltage=voltage))
    speeds = in_parts(np.asarray(record.speeds), parts)
    targets = in_parts(commands, parts)
    if np.allclose(speeds, targets * (speeds.mean() / targets.mean()), rtol=1e-6):
        raise InputError(f"{record.name}: the measured speeds are the commands: leave them out")
    ratios = np.median(speeds, axis=0) / np.maximum(np.median(targets, axis=0), 1e-9)
    rotor, ratio = _outlier(ratios)
    if ratio < 1.0 / NOTED_RATIO or ratio > NOTED_RATIO:
        what = f"{record.name}: rotor {rotor + 1} turns {ratio:.3g} times as fast as the others do at its command"
        if ratio < 1.0 / REFUSED_RATIO or ratio > REFUSED_RATIO:
            raise InputError(f"{what}; at most {REFUSED_RATIO:g} is allowed: correct its measured speed or its command")
        yield f"{what}: look for a wrong scale, or another propeller"


def _outlier(ratios: Array) -> tuple[int, float]:
    """The rotor whose ratio is farthest from the median of the others', and by which factor."""
    of_others = [np.median(np.delete(ratios, i)) for i in range(len(ratios))]
    factors = ratios / np.array(of_others)
    distances = np.abs(np.log(np.maximum(factors, 1e-9)))
    rotor = int(np.argmax(distances))
    return rotor, float(factors[rotor])


def check_against_each_other(record: Record, parts: Sequence[slice], vehicle: Vehicle) -> None:
    """Find a rotor whose speeds, were they scaled, would balance the mean yaw torque and the tilting ones at once.

    Sum spin_j b_j w_j^2 = 0 gives the scale; the centre of mass, sum r_j b_j w_j^2 / sum b_j w_j^2, shows which rotor
    it is.

    Raises:
        InputError: there is one.
    """
    squares = np.square(in_parts(np.asarray(record.speeds), parts)).mean(axis=0)
    thrusts = squares * (vehicle.hover_speeds.mean() / vehicle.hover_speeds) ** 2
    spins = np.array(vehicle.rotor_spins, float)
    arms = vehicle.hubs[:, :2] / vehicle.longest_arm

    def centre_distance(thrusts: Array) -> float:
        return float(np.linalg.norm(arms.T @ thrusts) / thrusts.sum())

    scales = np.ones(len(spins))
    distances = np.full(len(spins), np.inf)
    for i, spin in enumerate(spins):
        others = spins * thrusts
        others[i] = 0.0
        balancing = -float(others.sum()) / spin  # the thrust of rotor i that balances the yaw torque
        if balancing > 0.0:
            scales[i] = math.sqrt(thrusts[i] / balancing)
            balanced = thrusts.copy()
            balanced[i] = balancing
            distances[i] = centre_distance(balanced)
    i = int(np.argmin(distances))
    factor = max(scales[i], 1.0 / scales[i])
    if factor > REFUSED_SCALE and distances[i] < CENTRE_LEFT * centre_distance(thrusts):
        raise InputError(
            f"{record.name}: the measured speed of rotor {i + 1} is {scales[i]:.3g} times what balances the torques of "
            "the others about all three axes: correct its scale, or give each rotor its own thrust_coefficient"
        )


def check_not_commands(record: Record, parts: Sequence[slice], vehicle: Vehicle) -> None:
    """Distinguish measured speeds from commands: the vehicle turns as they are, not as they were a rotor's lag ago.

    A lag removes noise too, so the speeds without lag are also tried through filters without phase shift.

    Raises:
        InputError: behind a lag they explain roll and pitch far better.
    """
    behind_lags = [explained_at_lag(record, parts, vehicle, lag) for lag in LAGS[1:]]
    without_lag = []
    for tau in SMOOTHING:
        without_lag.append(explained_at_lag(_filtered(record, parts, tau), parts, vehicle, 0.0))
    best, behind = _best_explained(behind_lags)
    _, beside = _best_explained(without_lag)
    gain = (1.0 - beside.mean()) / max(1.0 - behind.mean(), 1e-9)
    agreeing = (behind > beside).mean()
    if behind.mean() > EXPLAINED and gain > LAGGING_BETTER and agreeing >= AGREEING - 0.05:
        raise InputError(
            f"{record.name}: the vehicle turns as its measured speeds were {1e3 * LAGS[1 + best]:.0f} ms ago, as it "
            f"does behind commands ({behind.mean():.0%} of roll and pitch explained, {beside.mean():.0%} without): "
            "name them commands, u1..u4"
        )


def _best_explained(shares: Sequence[Array]) -> tuple[int, Array]:
    """The shares that are the largest in the mean, and their place."""
    best = int(np.argmax([of_blocks.mean() for of_blocks in shares]))
    return best, shares[best]


def _filtered(record: Record, parts: Sequence[slice], tau: float) -> Record:
    """The record with its speeds through a first-order filter of a time constant [s], forward and backward."""
    speeds = np.asarray(record.speeds).copy()
    pole = math.exp(-record.period / tau) if tau else 0.0
    for part in parts:
        speeds[part] = filtfilt([1.0 - pole], [1.0, -pole], speeds[part], axis=0)
    return replace(record, speeds=speeds)
