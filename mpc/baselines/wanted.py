"""The attitude that a force and a heading require under rotor drag, how it turns, and how that changes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mpc.baselines.attitude import unit_derivatives, vee
from quadsim.state import Array


@dataclass(frozen=True, kw_only=True)
class Wanted:
    """The computed attitude R_c (3, 3), Omega_c (3,) [rad/s] and its derivative (3,) [rad/s^2], in its own axes."""

    attitude: Array
    rates: Array
    acceleration: Array


def wanted_attitude(force: Sequence[Array], momentum: Sequence[Array], drag: Array, heading: Array) -> Wanted:
    """R_c = [b_1c, b_2c, b_3c] with b_1c as near to the heading as the force leaves.

    What the rotors and drag give together is to be `force`, f b_3c - R_c diag(d) R_c' p = A: across the body
    b_1c . (A + d_x p) = 0 and b_2c . (A + d_y p) = 0, and f = b_3c . (A + d_z p).  Faessler et al. (2018), Eqs. (12)
    to (16), with body x rather than body y near to a given direction.  Without drag b_3c lies along A.

    Args:
        force: A and its first two derivatives, (3,) each [N].
        momentum: p, mass times the velocity that drag is computed from, and its first two derivatives, (3,) each.
        drag: d (3,), body axes [1/s].
        heading: (3, 3) rows: the direction h and its first two derivatives.
    """
    h, h1, h2 = heading
    beta = unit_derivatives(*_with_drag(force, momentum, drag[1]))
    b2, b21, b22 = unit_derivatives(*_cross(beta, (h, h1, h2)))
    if drag[0] == drag[1]:
        b3, b31, b32 = beta
        b1, b11, b12 = _cross((b2, b21, b22), beta)
    else:
        alpha = unit_derivatives(*_with_drag(force, momentum, drag[0]))
        b1, b11, b12 = unit_derivatives(*_cross((b2, b21, b22), alpha))
        b3, b31, b32 = _cross((b1, b11, b12), (b2, b21, b22))
    R_c = np.stack([b1, b2, b3], axis=1)
    Omega_c = vee(R_c.T @ np.stack([b11, b21, b31], axis=1))
    acceleration_c = vee(R_c.T @ np.stack([b12, b22, b32], axis=1))  # of hat(Omega_c)^2 + hat(Omega_c'), skew
    return Wanted(attitude=R_c, rates=Omega_c, acceleration=acceleration_c)


def _with_drag(force: Sequence[Array], momentum: Sequence[Array], drag: float) -> Sequence[Array]:
    return force if drag == 0.0 else [A + drag * p for A, p in zip(force, momentum, strict=True)]


def _cross(a: Sequence[Array], b: Sequence[Array]) -> tuple[Array, Array, Array]:
    """The cross product of two vectors, each with its first two derivatives, and its own."""
    (a0, a1, a2), (b0, b1, b2) = a, b
    first = np.cross(a1, b0) + np.cross(a0, b1)
    return np.cross(a0, b0), first, np.cross(a2, b0) + 2.0 * np.cross(a1, b1) + np.cross(a0, b2)
