"""The rigid body with a quaternion: any attitude, no singularity; its equations and its numbers.

The states are position p (world), quaternion q = (w, x, y, z) (Hamilton, body to world), velocity v (world) and body
rates omega: 13. With rotor lag, the four rotors' thrusts or speeds are four further states that follow the inputs,

    p' = v,    q' = 1/2 q (0, omega),    v' = T R(q) e_z - g e_z + R(q) d(R(q)' v) + a,
    omega' = I^-1 (tau + tau_a - omega x I omega) + alpha,    d(v_b) = -(D_1 v_b + D_2 |v_b| v_b) / m, by components.

With `moment`, tau_a = (m_x W v_y, -m_y W v_x, 0) - D omega (`Vehicle.air_moment`), and T is less by k W v_z / m, with
v_b, the vehicle's `inflow` k and the sum W of the rotors' speeds: roots of thrusts, but below a share of 1 % a
parabola, as the root has no derivative at 0.  D has the damping by `inflow`, as in hover.

R(q) is polynomial and not divided by |q|^2, so the derivatives are valid for a q of any length.  Inputs u are the
rotors' thrusts or speeds as shares of the largest, held between nodes; T = thrust / m and I^-1 tau are known exactly at
every instant.  The classical Runge-Kutta method integrates the body.

With `Inputs.RATES`, the inputs are targets of an inner loop, which follows each of them with a first-order lag. T is
the only further state then, and omega has no torque in its equation:

    omega' = (omega_c - omega) / tau_omega,    T' = (T_c - T) / tau_T.

Both are known exactly at every instant; only p, q and v are integrated, so that a lag may be short, or 0.

Where the inner loop takes an attitude q_c instead, it commands rates in proportion to the attitude's error,
omega_c = 2 vec(q* q_c) / tau_a.  The inputs are those rates as they are at the start of a step, omega_0: they say by
how much the attitude is to be turned, in the body's own axes.  In the step the body turns by theta towards q_c, which
takes from them; to first order in theta,

    omega' = (omega_0 - theta / tau_a - omega) / tau_omega,    theta' = omega,    theta = 0 at the start,

is linear, so that omega is again known exactly at every instant.  `inner_response` has its two shares.

The motion and its exact derivatives are computed in C, `quadsim_nmpc_model.c`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from functools import cached_property, partial
from typing import Final, NamedTuple

import numpy as np
import scipy.linalg

from quadsim.core.mirror import constant
from quadsim.mpc.problem.model import SHORTEST_LAG
from quadsim.state import Array, read_only
from quadsim.vehicle import N_ROTORS, Vehicle

SUBSTEPS: Final = constant("QUADSIM_SUBSTEPS")
"""Runge-Kutta steps of a prediction."""
N_BODY: Final = 13
"""States of the body; rotor states follow."""
P = slice(0, 3)
Q = slice(3, 7)
V = slice(7, 10)
W = slice(10, 13)
RATE_SCALE: Final = 1.5
"""The body rate [rad/s] that is a share of 1, where inputs are targets, beside the weight as thrust.  Shares of the
largest would be penalised too little: where noise reaches the controller, rates then move by hundreds of deg/s, for
which the mixer raises the thrust."""
# R(q), row by row: 1 - 2 (yy + zz), 2 (xy - wz), 2 (xz + wy), ..., by the places of its products in q q'.
_FIRST = np.array([10, 6, 7, 6, 5, 11, 7, 11, 5])
_SECOND = np.array([15, 3, 2, 3, 15, 1, 2, 1, 10])
_SIGN: Final = np.array([1.0, -1.0, 1.0, 1.0, 1.0, -1.0, -1.0, 1.0, 1.0])
_EYE: Final = np.eye(3).ravel()
_OUTER: Final = 1.0 - 2.0 * _EYE


def zero() -> Array:
    """Three zeros, not to be written to."""
    return read_only(np.zeros(3))


def _zeros(columns: int) -> Array:
    return read_only(np.zeros((3, columns)))


class Inputs(StrEnum):
    """The physical quantity of the inputs, as shares of the largest."""

    THRUST = "thrust"
    SPEED = "speed"
    RATES = "rates"
    """Collective thrust, as a share of the weight, and body rates, as shares of `RATE_SCALE`."""


@dataclass(frozen=True, kw_only=True)
class RigidBody:
    """x(k+1) = f(x(k), u(k)) between nodes; see the module.  `dataclasses.replace` sets another disturbance."""

    effectiveness: Array  # (4, 4) maps rotor thrusts [N] to T [m/s^2] and I^-1 tau [rad/s^2]
    largest_thrust: float  # of a rotor [N]
    inertia: Array  # (3,) [kg m^2]
    mass: float  # [kg]
    gravity: float  # [m/s^2]
    step: float  # time between nodes [s]
    substeps: int = 1  # Runge-Kutta steps in it
    inputs: Inputs = Inputs.THRUST
    rotor_lag: float | None = None  # time constant of thrusts or speeds [s]; None for none
    lag: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)  # time constants of collective thrust, p, q, r behind targets [s]
    attitude_lag: tuple[float, ...] | None = None  # tau_a about body x, y, z [s], where an attitude is commanded
    thrust_scale: float = 1.0  # thrust that acts per thrust of the inputs
    drag: Array = field(default_factory=zero)  # (3,) D_1, linear, body axes [N s/m]
    quadratic_drag: Array = field(default_factory=zero)  # (3,) D_2, body axes [N s^2/m^2]
    moment: Array = field(default_factory=partial(_zeros, 2))  # (3, 2) maps v_x, v_y [m/s] to I^-1 tau_a per share of W
    inflow: Array = field(default_factory=partial(_zeros, 2))  # (3, 2) maps v_x v_z, v_y v_z [m^2/s^2] to I^-1 tau_a
    damping: Array = field(default_factory=partial(_zeros, 3))  # (3, 3) I^-1 D [1/s]
    loss: float = 0.0  # T that v_z takes, per share of W [1/s]; none of these four with targets
    acceleration: Array = field(default_factory=zero)  # (3,) a of the disturbance, world frame [m/s^2]
    angular_acceleration: Array = field(default_factory=zero)  # (3,) alpha, body frame [rad/s^2]; none with targets

    @cached_property
    def drags(self) -> bool:
        """Whether there is drag."""
        return bool(np.any(self.drag) or np.any(self.quadratic_drag))

    @cached_property
    def moments(self) -> bool:
        """Whether the air turns the body."""
        return bool(self.loss) or any(map(np.any, (self.moment, self.inflow, self.damping)))

    @property
    def targets(self) -> bool:
        """Whether the inputs are targets of an inner loop."""
        return self.inputs is Inputs.RATES

    @property
    def actuators(self) -> int:
        """Number of actuator states: four rotors, the collective thrust, or none."""
        if self.targets:
            return 1
        if self.rotor_lag is None:
            return 0
        return N_ROTORS

    @property
    def n(self) -> int:
        """Number of states."""
        return N_BODY + self.actuators

    @property
    def scale(self) -> Array:
        """(4,) the target [N], [rad/s] that is a share of 1."""
        return np.array([self.mass * self.gravity, RATE_SCALE, RATE_SCALE, RATE_SCALE])

    @property
    def lags(self) -> tuple[float, ...]:
        """(4,) time constants of what follows the inputs [s], 0 for none."""
        if self.targets:
            return self.lag
        return (self.rotor_lag or 0.0,) * N_ROTORS

    @property
    def effect(self) -> Array:
        """(4, 4) maps shares of inputs to T [m/s^2] and I^-1 tau [rad/s^2]; of targets, to T and body rates [rad/s]."""
        if self.targets:
            return np.diag(self.scale / [self.mass, 1.0, 1.0, 1.0])
        return self.effectiveness * self.largest_thrust

    def thrusts(self, shares: Array) -> Array:
        """Return the rotor thrusts [N] for inputs, or for the rotors' states."""
        if self.inputs is Inputs.SPEED:
            return self.largest_thrust * np.square(shares)
        return self.largest_thrust * shares

    def shares(self, thrusts: Array) -> Array:
        """Return the inputs for rotor thrusts [N]; negative ones count as zero if inputs are speeds."""
        shares = np.asarray(thrusts) / self.largest_thrust
        if self.inputs is Inputs.THRUST:
            return shares
        return np.sqrt(np.maximum(shares, 0.0))


class AirMaps(NamedTuple):
    """What the air does to a vehicle, by its velocity through the air and its rates, body axes."""

    across: Array  # (3, 2) maps v_x, v_y [m/s] to angular accelerations [rad/s^2], per share of the speed
    inflow: Array  # (3, 2) maps v_x v_z, v_y v_z [m^2/s^2] to them
    damping: Array  # (3, 3) maps rates [rad/s] to their loss
    loss: float  # maps v_z [m/s] to the loss of U / m [m/s^2], per share of the speed


def air_maps(vehicle: Vehicle, speed: float) -> AirMaps:
    """Return them for shares of a `speed` [rad/s], to which the rotors' speeds add up.

    Of the thrust that rotors lose to their own motion as the vehicle turns, `damping` has the torque, in hover.
    """
    still = np.zeros(3)
    units = np.eye(3)
    across = [vehicle.air_moment(speed, unit, still) for unit in units[:2]]
    climbing = [vehicle.air_moment(0.0, unit + units[2], still) for unit in units[:2]]
    damped = [vehicle.air_moment(0.0, still, unit) for unit in units]
    lost = [vehicle.lost_to_inflow(vehicle.hover_speeds, still, unit)[1:] for unit in units]
    return AirMaps(
        across=read_only(vehicle.angular_acceleration(np.array(across)).T),
        inflow=read_only(vehicle.angular_acceleration(np.array(climbing)).T),
        damping=read_only(vehicle.angular_acceleration(np.array(lost) - np.array(damped)).T),
        loss=(vehicle.inflow or 0.0) * speed / vehicle.mass,
    )


def rigid_body(vehicle: Vehicle, step: float, *, moment: bool = False, **others: object) -> RigidBody:
    """Return the vehicle's model, undisturbed, with `moment` also in the air's torque; `others` sets other fields."""
    if moment:
        air = air_maps(vehicle, vehicle.speed_max)
        others |= {"moment": air.across, "inflow": air.inflow, "damping": air.damping, "loss": air.loss}
    return RigidBody(
        effectiveness=read_only(vehicle.accelerations(vehicle.allocation / vehicle.mean_coefficient)),
        largest_thrust=vehicle.mean_coefficient * vehicle.speed_max**2,
        inertia=read_only(np.array(vehicle.inertia)),
        mass=vehicle.mass,
        gravity=vehicle.gravity,
        step=step,
        **others,  # type: ignore[arg-type]
    )


def inner_response(step: float, count: int, lag: float, attitude_lag: float | None) -> tuple[Array, Array]:
    """Return the shares of an inner loop's answer: omega = a omega(0) + (1 - a - b) omega_0.

    Args:
        step: time between the instants [s], of which the first is 0.
        count: M of them.
        lag: tau_omega, of the rate behind its target [s].
        attitude_lag: tau_a, one over the gain of the attitude's error [s]; None where rates are commanded.

    Returns:
        (M,) a, what is left of the rate at the start, and (M,) b, what the turn so far has taken of the target; without
        `attitude_lag` no turn takes anything.
    """
    times = step * np.arange(count)
    if attitude_lag is None:
        left = np.zeros(count)
        if lag > 0.0:
            left = np.exp(-times / lag)
        return left, np.zeros(count)
    lag = max(lag, SHORTEST_LAG)
    # Of the turn theta, the rate omega and the held target omega_0.
    slope = np.array([[0.0, 1.0, 0.0], [-1.0 / (attitude_lag * lag), -1.0 / lag, 1.0 / lag], [0.0, 0.0, 0.0]])
    transition = scipy.linalg.expm(slope * step)
    left = np.empty(count)
    gained = np.empty(count)
    motion = np.eye(3)
    for i in range(count):
        left[i] = motion[1, 1]
        gained[i] = motion[1, 2]
        motion = transition @ motion
    return left, 1.0 - left - gained


def thrust_axis(q: Array) -> Array:
    """R(q) e_z (..., 3) of quaternions (..., 4) of any length."""
    w, x, y, z = (q[..., i] for i in range(4))
    axis = np.empty((*q.shape[:-1], 3))
    axis[..., 0] = 2.0 * (x * z + w * y)
    axis[..., 1] = 2.0 * (y * z - w * x)
    axis[..., 2] = 1.0 - 2.0 * (x * x + y * y)
    return axis


def rotation(q: Array) -> Array:
    """R(q) (..., 3, 3), polynomial, of quaternions (..., 4) of any length."""
    products = (q[..., :, None] * (2.0 * q[..., None, :])).reshape(*q.shape[:-1], 16)
    sums = products.take(_FIRST, -1) + _SIGN * products.take(_SECOND, -1)
    return (_EYE + _OUTER * sums).reshape(*q.shape[:-1], 3, 3)
