"""Geometric control in NumPy, written from its equations, against which the core is tested."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from quadsim.controller import ROTORS
from quadsim.motion import Motion
from quadsim.mpc.laws.geometric import (
    NO_LAG,
    UNDISTURBED,
    DesiredAttitude,
    ForeseenDisturbance,
    Geometric,
    Integrals,
    geometric_gains,
)
from quadsim.mpc.laws.parts.attitude import LEAST_THRUST_SHARE, Measured
from quadsim.mpc.laws.parts.bandwidths import YAW_SHARE
from quadsim.mpc.laws.parts.preview import MOTION_DEGREE, MOTION_SAMPLES, Target, differentiator
from quadsim.mpc.problem.rigidbody import rotation
from quadsim.rotation import multiply
from quadsim.state import Array, wrapped
from quadsim.vehicle import Vehicle


def vee(matrix: Array) -> Array:
    """(3,) inverse of `hat`, applied to the skew part of a matrix (3, 3)."""
    skew = 0.5 * (matrix - matrix.T)
    return np.array([skew[2, 1], skew[0, 2], skew[1, 0]])


def quaternion_of(rotation: Array) -> Array:
    """(4,) unit quaternion q, wxyz, of a matrix (3, 3): the longest column of 4 q q'."""
    (a, b, c), (d, e, f), (g, h, i) = rotation
    outer = np.array(
        [
            [1.0 + a + e + i, h - f, c - g, d - b],
            [h - f, 1.0 + a - e - i, b + d, c + g],
            [c - g, b + d, 1.0 - a + e - i, f + h],
            [d - b, c + g, f + h, 1.0 - a - e + i],
        ]
    )
    column = outer[np.argmax(np.diag(outer))]
    return np.asarray(column / np.linalg.norm(column))


def attitude_error(attitude: Array, desired: Array) -> Array:
    """e_R = (R_d' R - R' R_d)^vee / 2 (3,).  Lee, Leok, McClamroch (2010)."""
    return vee(desired.T @ attitude)


def rate_error(attitude: Array, rates: Array, desired: Array, desired_rates: Array) -> Array:
    """e_Omega = Omega - R' R_d Omega_d (3,) [rad/s].  Lee, Leok, McClamroch (2010)."""
    return np.asarray(rates - attitude.T @ desired @ desired_rates)


def unit_derivatives(v: Array, v1: Array, v2: Array) -> tuple[Array, Array, Array]:
    """The direction v / |v| of v (3,) != 0 and its first two derivatives (3,), from those of v."""
    length = np.linalg.norm(v)
    u = v / length
    along = u @ v1
    u1 = (v1 - along * u) / length
    u2 = (v2 - (u1 @ v1 + u @ v2) * u - 2.0 * along * u1) / length
    return u, u1, u2


def desired_attitude(force: Sequence[Array], momentum: Sequence[Array], drag: Array, heading: Array) -> DesiredAttitude:
    """R_c = [b_1c, b_2c, b_3c], with b_1c as close to the heading as the force allows.

    Rotors and drag together give `force`, f b_3c - R_c diag(d) R_c' p = A. Perpendicular to b_3c, b_1c . (A + d_x p) =
    0 and b_2c . (A + d_y p) = 0; along it, f = b_3c . (A + d_z p). Faessler et al.  (2018), Eqs.  (12) to (16), with
    body x rather than body y close to a given direction.  Without drag, b_3c lies along A.

    Args:
        force: A and its first two derivatives, (3,) each [N].
        momentum: p, mass times the velocity that causes drag, and its first two derivatives, (3,) each.
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
    return DesiredAttitude(attitude=R_c, rates=Omega_c, acceleration=acceleration_c)


def _with_drag(force: Sequence[Array], momentum: Sequence[Array], drag: float) -> Sequence[Array]:
    return force if drag == 0.0 else [A + drag * p for A, p in zip(force, momentum, strict=True)]


def _cross(a: Sequence[Array], b: Sequence[Array]) -> tuple[Array, Array, Array]:
    """The cross product of two vectors and its first two derivatives, from those of the vectors."""
    (a0, a1, a2), (b0, b1, b2) = a, b
    first = np.cross(a1, b0) + np.cross(a0, b1)
    return np.cross(a0, b0), first, np.cross(a2, b0) + 2.0 * np.cross(a1, b1) + np.cross(a0, b2)


def limit_force(force: Array, *, least: float, tilt: float) -> Array:
    """Limit a force (3,) [N], world, to at least `least` [N] upwards and at most `tilt` [rad] from the vertical.

    The limit changes the vertical part only if it is too small; the horizontal part keeps its direction.
    """
    upward = max(float(force[2]), least)
    horizontal = math.hypot(force[0], force[1])
    allowed = upward * math.tan(tilt)
    share = 1.0 if horizontal <= allowed else allowed / horizontal
    return np.array([share * force[0], share * force[1], upward])


def target_of_motion(motion: Motion, yaw: Array, period: float) -> Target:
    """Return the target from the present and next samples of a motion and yaw (3,), its rate and acceleration.

    All derivatives come from positions and attitudes, not from the velocities that a course states, so that they agree
    with the flown path.  Near the end of the course fewer samples give fewer derivatives.
    """
    samples = min(len(motion), MOTION_SAMPLES)
    degree = min(MOTION_DEGREE, samples - 1)
    operator = differentiator(samples, period, degree=degree, first=0)
    derivatives = np.zeros((MOTION_DEGREE, 3))  # position to snap
    orders = min(degree + 1, MOTION_DEGREE)
    derivatives[:orders] = operator[:orders] @ motion.position[:samples]
    heading = np.zeros((3, 3))
    heading[: min(degree + 1, 3)] = operator[:3] @ rotation(motion.attitude[:samples])[:, :, 0]
    position, velocity, acceleration, jerk, snap = derivatives
    return Target(
        position=position,
        velocity=velocity,
        acceleration=acceleration,
        jerk=jerk,
        snap=snap,
        yaw=float(yaw[0]),
        yaw_rate=float(yaw[1]),
        yaw_acceleration=float(yaw[2]),
        heading=heading,
    )


class NumpyGeometric:
    """The equations of `quadsim.mpc.laws.geometric.GeometricController`."""

    def __init__(self, vehicle: Vehicle, period: float, settings: Geometric) -> None:
        self.commands = settings.commands
        self._vehicle = vehicle
        self._period = period
        self.gains = gains = geometric_gains(vehicle, period, settings)
        self._feedforward = settings.feedforward
        self._drag = np.array(settings.drag)
        self._moment = settings.moment
        self._turning = float(vehicle.hover_speeds.sum())
        self._largest_tilt = math.radians(settings.tilt)
        lags = settings.inner_lag or NO_LAG
        half = 0.5 * period
        self._ahead = half + (lags[0] if settings.commands != ROTORS else 0.0)
        self._lead = np.array(lags[1:]) + (half if settings.feedforward else 0.0)
        self.k_R = gains.k_R * np.array([1.0, 1.0, YAW_SHARE**2])
        self.k_Omega = gains.k_Omega * np.array([1.0, 1.0, YAW_SHARE])

    def wrench(
        self, motion: Measured, target: Target, integrals: Integrals, disturbance: ForeseenDisturbance = UNDISTURBED
    ) -> tuple[Array, DesiredAttitude]:
        J = self._vehicle.momentum
        R = motion.attitude
        Omega = motion.rates
        thrust, desired = self._force(motion, target, integrals, disturbance)
        e_R = attitude_error(R, desired.attitude)
        e_Omega = rate_error(R, Omega, desired.attitude, desired.rates)
        R_rel = R.T @ desired.attitude
        ahead = np.cross(Omega, R_rel @ desired.rates) - R_rel @ desired.acceleration + disturbance[2]
        moment = np.cross(Omega, J(Omega)) - J(self.k_R * e_R + self.k_Omega * e_Omega + integrals.rotation + ahead)
        if self._moment:
            turning = self._turning * math.sqrt(max(thrust, 0.0) / (self._vehicle.mass * self._vehicle.gravity))
            velocity = R.T @ target.velocity
            rates = R_rel @ desired.rates
            moment -= self._vehicle.air_moment(turning, velocity, rates)
            moment += self._vehicle.lost_to_inflow(self._vehicle.hover_speeds, np.zeros(3), rates)[1:]
            thrust += (self._vehicle.inflow or 0.0) * turning * float(velocity[2])
        return np.concatenate([[thrust], moment]), desired

    def targets(
        self, motion: Measured, target: Target, integrals: Integrals, disturbance: ForeseenDisturbance = UNDISTURBED
    ) -> tuple[Array, DesiredAttitude]:
        R = motion.attitude
        Omega = motion.rates
        thrust, desired = self._force(motion, target, integrals, disturbance)
        R_rel = R.T @ desired.attitude
        Omega_d = R_rel @ desired.rates
        rates = Omega_d + self._lead * (R_rel @ desired.acceleration - np.cross(Omega, Omega_d))
        if self.commands == "rates":
            rates -= np.array(self.gains.k_attitude) * attitude_error(R, desired.attitude)
            return np.concatenate([[thrust], rates]), desired
        q = quaternion_of(desired.attitude)
        if self._feedforward:
            q = multiply(q, np.append(1.0, 0.25 * self._period * desired.rates))
            q /= np.linalg.norm(q)
        return np.concatenate([[thrust], rates, q]), desired

    def _force(
        self, motion: Measured, target: Target, integrals: Integrals, disturbance: ForeseenDisturbance
    ) -> tuple[float, DesiredAttitude]:
        gains = self.gains
        m = self._vehicle.mass
        gravity = self._vehicle.gravity
        R = motion.attitude
        Omega = motion.rates
        e_x = motion.position - target.position
        e_v = motion.velocity - target.velocity
        weight = np.array([0.0, 0.0, gravity])
        demanded = m * (-gains.k_x * e_x - gains.k_v * e_v - integrals.translation + weight + target.acceleration)
        demanded -= m * disturbance[0]
        A = limit_force(demanded, least=LEAST_THRUST_SHARE * m * gravity, tilt=self._largest_tilt)
        A1 = A2 = p1 = p2 = np.zeros(3)
        if np.array_equal(A, demanded):
            A1, A2 = self._force_derivatives(motion, target, A, e_v, disturbance)
            p1 = m * target.acceleration
            p2 = m * target.jerk
        desired = desired_attitude(
            (A, A1, A2),
            (m * target.velocity, p1, p2),
            self._drag,
            _heading(motion.yaw, target) if target.heading is None else target.heading,
        )
        if not self._feedforward:
            return float(A @ R[:, 2]), desired
        up = R[:, 2] + self._ahead * R @ np.array([Omega[1], -Omega[0], 0.0])
        along = A + m * self._drag[2] * target.velocity
        along1 = A1 + self._drag[2] * p1
        return float((along + self._ahead * along1) @ up), desired

    def integrate(self, integrals: Integrals, motion: Measured, target: Target, desired: DesiredAttitude) -> Integrals:
        gains = self.gains
        period = self._period
        e_x = motion.position - target.position
        e_v = motion.velocity - target.velocity
        e_R = attitude_error(motion.attitude, desired.attitude)
        e_Omega = rate_error(motion.attitude, motion.rates, desired.attitude, desired.rates)
        translation = integrals.translation + period * gains.k_i * (e_v + gains.c_1 * e_x)
        rotation = integrals.rotation + period * gains.k_I * (e_Omega + gains.c_2 * e_R)
        return Integrals(
            translation=np.clip(translation, -gains.sigma, gains.sigma),
            rotation=np.clip(rotation, -gains.sigma_R, gains.sigma_R),
        )

    def _force_derivatives(
        self, motion: Measured, target: Target, A: Array, e_v: Array, disturbance: ForeseenDisturbance
    ) -> tuple[Array, Array]:
        m = self._vehicle.mass
        R = motion.attitude
        Omega = motion.rates
        k_x = self.gains.k_x
        k_v = self.gains.k_v
        disturbing, change, _ = disturbance
        # R e_3 and its derivative, R hat(Omega) e_3
        up = R[:, 2]
        up1 = R @ np.array([Omega[1], -Omega[0], 0.0])
        v_b = R.T @ motion.velocity
        v_d = R.T @ target.velocity
        f = max(float(A @ up) + m * self._drag[2] * v_d[2], 0.0)
        e_a = f / m * up - np.array([0.0, 0.0, self._vehicle.gravity]) - target.acceleration
        e_a += disturbing - R @ (self._drag * v_b)
        A1 = -m * (k_x * e_v + k_v * e_a) + m * (target.jerk - change)
        f1 = float(A1 @ up + A @ up1)
        e_j = f1 / m * up + f / m * up1 - target.jerk + change
        if self._drag.any():
            along = self._drag[2] * (target.acceleration @ up + target.velocity @ up1)
            v_b1 = R.T @ (e_a + target.acceleration) - np.cross(Omega, v_b)
            e_j += along * up - R @ (np.cross(Omega, self._drag * v_b) + self._drag * v_b1)
        return A1, -m * (k_x * e_a + k_v * e_j) + m * target.snap


def _heading(yaw: float, target: Target) -> Array:
    """(3, 3) rows: the desired horizontal direction of body x, and its first two derivatives.

    e_R vanishes at half a turn, where it should be largest.  If the heading error exceeds a quarter turn, the desired
    heading is a quarter turn away, at rest.
    """
    turn = -wrapped(yaw - target.yaw)
    near = abs(turn) <= 0.5 * math.pi
    heading = yaw + (turn if near else math.copysign(0.5 * math.pi, turn))
    rate, acceleration = (target.yaw_rate, target.yaw_acceleration) if near else (0.0, 0.0)
    along, across = (
        np.array([math.cos(heading), math.sin(heading), 0.0]),
        np.array([-math.sin(heading), math.cos(heading), 0.0]),
    )
    return np.stack([along, rate * across, acceleration * across - rate**2 * along])
