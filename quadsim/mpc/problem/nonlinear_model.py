"""The nonlinear model: any attitude, any heading, optional rotor lag.  Sec. 2.2.

With Z-Y-X Euler angles eta = (roll, pitch, yaw) and body rates omega = E(eta) d(eta)/dt, the states of the paper obey

    d2(p)/dt2 = U / m R(eta) e_z - g e_z + a
    d2(eta)/dt2 = E(eta)^-1 (d(omega)/dt - dE/dt d(eta)/dt),    d(omega)/dt = I^-1 (tau - omega x I omega) + alpha

with [U, tau] from the squared rotor speeds and a constant disturbance (a, alpha). Sec.  2.2 uses d(eta)/dt for omega,
which is valid only at small angles.  Rotor speeds are the inputs or, with a lag, states 12 to 15 that follow the inputs
as tau_r dw/dt = u - w.

Inputs are held over a control period, so rotor speeds are known exactly at every instant of it.  The classical
fourth-order Runge-Kutta method integrates the body.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Final, TypeAlias

import numpy as np

from quadsim.state import ANGLE_RATES, ANGLES, N_STATES, POSITIONS, VELOCITIES, Array, read_only
from quadsim.vehicle import N_ROTORS, Vehicle

Triple: TypeAlias = tuple[float, float, float]

SUBSTEPS: Final = 2
"""Runge-Kutta steps per period.  Over 50 ms from 30 deg of tilt, turning at 2 rad/s, with commands 50 rad/s apart, two
steps have errors of 1e-5 rad, or 3e-4 rad with a rotor lag of 20 ms; one step has ten times as much."""


def zero() -> Array:
    """Three zeros, not to be written to."""
    return read_only(np.zeros(3))


@dataclass(frozen=True, kw_only=True)
class NonlinearModel:
    """x(k+1) = f(x(k), u(k)); see the module.  `dataclasses.replace` sets another disturbance."""

    effectiveness: Array  # (4, 4) maps squared rotor speeds to U / m [m/s^2] and I^-1 tau [rad/s^2]
    gyration: Array  # (3,) of (Iyy - Izz) / Ixx, (Izz - Ixx) / Iyy, (Ixx - Iyy) / Izz
    gravity: float  # g [m/s^2]
    period: float  # tau_s [s]
    substeps: int = SUBSTEPS  # Runge-Kutta steps per period
    rotor_lag: float | None = None  # time constant tau_r of the rotor speeds [s]; None if the inputs are the speeds
    acceleration: Array = field(default_factory=zero)  # (3,) a of the disturbance, world frame [m/s^2]
    angular_acceleration: Array = field(default_factory=zero)  # (3,) alpha of the disturbance, body frame [rad/s^2]

    @property
    def n(self) -> int:
        """Number of states."""
        return N_STATES if self.rotor_lag is None else N_STATES + N_ROTORS

    @cached_property
    def allocation(self) -> Array:
        """(4, 4) the inverse of `effectiveness`."""
        return read_only(np.array(np.linalg.inv(self.effectiveness), float))


def nonlinear_model(
    vehicle: Vehicle, period: float, *, substeps: int = SUBSTEPS, rotor_lag: float | None = None
) -> NonlinearModel:
    """The vehicle's model, undisturbed; see `NonlinearModel`."""
    ixx, iyy, izz = vehicle.inertia
    return NonlinearModel(
        effectiveness=read_only(vehicle.accelerations(vehicle.allocation)),
        gyration=read_only(np.array([(iyy - izz) / ixx, (izz - ixx) / iyy, (ixx - iyy) / izz])),
        gravity=vehicle.gravity,
        period=period,
        substeps=substeps,
        rotor_lag=rotor_lag,
    )


def next_state(model: NonlinearModel, x: Array, u: Array) -> Array:
    """The state (n,) one period after a state x (n,) under inputs u (4,) [rad/s]."""
    return advance_disturbed(model, x, u, model.period, model.effectiveness, model.acceleration.tolist())


def advance_disturbed(
    model: NonlinearModel, x: Array, u: Array, period: float, effectiveness: Array, acceleration: Sequence[float]
) -> Array:
    """`next_state` with the disturbance given as numbers.

    It uses plain numbers: arrays of three are several times slower.
    """
    step = period / model.substeps
    speeds = _rotor_speeds(model, step, x[N_STATES:], u)
    drive = np.dot(np.square(speeds), effectiveness.T).tolist()
    (k_p, k_q, k_r), (d_x, d_y, d_z) = model.gyration.tolist(), acceleration
    d_p, d_q, d_r = model.angular_acceleration.tolist()
    half, sixth = 0.5 * step, step / 6.0
    sin, cos = math.sin, math.cos

    def slopes(angles: Triple, rates: Triple, k: int) -> tuple[Triple, Triple]:
        """d2(p)/dt2 [m/s^2] and d2(eta)/dt2 [rad/s^2].

        With a, b, c the rates of roll, pitch and yaw, E^-1 dE/dt d(eta)/dt is (-b c cos - sin(pitch) l / cos, a c cos,
        -l / cos), where l = b (a + c sin(pitch)) and cos is that of pitch.
        """
        (roll, pitch, yaw), (a, b, c), (thrust, t_p, t_q, t_r) = angles, rates, drive[k]
        sr, sp, sy, cr, cp, cy = sin(roll), sin(pitch), sin(yaw), cos(roll), cos(pitch), cos(yaw)
        level, side, turn = thrust * sp * cr, thrust * sr, c * cp
        p, q, r = a - c * sp, b * cr + turn * sr, turn * cr - b * sr
        dp, dq, dr = t_p + k_p * q * r + d_p, t_q + k_q * r * p + d_q, t_r + k_r * p * q + d_r
        bend = (dq * sr + dr * cr + b * (a + c * sp)) / cp
        up = thrust * cp * cr + (d_z - model.gravity)
        moved = cy * level + sy * side + d_x, sy * level - cy * side + d_y, up
        return moved, (dp + b * turn + sp * bend, dq * cr - dr * sr - a * turn, bend)

    numbers = x.tolist()
    p, v, q, s = numbers[POSITIONS], numbers[VELOCITIES], numbers[ANGLES], numbers[ANGLE_RATES]
    try:
        for k in range(0, 4 * model.substeps, 4):
            a_1, b_1 = slopes(q, s, k)
            s_2 = _moved(s, half, b_1)
            a_2, b_2 = slopes(_moved(q, half, s), s_2, k + 1)
            s_3 = _moved(s, half, b_2)
            a_3, b_3 = slopes(_moved(q, half, s_2), s_3, k + 2)
            s_4 = _moved(s, step, b_3)
            a_4, b_4 = slopes(_moved(q, step, s_3), s_4, k + 3)
            p = _moved(p, sixth, _weighted(v, _moved(v, half, a_1), _moved(v, half, a_2), _moved(v, step, a_3)))
            v = _moved(v, sixth, _weighted(a_1, a_2, a_3, a_4))
            q = _moved(q, sixth, _weighted(s, s_2, s_3, s_4))
            s = _moved(s, sixth, _weighted(b_1, b_2, b_3, b_4))
    except ValueError:  # the sine of an infinite angle
        return np.full_like(x, np.nan)
    end = np.empty_like(x)
    end[POSITIONS], end[VELOCITIES], end[ANGLES], end[ANGLE_RATES] = p, v, q, s
    end[N_STATES:] = speeds[-1, : x.size - N_STATES]
    return end


def _moved(start: Triple, by: float, slope: Triple) -> Triple:
    (a, b, c), (d, e, f) = start, slope
    return a + by * d, b + by * e, c + by * f


def _weighted(first: Triple, second: Triple, third: Triple, fourth: Triple) -> Triple:
    """Six times the mean slope of a Runge-Kutta step."""
    (a, b, c), (d, e, f), (p, q, r), (x, y, z) = first, second, third, fourth
    return a + 2.0 * (d + p) + x, b + 2.0 * (e + q) + y, c + 2.0 * (f + r) + z


def _rotor_speeds(model: NonlinearModel, step: float, rotors: Array, inputs: Array) -> Array:
    """(4 substeps, 4) rotor speeds at the Runge-Kutta instants of a step [s], from rotors (4,) under inputs (4,)."""
    instants = (np.arange(model.substeps)[:, None] + [0.0, 0.5, 0.5, 1.0]).ravel()
    if model.rotor_lag is None:
        return np.broadcast_to(inputs, (instants.size, *inputs.shape))
    return inputs + np.exp(-instants * step / model.rotor_lag)[:, None] * (rotors - inputs)


def spun(model: NonlinearModel, rotors: Array, command: Array, time: float) -> Array:
    """Rotor speeds (4,) a time [s] after speeds (4,) under a command (4,) [rad/s]."""
    if model.rotor_lag is None:
        return command
    return command + math.exp(-time / model.rotor_lag) * (rotors - command)
