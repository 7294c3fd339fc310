"""Courses that speed up and slow down at a tangential acceleration: circle and lemniscate of an agile flight.

The phase theta comes of an angular acceleration by rectangle sums, w_k = D sum_{i<=k} alpha_i and
theta_k = D sum_{i<=k} w_i, as in the simplified simulation of Torrente et al., "Data-Driven MPC for Quadrotors" (2021).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Final, Literal

import numpy as np
from annotated_types import doc

from quadsim.errors import ParameterError
from quadsim.fields import Metres
from quadsim.mpc.problem.flatness import attitudes
from quadsim.rotation import quaternion_to_euler
from quadsim.scenarios.courses.course import Path, Speed, Time, Travelled
from quadsim.state import Array

MOST_SAMPLES: Final = 100_000  # of the phase: 2000 s at 50 Hz


@dataclass(frozen=True, kw_only=True)
class PhaseAngle:
    """An angle over samples a step apart, with its rate and acceleration; K samples."""

    angle: Array  # (K,) theta [rad]
    rate: Array  # (K,) w [rad/s]
    acceleration: Array  # (K,) alpha [rad/s^2]
    step: float  # [s]


Curve = Callable[[Array, Array, Array], tuple[Array, Array, Array]]
"""Angle, rate and acceleration (M,) -> position, velocity and acceleration (M, 3), world, from the origin on."""


def ramped_phase(*, rate: float, acceleration: float, ramp: float, step: float) -> PhaseAngle:
    """An angle that gains a rate [rad/s] at an acceleration [rad/s^2], and loses it at once in the same way.

    The share s of the acceleration goes by phases, each sampled from its own start, its end excluded, with T = ramp:
    sin^2(pi t / 2T) for T, 1 for rate / acceleration - T, cos(pi t / 2T) for 2 T, -1 as long as 1 before, and
    sin^2(pi t / 2T) - 1 for T.

    Args:
        rate: that would be reached without ramps; the turn over adds 4 T acceleration / pi - T acceleration to it.
        acceleration: largest magnitude.
        ramp: T [s], less than rate / acceleration.
        step: D, of the rectangle sums [s].
    """
    bend = 0.5 * math.pi / ramp
    full = rate / acceleration - ramp

    rising = step * np.arange(sample_count(ramp, step), dtype=np.float64)
    turning = step * np.arange(sample_count(2.0 * ramp, step), dtype=np.float64)
    constant = np.ones(sample_count(full, step))
    risen = np.square(np.sin(bend * rising))
    share = np.concatenate([risen, constant, np.cos(bend * turning), -constant, risen - 1.0])
    alpha = acceleration * share
    omega = step * np.cumsum(alpha)
    return PhaseAngle(angle=step * np.cumsum(omega), rate=omega, acceleration=alpha, step=step)


def sample_count(duration: float, step: float) -> int:
    """Return the number of samples, a step [s] apart, of a phase of a duration [s], its end excluded."""
    return math.ceil(duration / step - 1e-9)


def circle_curve(radius: float) -> Curve:
    """A level circle, clockwise seen from above, begun at its northernmost point (y) towards x; radius [m]."""

    def curve(theta: Array, omega: Array, alpha: Array) -> tuple[Array, Array, Array]:
        sin = np.sin(theta)
        cos = np.cos(theta)
        position = _level(radius * sin, radius * cos - radius)
        velocity = _level(radius * omega * cos, -radius * omega * sin)
        acceleration = _level(alpha * cos - omega**2 * sin, -alpha * sin - omega**2 * cos)
        return position, velocity, radius * acceleration

    return curve


def upright_circle_curve(radius: float, yaw: float) -> Curve:
    """A vertical circle towards a yaw [rad], begun at its lowest point; radius [m]."""

    def curve(theta: Array, omega: Array, alpha: Array) -> tuple[Array, Array, Array]:
        ahead = np.array([math.cos(yaw), math.sin(yaw), 0.0])
        up = np.array([0.0, 0.0, 1.0])
        sin = np.sin(theta)[:, None]
        cos = np.cos(theta)[:, None]
        square = np.square(omega)[:, None]
        change = alpha[:, None]
        position = sin * ahead + (1.0 - cos) * up
        velocity = omega[:, None] * (cos * ahead + sin * up)
        acceleration = (change * cos - square * sin) * ahead + (change * sin + square * cos) * up
        return radius * position, radius * velocity, radius * acceleration

    return curve


def lemniscate_curve(radius: float) -> Curve:
    """A level lemniscate of Gerono, begun at its tip in x towards y; radius is half its length [m]."""

    def curve(theta: Array, omega: Array, alpha: Array) -> tuple[Array, Array, Array]:
        sin = np.sin(theta)
        cos = np.cos(theta)
        sin2 = np.sin(2.0 * theta)
        cos2 = np.cos(2.0 * theta)
        position = _level(radius * cos - radius, radius * sin * cos)
        velocity = _level(-radius * omega * sin, radius * omega * cos2)
        acceleration = _level(-alpha * sin - omega**2 * cos, alpha * cos2 - 2.0 * omega**2 * sin2)
        return position, velocity, radius * acceleration

    return curve


def fly_ramped(curve: Curve, phase: PhaseAngle, *, initial: Array, gravity: float, free_heading: bool) -> Path:
    """A curve flown from and to rest, from the initial pose (4,) on; of a free heading see `Path`.

    The yaw is that of the attitude; of a curve that turns the vehicle upside down, where Euler's yaw turns by 180 deg,
    the initial one.
    """
    from scipy.interpolate import CubicSpline

    knots = phase.step * np.arange(len(phase.angle), dtype=np.float64)
    angle = CubicSpline(knots, phase.angle)

    def at(t: Array) -> tuple[Array, Array, Array]:
        return curve(angle(t), np.interp(t, knots, phase.rate), np.interp(t, knots, phase.acceleration))

    accelerations = curve(phase.angle, phase.rate, phase.acceleration)[2]
    initial_yaw = np.full(len(knots), initial[3])
    heading: Array | float = initial_yaw
    if free_heading:
        heading = float(initial[3])
    attitude, _ = attitudes(accelerations, period=phase.step, gravity=gravity, yaw=heading)
    is_inverted = bool((accelerations[:, 2] + gravity < 0.0).any())
    if is_inverted:
        yaw = initial_yaw
    else:
        yaw = np.unwrap(quaternion_to_euler(attitude)[:, 2])

    def pose(t: Array) -> Array:
        return np.column_stack([initial[:3] + at(t)[0], np.interp(t, knots, yaw)])

    def derivatives(t: Array) -> tuple[Array, Array]:
        _, velocity, acceleration = at(t)
        return velocity, acceleration

    return Path(pose=pose, duration=float(knots[-1]), derivatives=derivatives, free_heading=free_heading)


def _level(x: Array, y: Array) -> Array:
    """(M, 3) vectors without a vertical part."""
    return np.column_stack([x, y, np.zeros_like(x)])


@dataclass(frozen=True, kw_only=True)
class _Ramped(Travelled):
    speed: Annotated[
        Speed,
        doc(
            "[m/s] v, the product of radius and rate that would be reached without ramps; the highest rate of the "
            "phase is slightly higher"
        ),
    ]
    acceleration: Annotated[Speed, doc("[m/s^2] a, along the path, of radius and phase")] = 1.0
    radius: Annotated[Metres, doc("[m] r, seen from above; for a lemniscate half its length")]
    ramp: Annotated[Time, doc("[s] T, time over which the acceleration grows; below speed / acceleration")] = 2.0
    heading: Annotated[
        Literal["free", "held"],
        doc(
            "free: zero rate about body z, so the heading drifts; held: the initial yaw; "
            'without effect where yaw = "along_path"'
        ),
    ] = "free"
    sampling: Annotated[Time, doc("[s] step of the rectangle rule that integrates the phase")] = 0.02

    def __post_init__(self) -> None:
        if self.response_time:
            raise ParameterError("", "response_time", self.response_time, "0: the course is smooth by itself")
        longest = self.speed / self.acceleration
        if self.ramp >= longest:
            raise ParameterError("", "ramp", self.ramp, f"below speed / acceleration = {longest:g} s")
        least = 2.0 * (longest + self.ramp) / MOST_SAMPLES
        if least > self.sampling:
            rule = f">= {least:.3g}, which makes {MOST_SAMPLES} samples"
            raise ParameterError("", "sampling", self.sampling, rule)

    @property
    def until(self) -> float:
        """Time of its end [s]; see `ramped_phase`."""
        rising = sample_count(self.ramp, self.sampling)
        constant = sample_count(self.speed / self.acceleration - self.ramp, self.sampling)
        turning = sample_count(2.0 * self.ramp, self.sampling)
        return self.start + self.sampling * (2 * rising + 2 * constant + turning)

    def curve(self, yaw: float) -> Curve:
        """Return the curve for an initial yaw [rad]."""
        raise NotImplementedError

    def path(self, initial: Array, gravity: float) -> Path:
        """The curve by its phase."""
        rate = self.speed / self.radius
        acceleration = self.acceleration / self.radius
        phase = ramped_phase(rate=rate, acceleration=acceleration, ramp=self.ramp, step=self.sampling)
        curve = self.curve(float(initial[3]))
        free = self.heading == "free"
        return fly_ramped(curve, phase, initial=initial, gravity=gravity, free_heading=free)


@dataclass(frozen=True, kw_only=True)
class RampedCircle(_Ramped):
    """A level circle, clockwise seen from above, from the initial position, its northernmost point, towards +x.

    Or a vertical one, from its lowest point towards the initial yaw.
    """

    type: Annotated[Literal["ramped_circle"], doc("kind of course: a circle flown up to a speed and back to rest")]
    plane: Annotated[
        Literal["level", "vertical"],
        doc("vertical: upside down at the top if fast enough; the heading is free"),
    ] = "level"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.plane == "vertical" and self.heading == "held":
            raise ParameterError("", "heading", self.heading, "free where plane is vertical")
        if self.plane == "vertical" and self.yaw is not None:
            raise ParameterError("", "yaw", self.yaw, "absent where plane is vertical")

    def curve(self, yaw: float) -> Curve:
        """The circle."""
        if self.plane == "vertical":
            return upright_circle_curve(self.radius, yaw)
        return circle_curve(self.radius)


@dataclass(frozen=True, kw_only=True)
class RampedLemniscate(_Ramped):
    """A level lemniscate of Gerono from the initial position, its tip in +x, towards +y."""

    type: Annotated[
        Literal["ramped_lemniscate"], doc("kind of course: a lemniscate flown up to a speed and back to rest")
    ]

    def curve(self, yaw: float) -> Curve:
        """The lemniscate."""
        return lemniscate_curve(self.radius)
