"""Geometric tracking control on SE(3): Lee, Leok, McClamroch (2010), integrals by Goodarzi, Lee, Lee (2013).

With feed-forward by differential flatness: Faessler, Franchi, Scaramuzza, "Differential Flatness of Quadrotor Dynamics
Subject to Rotor Drag for Accurate Tracking of High-Speed Trajectories", 2018.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Final, Literal, TypeAlias

import numpy as np
from annotated_types import Len, doc

from quadsim.controller import ROTORS, TARGET_SIZES, Command, Phase, StepInputs
from quadsim.core.mirror import Struct, core_library, set_members, struct
from quadsim.errors import ParameterError
from quadsim.fields import NonNegative
from quadsim.motion import Motion
from quadsim.mpc.estimate.disturbance import RampObserver, RampSettings
from quadsim.mpc.guard.answer import ActuatorBounds
from quadsim.mpc.laws import register
from quadsim.mpc.laws.parts.attitude import LEAST_THRUST_SHARE, Measured
from quadsim.mpc.laws.parts.bandwidths import SEPARATION, YAW_SHARE, lag_to_allow_for, require_positive
from quadsim.mpc.laws.parts.delay import Bodies, adopt_sent, delay_numbers
from quadsim.mpc.laws.parts.feedback import FeedbackLaw, Tuned
from quadsim.mpc.laws.parts.preview import MOTION_DEGREE, MOTION_SAMPLES, PREVIEW_DEGREE, Target, differentiator
from quadsim.mpc.pilot.allocation import allocate, make_allocation
from quadsim.mpc.pilot.indi import INDISettings, TorqueIncrement, require_one_scale
from quadsim.mpc.problem.model import require_delay, split_delay, target_model
from quadsim.mpc.problem.rigidbody import SUBSTEPS, Inputs, rigid_body, zero
from quadsim.mpc.space import Shape
from quadsim.mpc.tables.commands import USUAL_TARGETS, TargetBounds, require_space
from quadsim.mpc.tables.controller import Range
from quadsim.mpc.tables.lags import LagSeconds, require_lags
from quadsim.state import Array
from quadsim.vehicle import Vehicle

Commands: TypeAlias = Literal["rotors", "rates", "attitude"]

GeometricNumbersStruct: Final = struct("quadsim_geometric_numbers")
MotionStruct: Final = struct("quadsim_geometric_motion")
TargetStruct: Final = struct("quadsim_geometric_target")
DisturbanceStruct: Final = struct("quadsim_geometric_disturbance")
GeometricStruct: Final = struct("quadsim_geometric")

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

    The controller feeds forward the rotation of the desired attitude, so its linearisation has the polynomial (s^2 +
    k_Omega s + k_R)(s^2 + k_v s + k_x), and its gain from rate error to angular acceleration is about k_Omega + k_v.
    That sum is 1 / (2 (period / 2 + lag)), as in `bandwidths`. The outer pair is four times slower than the inner pair
    (twice the cascade's separation of 2), and both have the damping 1 / sqrt(2): k_R = k_Omega^2 / 2. The integrals of
    Goodarzi et al.  (2013) act at a quarter of the bandwidth of the loops that they support.

    An autopilot's rates follow with its `inner_lag`; `lag` replaces that of p and q.  About each
    axis, an attitude error has the gain k = k_R / k_Omega, with the sum k + k_v = 1 / (2 (period / 2 + lag)), that of
    the loop which is the innermost then, and k_v = k / 2, as above.  The polynomial is (lag s^2 + s + k)(s^2 + k_v s +
    k_x), with a damping of at least 1 / sqrt(2).  The slower of p and q counts for k_v, and the autopilot integrates in
    place of the second integral.  One that takes attitudes is assumed to have about this k; allow for a slower one by
    `lag`.
    """
    require_positive("period", period)
    lag = settings.lag
    targets = settings.commands != ROTORS
    allowed = lag
    if allowed is None:
        allowed = lag_to_allow_for(vehicle, period)
    k_Omega = 1.0 / (2.0 * (0.5 * period + allowed)) / (1.0 + SEPARATION**-2)
    k_v = k_Omega / SEPARATION**2
    k = np.zeros(3)
    if targets:
        _, p, q, r = require_lags(settings.inner_lag)
        if lag is not None:
            p = q = lag
        lags = np.array([p, q, r])
        k = 1.0 / (2.0 * (0.5 * period + lags)) / (1.0 + SEPARATION**-1)
        k_v = float(k[:2].min()) / SEPARATION
    k_i = 0.0
    k_I = 0.0
    if settings.integral:
        k_i = 0.25 * k_v**2 / SEPARATION
    if settings.integral and not targets:  # an autopilot has an integral of its own
        k_I = 0.05 * k_Omega**2 / SEPARATION
    return GeometricGains(
        k_x=k_v**2 / SEPARATION,
        k_v=k_v,
        k_R=k_Omega**2 / SEPARATION,
        k_Omega=k_Omega,
        k_i=k_i,
        k_I=k_I,
        c_1=k_v / SEPARATION,
        c_2=k_Omega / SEPARATION,
        k_attitude=tuple(k.tolist()),
    )


@dataclass(frozen=True, kw_only=True)
class Integrals:
    """The integral terms, limited to +-sigma: acceleration, world, and angular acceleration, body; (3,) each."""

    translation: Array
    rotation: Array


ForeseenDisturbance: TypeAlias = tuple[Array, Array, Array]
"""The disturbance: acceleration and its rate of change, world, and angular acceleration, body; (3,) each."""
UNDISTURBED: Final[ForeseenDisturbance] = (zero(), zero(), zero())


@dataclass(frozen=True, kw_only=True)
class DesiredAttitude:
    """The commanded attitude R_c (3, 3), Omega_c (3,) [rad/s] and its derivative (3,) [rad/s^2], in its own axes."""

    attitude: Array
    rates: Array
    acceleration: Array


class GeometricController(FeedbackLaw):
    """Thrust along the body axis and a moment from errors on SE(3).  Frames: `docs/conventions.md`.

    It commands rotor speeds, or to an autopilot targets: thrust and body rates (4,) [N, rad/s], or these and a
    quaternion wxyz (8,), with rates that are fed forward. With targets, `reset` and `StepInputs.acting` are targets.
    The controller is in C, `quadsim_geometric.c`; the core's allocation turns its wrench into rotor speeds.

    Attributes:
        commands: what it commands.
        gains: of its errors.
        numbers: all that does not change, for C.
        pointed: the arrays that it points to, by name.
        delay: how late commands act, for C; None for at once.
        delay_bodies: the bodies that it points to.
        observer: of disturbances; None for none.
        k_R: (3,) gains of the attitude error about body x, y, z [1/s^2].
        k_Omega: (3,) gains of the rate error [1/s].

    Examples:
        >>> import numpy as np
        >>> import quadsim
        >>> vehicle = quadsim.load_vehicle("hummingbird")
        >>> controller = quadsim.load("hover", {"controller": "geometric"}).controller.law(vehicle, 0.05)
        >>> command = controller.step(quadsim.StepInputs(), np.zeros(12), np.zeros((controller.horizon, 4)))
        >>> bool(np.allclose(command.speeds, vehicle.hover_speeds))
        True
    """

    name: Final = "geometric"

    def __init__(self, vehicle: Vehicle, period: float, settings: Geometric) -> None:
        self.commands = settings.commands
        self._targets = settings.commands != ROTORS
        self.gains = gains = geometric_gains(vehicle, period, settings)
        self._feedforward = settings.feedforward
        model = None  # that of rotor speeds
        thrust_lag = None
        if self._targets:
            lags = settings.inner_lag or NO_LAG
            model = target_model(vehicle, period, lags)
            thrust_lag = lags[0]
        if settings.moment:
            vehicle.require_moment("controller")
        self.observer: RampObserver | None = None
        if settings.disturbance is not None:
            _, late = split_delay(settings.delay, period)
            self.observer = RampObserver(
                settings.disturbance,
                vehicle,
                period,
                drag=settings.drag,
                moment=settings.moment,
                thrust_lag=thrust_lag,
                late=late,
            )
        self.k_R = gains.k_R * np.array([1.0, 1.0, YAW_SHARE**2])
        self.k_Omega = gains.k_Omega * np.array([1.0, 1.0, YAW_SHARE])
        self._allocation = make_allocation(vehicle)
        self._library = core_library()
        self.pointed = previews(settings, period)
        self.numbers = geometric_numbers(vehicle, period, settings, gains)
        set_members(self.numbers, k_R=self.k_R, k_Omega=self.k_Omega)
        self.numbers.preview = self.pointed["preview"].ctypes.data
        self.numbers.course = self.pointed["course"].ctypes.data
        self.delay = None
        self.delay_bodies = Bodies()
        if settings.delay:
            self.delay, self.delay_bodies = _delay_of(settings, vehicle, period)
            self.numbers.delay = ctypes.addressof(self.delay)
        self._law = GeometricStruct()
        self._motion = MotionStruct()
        self._target = TargetStruct()
        if self.observer is not None:
            self.observer.bind(self._law.ramp)
            self.numbers.ramp = ctypes.addressof(self.observer.numbers)
        self._library.quadsim_geometric_start(self._law, self.numbers, None)
        super().__init__(vehicle, period, settings, model)

    def reset(self, speeds: Array) -> None:
        """Restart after the command u(-1) (4,) [rad/s], or target."""
        super().reset(speeds)
        self._library.quadsim_geometric_reset(self._law, self._before.ctypes.data)

    def adopt(self, previous: object) -> None:
        """Take over the integrals and the observer of the previous controller."""
        if isinstance(previous, GeometricController):
            set_members(self._law, **vars(previous.integrals))
            if self._targets is previous._targets:
                adopt_sent(self._law.delay, self.delay, previous._law.delay, previous.delay)
            if self.observer is not None and previous.observer is not None:
                self.observer.adopt(previous.observer)

    @property
    def motion_rows(self) -> int:
        """Samples that it takes of a course's motion; 0 for none."""
        if self._feedforward:
            return MOTION_SAMPLES
        return 0

    @property
    def integrals(self) -> Integrals:
        """The integrals now."""
        return _integrals_of(self._law)

    def _command(self, now: StepInputs, state: Array, reference: Array, before: Array) -> Command:
        """Return the controller's wrench as rotor speeds, or its targets; the integrals hold while bounds limit it."""
        flying = now.phase is Phase.FLYING
        if self.numbers.exact:
            self._measure(state, now.attitude, now.body_rates)
        else:
            self._measure(state, None, None)
        self._aim(reference, now.motion)
        follows = flying and self.observer is not None and self.observer.follows(now.time)
        acting = np.ascontiguousarray(before, np.float64)
        self._library.quadsim_geometric_solve(
            self._law, flying, follows, self._motion, self._target, acting.ctypes.data
        )
        if flying and self.observer is not None:
            self.observer.log(now)
        command = np.array(self._law.command[: TARGET_SIZES[self.commands]])
        if self._targets:
            return self._held_for_a_period(command)
        speeds = allocate(self._allocation, command, *self.bounds.reach(before))
        achieved = self._allocation.wrench(speeds)
        smallest = 1e-6 * self._allocation.scale.max()
        if flying and np.allclose(achieved, command, rtol=0.0, atol=smallest):
            self._library.quadsim_geometric_integrate(self._law, self._motion, self._target)
        return self._held_for_a_period(speeds)

    def _measure(self, state: Array, attitude: Array | None, rates: Array | None) -> None:
        """Take the motion of a state, with the attitude and the body rates that are measured, if they are."""
        kept = []  # until the call has read them
        addresses: list[int | None] = []
        for array in (state, attitude, rates):
            if array is None:
                addresses.append(None)
                continue
            numbers = np.ascontiguousarray(array, np.float64)
            kept.append(numbers)
            addresses.append(numbers.ctypes.data)
        self._library.quadsim_geometric_measure(*addresses, self._motion)

    def _aim(self, reference: Array, motion: Motion | None) -> None:
        """Take the target of a preview (N, 4), with feed-forward that of a motion if the course has one."""
        if self._feedforward and motion is not None:
            samples = slice(self.motion_rows)
            rows = np.hstack([motion.position[samples], motion.attitude[samples]])
            self._library.quadsim_geometric_course(self.numbers, *rows.shape, rows.ctypes.data, self._target)
        else:
            preview = np.ascontiguousarray(reference, np.float64)
            self._library.quadsim_geometric_preview(self.numbers, preview.ctypes.data, self._target)

    def target(self, reference: Array, motion: Motion | None = None) -> Target:
        """Return the target of a preview (N, 4) of x, y, z [m], yaw [rad], or with feed-forward that of a given motion.

        All derivatives of a motion come from positions and attitudes, not from the velocities that a course states, so
        that they agree with the flown path.  Near the end of the course fewer samples give fewer derivatives.
        """
        self._aim(reference, motion)
        path = np.array(self._target.path)
        yaw = list(self._target.yaw)
        heading = None
        if self._target.headed:
            heading = np.array(self._target.heading).reshape(3, 3)
        return Target(
            position=path[0],
            velocity=path[1],
            acceleration=path[2],
            jerk=path[3],
            snap=path[4],
            yaw=yaw[0],
            yaw_rate=yaw[1],
            yaw_acceleration=yaw[2],
            heading=heading,
        )

    def wrench(
        self, motion: Measured, target: Target, integrals: Integrals, disturbance: ForeseenDisturbance = UNDISTURBED
    ) -> tuple[Array, DesiredAttitude]:
        """Return [f, M_x, M_y, M_z] (4,) [N, N m], and the attitude that the moment turns to.

        f = A . R e_3 with A = m (-k_x e_x - k_v e_v + g e_3 + x_d'' - d) less the integral, and
        M = -J (k_R e_R + k_Omega e_Omega + d_Omega) + Omega x J Omega
            - J (hat(Omega) R' R_c Omega_c - R' R_c Omega_c'),

        with the errors e_R = (R_c' R - R' R_c)^vee / 2 and e_Omega = Omega - R' R_c Omega_c of Lee et al. (2010), and
        the observed disturbance d, d_Omega.  R_c has b_3c along A, and b_1c as close to the heading as that allows.
        Feed-forward adds the drag at the reference's velocity to A and R_c (Faessler et al.), and f is that of half a
        period later.  With `moment`, M also balances `Vehicle.air_moment` at the reference's velocity and rates, with
        rotor speeds as the root of f.

        Where the limits of tilt or lift change A, the desired attitude counts as constant.
        """
        return self._evaluate(self._library.quadsim_geometric_wrench, 4, motion, target, integrals, disturbance)

    def targets(
        self, motion: Measured, target: Target, integrals: Integrals, disturbance: ForeseenDisturbance = UNDISTURBED
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
        size = TARGET_SIZES[self.commands]
        return self._evaluate(self._library.quadsim_geometric_targets, size, motion, target, integrals, disturbance)

    def integrate(self, integrals: Integrals, motion: Measured, target: Target, desired: DesiredAttitude) -> Integrals:
        """Return the integrals of e_v + c_1 e_x and e_Omega + c_2 e_R one period later, saturated."""
        law = self._copy(integrals)
        measured, target_struct = _structs(motion, target)
        set_members(law.desired, **vars(desired))
        self._library.quadsim_geometric_integrate(law, measured, target_struct)
        return _integrals_of(law)

    def _evaluate(
        self,
        law_in_c: Any,
        size: int,
        motion: Measured,
        target: Target,
        integrals: Integrals,
        disturbance: ForeseenDisturbance,
    ) -> tuple[Array, DesiredAttitude]:
        law = self._copy(integrals)
        structs = _structs(motion, target)
        result = np.empty(size)
        d = DisturbanceStruct()
        force, change, torque = disturbance
        set_members(d, force=force, change=change, torque=torque)
        law_in_c(law, *structs, d, result.ctypes.data)
        desired = law.desired
        attitude = DesiredAttitude(
            attitude=np.reshape(desired.attitude, (3, 3)),
            rates=np.array(desired.rates),
            acceleration=np.array(desired.acceleration),
        )
        return result, attitude

    def _copy(self, integrals: Integrals) -> Struct:
        """Return the controller with other integrals."""
        law = GeometricStruct.from_buffer_copy(self._law)
        set_members(law, **vars(integrals))
        return law


def _integrals_of(law: Struct) -> Integrals:
    return Integrals(translation=np.array(law.translation), rotation=np.array(law.rotation))


def _structs(motion: Measured, target: Target) -> tuple[Struct, Struct]:
    """Return both as C takes them."""
    measured = MotionStruct()
    target_struct = TargetStruct()
    measured.yaw = motion.yaw
    set_members(
        measured,
        position=motion.position,
        velocity=motion.velocity,
        attitude=motion.attitude,
        rates=motion.rates,
    )
    path = (target.position, target.velocity, target.acceleration, target.jerk, target.snap)
    set_members(target_struct, path=np.stack(path), yaw=(target.yaw, target.yaw_rate, target.yaw_acceleration))
    if target.heading is not None:
        target_struct.headed = 1
        set_members(target_struct, heading=target.heading)
    return measured, target_struct


def _delay_of(settings: Geometric, vehicle: Vehicle, period: float) -> tuple[Struct, Bodies]:
    """Return the numbers of a delay for C, and the bodies that they point to.

    Raises:
        ParameterError: the delay is too long.
    """
    require_delay(settings.delay, period, min(settings.horizon, MOTION_SAMPLES - 1))
    targets = settings.commands != ROTORS
    if targets and settings.delay >= period:
        rule = f"below the control period of {period:g} s where an autopilot flies the commands"
        raise ParameterError("controller", "delay", settings.delay, rule)
    inputs = Inputs.RATES
    rotor_lag = None
    if not targets:
        inputs = Inputs.SPEED
        rotor_lag = vehicle.rotor_rise or None
    lag = settings.inner_lag or NO_LAG
    model = rigid_body(vehicle, period, substeps=SUBSTEPS, inputs=inputs, rotor_lag=rotor_lag, lag=lag)
    return delay_numbers(settings.delay, model, vehicle, period)


def previews(settings: Geometric, period: float) -> dict[str, Array]:
    """Return the differentiators of a `preview`, and of 1, 2, ... `MOTION_SAMPLES` samples of a `course` in a row.

    They give values and derivatives when the command takes over.
    """
    degree = _preview_degree(settings)
    late = settings.delay / period  # periods
    course = []
    for count in range(1, MOTION_SAMPLES + 1):  # near the end the last sample is held
        first = 0.0 - min(late, count - 1.0)
        course.append(differentiator(count, period, degree=min(MOTION_DEGREE, count - 1), first=first).ravel())
    preview = differentiator(settings.horizon, period, degree=degree, first=1.0 - late)
    return {"preview": np.ascontiguousarray(preview), "course": np.concatenate(course)}


def _preview_degree(settings: Geometric) -> int:
    """Return the degree of the polynomial through a preview: up to snap with feed-forward, else up to acceleration."""
    if settings.feedforward:
        return PREVIEW_DEGREE
    return 2


def geometric_numbers(vehicle: Vehicle, period: float, settings: Geometric, gains: GeometricGains) -> Struct:
    """Return the controller's numbers for C but for `k_R`, `k_Omega`, and what they point to."""
    numbers = GeometricNumbersStruct()
    targets = settings.commands != ROTORS
    bounds = settings.actuators(vehicle)
    lags = settings.inner_lag or NO_LAG
    half = 0.5 * period
    ahead = half
    lead = np.array(lags[1:])
    if targets:
        ahead += lags[0]
    if settings.feedforward:
        lead = lead + half
    weight = vehicle.mass * vehicle.gravity
    numbers.commands = list(TARGET_SIZES).index(settings.commands)
    numbers.feedforward = settings.feedforward
    numbers.moment = settings.moment
    numbers.horizon = settings.horizon
    numbers.exact = settings.feedforward or settings.disturbance is not None
    numbers.orders = _preview_degree(settings) + 1
    numbers.period = period
    numbers.mass = vehicle.mass
    numbers.gravity = vehicle.gravity
    for name in ("k_x", "k_v", "k_i", "k_I", "c_1", "c_2", "sigma", "sigma_R"):
        setattr(numbers, name, getattr(gains, name))
    numbers.least_lift = LEAST_THRUST_SHARE * weight
    numbers.slope = math.tan(math.radians(settings.tilt))
    numbers.ahead = ahead
    numbers.turning = float(vehicle.hover_speeds.sum())
    numbers.loss = vehicle.inflow or 0.0
    set_members(
        numbers,
        k_attitude=gains.k_attitude,
        lead=lead,
        drag=settings.drag,
        inertia=vehicle.inertia_matrix,
        across=vehicle.rotor_moment or (0.0, 0.0),
        inflow=vehicle.inflow_moment or (0.0, 0.0),
        damping=vehicle.turn_damping,
        least=bounds.u_min,
        most=bounds.u_max,
    )
    return numbers


@register(
    title="geometric control",
    description="geometric tracking control on SE(3)",
    place=7,
)
@dataclass(frozen=True, kw_only=True)
class Geometric(Tuned):
    """Geometric tracking on SE(3)."""

    type: Annotated[Literal["geometric"], doc("the controller, by its name in `quadsim list`")] = "geometric"
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
        doc("whether feedforward balances rotor_moment, inflow_moment, rate_damping, inflow at the reference's motion"),
    ] = False
    disturbance: Annotated[RampSettings | None, doc("absent: no disturbance observer")] = None
    delay: Annotated[
        LagSeconds,
        doc(
            "[s] known delay from measurement to command, bridged by prediction, with the vehicle's rotor_rise or the "
            f"inner_lag; at most the horizon and {MOTION_SAMPLES - 1} control periods; to an autopilot below one, and "
            "none with attitudes"
        ),
    ] = 0.0
    indi: Annotated[INDISettings | None, doc("absent: rotors hold each command for a period")] = None
    commands: Annotated[
        Commands, doc("rotor speeds, or to an autopilot thrust and body rates, or thrust and attitude")
    ] = "rotors"
    inner_lag: Annotated[
        Annotated[tuple[LagSeconds, ...], Len(4, 4)] | None,
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
        """See `quadsim.mpc.tables.controller.ControllerTable.audited`."""
        if self.commands == "rotors":
            return super().audited(vehicle)
        return self.target_bounds.audited(vehicle)

    def actuators(self, vehicle: Vehicle) -> ActuatorBounds:
        """See `quadsim.mpc.laws.parts.feedback.Baseline.actuators`; of targets where it commands these."""
        if self.commands == ROTORS:
            return super().actuators(vehicle)
        return self.target_bounds.actuators(vehicle)

    def inner_loop(self, vehicle: Vehicle) -> TorqueIncrement | None:
        """See `quadsim.mpc.tables.controller.ControllerTable.inner_loop`."""
        if self.indi is None:
            return None
        return TorqueIncrement(vehicle, self.indi, self.actuators(vehicle))

    def law(self, vehicle: Vehicle, period: float, shapes: Sequence[Shape] = ()) -> GeometricController:
        """See `quadsim.mpc.tables.controller.ControllerTable.law`."""
        return GeometricController(vehicle, period, self)
