"""Differential flatness: attitude, body rates and rotor thrusts along a sampled course of positions.

The thrust axis is b = (a + g e_z) / |a + g e_z| (Mellinger and Kumar 2011, Sec. III). The heading about it is either
free, so that the rate about body z is zero, or held, so that body x is as close as possible to the direction of a given
yaw, and body y is perpendicular to that direction.
Derivatives along the samples are central differences, one-sided at both ends, as in the simplified simulation of
Torrente et al., "Data-Driven MPC for Quadrotors" (2021), which leaves the heading free.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from quadsim.errors import ParameterError
from quadsim.motion import Motion
from quadsim.rotation import conjugate, multiply
from quadsim.state import Array, read_only
from quadsim.vehicle import Vehicle

STEEP: Final = math.cos(math.radians(150.0))
"""Lowest vertical component of the thrust axis for which the least rotation from upright describes the attitude."""


def motion_along(
    position: Array, velocity: Array, acceleration: Array, *, period: float, vehicle: Vehicle, yaw: Array | float = 0.0
) -> Motion:
    """Return the reference motion of a vehicle that follows a course exactly, without drag.

    Args:
        position: (K, 3) world [m], K >= 2.
        velocity: (K, 3) world [m/s].
        acceleration: (K, 3) world [m/s^2]; no sample may be in free fall.
        period: sample period [s].
        vehicle: mass, inertia, gravity and rotors.
        yaw: (K,) held heading, as a direction from world x [rad]; or the initial value of a free heading [rad].
    """
    attitude, rates = attitudes(acceleration, period=period, gravity=vehicle.gravity, yaw=yaw)
    torque = vehicle.momentum(np.gradient(rates, period, axis=0)) + np.cross(rates, vehicle.momentum(rates))
    collective = vehicle.mass * np.linalg.norm(_pushed(acceleration, vehicle.gravity), axis=1)
    squared = np.linalg.solve(vehicle.allocation, np.column_stack([collective, torque]).T).T
    return Motion(
        position=read_only(np.array(position, float)),
        velocity=read_only(np.array(velocity, float)),
        acceleration=read_only(np.array(acceleration, float)),
        attitude=read_only(attitude),
        body_rates=read_only(rates),
        thrusts=read_only(vehicle.coefficients * squared),
    )


def attitudes(acceleration: Array, *, period: float, gravity: float, yaw: Array | float) -> tuple[Array, Array]:
    """(K, 4) quaternions, and (K, 3) body rates [rad/s], along accelerations (K, 3); arguments as of `motion_along`.

    The free heading of a course that turns the vehicle upside down is propagated from sample to sample by the least
    rotation from one thrust axis to the next, since no least rotation from upright exists there.
    """
    pushed = _pushed(acceleration, gravity)
    b = pushed / np.linalg.norm(pushed, axis=1)[:, None]
    if b[:, 2].min() < STEEP:
        if not isinstance(yaw, float):
            raise ParameterError("reference", "heading", "held", "free where the course turns the vehicle upside down")
        attitude = _carried(b, yaw)
        return attitude, _body_rates(attitude, period)
    least = np.column_stack([1.0 + b[:, 2], -b[:, 1], b[:, 0], np.zeros(len(b))])  # the least rotation of e_z to b
    least /= np.linalg.norm(least, axis=1)[:, None]
    least_rates = _body_rates(least, period)
    if isinstance(yaw, float):
        turn = yaw - period * np.concatenate([[0.0], np.cumsum(least_rates[1:, 2])])
    else:
        turn = _turn_to(least, yaw)
    attitude = multiply(least, _about_z(turn))
    rates = _body_rates(attitude, period)
    cos = np.cos(turn[0])
    sin = np.sin(turn[0])
    wx, wy, wz = least_rates[0]
    rates[0] = cos * wx + sin * wy, cos * wy - sin * wx, wz  # the first sample has no step before it
    return attitude, rates


def _carried(b: Array, yaw: float) -> Array:
    """(K, 4) quaternions with thrust axes b (K, 3), each obtained from the previous one by the least rotation."""
    before = np.concatenate([[[0.0, 0.0, 1.0]], b[:-1]])
    turn = np.column_stack([1.0 + np.sum(before * b, axis=1), np.cross(before, b)])
    turn /= np.linalg.norm(turn, axis=1)[:, None]
    attitude = np.empty((len(b), 4))
    now = _about_z(np.array([yaw]))
    for k in range(len(b)):
        now = multiply(turn[k : k + 1], now)
        attitude[k] = now[0]
    return attitude


def _body_rates(attitude: Array, period: float) -> Array:
    """(K, 3) body rates 2 vec(q* Dq) [rad/s] of quaternions (K, 4) sampled at a period [s]."""
    rates: Array = 2.0 * multiply(conjugate(attitude), np.gradient(attitude, period, axis=0))[:, 1:]
    return rates


def _pushed(acceleration: Array, gravity: float) -> Array:
    """(K, 3) specific force a + g e_z [m/s^2] of the rotors."""
    return np.asarray(acceleration, float) + np.array([0.0, 0.0, gravity])


def _turn_to(least: Array, yaw: Array) -> Array:
    """(K,) angle about body z [rad], without jumps, that makes body y perpendicular to the direction of a yaw."""
    w, x, y, z = least.T
    cos = np.cos(yaw)
    sin = np.sin(yaw)
    of_x = cos * (1.0 - 2.0 * (y * y + z * z)) + sin * 2.0 * (x * y + w * z)
    of_y = cos * 2.0 * (x * y - w * z) + sin * (1.0 - 2.0 * (x * x + z * z))
    turn: Array = np.unwrap(np.arctan2(of_y, of_x))
    return turn


def _about_z(angle: Array) -> Array:
    """(K, 4) quaternions of rotations about z by angles (K,) [rad]."""
    half = 0.5 * angle
    zero = np.zeros_like(angle)
    return np.column_stack([np.cos(half), zero, zero, np.sin(half)])
