"""The linear model: linearised at hover, discretised exactly.  Eq. (1).

    xi(k+1) = A xi(k) + B (u(k) - u_bar),    [A B; 0 1] = exp(tau_s [A_c B_c; 0 0]),

with the Jacobians A_c and B_c of the nonlinear model at hover.  Linear MPCs, the LQR and the fallback predict by it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import scipy.linalg

from quadsim.errors import ParameterError
from quadsim.state import EULER_RATE, INDEX, N_STATES, VELOCITY, Array, read_only
from quadsim.vehicle import N_ROTORS, Vehicle

SHORTEST_LAG: Final = 1e-4
"""Shortest lag [s] for which gains can be computed; far below any period."""
ACCELERATED: Final = [INDEX[name] for name in ("vz", "roll_rate", "pitch_rate", "yaw_rate")]
"""States whose rates of change are U / m and J^-1 tau at hover."""


@dataclass(frozen=True, kw_only=True)
class LinearModel:
    """xi(k+1) = A xi(k) + B (u(k) - u_bar).

    Eq. (1) prints u(k) for the deviation; taken literally, hover would predict a climb. A xi_bar = xi_bar at any hover
    position, so only the input needs the offset. `docs/conventions.md` lists the states.
    """

    A: Array  # (n, n) state matrix
    B: Array  # (n, nu) input matrix
    u_bar: Array  # (nu,) equilibrium input; the trim of a quadrotor, often omega_bar on all rotors [rad/s]
    period: float  # tau_s [s]
    targets: bool = (
        False  # whether the inputs are an inner loop's targets, collective thrust [N] and body rates [rad/s]
    )

    @property
    def n(self) -> int:
        """Number of states."""
        return self.A.shape[0]

    @property
    def nu(self) -> int:
        """Number of inputs."""
        return self.B.shape[1]


def continuous_model(vehicle: Vehicle, rotor_lag: float = 0.0, *, moment: bool = False) -> tuple[Array, Array]:
    """Jacobians (A_c, B_c) of the nonlinear model of Sec. 2.2 at hover with zero yaw.

    With a rotor lag T [s], dw/dt = (u - w) / T, the rotor speeds w are four further states.  With `moment`, velocities
    and rates also turn the vehicle, and climbing costs thrust, as the air does in hover (`Vehicle.air_accelerations`);
    `inflow_moment`, a product of two velocities, has no part in that.

    Returns:
        (12, 12) and (12, 4): d(xi)/dt = A_c (xi - xi_bar) + B_c (u - u_bar); with lag (16, 16) and (16, 4).
    """
    A = np.zeros((N_STATES, N_STATES))
    B = np.zeros((N_STATES, N_ROTORS))
    for name in ("x", "y", "z", "roll", "pitch", "yaw"):
        A[INDEX[name], INDEX[name] + 1] = 1.0
    A[INDEX["vx"], INDEX["pitch"]] = vehicle.gravity
    A[INDEX["vy"], INDEX["roll"]] = -vehicle.gravity
    # [U, tau_x, tau_y, tau_z] = allocation w^2, so its slope at hover is allocation diag(2 w_bar); of a thrust
    # a_1 w + a_2 w^2 = b w_bar^2 it is a_1 + 2 a_2 w_bar = b (2 w_bar - a_1 / b).
    linear, _ = vehicle.thrust_law
    wrench_slope = (2.0 * vehicle.hover_speeds - linear / vehicle.coefficients) * vehicle.allocation
    B[ACCELERATED] = vehicle.accelerations(wrench_slope)
    if moment:
        A[np.ix_(ACCELERATED, [*VELOCITY, *EULER_RATE])] += air_slopes(vehicle)
    if rotor_lag == 0.0:
        return A, B
    follow = np.eye(N_ROTORS) / rotor_lag
    return np.block([[A, B], [np.zeros((N_ROTORS, N_STATES)), -follow]]), np.vstack([np.zeros_like(B), follow])


def air_slopes(vehicle: Vehicle) -> Array:
    """(4, 6) what air adds to U / m and J^-1 tau in hover, per velocity [1/s, rad/(m s)] and rate [m/s, 1/s]."""
    units = np.eye(3)
    still = np.zeros(3)
    by_velocity = [vehicle.air_accelerations(unit, still) for unit in units]
    by_rate = [vehicle.air_accelerations(still, unit) for unit in units]
    return np.array(by_velocity + by_rate).T


def discretise(A_c: Array, B_c: Array, period: float) -> tuple[Array, Array]:
    """Exact zero-order-hold discretisation, by the exponential of [[A_c, B_c], [0, 0]] tau_s."""
    n, nu = B_c.shape
    block = np.zeros((n + nu, n + nu))
    block[:n, :n] = A_c
    block[:n, n:] = B_c
    exponential = scipy.linalg.expm(block * period)
    return exponential[:n, :n], exponential[:n, n:]


def hover_model(vehicle: Vehicle, period: float, *, moment: bool = False) -> LinearModel:
    """The vehicle's discrete model at hover, for a control period tau_s [s]; `moment` as in `continuous_model`."""
    A, B = discretise(*continuous_model(vehicle, moment=moment), period)
    return LinearModel(A=read_only(A), B=read_only(B), u_bar=read_only(vehicle.hover_speeds), period=period)


def target_model(
    vehicle: Vehicle, period: float, lag: Sequence[float], attitude_lag: Sequence[float] | None = None
) -> LinearModel:
    """The discrete model at hover above an inner loop, whose targets are the inputs.

    The rates follow with the time constants `lag` (thrust, p, q, r) [s], at least `SHORTEST_LAG`; the thrust at once.
    With `attitude_lag` (roll, pitch, yaw) [s] an attitude is commanded: the inputs are then the body rates that its
    error commands at the start of a period, and the turn since then takes from them
    (`quadsim.mpc.problem.rigidbody`).
    """
    A, B = continuous_model(vehicle)
    if attitude_lag is not None:
        A = np.pad(A, (0, 3))  # three further states: the turn since the start of the period
    B = np.zeros((len(A), N_ROTORS))
    B[INDEX["vz"], 0] = 1.0 / vehicle.mass
    for axis, (rate, tau) in enumerate(zip(EULER_RATE, lag[1:], strict=True)):
        B[rate, 1 + axis] = 1.0 / max(tau, SHORTEST_LAG)
        A[rate, rate] = -B[rate, 1 + axis]
        if attitude_lag is not None:
            turn = N_STATES + axis
            A[turn, rate] = 1.0
            A[rate, turn] = -B[rate, 1 + axis] / attitude_lag[axis]
    u_bar = np.array([vehicle.mass * vehicle.gravity, 0.0, 0.0, 0.0])
    A, B = discretise(A, B, period)
    A = np.ascontiguousarray(A[:N_STATES, :N_STATES])
    B = np.ascontiguousarray(B[:N_STATES])
    return LinearModel(A=read_only(A), B=read_only(B), u_bar=read_only(u_bar), period=period, targets=True)


def split_delay(delay: float, period: float) -> tuple[int, float]:
    """Split a delay [s] into n whole periods and the rest, which is at most a period and zero only without delay.

    At t_k the commands u(k-n) .. u(k-1) are under way, and u(k-1-n) is in force for that rest.
    """
    whole = max(math.ceil(delay / period - 1e-9) - 1, 0)
    return whole, delay - whole * period


def require_delay(delay: float, period: float, periods: int) -> None:
    """Reject a delay [s] of more than so many control periods.

    Raises:
        ParameterError: it is longer.
    """
    if delay > periods * period * (1.0 + 1e-9):
        rule = f"at most {periods} control periods, {periods * period:g} s"
        raise ParameterError("controller", "delay", delay, rule)
