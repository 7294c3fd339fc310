"""The loop that a tuning makes, without bounds: its poles, and the delay that it stands."""

from __future__ import annotations

from typing import Final

import numpy as np
import scipy.linalg

from mpc.model import continuous_model, discretise
from quadsim.state import INDEX, Array
from quadsim.vehicle import N_ROTORS, Vehicle
from scenarios.design.tuning import Tuning

LONGEST: Final = 2.0  # delays beyond are not looked for [s]
_HALVINGS: Final = 14


def gain(vehicle: Vehicle, tuning: Tuning) -> Array:
    """K (4, n + 4) of u = -K [x; u(k-1)], deviations from hover: the weights' optimum over an infinite horizon.

    Changes of inputs are part of the cost, so the last input is a state; n is 12, or 16 with rotors that lag.
    """
    A, B = discretise(*continuous_model(vehicle, vehicle.rotor_rise or 0.0), tuning.period)
    n = len(A)
    Q = np.zeros((n, n))
    place, height, heading = tuning.weights
    for name, weight in (("x", place), ("y", place), ("z", height), ("yaw", heading)):
        Q[INDEX[name], INDEX[name]] = weight
    D, R = tuning.move_weight * np.eye(N_ROTORS), tuning.speed_weight * np.eye(N_ROTORS)
    A = scipy.linalg.block_diag(A, np.zeros((N_ROTORS, N_ROTORS)))
    B = np.vstack([B, np.eye(N_ROTORS)])
    cross = np.vstack([np.zeros((n, N_ROTORS)), -D])
    P = scipy.linalg.solve_discrete_are(A, B, scipy.linalg.block_diag(Q, D), R + D, s=cross)
    return np.asarray(np.linalg.solve(R + D + B.T @ P @ B, B.T @ P @ A + cross.T))


def is_stable(vehicle: Vehicle, tuning: Tuning, K: Array, delay: float) -> bool:
    """Whether the loop of a gain is stable where commands act some time [s] later than it knows of."""
    A_c, B_c = continuous_model(vehicle, vehicle.rotor_rise or 0.0)
    n, period = len(A_c), tuning.period
    whole = int(delay / period + 1e-9)
    late = max(delay - whole * period, 0.0)
    A, _ = discretise(A_c, B_c, period)
    rest, newer = discretise(A_c, B_c, period - late)
    older = rest @ discretise(A_c, B_c, late)[1]
    # States: x, u(k-1) .. u(k-whole-1); u(k-whole-1) acts until `late`, then u(k-whole).
    size = n + N_ROTORS * (whole + 1)
    closed, entry = np.zeros((size, size)), np.zeros((size, N_ROTORS))
    closed[:n, :n] = A
    closed[:n, size - N_ROTORS :] = older
    if whole == 0:
        entry[:n] = newer
    else:
        closed[:n, size - 2 * N_ROTORS : size - N_ROTORS] += newer
    entry[n : n + N_ROTORS] = np.eye(N_ROTORS)
    closed[n + N_ROTORS :, n : size - N_ROTORS] = np.eye(N_ROTORS * whole)
    closed[:, : n + N_ROTORS] -= entry @ K
    return float(np.abs(np.linalg.eigvals(closed)).max()) < 1.0


def delay_margin(vehicle: Vehicle, tuning: Tuning) -> float:
    """Shortest delay [s] beyond what the model knows of at which the loop is no longer stable, to a thousandth."""
    K = gain(vehicle, tuning)
    low, high = 0.0, 1e-3
    while high < LONGEST and is_stable(vehicle, tuning, K, high):
        low, high = high, 1.5 * high
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if is_stable(vehicle, tuning, K, middle) else (low, middle)
    return low
