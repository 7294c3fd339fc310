"""The linear model: linearised at hover, discretised exactly.  Eq. (1).

From the vehicle's equations of motion come the Jacobians at hover, dxi/dt = A_c (xi - xi_bar) + B_c (u - u_bar), and
with a zero-order hold over the period tau_s

    xi(k+1) = A xi(k) + B (u(k) - u_bar),    [[A, B], [0, 1]] = exp([[A_c, B_c], [0, 0]] tau_s).

`quadsim.mpc.problem.ocp` predicts with it.
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

    Examples:
        >>> import numpy as np
        >>> from quadsim import mpc
        >>> A = np.array([[1.0, 0.1], [0.0, 1.0]])  # a double integrator: position, velocity
        >>> B = np.array([[0.005], [0.1]])
        >>> model = mpc.LinearModel(A=A, B=B, u_bar=np.zeros(1), period=0.1)
        >>> model.n, model.nu
        (2, 1)
    """

    A: Array  # (n, n) state matrix
    B: Array  # (n, nu) input matrix
    u_bar: Array  # (nu,) equilibrium input; the trim of a quadrotor, often omega_bar on all rotors [rad/s]
    period: float  # tau_s [s]
    # whether the inputs are an inner loop's targets, collective thrust [N] and body rates [rad/s]
    targets: bool = False

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
    # [U, tau_x, tau_y, tau_z] = allocation w^2, so its slope at hover is allocation diag(2 w_bar).  If a rotor's thrust
    # is a_1 w + a_2 w^2, equal to b w_bar^2 at hover, its slope there is a_1 + 2 a_2 w_bar = b (2 w_bar - a_1 / b).
    linear, _ = vehicle.thrust_law
    speed_slopes = 2.0 * vehicle.hover_speeds - linear / vehicle.coefficients
    B[ACCELERATED] = vehicle.accelerations(speed_slopes * vehicle.allocation)
    if moment:
        A[np.ix_(ACCELERATED, [*VELOCITY, *EULER_RATE])] += air_slopes(vehicle)
    if rotor_lag == 0.0:
        return A, B
    return _with_rotor_speeds(A, B, rotor_lag)


def _with_rotor_speeds(A: Array, B: Array, rotor_lag: float) -> tuple[Array, Array]:
    """Add the rotor speeds w as states, dw/dt = (u - w) / T, which take the place of the inputs u in B."""
    rate = np.eye(N_ROTORS) / rotor_lag
    of_states = np.hstack([A, B])
    of_rotors = np.hstack([np.zeros((N_ROTORS, N_STATES)), -rate])
    return np.vstack([of_states, of_rotors]), np.vstack([np.zeros_like(B), rate])


def air_slopes(vehicle: Vehicle) -> Array:
    """(4, 6) what air adds to U / m and J^-1 tau in hover, per velocity [1/s, rad/(m s)] and rate [m/s, 1/s].

    It is linear in both there, so that unit velocities and rates give the columns.
    """
    zero = np.zeros(3)
    columns = []
    for velocity in np.eye(3):
        columns.append(vehicle.air_accelerations(velocity, zero))
    for rates in np.eye(3):
        columns.append(vehicle.air_accelerations(zero, rates))
    return np.array(columns).T


def discretise(A_c: Array, B_c: Array, period: float) -> tuple[Array, Array]:
    """Exact zero-order-hold discretisation, by the exponential of [[A_c, B_c], [0, 0]] tau_s."""
    n, nu = B_c.shape
    block = np.zeros((n + nu, n + nu))
    block[:n, :n] = A_c
    block[:n, n:] = B_c
    exponential = scipy.linalg.expm(block * period)
    return exponential[:n, :n], exponential[:n, n:]


def hover_model(vehicle: Vehicle, period: float, *, moment: bool = False) -> LinearModel:
    """The vehicle's discrete model at hover, for a control period tau_s [s]; `moment` as in `continuous_model`.

    Examples:
        >>> import quadsim
        >>> from quadsim import mpc
        >>> model = mpc.hover_model(quadsim.load_vehicle("lopes2011"), 0.05)
        >>> model.A.shape, model.B.shape, model.u_bar.round(1).tolist()
        ((12, 12), (12, 4), [192.8, 192.8, 192.8, 192.8])
    """
    A, B = discretise(*continuous_model(vehicle, moment=moment), period)
    return LinearModel(A=read_only(A), B=read_only(B), u_bar=read_only(vehicle.hover_speeds), period=period)


def target_model(
    vehicle: Vehicle, period: float, lag: Sequence[float], attitude_lag: Sequence[float] | None = None
) -> LinearModel:
    """The discrete model at hover above an inner loop, whose targets are the inputs.

    The rates follow with the time constants `lag` (thrust, p, q, r) [s], at least `SHORTEST_LAG`; the thrust at once.
    With `attitude_lag` (roll, pitch, yaw) [s] an attitude is commanded.  The inputs are then the body rates that the
    attitude loop commands at the start of a period; as the vehicle turns, its error falls, and so do the commanded
    rates, by the turn over `attitude_lag` (`quadsim.mpc.problem.rigidbody`).
    """
    A, _ = continuous_model(vehicle)
    if attitude_lag is not None:
        A = np.pad(A, (0, 3))  # three further states: the turn since the start of the period
    B = np.zeros((len(A), N_ROTORS))
    B[INDEX["vz"], 0] = 1.0 / vehicle.mass
    for axis, (rate, tau) in enumerate(zip(EULER_RATE, lag[1:], strict=True)):
        gain = 1.0 / max(tau, SHORTEST_LAG)
        B[rate, 1 + axis] = gain
        A[rate, rate] = -gain
        if attitude_lag is not None:
            turn = N_STATES + axis
            A[turn, rate] = 1.0
            A[rate, turn] = -gain / attitude_lag[axis]
    u_bar = np.array([vehicle.mass * vehicle.gravity, 0.0, 0.0, 0.0])
    A, B = discretise(A, B, period)
    # The turn is zero at the start of every period: the states of the next period need neither its column nor its row.
    A = np.ascontiguousarray(A[:N_STATES, :N_STATES])
    B = np.ascontiguousarray(B[:N_STATES])
    return LinearModel(A=read_only(A), B=read_only(B), u_bar=read_only(u_bar), period=period, targets=True)


def split_delay(delay: float, period: float) -> tuple[int, float]:
    """Split a delay [s] into n whole periods and the rest, which is at most a period and zero only without delay.

    At t_k the commands u(k-n) .. u(k-1) are under way, and u(k-1-n) is in force for that rest.  A delay of a whole
    number of periods, up to rounding, has a rest of one period.
    """
    begun_periods = math.ceil(delay / period - 1e-9)
    whole = max(begun_periods - 1, 0)
    return whole, delay - whole * period


def require_delay(delay: float, period: float, periods: int) -> None:
    """Reject a delay [s] of more than so many control periods.

    Raises:
        ParameterError: it is longer.
    """
    if delay > periods * period * (1.0 + 1e-9):
        rule = f"at most {periods} control periods, {periods * period:g} s"
        raise ParameterError("controller", "delay", delay, rule)
