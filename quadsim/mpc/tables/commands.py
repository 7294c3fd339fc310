"""Weights and bounds of what controllers command: rotor speeds, or an autopilot's targets."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, Final

import numpy as np
from annotated_types import Len, doc

from quadsim.controller import ATTITUDE, ROTORS
from quadsim.errors import ParameterError
from quadsim.fields import Pair, Positive, Weight
from quadsim.mpc.guard.answer import ActuatorBounds
from quadsim.mpc.pilot.allocation import thrust_to_command
from quadsim.mpc.problem.model import SHORTEST_LAG
from quadsim.mpc.tables.controller import Range, require_ordered
from quadsim.vehicle import N_ROTORS, Vehicle

COMMANDS: Final = (
    "what it commands: rotor speeds, or to an autopilot's inner loop collective thrust and body rates, or collective "
    "thrust and an attitude"
)
"""Meaning of the field `commands` of controllers that command all of these."""
TARGET_BOUNDS: Final = "only where an autopilot flies; of an attitude, bounds on the body rates that its error commands"
"""Meaning of the field `target_bounds` of such controllers."""
LEAST_THRUST = 0.5
MOST_THRUST = 0.9
"""Default bounds on a target of collective thrust: shares of the weight, and of the largest; see `TargetBounds`."""
Rates = Positive | Annotated[tuple[Positive, ...], Len(3, 3)]
"""One largest magnitude for three body rates, or one per axis."""
RateWeights = Weight | Annotated[tuple[Weight, ...], Len(3, 3)]
"""One weight for three body rates, or one per axis."""
RotorWeights = Weight | Annotated[tuple[Weight, ...], Len(N_ROTORS, N_ROTORS)]
"""One weight for all rotors, or one per rotor."""


@dataclass(frozen=True, kw_only=True)
class InputWeights:
    """Weights on deviations of the rotor speeds from hover."""

    speed: Annotated[RotorWeights, doc("[1/(rad/s)^2] diagonal of Q_u: one weight for all rotors, or a list of four")]


@dataclass(frozen=True, kw_only=True)
class TargetWeights:
    """Weights on deviations of an inner loop's targets from those of hover."""

    thrust: Annotated[Weight, doc("[1/N^2] of the collective thrust")]
    body_rate: Annotated[RateWeights, doc("[1/(rad/s)^2] one weight for three body rates, or about body x, y, z")]

    @property
    def of_inputs(self) -> tuple[float, ...]:
        """(4,) diagonal of Q_u."""
        return (self.thrust, *np.broadcast_to(np.asarray(self.body_rate, float), 3).tolist())


@dataclass(frozen=True, kw_only=True)
class RotorBounds:
    """Hard bounds on the rotor speeds and their steps, for every rotor."""

    speed: Annotated[Pair | None, doc("[rad/s] absent: the vehicle's range")] = None
    slew: Annotated[Pair | None, doc('[rad/s per period] only where inputs = "speed"; absent: no bound')] = None

    def __post_init__(self) -> None:
        if self.speed is not None:
            require_ordered("speed", self.speed)
            if self.speed[0] < 0.0:
                raise ValueError(f"speed must have a lower bound >= 0 rad/s; got {[*self.speed]}")
        if self.slew is not None:
            require_ordered("slew", self.slew)
            if not self.slew[0] <= 0.0 <= self.slew[1]:
                raise ValueError(f"slew must allow a speed to be held, so contain 0; got {[*self.slew]}")

    def audited(self, vehicle: Vehicle) -> dict[str, Range]:
        """Return the bounds on each rotor's speed [rad/s] and step [rad/s per period], where it has any."""
        slowest, fastest = self.speed or (vehicle.speed_min, vehicle.speed_max)
        bounds = {"speed": (slowest, fastest)}
        if self.slew is not None:
            down, up = self.slew
            bounds["slew"] = (down, up)
        return bounds

    def actuators(self, vehicle: Vehicle) -> ActuatorBounds:
        """Return the same bounds for the actuators."""
        return ActuatorBounds.alike(**self.audited(vehicle))


@dataclass(frozen=True, kw_only=True)
class InputBounds(RotorBounds):
    """Hard bounds on the rotor speeds and their steps, for every rotor."""

    # `field()` makes them required: without it, they would inherit the defaults of `RotorBounds`.
    speed: Annotated[Pair, doc("[rad/s] u_min, u_max of every rotor.  Eq. (20)")] = field()
    slew: Annotated[Pair, doc("[rad/s per period] delta_min, delta_max of every rotor.  Eq. (15)")] = field()


@dataclass(frozen=True, kw_only=True)
class TargetBounds:
    """Hard bounds on an inner loop's targets: collective thrust and body rates."""

    thrust: Annotated[
        Pair | None,
        doc(
            f"[N] collective, around the weight; absent: {100 * LEAST_THRUST:g} % of the weight to "
            f"{100 * MOST_THRUST:g} % of the largest, at least half way to it: the rest is for torques"
        ),
    ] = None
    body_rate: Annotated[Rates, doc("[deg/s] largest magnitude, one or about body x, y, z")] = (300.0, 300.0, 90.0)

    def __post_init__(self) -> None:
        if self.thrust is not None:
            require_ordered("thrust", self.thrust)
            if self.thrust[0] < 0.0:
                raise ValueError(f"thrust must have a lower bound >= 0 N; got {[*self.thrust]}")

    def audited(self, vehicle: Vehicle) -> dict[str, Range]:
        """Return the bounds on collective thrust [N] and on each body rate [deg/s]."""
        largest = vehicle.level_thrust(vehicle.speed_max)
        weight = vehicle.mass * vehicle.gravity
        lower, upper = self.thrust or (LEAST_THRUST * weight, thrust_to_command(largest, weight, MOST_THRUST))
        if not lower < weight < upper:
            rule = f"below and above the weight, {weight:.4g} N"
            raise ParameterError("controller", "target_bounds.thrust", [lower, upper], rule)
        rates = np.broadcast_to(np.asarray(self.body_rate, float), 3).tolist()
        bounds = {"thrust": (lower, upper)}
        for axis, rate in zip("xyz", rates, strict=True):
            bounds[f"body_rate_{axis}"] = (-rate, rate)
        return bounds

    def actuators(self, vehicle: Vehicle) -> ActuatorBounds:
        """Return the same bounds on targets (4,) [N], [rad/s], with unbounded steps."""
        thrust, *rates = self.audited(vehicle).values()
        lower, upper = np.array([thrust, *np.radians(rates)]).T
        steps = np.full(N_ROTORS, math.inf)
        return ActuatorBounds(u_min=lower, u_max=upper, delta_min=-steps, delta_max=steps, targets=True)


USUAL_TARGETS: Final = TargetBounds()


def require_targets(table: Any) -> None:
    """Refuse fields of an autopilot where there is none, and those of an attitude where none is commanded.

    Raises:
        ValueError: a field is given that does not act, or has a value that it cannot have.
    """
    if table.commands == ROTORS:
        reason = "rotor speeds pass no autopilot, whose lags and targets these are"
        for name, usual in (("inner_lag", None), ("target_bounds", USUAL_TARGETS)):
            if getattr(table, name) != usual:
                raise ValueError(f'{name} must be absent where commands = "{table.commands}": {reason}')
    elif any(0.0 < lag < SHORTEST_LAG for lag in table.inner_lag or ()):
        raise ParameterError("", "inner_lag", table.inner_lag, f"0, or at least {SHORTEST_LAG:g} s, each")
    if table.commands == ATTITUDE and table.delay:
        rule = f'zero where commands = "{ATTITUDE}", whose rates the autopilot decides'
        raise ParameterError("", "delay", table.delay, rule)
    if table.commands != ATTITUDE and table.attitude_lag is not None:
        reason = "no attitude is commanded, behind which this is the lag"
        raise ValueError(f'attitude_lag must be absent where commands = "{table.commands}": {reason}')


def require_space(table: Any, of_rotors: Mapping[str, object]) -> None:
    """Refuse fields of the other space of commands: those `of_rotors` with an autopilot, of its targets without one.

    `of_rotors` has the names of fields and the values that say nothing; a lag may be 0, or at least `SHORTEST_LAG`.

    Raises:
        ValueError: a field is given that does not act.
    """
    require_targets(table)
    if table.commands == ROTORS:
        return
    reason = "the autopilot turns the rotors; inner_lag and target_bounds describe it"
    if table.disturbance is not None and table.disturbance.rotor_lag is not None:
        raise ValueError(f'disturbance.rotor_lag must be absent where commands = "{table.commands}": {reason}')
    for name, usual in of_rotors.items():
        if getattr(table, name) != usual:
            raise ValueError(f'{name} must be absent where commands = "{table.commands}": {reason}')
