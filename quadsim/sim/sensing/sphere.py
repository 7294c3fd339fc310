"""Attitude on the sphere of unit quaternions: product, exponential and logarithm, on plain numbers.

Quaternions are (w, x, y, z), body to world, Hamilton's product; rotation vectors are (angle times axis) [rad].  A small
error e of an attitude q turns the body: q * exp(e).  Solà, "Quaternion kinematics for the error-state Kalman filter",
2017, arXiv:1711.02508: Eqs. (12), (101), (105).  Plain floats, because NumPy spends its time on arrays this small
on everything but the arithmetic.
"""

from __future__ import annotations

import math

Quaternion = tuple[float, float, float, float]
Vector = tuple[float, float, float]


def product(a: Quaternion, b: Quaternion) -> Quaternion:
    """The rotation b followed, in the frame it is written in, by a: body to world of both."""
    aw, ax, ay, az = a
    bw, bx, by, bz = b
    return (
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )


def of_euler(roll: float, pitch: float, yaw: float) -> Quaternion:
    """The unit quaternion of Z-Y-X Euler angles [rad]; see `quadsim.state`."""
    cr, sr = math.cos(0.5 * roll), math.sin(0.5 * roll)
    cp, sp = math.cos(0.5 * pitch), math.sin(0.5 * pitch)
    cy, sy = math.cos(0.5 * yaw), math.sin(0.5 * yaw)
    return (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )


def conjugate(q: Quaternion) -> Quaternion:
    """The inverse rotation of a unit quaternion."""
    return q[0], -q[1], -q[2], -q[3]


def normalise(q: Quaternion) -> Quaternion:
    """The unit quaternion in the same direction."""
    scale = 1.0 / math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    return q[0] * scale, q[1] * scale, q[2] * scale, q[3] * scale


def exponential(vector: Vector) -> Quaternion:
    """The unit quaternion of a rotation vector [rad]."""
    x, y, z = vector
    angle = math.sqrt(x * x + y * y + z * z)
    # sin(a/2)/a by its series where the quotient loses its digits; the terms left out are below 1e-17 there.
    scale = 0.5 - angle * angle / 48.0 if angle < 1e-4 else math.sin(0.5 * angle) / angle
    return math.cos(0.5 * angle), scale * x, scale * y, scale * z


def logarithm(q: Quaternion) -> Vector:
    """The shortest rotation vector [rad] of a unit quaternion, at most pi long; q and -q are one rotation."""
    w, x, y, z = q if q[0] >= 0.0 else (-q[0], -q[1], -q[2], -q[3])
    sine = math.sqrt(x * x + y * y + z * z)
    scale = 2.0 if sine < 1e-8 else 2.0 * math.atan2(sine, w) / sine
    return scale * x, scale * y, scale * z
