"""The exact derivative of the nonlinear model's Runge-Kutta map, for all points of a horizon at once.

By the chain rule, variations of the state go through the same Runge-Kutta stages, with the model's Jacobians at the
instants where these evaluate it.  Position and velocity at the start have only the trivial effect of straight motion;
carried along are the variations by (eta, d(eta)/dt), by the rotor speeds where they are states, and by the inputs.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from mpc.nonlinear.model import NonlinearModel, Passage, integrate
from quadsim.state import EULER, EULER_RATE, N_STATES, POSITION, VELOCITY, Array
from quadsim.vehicle import N_ROTORS

_ROWS: Final = np.array([*POSITION, *EULER, *EULER_RATE, *VELOCITY])
"""States in the order of the variations' rows, in which the rates of the first half are the second half, reordered."""
_ATTITUDE: Final = np.array([*EULER, *EULER_RATE])


def linearise(model: NonlinearModel, x: Array, u: Array) -> tuple[Array, Array, Array]:
    """A, B, c of x(k+1) ~ A x(k) + B u(k) + c about points x (M, n), u (M, 4).

    Returns:
        (M, n, n), (M, n, 4) and (M, n): the derivatives of `mpc.nonlinear.model.advance` at each point, and what makes
        the approximation exact there.
    """
    passage = integrate(model, x, u)
    by_attitude, by_speeds = _jacobians(model, passage)
    Y = np.zeros((len(x), N_STATES, 6 + N_ROTORS + (model.n - N_STATES)))
    Y[:, 3:9, :6] = np.eye(6)
    step = model.period / model.substeps

    def slope(k: int, Y: Array) -> Array:
        dY = np.empty_like(Y)
        dY[:, 0:3], dY[:, 3:6] = Y[:, 9:12], Y[:, 6:9]
        np.matmul(by_attitude[k], Y[:, 3:9], out=dY[:, 6:12])
        dY[:, 6:12, -N_ROTORS:] += (1.0 - passage.decay[k]) * by_speeds[k]
        if model.rotor_lag is not None:
            dY[:, 6:12, 6:-N_ROTORS] += passage.decay[k] * by_speeds[k]
        return dY

    for k in range(0, 4 * model.substeps, 4):
        first = slope(k, Y)
        second = slope(k + 1, Y + 0.5 * step * first)
        third = slope(k + 2, Y + 0.5 * step * second)
        fourth = slope(k + 3, Y + step * third)
        second += third
        second *= 2.0
        first += second
        first += fourth
        first *= step / 6.0
        Y = Y + first
    A, B = _assemble(model, Y)
    c = passage.end - (A @ x[:, :, None] + B @ u[:, :, None])[:, :, 0]
    return A, B, c


def _assemble(model: NonlinearModel, Y: Array) -> tuple[Array, Array]:
    A, B = np.zeros((len(Y), model.n, model.n)), np.zeros((len(Y), model.n, N_ROTORS))
    A[:, POSITION, POSITION] = A[:, VELOCITY, VELOCITY] = 1.0
    A[:, POSITION, VELOCITY] = model.period
    A[:, _ROWS[:, None], _ATTITUDE] = Y[:, :, :6]
    B[:, _ROWS] = Y[:, :, -N_ROTORS:]
    if model.rotor_lag is not None:
        rotors = np.arange(N_STATES, model.n)
        A[:, _ROWS[:, None], rotors] = Y[:, :, 6:-N_ROTORS]
        decay = np.exp(-model.period / model.rotor_lag)
        A[:, rotors, rotors] = decay
        B[:, rotors, range(N_ROTORS)] = 1.0 - decay
    return A, B


def _jacobians(model: NonlinearModel, passage: Passage) -> tuple[Array, Array]:
    """Derivatives of (d2(eta)/dt2, d2(p)/dt2) at the K instants of a passage of M points.

    Returns:
        (K, M, 6, 6) by (eta, d(eta)/dt), and (K, M, 6, 4) by the rotor speeds.
    """
    (sr, sp, sy), (cr, cp, cy) = (np.moveaxis(of(passage.euler), 1, 0) for of in (np.sin, np.cos))
    a, b, c = np.moveaxis(passage.euler_rate, 1, 0)
    thrust, _, t_q, t_r = np.moveaxis(passage.drive, 1, 0)
    k_p, k_q, k_r = model.gyration
    _, d_q, d_r = model.angular_acceleration
    zero, one = np.zeros_like(a), np.ones_like(a)
    turn = c * cp
    lag = c * sp
    p, q, r = a - lag, b * cr + turn * sr, turn * cr - b * sr
    dq, dr = t_q + k_q * r * p + d_q, t_r + k_r * p * q + d_r
    yaw = (dq * sr + dr * cr + b * (a + lag)) / cp

    # Body rates and their derivatives by (roll, pitch, roll rate, pitch rate, yaw rate): (5, K, M) each.
    by_p = np.stack([zero, -turn, one, zero, -sp])
    by_q = np.stack([r, -lag * sr, zero, cr, cp * sr])
    by_r = np.stack([-q, -lag * cr, zero, -sr, cp * cr])
    by_dp, by_dq, by_dr = k_p * (r * by_q + q * by_r), k_q * (p * by_r + r * by_p), k_r * (q * by_p + p * by_q)
    by_lateral = by_dq * sr + by_dr * cr + np.stack([dq * cr - dr * sr, b * turn + sp * yaw, b, a + lag, b * sp])
    by_yaw = by_lateral / cp
    by_pitch = by_dq * cr - by_dr * sr
    by_pitch += np.stack([-dq * sr - dr * cr, a * lag, -turn, zero, -a * cp])
    by_roll = by_dp + sp * by_yaw + np.stack([zero, cp * yaw - b * lag, zero, turn, b * cp])

    level, side = thrust * sp, thrust * sr
    lift = thrust * cr
    F = np.zeros((6, 6, *a.shape))
    angles = [0, 1, 3, 4, 5]
    F[0, angles], F[1, angles], F[2, angles] = by_roll, by_pitch, by_yaw
    F[3, 0], F[3, 1], F[3, 2] = sy * lift - cy * level * sr, cy * cp * lift, cy * side - sy * level * cr
    F[4, 0], F[4, 1], F[4, 2] = -cy * lift - sy * level * sr, sy * cp * lift, sy * side + cy * level * cr
    F[5, 0], F[5, 1] = -cp * side, -sp * lift

    D = np.zeros((6, 4, *a.shape))  # by U / m and I^-1 tau
    D[0, 1] = 1.0
    D[1, 2], D[1, 3] = cr, -sr
    D[2, 2], D[2, 3] = sr / cp, cr / cp
    D[0, 2:] = sp * D[2, 2:]
    D[3, 0], D[4, 0], D[5, 0] = cy * sp * cr + sy * sr, sy * sp * cr - cy * sr, cp * cr
    G = np.matmul(model.effectiveness.T, D.reshape(6, 4, -1)).reshape(D.shape)
    G *= 2.0 * np.moveaxis(passage.speeds, 1, 0)
    return np.ascontiguousarray(np.moveaxis(F, (0, 1), (2, 3))), np.ascontiguousarray(np.moveaxis(G, (0, 1), (2, 3)))
