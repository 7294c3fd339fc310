"""What an accelerometer and a gyro give where a log has no velocity or attitude, or has them rarely.

The specific force f is dv/dt - g in body axes, so v is the integral of R f + g, but for its drift; and the attitude is
the integral of the gyro, levelled by the mean of f.  `record` takes these in place of what is not logged.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from scipy.ndimage import uniform_filter1d

from quadsim.errors import InputError
from quadsim.features.identify.windows import to_world
from quadsim.rotation import euler_to_quaternion, exponential, multiply, normalise
from quadsim.state import Array

_GRAVITY: Final = 9.81  # [m/s^2] of what an accelerometer shows at rest
_LOAD_TOLERANCE: Final = 0.07  # by which the mean force may differ from the weight
_MISTAKEN_FORCES: Final = ((1.0 / _GRAVITY, "in g"), (-1.0, "z points down"), (-1.0 / _GRAVITY, "in g, z points down"))
"""Mean force over the weight, and its usual causes."""
_FIRST_LEVELLING: Final = 1.0  # [s] whose mean force levels the first attitude
_LEVELLING: Final = 20.0  # time constant [s] by which the mean force levels all others


def integrated_velocity(name: str, force: Array, attitude: Array, period: float) -> Array:
    """Velocity (N, 3), but for its drift, by specific force (N, 3), body, and attitude (N, 4); NaN in gaps.

    Raises:
        InputError: the mean force does not carry the weight.
    """
    world = to_world(attitude, force)
    there = np.asarray(np.isfinite(world).all(axis=1))
    if not there.any():
        return world
    load = float(np.mean(world[there, 2])) / _GRAVITY
    if not 1.0 / (1.0 + _LOAD_TOLERANCE) < load < 1.0 + _LOAD_TOLERANCE:
        raise InputError(
            f"{name}: ax, ay, az carry {load:.3g} times the weight in the mean, 1 within {_LOAD_TOLERANCE:.0%} is "
            f"allowed: likely {_likely(load)}; give the specific force in m/s^2, x forward, y left, z up"
        )
    acceleration = np.where(there[:, None], world - [0.0, 0.0, _GRAVITY], 0.0)
    acceleration -= acceleration[there].mean(axis=0)
    steps = np.zeros_like(acceleration)
    steps[1:] = 0.5 * period * (acceleration[1:] + acceleration[:-1])
    return np.where(there[:, None], np.cumsum(steps, axis=0), np.nan)


def _likely(load: float) -> str:
    """The usual cause of a mean force that is some times the weight."""
    for mistaken, cause in _MISTAKEN_FORCES:
        if abs(load / mistaken - 1.0) < _LOAD_TOLERANCE:
            return cause
    return "not the specific force in body axes"


def filled_velocity(velocity: Array, inertial: Array, window: int) -> Array:
    """Velocity (N, 3) that follows the one logged over a window of samples, and the inertial one within it."""
    difference = velocity - inertial
    there = np.asarray(np.isfinite(difference).all(axis=1))[:, None]
    drift = uniform_filter1d(np.where(there, difference, 0.0), window, axis=0)
    drift /= np.maximum(uniform_filter1d(there.astype(float), window, axis=0), 1e-9)
    return np.where(there, inertial + drift, np.nan)


def levelled_attitude(t: Array, rates: Array, force: Array) -> Array:
    """Attitude (N, 4) by the gyro, level as the specific force is in the mean; its heading begins at 0.

    q_{k+1} = q_k exp(dt w), turned towards f = g e_z in the world with a time constant of `_LEVELLING`: where a flight
    ends as fast as it began, the mean of f is the weight.
    """
    rates = np.nan_to_num(rates)
    there = np.asarray(np.isfinite(force).all(axis=1))
    force = np.where(there[:, None], force, np.nan)
    fx, fy, fz = np.nanmean(force[t <= t[0] + _FIRST_LEVELLING], axis=0)
    level = np.array([np.arctan2(fy, fz), np.arctan2(-fx, np.hypot(fy, fz)), 0.0])
    q = tuple(euler_to_quaternion(level).tolist())
    attitude = [q]
    steps = np.diff(t)
    halves = 0.5 * steps[:, None] * (rates[1:] + rates[:-1])
    for dt, angle, (x, y, z) in zip(steps.tolist(), halves.tolist(), force[1:].tolist(), strict=True):
        q = multiply(q, exponential(tuple(angle)))
        if not math.isnan(x):
            conjugate = (q[0], -q[1], -q[2], -q[3])
            _, fx, fy, _ = multiply(multiply(q, (0.0, x, y, z)), conjugate)
            share = dt / (_LEVELLING * _GRAVITY)
            q = multiply(exponential((share * fy, -share * fx, 0.0)), q)  # along f x e_z
        q = normalise(q)
        attitude.append(q)
    return np.array(attitude)
