"""The air: its drag on the vehicle, and wind as it passes: a mean that may change, gusts, and turbulence."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Final, Literal

import numpy as np
from annotated_types import Len, doc

from quadsim.errors import InputError, ParameterError
from quadsim.fields import Instant, NonNegative, Pair, Positive, Seconds, Vector, filled
from quadsim.sim.effects.turbulence import FASTEST_AIRSPEED, SLOWEST_AIRSPEED, Dryden, Turbulence
from quadsim.state import Array
from quadsim.vehicle import Vehicle

SEA_LEVEL_DENSITY: Final = 1.225
"""Density of air [kg/m^3] at sea level in the International Standard Atmosphere (ISO 2533)."""
_AHEAD: Final = 2000
"""Physics steps whose wind is computed ahead."""


_Drag = Annotated[tuple[NonNegative, ...], Len(3, 3)]


@dataclass(frozen=True, kw_only=True)
class Air:
    """Drag, and the wind; see `quadsim.sim.effects` and `quadsim.sim.effects.wind`."""

    density: Annotated[Positive, doc("[kg/m^3] of the air, for the drag of the body")] = SEA_LEVEL_DENSITY
    rotor_drag: Annotated[
        NonNegative | None,
        doc("[kg/rad] drag of one rotor per speed and air speed in its plane; absent: the vehicle's, or 0"),
    ] = None
    inflow: Annotated[
        NonNegative | None,
        doc(
            "[N s^2/(m rad)] thrust one rotor loses per speed and air speed along its axis; absent: the vehicle's, or 0"
        ),
    ] = None
    rotor_moment: Annotated[
        Pair | None,
        doc(
            "[N m s^2/(m rad)] moment of one rotor about body x and y, per speed and air speed across it; absent: the "
            "vehicle's, or 0"
        ),
    ] = None
    inflow_moment: Annotated[
        Pair | None,
        doc(
            "[N m s^2/m^2] moment about body x and y, per air speed along z and across it; absent: the vehicle's, or "
            "that of the ellipsoid that drags"
        ),
    ] = None
    rate_damping: Annotated[
        _Drag | None,
        doc("[N m s/rad] torque against the body rates, about each body axis; absent: the vehicle's, or 0"),
    ] = None
    body_drag: Annotated[
        Annotated[tuple[Positive, ...], Len(3, 3)] | None,
        doc("[m^2] drag areas C_d A along body x, y, z; absent: the vehicle's, or none"),
    ] = None
    linear_drag: Annotated[_Drag, doc("[N s/m] drag of the body per air speed along each body axis")] = (0.0, 0.0, 0.0)
    quadratic_drag: Annotated[
        _Drag, doc("[N s^2/m^2] drag of the body per squared air speed, along each body axis")
    ] = (0.0, 0.0, 0.0)
    wind: Annotated[Vector, doc("[m/s] mean velocity of the air, world frame")] = (0.0, 0.0, 0.0)
    turbulence: Annotated[Dryden | None, doc("Dryden turbulence; absent: none")] = None

    def __post_init__(self) -> None:
        carried = self.turbulence is None or self.turbulence.airspeed is not None
        if not carried and not SLOWEST_AIRSPEED <= math.hypot(*self.wind) <= FASTEST_AIRSPEED:
            raise InputError(
                f"turbulence.airspeed must be given where no mean wind of {SLOWEST_AIRSPEED:g} to {FASTEST_AIRSPEED:g} "
                f"m/s carries the turbulence past; got a wind of {[*self.wind]}"
            )

    @property
    def axis_drag(self) -> bool:
        """Whether the body drags along its axes, by `linear_drag` or `quadratic_drag`."""
        return any(self.linear_drag) or any(self.quadratic_drag)

    @property
    def drags(self) -> bool:
        """Whether anything drags, once resolved: without it, wind pushes nothing."""
        turns = any(self.rotor_moment or ()) or any(self.inflow_moment or ())
        return bool(self.rotor_drag) or bool(self.inflow) or self.body_drag is not None or self.axis_drag or turns

    def require_drag(self, vehicle: Vehicle) -> None:
        """Reject wind on a vehicle that nothing drags, once resolved.

        Raises:
            ParameterError: the wind would push nothing.
        """
        if not self.drags:
            name = vehicle.name
            rule = f"positive, or body_drag given, for the wind to push: the vehicle {name!r} states no drag"
            raise ParameterError("effects.air", "rotor_drag", self.rotor_drag or 0.0, rule)

    def resolved(self, vehicle: Vehicle) -> Air:
        """With the sizes that are left to the vehicle, and to the mean wind."""
        air = filled(
            self,
            rotor_drag=vehicle.rotor_drag or 0.0,
            inflow=vehicle.inflow or 0.0,
            rotor_moment=vehicle.rotor_moment or (0.0, 0.0),
            inflow_moment=vehicle.inflow_moment,
            rate_damping=vehicle.rate_damping or (0.0, 0.0, 0.0),
            body_drag=vehicle.body_drag,
        )
        if air.turbulence is None:
            return air
        return replace(air, turbulence=filled(air.turbulence, airspeed=math.hypot(*air.wind)))


@dataclass(frozen=True, kw_only=True)
class Gust:
    """A gust of the 1-cosine shape.

    v(t) = v_peak / 2 (1 - cos(2 pi (t - t0) / T)) for t0 <= t <= t0 + T, and zero elsewhere.
    The shape is that of 14 CFR 25.341(a)(2), v = v_peak / 2 (1 - cos(pi s / H)) over the way s = 0 .. 2 H; its rise
    to the peak is the discrete gust of MIL-F-8785C, Sec. 3.7.1.3.  Both measure the gust along the way of an aeroplane
    that flies into it at the airspeed V.  A hovering vehicle waits for the air instead: T = 2 H / V is given here.
    t0 is `at`, T `duration` and v_peak `velocity`.
    """

    at: Instant
    type: Annotated[Literal["gust"], doc("kind of event: gust")] = "gust"
    duration: Annotated[Seconds, doc("[s] from calm to calm")]
    velocity: Annotated[Vector, doc("[m/s] in its middle, world frame")]

    def text(self) -> str:
        """Describe the event."""
        return f"a gust of {math.hypot(*self.velocity):.3g} m/s"


def gust_velocity(gusts: Sequence[Gust], t: Array) -> Array:
    """Sum of gusts (M, 3) at times `t` (M,) [s], world frame [m/s]."""
    velocity = np.zeros((t.size, 3))
    for gust in gusts:
        share = (t - gust.at) / gust.duration
        inside = (share > 0.0) & (share < 1.0)
        velocity[inside] += 0.5 * (1.0 - np.cos(2.0 * np.pi * share[inside, None])) * np.array(gust.velocity)
    return velocity


@dataclass(frozen=True, kw_only=True)
class WindChange:
    """The mean wind changes."""

    at: Instant
    type: Annotated[Literal["wind"], doc("kind of event: wind")] = "wind"
    velocity: Annotated[Vector, doc("[m/s] from then on, world frame")]

    def text(self) -> str:
        """Describe the event."""
        return f"the mean wind is {math.hypot(*self.velocity):.3g} m/s"


class WindField:
    """The wind at the vehicle, an evolving state: the same everywhere, mean(t) + gusts(t) + turbulence(t).

    The turbulence's longitudinal axis is the horizontal direction of the mean wind at time zero, or world x where
    there is none, whatever the mean changes to later.  The mean is where the air goes, not where it comes from; of two
    changes at one time the later one counts.
    """

    def __init__(
        self,
        *,
        mean: Vector,
        gusts: tuple[Gust, ...] = (),
        turbulence: Dryden | None = None,
        timestep: float,
        rng: np.random.Generator,
        changes: tuple[WindChange, ...] = (),
    ) -> None:
        self._mean = mean
        x, y, _ = mean
        speed = math.hypot(x, y)
        if speed > 0.0:
            self._along = (x / speed, y / speed)
        else:
            self._along = (1.0, 0.0)
        self._timestep = timestep
        if turbulence is None:
            self._turbulence = None
        else:
            self._turbulence = Turbulence(turbulence, timestep=timestep, rng=rng)
        self.reset()
        self.reschedule(gusts, changes)

    def reset(self) -> None:
        """Rewind: the same wind again."""
        self._step = self._start = 0
        self._turbulent = np.empty((0, 3))
        self._wind = np.empty((0, 3))
        if self._turbulence is not None:
            self._turbulence.reset()

    def reschedule(self, gusts: tuple[Gust, ...], changes: tuple[WindChange, ...]) -> None:
        """Let these gusts and steps of the mean take the place of those before, from the next physics step on."""
        ordered = sorted(changes, key=lambda change: change.at)
        means = [self._mean]
        times = []
        for change in ordered:
            means.append(change.velocity)
            times.append(change.at)
        self._means = np.array(means, float)
        self._change_times = np.array(times)
        self._gusts = gusts
        self._wind = self._sum_up()

    def advance(self, steps: int) -> Array:
        """(steps, 3) wind velocity at the middle of each of the next physics steps, world frame, z up [m/s]."""
        end = self._step + steps
        if end > self._start + len(self._wind):
            self._extend(end + _AHEAD)
        wind = self._wind[self._step - self._start : end - self._start]
        self._step = end
        return wind.copy()

    def _extend(self, end: int) -> None:
        """Compute the wind from now on to a physics step."""
        left = self._turbulent[self._step - self._start :]
        more = end - self._step - len(left)
        if self._turbulence is None:
            fresh = np.zeros((more, 3))
        else:
            fresh = self._turbulence.advance(more)
        self._turbulent = np.concatenate([left, fresh])
        self._start = self._step
        self._wind = self._sum_up()

    def _sum_up(self) -> Array:
        """(M, 3) the wind in the physics steps whose turbulence is known, from `_start` on."""
        steps = np.arange(self._start, self._start + len(self._turbulent), dtype=np.float64)
        middles = self._timestep * (steps + 0.5)
        wind: Array = self._means[np.searchsorted(self._change_times, middles, side="right")]
        wind += gust_velocity(self._gusts, middles)
        if self._turbulence is None:
            return wind
        along, across, vertical = self._turbulent.T
        x, y = self._along  # spelt out, as a matrix product may round by the number of rows
        return wind + np.stack([x * along - y * across, y * along + x * across, vertical], axis=1)
