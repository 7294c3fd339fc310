"""Geometric tracking control on SE(3): Lee, Leok, McClamroch (2010), integrals by Goodarzi, Lee, Lee (2013).

With feed-forward by differential flatness: Faessler, Franchi, Scaramuzza, "Differential Flatness of Quadrotor Dynamics
Subject to Rotor Drag for Accurate Tracking of High-Speed Trajectories", 2018.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Final, Literal, TypeAlias

import numpy as np
from annotated_types import Len, doc

from mpc.allocation import allocate, make_allocation
from mpc.answer import ActuatorBounds
from mpc.baselines.attitude import (
    LEAST_THRUST_SHARE,
    DesiredAttitude,
    Measured,
    attitude_error,
    desired_attitude,
    limit_force,
    motion_of,
    quaternion_of,
    rate_error,
)
from mpc.baselines.bandwidths import SEPARATION, YAW_SHARE, lag_to_allow_for, require_positive
from mpc.baselines.law import FeedbackLaw, Tuned
from mpc.baselines.preview import PREVIEW_DEGREE, Target, differentiator, target_of, target_of_motion
from mpc.bounded import USUAL_TARGETS, Range, Seconds, TargetBounds, law_of, require_lags, require_space
from mpc.disturbance import RampObserver, RampSettings
from mpc.indi import INDISettings, TorqueIncrement, require_one_scale
from mpc.model import target_model
from mpc.nonlinear.model import zero
from mpc.obstacles import Shape
from quadsim.controller import ROTORS, Command, Phase, StepInputs
from quadsim.errors import ParameterError
from quadsim.fields import NonNegative
from quadsim.rotation import multiply
from quadsim.state import Array, wrapped
from quadsim.vehicle import Vehicle

Commands: TypeAlias = Literal["rotors", "rates", "attitude"]


NO_LAG: Final = (0.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True, kw_only=True)
class GeometricGains:
    """Gains of a geometric controller; `geometric_gains` derives them from a vehicle and a period.

    Those of the heading have `YAW_SHARE` of the bandwidth: its factor for k_Omega, its square for k_R, as reaction
    torques are weak.
    """

    k_x: float  # gain of the position error [1/s^2], k_x / m of Lee et al. (2010)
    k_v: float  # gain of the velocity error [1/s], k_v / m there
    k_R: float  # gain of the roll and pitch error [1/s^2], J^-1 k_R there
    k_Omega: float  # gain of the roll and pitch rate error [1/s], J^-1 k_Omega there
    k_i: float  # gain of the integral of e_v + c_1 e_x [1/s^2]; 0 for none, as in Lee et al. (2010)
    k_I: float  # gain of the integral of e_Omega + c_2 e_R [1/s^2]; 0 for none
    c_1: float  # weight of the position error in the first integral [1/s]
    c_2: float  # weight of the attitude error in the second [1/s]
    sigma: float = 5.0  # limit of the first integral, per axis [m/s^2]
    sigma_R: float = 5.0  # limit of the second integral, per axis [rad/s^2]
    k_attitude: tuple[float, ...]
    """Gains from the attitude error about body x, y, z to the rates commanded [1/s]; only for an autopilot's rates."""


def geometric_gains(vehicle: Vehicle, period: float, settings: Geometric) -> GeometricGains:
    """Return gains that follow from the period [s] and the lag.

    The law feeds forward the rotation of the desired attitude, so its linearisation has the polynomial (s^2 + k_Omega s
    + k_R)(s^2 + k_v s + k_x), and its gain from rate error to angular acceleration is about k_Omega + k_v.  That sum is
    1 / (2 (period / 2 + lag)), as in `bandwidths`. The outer pair is four times slower than the inner pair (twice the
    cascade's separation of 2), and both have the damping 1 / sqrt(2): k_R = k_Omega^2 / 2. The integrals of Goodarzi et
    al.  (2013) act at a quarter of the bandwidth of the loops that they support.

    An autopilot's rates follow with its `inner_lag`; `lag` replaces that of p and q.  About each
    axis, an attitude error has the gain k = k_R / k_Omega, with the sum k + k_v = 1 / (2 (period / 2 + lag)), that of
    the loop which is the innermost then, and k_v = k / 2, as above.  The polynomial is (lag s^2 + s + k)(s^2 + k_v s +
    k_x), with a damping of at least 1 / sqrt(2).  The slower of p and q counts for k_v, and the autopilot integrates in
    place of the second integral.  One that takes attitudes is assumed to have about this k; allow for a slower one by
    `lag`.
    """
    require_positive("period", period)
    lag, targets = settings.lag, settings.commands != ROTORS
    allowed = lag_to_allow_for(vehicle, period) if lag is None else lag
    k_Omega = 1.0 / (2.0 * (0.5 * period + allowed)) / (1.0 + SEPARATION**-2)
    k_v = k_Omega / SEPARATION**2
    k = np.zeros(3)
    if targets:
        _, p, q, r = require_lags(settings.inner_lag)
        lags = np.array([p, q, r] if lag is None else [lag, lag, r])
        k = 1.0 / (2.0 * (0.5 * period + lags)) / (1.0 + SEPARATION**-1)
        k_v = float(k[:2].min()) / SEPARATION
    return GeometricGains(
        k_x=k_v**2 / SEPARATION,
        k_v=k_v,
        k_R=k_Omega**2 / SEPARATION,
        k_Omega=k_Omega,
        k_i=0.25 * k_v**2 / SEPARATION if settings.integral else 0.0,
        k_I=0.05 * k_Omega**2 / SEPARATION if settings.integral and not targets else 0.0,
        c_1=k_v / SEPARATION,
        c_2=k_Omega / SEPARATION,
        k_attitude=tuple(k.tolist()),
    )


@dataclass(frozen=True, kw_only=True)
class Integrals:
    """The integral terms, limited to +-sigma: acceleration, world, and angular acceleration, body; (3,) each."""

    translation: Array
    rotation: Array


Disturbance: TypeAlias = tuple[Array, Array, Array]
"""The disturbance: acceleration and its rate of change, world, and angular acceleration, body; (3,) each."""
UNDISTURBED: Final[Disturbance] = (zero(), zero(), zero())


class GeometricController(FeedbackLaw):
    """Thrust along the body axis and a moment from errors on SE(3).  Frames: `docs/conventions.md`.

    It commands rotor speeds, or to an autopilot targets: thrust and body rates (4,) [N, rad/s], or these and a
    quaternion wxyz (8,), with rates that are fed forward. With targets, `reset` and `StepInputs.acting` are targets.

    Attributes:
        commands: what it commands.
        gains: of its errors.
        k_R: (3,) gains of the attitude error about body x, y, z [1/s^2].
        k_Omega: (3,) gains of the rate error [1/s].
    """

    name: Final = "geometric"

    def __init__(self, vehicle: Vehicle, period: float, settings: Geometric) -> None:
        self.commands, self._targets, self._vehicle = settings.commands, settings.commands != ROTORS, vehicle
        self.gains = gains = geometric_gains(vehicle, period, settings)
        self._feedforward, self._drag, self._moment = settings.feedforward, np.array(settings.drag), settings.moment
        if settings.moment:
            vehicle.require_moment("controller")
        self._turning = float(vehicle.hover_speeds.sum())  # of all rotors [rad/s]
        self._largest_tilt, lags = math.radians(settings.tilt), settings.inner_lag or NO_LAG
        half = 0.5 * period
        self._ahead = half + (lags[0] if self._targets else 0.0)  # of the thrust that is fed forward
        self._lead = np.array(lags[1:]) + (half if settings.feedforward else 0.0)
        self._observer = None
        if settings.disturbance is not None:
            lag = lags[0] if self._targets else None
            self._observer = RampObserver(
                settings.disturbance, vehicle, period, drag=settings.drag, moment=settings.moment, thrust_lag=lag
            )
        super().__init__(vehicle, period, settings, target_model(vehicle, period, lags) if self._targets else None)
        if settings.feedforward:
            self._operator = differentiator(settings.horizon, period, degree=PREVIEW_DEGREE)
        self.k_R = gains.k_R * np.array([1.0, 1.0, YAW_SHARE**2])
        self.k_Omega = gains.k_Omega * np.array([1.0, 1.0, YAW_SHARE])
        self._allocation = make_allocation(vehicle)

    def reset(self, speeds: Array) -> None:
        """Restart after the command u(-1) (4,) [rad/s], or target."""
        super().reset(speeds)
        self._integrals = Integrals(translation=np.zeros(3), rotation=np.zeros(3))
        if self._observer is not None:
            self._observer.reset(speeds[0] if self._targets else speeds)

    def adopt(self, previous: object) -> None:
        """Take over the integrals and the observer of the previous law."""
        if isinstance(previous, GeometricController):
            self._integrals = previous._integrals
            if self._observer is not None and previous._observer is not None:
                self._observer.adopt(previous._observer)

    def _command(self, now: StepInputs, state: Array, reference: Array, before: Array) -> Command:
        """Return the law's wrench as rotor speeds, or its targets; the integrals hold while bounds limit it."""
        exact = self._feedforward or self._observer is not None
        motion = motion_of(state, now.attitude, now.body_rates) if exact else motion_of(state)
        target = target_of(reference, self._operator)
        if self._feedforward and now.motion is not None:
            yaw = np.array([target.yaw, target.yaw_rate, target.yaw_acceleration])
            target = target_of_motion(now.motion, yaw, self._period)
        disturbance = self._observed(now, motion, before)
        kappa = 1.0 if self._observer is None else self._observer.thrust_scale
        if self._targets:
            speeds, desired = self.targets(motion, target, self._integrals, disturbance)
            speeds[0] /= kappa
            demanded = speeds[:3].copy()  # translation does not depend on yaw
            speeds[:4] = self.bounds.clip(speeds[:4], before)
            attained = np.array_equal(speeds[:3], demanded)
        else:
            wrench, desired = self.wrench(motion, target, self._integrals, disturbance)
            wrench /= kappa
            lower, upper = self.bounds.reach(before)
            speeds = allocate(self._allocation, wrench, lower, upper)
            attained = np.allclose(
                self._allocation.M @ speeds**2, wrench, rtol=0.0, atol=1e-6 * self._allocation.scale.max()
            )
        if attained and now.phase is Phase.FLYING:
            self._integrals = self.integrate(self._integrals, motion, target, desired)
        return self._held_for_a_period(speeds)

    def _observed(self, now: StepInputs, motion: Measured, before: Array) -> Disturbance:
        """Predict the disturbance in the middle of the period that starts now; zero until the vehicle flies."""
        if self._observer is None:
            return UNDISTURBED
        acting = before[0] if self._targets else before
        if now.phase is not Phase.FLYING:
            self._observer.reset(acting)
            return UNDISTURBED
        self._observer.update(now.time, motion.velocity, motion.attitude, motion.rates, acting)
        self._observer.log(now)
        return self._observer.foreseen(0.5 * self._period)

    def wrench(
        self, motion: Measured, target: Target, integrals: Integrals, disturbance: Disturbance = UNDISTURBED
    ) -> tuple[Array, DesiredAttitude]:
        """Return [f, M_x, M_y, M_z] (4,) [N, N m], and the attitude that the moment turns to.

        f = A . R e_3 with A = m (-k_x e_x - k_v e_v + g e_3 + x_d'' - d) less the integral, and
        M = -J (k_R e_R + k_Omega e_Omega + d_Omega) + Omega x J Omega
            - J (hat(Omega) R' R_c Omega_c - R' R_c Omega_c'),

        with the observed disturbance d, d_Omega.  Feed-forward adds the drag at the reference's velocity
        (`desired_attitude`), and f is that of half a period later.  With `moment`, M also balances `Vehicle.air_moment`
        at the reference's velocity and rates, with rotor speeds as the root of f.

        Where the limits of tilt or lift change A, the desired attitude counts as constant.
        """
        J, R, Omega = self._vehicle.momentum, motion.attitude, motion.rates
        thrust, desired = self._force(motion, target, integrals, disturbance)
        e_R, e_Omega = attitude_error(R, desired.attitude), rate_error(R, Omega, desired.attitude, desired.rates)
        R_rel = R.T @ desired.attitude
        ahead = np.cross(Omega, R_rel @ desired.rates) - R_rel @ desired.acceleration + disturbance[2]
        moment = np.cross(Omega, J(Omega)) - J(self.k_R * e_R + self.k_Omega * e_Omega + integrals.rotation + ahead)
        if self._moment:
            turning = self._turning * math.sqrt(max(thrust, 0.0) / (self._vehicle.mass * self._vehicle.gravity))
            moment -= self._vehicle.air_moment(turning, R.T @ target.velocity, R_rel @ desired.rates)
        return np.concatenate([[thrust], moment]), desired

    def targets(
        self, motion: Measured, target: Target, integrals: Integrals, disturbance: Disturbance = UNDISTURBED
    ) -> tuple[Array, DesiredAttitude]:
        """Return thrust and body rates (4,) [N, rad/s], for "attitude" (8,) with a quaternion wxyz, and R_c.

        f is that of `wrench`, with feed-forward that of half a period and the thrust's lag later.  The rates are

            Omega_d + lag Omega_d' - k e_R,    Omega_d = R' R_c Omega_c,

        which the inner loop, Omega' = (command - Omega) / lag, turns into

            lag (Omega - Omega_d)' + (Omega - Omega_d) + k e_R = 0,

        as the moment of `wrench` would with k_Omega = 1 / lag and k_R = k / lag.  Feed-forward adds half a period to
        the lag in the command.  An autopilot that takes R_c, with feed-forward that of half a period later, adds its
        own k e_R.
        """
        R, Omega = motion.attitude, motion.rates
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
        self, motion: Measured, target: Target, integrals: Integrals, disturbance: Disturbance
    ) -> tuple[float, DesiredAttitude]:
        """Return the thrust [N] along body z, and the desired attitude; see `wrench`."""
        gains, m, gravity = self.gains, self._vehicle.mass, self._vehicle.gravity
        R, Omega = motion.attitude, motion.rates
        e_x, e_v = motion.position - target.position, motion.velocity - target.velocity
        weight = np.array([0.0, 0.0, gravity])
        demanded = m * (-gains.k_x * e_x - gains.k_v * e_v - integrals.translation + weight + target.acceleration)
        demanded -= m * disturbance[0]
        A = limit_force(demanded, least=LEAST_THRUST_SHARE * m * gravity, tilt=self._largest_tilt)
        A1 = A2 = p1 = p2 = np.zeros(3)
        if np.array_equal(A, demanded):
            A1, A2 = self._force_derivatives(motion, target, A, e_v, disturbance)
            p1, p2 = m * target.acceleration, m * target.jerk
        desired = desired_attitude(
            (A, A1, A2),
            (m * target.velocity, p1, p2),
            self._drag,
            _heading(motion.yaw, target) if target.heading is None else target.heading,
        )
        if not self._feedforward:
            return float(A @ R[:, 2]), desired
        up = R[:, 2] + self._ahead * R @ np.array([Omega[1], -Omega[0], 0.0])
        along, along1 = A + m * self._drag[2] * target.velocity, A1 + self._drag[2] * p1
        return float((along + self._ahead * along1) @ up), desired

    def integrate(self, integrals: Integrals, motion: Measured, target: Target, desired: DesiredAttitude) -> Integrals:
        """Return the integrals of e_v + c_1 e_x and e_Omega + c_2 e_R one period later, saturated."""
        gains, period = self.gains, self._period
        e_x, e_v = motion.position - target.position, motion.velocity - target.velocity
        e_R = attitude_error(motion.attitude, desired.attitude)
        e_Omega = rate_error(motion.attitude, motion.rates, desired.attitude, desired.rates)
        translation = integrals.translation + period * gains.k_i * (e_v + gains.c_1 * e_x)
        rotation = integrals.rotation + period * gains.k_I * (e_Omega + gains.c_2 * e_R)
        return Integrals(
            translation=np.clip(translation, -gains.sigma, gains.sigma),
            rotation=np.clip(rotation, -gains.sigma_R, gains.sigma_R),
        )

    def _force_derivatives(
        self, motion: Measured, target: Target, A: Array, e_v: Array, disturbance: Disturbance
    ) -> tuple[Array, Array]:
        """Return A' and A'' (3,), by the equations of motion under the law's own thrust, drag and disturbance.

        The disturbance is assumed to change at a constant rate; drag turns with the body.
        """
        m, R, Omega, k_x, k_v = self._vehicle.mass, motion.attitude, motion.rates, self.gains.k_x, self.gains.k_v
        disturbing, change, _ = disturbance
        up, up1 = R[:, 2], R @ np.array([Omega[1], -Omega[0], 0.0])  # R e_3 and its derivative, R hat(Omega) e_3
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


@dataclass(frozen=True, kw_only=True)
class Geometric(Tuned):
    """Geometric tracking on SE(3)."""

    type: Annotated[Literal["geometric"], doc("the control law, by its name in `quadsim list`")] = "geometric"
    integral: Annotated[bool, doc("whether position and attitude errors are integrated")] = False
    feedforward: Annotated[
        bool, doc("whether the reference's jerk and snap are fed forward, and drag, by differential flatness")
    ] = False
    drag: Annotated[
        tuple[NonNegative, ...],
        Len(3, 3),
        doc("[1/s] linear drag along body x, y, z that feedforward compensates"),
    ] = (0.0, 0.0, 0.0)
    moment: Annotated[
        bool,
        doc("whether feedforward balances the vehicle's rotor_moment and rate_damping, at the reference's motion"),
    ] = False
    disturbance: Annotated[RampSettings | None, doc("absent: no disturbance observer")] = None
    indi: Annotated[INDISettings | None, doc("absent: rotors hold each command for a period")] = None
    commands: Annotated[
        Commands, doc("rotor speeds, or to an autopilot thrust and body rates, or thrust and attitude")
    ] = "rotors"
    inner_lag: Annotated[
        Annotated[tuple[Seconds, ...], Len(4, 4)] | None,
        doc("[s] time constants of thrust, p, q, r behind an autopilot's targets; absent: identified by steps on it"),
    ] = None
    target_bounds: Annotated[TargetBounds, doc('only where commands is not "rotors"')] = USUAL_TARGETS

    def __post_init__(self) -> None:
        require_space(self, {"input_bounds": None, "indi": None})
        require_one_scale(self.indi, self.disturbance)
        if any(self.drag) and not self.feedforward:
            raise ParameterError("", "drag", [*self.drag], "zero where feedforward is not true")
        if self.moment and (not self.feedforward or self.commands != ROTORS):
            raise ParameterError("", "moment", True, 'false where feedforward is not true or commands is not "rotors"')
        if self.feedforward and self.horizon <= PREVIEW_DEGREE:
            rule = f"at least {PREVIEW_DEGREE + 1} where feedforward is true"
            raise ParameterError("", "horizon", self.horizon, rule)

    def audited(self, vehicle: Vehicle) -> dict[str, Range]:
        """See `mpc.bounded.ControllerTable.audited`."""
        return super().audited(vehicle) if self.commands == "rotors" else self.target_bounds.audited(vehicle)

    def actuators(self, vehicle: Vehicle) -> ActuatorBounds:
        """See `mpc.baselines.law.Baseline.actuators`; of targets where it commands these."""
        return super().actuators(vehicle) if self.commands == ROTORS else self.target_bounds.actuators(vehicle)

    def inner_loop(self, vehicle: Vehicle) -> TorqueIncrement | None:
        """See `mpc.bounded.ControllerTable.inner_loop`."""
        return None if self.indi is None else TorqueIncrement(vehicle, self.indi, self.actuators(vehicle))


@law_of.register(Geometric)
def _law(table: Geometric, vehicle: Vehicle, period: float, shapes: Sequence[Shape] = ()) -> GeometricController:
    return GeometricController(vehicle, period, table)
