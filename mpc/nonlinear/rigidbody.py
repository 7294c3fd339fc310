"""The rigid body with a quaternion: any attitude, no singularity, exact derivatives of all nodes in one pass.

The states are position p (world), quaternion q = (w, x, y, z) (Hamilton, body to world), velocity v (world) and body
rates omega: 13. With rotor lag, the four rotors' thrusts or speeds are four further states that follow the inputs,

    p' = v,    q' = 1/2 q (0, omega),    v' = T R(q) e_z - g e_z + R(q) d(R(q)' v) + a,
    omega' = I^-1 (tau - omega x I omega) + alpha,    d(v_b) = -(D_1 v_b + D_2 |v_b| v_b) / m, component by component.

R(q) is polynomial and not divided by |q|^2, so the derivatives are valid for a q of any length.  Inputs u are the
rotors' thrusts or speeds as shares of the largest, held between nodes; T = thrust / m and I^-1 tau are known exactly at
every instant.  The classical Runge-Kutta method integrates the body.

With `Inputs.RATES`, the inputs are targets of an inner loop, which follows each of them with a first-order lag. T is
the only further state then, and omega has no torque in its equation:

    omega' = (omega_c - omega) / tau_omega,    T' = (T_c - T) / tau_T.

Both are known exactly at every instant; only p, q and v are integrated, so that a lag may be short, or 0.

All terms but drag are quadratic in (q, omega), for given T and I^-1 tau: with F the Jacobian of that part, linear in
(q, omega, T q), its value is F x / 2. So derivatives and value are the columns of one matrix that passes through the
Runge-Kutta stages.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import StrEnum
from functools import cache, cached_property
from typing import Final

import numpy as np

from mpc.nonlinear.model import zero
from quadsim.state import Array, read_only
from quadsim.vehicle import N_ROTORS, Vehicle

N_BODY: Final = 13
"""States of the body; rotor states follow."""
P, Q, V, W = slice(0, 3), slice(3, 7), slice(7, 10), slice(10, 13)
_TURNING: Final = 10
"""Rows and columns of (q, v, omega), on which the derivatives depend."""
RATE_SCALE: Final = 1.5
"""The body rate [rad/s] that is a share of 1, where inputs are targets, beside the weight as thrust.  Shares of the
largest would be penalised too little: where noise reaches the controller, rates then move by hundreds of deg/s, for
which the mixer raises the thrust."""
_q, _v, _w = slice(0, 4), slice(4, 7), slice(7, 10)


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
    thrust_scale: float = 1.0  # thrust that acts per thrust of the inputs
    drag: Array = field(default_factory=zero)  # (3,) D_1, linear, body axes [N s/m]
    quadratic_drag: Array = field(default_factory=zero)  # (3,) D_2, body axes [N s^2/m^2]
    acceleration: Array = field(default_factory=zero)  # (3,) a of the disturbance, world frame [m/s^2]
    angular_acceleration: Array = field(default_factory=zero)  # (3,) alpha, body frame [rad/s^2]; none with targets

    @cached_property
    def features(self) -> Array:
        """(11, 100): maps (q, omega, T q) to F, the Jacobian of (q, v, omega)' in (q, v, omega) without drag."""
        if self.targets:
            return _features((0.0, 0.0, 0.0))
        ixx, iyy, izz = self.inertia.tolist()
        return _features(((iyy - izz) / ixx, (izz - ixx) / iyy, (ixx - iyy) / izz))

    @cached_property
    def drags(self) -> bool:
        """Whether there is drag."""
        return bool(np.any(self.drag) or np.any(self.quadratic_drag))

    @property
    def targets(self) -> bool:
        """Whether the inputs are targets of an inner loop."""
        return self.inputs is Inputs.RATES

    @property
    def actuators(self) -> int:
        """Number of actuator states: four rotors, the collective thrust, or none."""
        if self.targets:
            return 1
        return 0 if self.rotor_lag is None else N_ROTORS

    @property
    def n(self) -> int:
        """Number of states."""
        return N_BODY + self.actuators

    @property
    def scale(self) -> Array:
        """(4,) the target [N], [rad/s] that is a share of 1."""
        return np.array([self.mass * self.gravity, RATE_SCALE, RATE_SCALE, RATE_SCALE])

    def thrusts(self, shares: Array) -> Array:
        """Return the rotor thrusts [N] for inputs, or for the rotors' states."""
        return self.largest_thrust * (np.square(shares) if self.inputs is Inputs.SPEED else shares)

    def shares(self, thrusts: Array) -> Array:
        """Return the inputs for rotor thrusts [N]; negative ones count as zero if inputs are speeds."""
        shares = np.asarray(thrusts) / self.largest_thrust
        return shares if self.inputs is Inputs.THRUST else np.sqrt(np.maximum(shares, 0.0))


def rigid_body(vehicle: Vehicle, step: float, **others: object) -> RigidBody:
    """Return the vehicle's model, undisturbed; `others` sets fields of `RigidBody`."""
    return RigidBody(
        effectiveness=read_only(vehicle.accelerations(vehicle.allocation / vehicle.mean_coefficient)),
        largest_thrust=vehicle.mean_coefficient * vehicle.speed_max**2,
        inertia=read_only(np.array(vehicle.inertia)),
        mass=vehicle.mass,
        gravity=vehicle.gravity,
        step=step,
        **others,  # type: ignore[arg-type]
    )


@cache
def _features(gyration: tuple[float, float, float]) -> Array:
    F = np.zeros((11, _TURNING, _TURNING))
    w, x, y, z, p, q, r, Tw = range(8)  # the last is the first of four components of T q
    half = 0.5
    # q' = 1/2 q (0, omega): each term is sign/2 q_i omega_j in row k.
    for k, i, j, sign in (
        (0, x, p, -1), (0, y, q, -1), (0, z, r, -1),
        (1, w, p, 1), (1, y, r, 1), (1, z, q, -1),
        (2, w, q, 1), (2, x, r, -1), (2, z, p, 1),
        (3, w, r, 1), (3, x, q, 1), (3, y, p, -1),
    ):  # fmt: skip
        F[j, k, i] += sign * half
        F[i, k, j + 3] += sign * half
    # v' = T R e_z: 2 T (x z + w y), 2 T (y z - w x), T (1 - 2 (x^2 + y^2)).
    for row, i, j, sign in ((4, x, z, 2), (4, w, y, 2), (5, y, z, 2), (5, w, x, -2), (6, x, x, -2), (6, y, y, -2)):
        F[j + Tw, row, i] += sign
        F[i + Tw, row, j] += sign
    for row, (i, j, k) in enumerate(((q, r, 0), (r, p, 1), (p, q, 2))):
        F[j, 7 + row, i + 3] += gyration[k]
        F[i, 7 + row, j + 3] += gyration[k]
    return read_only(F.reshape(11, -1))


_UP: Final = np.array([0.0, 0.0, 1.0])
_EYE: Final = np.eye(3)
_START: Final = np.eye(_TURNING, _TURNING + 2 * N_ROTORS + 1)
_HALF: Final = np.repeat([0.5, 0.0, 0.5], [4, 3, 3])


def thrust_axis(q: Array) -> Array:
    """R(q) e_z (..., 3) of quaternions (..., 4) of any length."""
    w, x, y, z = np.moveaxis(q, -1, 0)
    return np.stack([2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)], axis=-1)


def rotation(q: Array) -> Array:
    """R(q) (..., 3, 3), polynomial, of quaternions (..., 4) of any length."""
    w, x, y, z = (q[..., i] for i in range(4))
    rows = [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
        [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
        [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def _rotation_slopes() -> Array:
    """(4, 36): maps q to the derivatives (4, 3, 3) of R(q) in its components."""
    q = np.eye(4)  # R - I is a quadratic form; this is its polarisation
    return (rotation(q[:, None] + q) - rotation(q)[:, None] - rotation(q) + np.eye(3)).reshape(4, 36)


_SLOPES: Final = _rotation_slopes()


def linearise_nodes(model: RigidBody, x: Array, u: Array, frames: Array | None = None) -> tuple[Array, Array, Array]:
    """Linearise the map from M nodes' states x (M, n) under inputs u (M, 4) to the next nodes: A, B and x(k+1).

    With `frames` (M + 1, 4, 4), orthogonal matrices that multiply the quaternion, A and B refer to the transformed
    states: the first M frames at the start of the steps, the last M at the end.

    Returns:
        (M, n, n), (M, n, 4) and (M, n): exact derivatives of the Runge-Kutta map; x(k+1) is not transformed.
    """
    m = model.n - 3 + N_ROTORS + 1  # columns: q, v, omega, actuators, inputs, and the value
    Y = np.empty((len(x), _TURNING, m))
    Y[:] = _START[:, :m]
    if frames is not None:
        Y[:, _q, _q] = frames[:-1].transpose(0, 2, 1)
    Y[:, :, -1] = x[:, 3:N_BODY]
    Y, travelled = _integrate(model, *_drives(model, x, u), Y)
    return _assemble(model, x, u, Y, travelled, frames)


def _integrate(model: RigidBody, drives: Array, turning: Array | None, Y: Array) -> tuple[Array, Array]:
    """Integrate columns Y (M, 10, m) through the Runge-Kutta stages; also return (M, 3, m) the change of position.

    The columns are derivatives of (q, v, omega), and last its value, or the value alone; `drives` are those of the
    last. The rows of omega are `turning` (K, M, 3, m) at the K instants, where they are known.
    """
    M, _, m = Y.shape
    lagging, driven = len(drives) > 1, slice(m - drives.shape[-1], m)
    h = model.step / model.substeps
    constant = model.acceleration - model.gravity * _UP

    def slope(k: int, Y: Array) -> Array:
        if turning is not None:
            Y = Y.copy()
            Y[:, _w] = turning[k]
        state, drive = Y[:, :, -1], drives[k if lagging else 0]
        q = state[:, _q]
        z = np.concatenate([q, state[:, _w], q * drive[:, 0, -1:]], axis=1)
        F = (z @ model.features).reshape(M, _TURNING, _TURNING)
        drag = _drag(model, F, state) if model.drags else 0.0
        K = F @ Y
        K[:, :, -1] *= _HALF
        along = thrust_axis(q)[:, :, None] * drive[:, :1]
        along[:, :, -1] += constant
        K[:, _v, driven] += along
        if turning is None:
            K[:, _w, driven] += drive[:, 1:]
        K[:, _v, -1] += drag
        return np.asarray(K)

    travelled = np.zeros((M, 3, m))  # of position, without the straight motion
    for s in range(0, 4 * model.substeps, 4):
        first = slope(s, Y)
        second = slope(s + 1, Y + 0.5 * h * first)
        third = slope(s + 2, Y + 0.5 * h * second)
        fourth = slope(s + 3, Y + h * third)
        total = first + second + third
        travelled += h * Y[:, _v] + (h * h / 6.0) * total[:, _v]
        Y = Y + h / 6.0 * (total + second + third + fourth)
    if turning is not None:
        Y[:, _w] = turning[-1]
    return Y, travelled


def _assemble(
    model: RigidBody, x: Array, u: Array, Y: Array, travelled: Array, frames: Array | None
) -> tuple[Array, Array, Array]:
    M, n = len(x), model.n
    A, B, end = np.zeros((M, n, n)), np.empty((M, n, N_ROTORS)), np.empty((M, n))
    end[:, P], end[:, 3:N_BODY] = x[:, P] + travelled[:, :, -1], Y[:, :, -1]
    if frames is not None:
        Y[:, _q, :-1] = frames[1:] @ Y[:, _q, :-1]
    inputs = slice(n - 3, n - 3 + N_ROTORS)
    A[:, :3, :3] = _EYE
    A[:, P, 3:] = travelled[:, :, : n - 3]
    A[:, 3:N_BODY, 3:] = Y[:, :, : n - 3]
    B[:, P], B[:, 3:N_BODY] = travelled[:, :, inputs], Y[:, :, inputs]
    if model.actuators:
        states, decay = np.arange(N_BODY, n), _left(model)
        A[:, states, states] = decay
        B[:, N_BODY:] = (1.0 - decay) * np.eye(N_ROTORS)[: model.actuators]
        end[:, N_BODY:] = _actuators_after(model, x, u)
    return A, B, end


def _left(model: RigidBody) -> float:
    """Return the share of an actuator state's distance from its input that a step leaves; only with these states."""
    lag = model.lag[0] if model.targets else model.rotor_lag
    return math.exp(-model.step / lag) if lag else 0.0


def _actuators_after(model: RigidBody, x: Array, u: Array) -> Array:
    """(M, 4 or 1) the actuators' states after a step; only with these states."""
    followed = u[:, : model.actuators]
    return followed + _left(model) * (x[:, N_BODY:] - followed)


def _drives(model: RigidBody, x: Array, u: Array) -> tuple[Array, Array | None]:
    """Slopes of (T, I^-1 tau) in the actuators' states and inputs, and values, at K instants; see `_integrate`.

    Returns:
        (K, M, 4, 4 or 8, and 1), and None; with targets, T alone (K, M, 1, 6), and omega (K, M, 3, 16).
    """
    instants = (np.arange(model.substeps)[:, None] + [0.0, 0.5, 0.5, 1.0]).ravel()
    if model.targets:
        return _followed(model, instants * (model.step / model.substeps), x, u)
    if model.rotor_lag is None:
        decay = np.zeros(1)
    else:
        decay = np.exp(-instants * (model.step / model.substeps / model.rotor_lag))
    lagging = model.rotor_lag is not None
    now = u[None] if not lagging else u + decay[:, None, None] * (x[:, N_BODY:] - u)  # (K, M, 4)
    effect = model.effectiveness * (model.largest_thrust * model.thrust_scale)
    drives = np.empty((len(decay), len(x), 4, N_ROTORS * (1 + lagging) + 1))
    by_share = effect if model.inputs is Inputs.THRUST else effect * (2.0 * now[:, :, None, :])
    drives[..., -N_ROTORS - 1 : -1] = by_share
    if lagging:
        drives[..., :N_ROTORS] = decay[:, None, None, None] * by_share
        drives[..., N_ROTORS:-1] *= 1.0 - decay[:, None, None, None]
    drives[..., -1] = (now if model.inputs is Inputs.THRUST else np.square(now)) @ effect.T
    drives[..., 1:, -1] += model.angular_acceleration
    return drives, None


def _followed(model: RigidBody, instants: Array, x: Array, u: Array) -> tuple[Array, Array]:
    """See `_drives`, with targets, which T and omega approach exponentially; at once where a lag is 0."""
    lag = np.array(model.lag)
    left = np.where(lag > 0.0, np.exp(-instants[:, None] / np.where(lag > 0.0, lag, 1.0)), 0.0)  # (K, 4)
    effect = model.scale * [model.thrust_scale / model.mass, 1.0, 1.0, 1.0]  # T [m/s^2] and omega of a share of 1
    start = np.concatenate([effect[0] * x[:, N_BODY:], x[:, W]], axis=1)
    now = effect * u + left[:, None] * (start - effect * u)  # (K, M, 4): T, omega
    T, turning = np.zeros((len(left), len(x), 1, 6)), np.zeros((len(left), len(x), 3, 16))
    T[..., 0, 0] = effect[0] * left[:, :1]
    T[..., 0, 1] = effect[0] * (1.0 - left[:, :1])
    T[..., 0, -1] = now[..., 0]
    axes = np.arange(3)
    turning[:, :, axes, 7 + axes] = left[:, None, 1:]
    turning[:, :, axes, 12 + axes] = effect[1:] * (1.0 - left[:, None, 1:])
    turning[..., -1] = now[..., 1:]
    return T, turning


def _drag(model: RigidBody, F: Array, state: Array) -> Array:
    """Add drag's derivatives to F (M, 10, 10); return (M, 3) its acceleration [m/s^2], for states (M, 10)."""
    q, v = state[:, _q], state[:, _v]
    slopes = (q @ _SLOPES).reshape(-1, 4, 3, 3)  # slopes of R in each component of q; R - I is quadratic
    R = 0.5 * (q[:, None] @ slopes.reshape(-1, 4, 9)).reshape(-1, 3, 3) + _EYE
    body = (v[:, None] @ R)[:, 0]
    size = np.abs(body)
    pull = -(model.drag + model.quadratic_drag * size) * body / model.mass
    rate = -(model.drag + 2.0 * model.quadratic_drag * size) / model.mass
    damping = R * rate[:, None]
    F[:, _v, _v] += damping @ R.transpose(0, 2, 1)
    F[:, _v, _q] += (slopes @ pull[:, None, :, None])[..., 0].transpose(0, 2, 1)
    F[:, _v, _q] += damping @ (v[:, None, None] @ slopes)[:, :, 0].transpose(0, 2, 1)
    return (R @ pull[:, :, None])[:, :, 0]


def drag_acceleration(model: RigidBody, q: Array, v: Array) -> Array:
    """(..., 3) acceleration by drag, world [m/s^2], for quaternions (..., 4) and velocities (..., 3) [m/s]."""
    R = rotation(q)
    air = (np.swapaxes(R, -1, -2) @ v[..., None])[..., 0]
    pull = -(model.drag * air + model.quadratic_drag * np.abs(air) * air) / model.mass
    return np.asarray((R @ pull[..., None])[..., 0])


def advance_nodes(model: RigidBody, x: Array, u: Array) -> Array:
    """Return the states (..., n) one step after states x (..., n) under inputs u (..., 4), without derivatives."""
    shape, x, u = x.shape, x.reshape(-1, model.n), u.reshape(-1, N_ROTORS)
    drives, turning = _drives(model, x, u)
    Y, travelled = _integrate(
        model, drives[..., -1:], None if turning is None else turning[..., -1:], x[:, 3:N_BODY, None]
    )
    end = [x[:, P] + travelled[:, :, 0], Y[:, :, 0]]
    if model.actuators:
        end.append(_actuators_after(model, x, u))
    return np.concatenate(end, axis=1).reshape(shape)
