"""Which rotor is which: does another order or layout of the rotors explain the angular acceleration better?

Roll and pitch acceleration are fitted, block by block, as gain * sum of arm_i w_i^2 with the arms of every order of the
rotors, in plus and in X layout.  One of the checks before any fit, which relies on those of axes, scales and clocks.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import permutations
from typing import Final, NamedTuple

import numpy as np
from scipy.signal import lfilter

from quadsim.errors import InputError
from quadsim.features.identify.record import Record, rotor_inputs
from quadsim.features.identify.windows import mean_over_window, rate_over_window
from quadsim.state import Array
from quadsim.vehicle import N_ROTORS, Vehicle

ACCELERATION_WINDOW: Final = 0.02  # [s] of an angular acceleration
LAGS: Final = (0.0, 0.015, 0.03, 0.06, 0.1)  # [s] of rotors that are tried
BLOCK: Final = 1.0  # length [s] of the blocks in which orders are compared
AGREEING: Final = 0.8  # share of blocks that another order must explain better
INFERIOR: Final = 0.85  # of what the best order explains, at most, by the one given
EXPLAINED: Final = 0.1  # least share of roll and pitch acceleration that an order must explain to count
YAW_EXPLAINED: Final = 0.05  # the same of yaw, by reversed spins


class Moments(NamedTuple):
    """Second moments in each of K blocks: squared rotor speeds x (4,), angular acceleration a (3,)."""

    xx: Array  # (K, 4, 4)
    xa: Array  # (K, 4, 3)
    aa: Array  # (K, 3)


def check_rotor_order(record: Record, parts: Sequence[slice], vehicle: Vehicle) -> None:
    """Refuse rotors whose order, layout or spins another far better one explains.

    Roll and pitch decide on order and layout: a loop's yaw command mostly answers disturbances.

    Raises:
        InputError: naming the order, azimuths or spins to try.
    """
    if record.speeds is None:
        blocks = [_moments(record, parts, lag) for lag in LAGS]
    else:
        blocks = [_moments(record, parts, 0.0)]
    as_given = _explained_at_best_lag(blocks, _arms(vehicle, 0.0))
    best = _best_arrangement(blocks, vehicle, as_given)
    share = best.explained.mean()
    share_as_given = as_given.mean()
    is_far_better = share > EXPLAINED and share_as_given < INFERIOR * share
    if is_far_better and (best.explained > as_given).mean() >= AGREEING:
        if best.turn:
            advice = _layout_advice(best.order, vehicle)
        else:
            advice = _order_advice(best.order, vehicle, record)
        raise InputError(
            f"{record.name}: {advice}, which explains {100.0 * share:.0f} % of the roll and pitch acceleration "
            f"(as given: {100.0 * share_as_given:.0f} %)"
        )
    _check_spins(record.name, blocks, vehicle)


class _Arrangement(NamedTuple):
    """An order and a layout of the rotors."""

    order: tuple[int, ...]  # the logged rotor at each place of the vehicle's
    turn: float  # of the layout [rad]
    explained: Array  # (K,) share of roll and pitch acceleration in each block


def _best_arrangement(blocks: Sequence[Moments], vehicle: Vehicle, as_given: Array) -> _Arrangement:
    """The order and layout that explain most; those given, which explain `as_given` (K,), if none explains more."""
    best = _Arrangement(tuple(range(N_ROTORS)), 0.0, as_given)
    for turn in (0.0, math.pi / 4.0):
        turned_arms = _arms(vehicle, turn)
        for order in permutations(range(N_ROTORS)):
            arms = np.empty((2, N_ROTORS))
            arms[:, order] = turned_arms
            explained = _explained_at_best_lag(blocks, arms)
            if explained.mean() > best.explained.mean() + 1e-9:
                best = _Arrangement(order, turn, explained)
    return best


def explained_at_lag(record: Record, parts: Sequence[slice], vehicle: Vehicle, lag: float) -> Array:
    """Share (K,) of roll and pitch acceleration that rotors as given explain in each block, behind a lag [s]."""
    return _explained(_moments(record, parts, lag), _arms(vehicle, 0.0))


def _arms(vehicle: Vehicle, turn: float) -> Array:
    """Arms (2, 4) of the rotors' thrusts about body x and y, over the longest, with the layout turned [rad]."""
    x, y, _ = vehicle.hubs.T / vehicle.longest_arm
    turned_x = x * math.cos(turn) - y * math.sin(turn)
    turned_y = x * math.sin(turn) + y * math.cos(turn)
    return np.stack([turned_y, -turned_x])


def _moments(record: Record, parts: Sequence[slice], lag: float) -> Moments:
    """Moments of the blocks of all parts, the mean of each block removed, the commands behind a lag [s]."""
    period = record.period
    size = max(round(BLOCK / record.period), 8)
    speeds = []
    accelerations = []
    for part in parts:
        inputs = rotor_inputs(record)[part]
        if lag:
            pole = math.exp(-period / lag)
            before = np.concatenate([inputs[:1], inputs[:-1]])  # a command moves the rotors after its sample
            inputs = lfilter([1.0 - pole], [1.0, -pole], before, axis=0, zi=pole * inputs[:1])[0]
        whole = len(inputs) // size * size
        squares = mean_over_window(np.square(inputs), period, ACCELERATION_WINDOW)[:whole]
        rates = rate_over_window(record.rates[part], period, ACCELERATION_WINDOW)[:whole]
        speeds.append(squares.reshape(-1, size, N_ROTORS))
        accelerations.append(rates.reshape(-1, size, 3))
    x = np.concatenate(speeds)
    a = np.concatenate(accelerations)
    x = x - x.mean(axis=1, keepdims=True)
    a = a - a.mean(axis=1, keepdims=True)
    return Moments(xx=x.transpose(0, 2, 1) @ x, xa=x.transpose(0, 2, 1) @ a, aa=np.square(a).sum(axis=1))


def _explained_at_best_lag(blocks: Sequence[Moments], arms: Array) -> Array:
    """Share (K,) of roll and pitch acceleration that arms (2, 4) explain in each block, at the best lag."""
    by_lag = [_explained(of_lag, arms) for of_lag in blocks]
    return max(by_lag, key=lambda shares: float(shares.mean()))


def _explained(blocks: Moments, arms: Array) -> Array:
    """The same at one lag, with one positive gain per axis for all blocks.

    With the torque m = sum of arm_i w_i^2 and the gain g of least squares, it is (2 g m a - g^2 m^2) / a^2.
    """
    along = np.einsum("ij,kji->ki", arms, blocks.xa[:, :, :2])
    power = np.einsum("ij,kjl,il->ki", arms, blocks.xx, arms)
    gain = np.maximum(along.sum(axis=0) / np.maximum(power.sum(axis=0), 1e-30), 0.0)
    total = np.maximum(blocks.aa[:, :2].mean(axis=0), 1e-30)
    return np.asarray(((2.0 * gain * along - gain**2 * power) / total).mean(axis=1))


def _layout_advice(order: Sequence[int], vehicle: Vehicle) -> str:
    """The azimuths to try, of arms that are turned by 45 deg."""
    azimuths = [0.0] * N_ROTORS
    for place, i in enumerate(order):
        azimuths[i] = (math.degrees(vehicle.azimuths[place]) + 45.0 + 180.0) % 360.0 - 180.0
    listed = ", ".join(f"{azimuth:g}" for azimuth in azimuths)
    return f"the arms are 45 deg off: try rotor_azimuths = [{listed}]"


def _order_advice(order: Sequence[int], vehicle: Vehicle, record: Record) -> str:
    """The order of columns to try."""
    if record.speeds is not None:
        column = "w"
    elif record.commands is not None:
        column = "u"
    else:
        column = "throttle"
    moved = [i + 1 for i in range(N_ROTORS) if order[i] != i]
    if len(moved) == 2:
        fault = f"rotors {moved[0]} and {moved[1]} are swapped"
    else:
        fault = "the rotors are in another order"
    columns = ",".join(f"{column}{i + 1}" for i in order)
    advice = f"{fault}: try the order {columns}"
    if np.allclose(vehicle.hubs[list(order)], vehicle.hubs * [-1.0, 1.0, 1.0]):
        advice += " (or body axes are x forward, y right, z down)"
    return advice


def _check_spins(name: str, blocks: Sequence[Moments], vehicle: Vehicle) -> None:
    """Refuse spins of which all are reversed."""
    spins = np.array(vehicle.rotor_spins, float)
    fits = []
    for xx, xa, aa in blocks:
        along = xa[:, :, 2] @ spins
        power = float((xx @ spins @ spins).sum())
        gain = float(along.sum()) / max(power, 1e-30)
        explained = gain * float(along.sum()) / max(float(aa[:, 2].sum()), 1e-30)
        fits.append((explained, gain, (along < 0.0).mean()))
    explained, gain, against = max(fits)
    if gain < 0.0 and explained > YAW_EXPLAINED and against >= AGREEING:
        reversed_spins = [-int(spin) for spin in spins]
        raise InputError(
            f"{name}: the yaw acceleration is against the rotors' torque: try rotor_spins = {reversed_spins}, which "
            f"explains {100.0 * explained:.0f} % of it, or negate wz if it is logged clockwise"
        )
