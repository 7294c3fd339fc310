"""The linear model: linearised at hover, discretised exactly.  Eq. (1)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg

from quadsim.state import INDEX, N_STATES, Array, read_only
from quadsim.vehicle import N_ROTORS, Vehicle


@dataclass(frozen=True, kw_only=True)
class LinearModel:
    """xi(k+1) = A xi(k) + B (u(k) - u_bar).

    Eq. (1) prints u(k) for the deviation; taken literally, hover would predict a climb. A xi_bar = xi_bar at any hover
    position, so only the input needs the offset. `docs/conventions.md` lists the states.
    """

    A: Array  # (n, n) state matrix
    B: Array  # (n, nu) input matrix
    u_bar: Array  # (nu,) equilibrium input; for a quadrotor, omega_bar on all rotors [rad/s]
    period: float  # tau_s [s]

    @property
    def n(self) -> int:
        """Number of states."""
        return self.A.shape[0]

    @property
    def nu(self) -> int:
        """Number of inputs."""
        return self.B.shape[1]


def continuous_model(vehicle: Vehicle, rotor_lag: float = 0.0) -> tuple[Array, Array]:
    """Jacobians (A_c, B_c) of the nonlinear model of Sec. 2.2 at hover with zero yaw.

    With a rotor lag T [s], dw/dt = (u - w) / T, the rotor speeds w are four further states.

    Returns:
        (12, 12) and (12, 4): d(xi)/dt = A_c (xi - xi_bar) + B_c (u - u_bar); with lag (16, 16) and (16, 4).
    """
    A, B = np.zeros((N_STATES, N_STATES)), np.zeros((N_STATES, N_ROTORS))
    for name in ("x", "y", "z", "roll", "pitch", "yaw"):
        A[INDEX[name], INDEX[name] + 1] = 1.0
    A[INDEX["vx"], INDEX["pitch"]] = vehicle.gravity
    A[INDEX["vy"], INDEX["roll"]] = -vehicle.gravity
    # [U, tau_x, tau_y, tau_z] = allocation w^2, so its slope at hover is 2 omega_bar allocation.
    wrench_slope = 2.0 * vehicle.hover_speed * vehicle.allocation
    resistance = np.array([vehicle.mass, *vehicle.inertia])
    B[[INDEX[name] for name in ("vz", "roll_rate", "pitch_rate", "yaw_rate")]] = wrench_slope / resistance[:, None]
    if rotor_lag == 0.0:
        return A, B
    follow = np.eye(N_ROTORS) / rotor_lag
    return np.block([[A, B], [np.zeros((N_ROTORS, N_STATES)), -follow]]), np.vstack([np.zeros_like(B), follow])


def discretise(A_c: Array, B_c: Array, period: float) -> tuple[Array, Array]:
    """Exact zero-order-hold discretisation, by the exponential of [[A_c, B_c], [0, 0]] tau_s."""
    n, nu = B_c.shape
    block = np.zeros((n + nu, n + nu))
    block[:n, :n], block[:n, n:] = A_c, B_c
    exponential = scipy.linalg.expm(block * period)
    return exponential[:n, :n], exponential[:n, n:]


def lqr(A: Array, B: Array, Q: Array, R: Array) -> Array:
    """K (nu, n) of u = -K x, which minimises the infinite sum of x' Q x + u' R u, x(k+1) = A x(k) + B u(k)."""
    P = scipy.linalg.solve_discrete_are(A, B, Q, R)
    return np.asarray(np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A))


def hover_model(vehicle: Vehicle, period: float) -> LinearModel:
    """The vehicle's discrete model at hover, for a control period tau_s [s]."""
    A, B = discretise(*continuous_model(vehicle), period)
    u_bar = np.full(N_ROTORS, vehicle.hover_speed)
    return LinearModel(A=read_only(A), B=read_only(B), u_bar=read_only(u_bar), period=period)
