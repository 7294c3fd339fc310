"""Rotor dynamics: lag, limited acceleration, and angular momentum."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Literal

from annotated_types import Ge, Gt, Le, Len, doc

from quadsim.errors import ParameterError
from quadsim.fields import Fraction, Instant, NonNegative, Positive, Seconds, filled, require_floor
from quadsim.sim.effects.lasting import in_force
from quadsim.vehicle import N_ROTORS, Vehicle


@dataclass(frozen=True, kw_only=True)
class RotorDynamics:
    """Rotor lag and wear; see `quadsim.sim.effects.rotors`.

    Speeds follow a first-order lag with limited slope, dw/dt = clip((w_cmd - w) / tau, -a, a): the model of RotorS
    (Furrer et al.  2016, "RotorS - A Modular Gazebo MAV Simulator Framework", Eq.  (18)) with its separate time
    constants for speeding up and slowing down, tau = `rise` and `fall`, and a = `acceleration`. A speed approaches
    w_cmd from one side and never passes it, so the response to a held command is a straight line followed by an
    exponential: no integration, no step size.
    """

    rise: Annotated[
        Seconds | None,
        doc("[s] time constant while speeding up; absent: the vehicle's, or no lag if it has none"),
    ] = None
    fall: Annotated[
        Seconds | None,
        doc("[s] time constant while slowing down; absent: the vehicle's, or no lag if it has none"),
    ] = None
    acceleration: Annotated[Positive | None, doc("[rad/s^2] largest change of a rotor's speed; absent: no limit")] = (
        None
    )
    inertia: Annotated[
        NonNegative | None,
        doc("[kg m^2] of one rotor: gyroscopic and spin-up torque; absent: the vehicle's, or 0 if it has none"),
    ] = None
    efficiency: Annotated[
        tuple[Fraction, ...],
        Len(N_ROTORS, N_ROTORS),
        doc("[-] share of nominal thrust and torque, per rotor"),
    ] = (1.0, 1.0, 1.0, 1.0)

    @property
    def at_once(self) -> bool:
        """Whether rotors have the commanded speed at once, and no inertia."""
        return not (self.rise or self.fall or self.acceleration or self.inertia)

    def resolved(self, vehicle: Vehicle) -> RotorDynamics:
        """Fill in the sizes left to the vehicle.

        Raises:
            ParameterError: rotors with inertia change their speed at once.
        """
        inertia = vehicle.rotor_inertia or 0.0
        rotors = filled(self, rise=vehicle.rotor_rise, fall=vehicle.rotor_fall, inertia=inertia)
        rotors._check_torque()
        return rotors

    def lagging(self, change: LagChange) -> RotorDynamics:
        """Return the same rotors with other time constants.

        Raises:
            ParameterError: rotors with inertia change their speed at once.
        """
        fall = change.fall
        if fall is None:
            fall = change.rise
        rotors = replace(self, rise=change.rise, fall=fall)
        rotors._check_torque()
        return rotors

    def _check_torque(self) -> None:
        if self.inertia and not self.acceleration and not (self.rise and self.fall):
            rule = "0 where rotors change their speed at once: that would take an infinite torque"
            raise ParameterError("effects.rotors", "inertia", self.inertia, rule)


@dataclass(frozen=True, kw_only=True)
class RotorLoss:
    """A rotor loses thrust, permanently or for a time."""

    at: Instant
    type: Annotated[Literal["rotor_loss"], doc("kind of event: rotor_loss")] = "rotor_loss"
    rotor: Annotated[int, Ge(1), Le(N_ROTORS), doc("number of the rotor, 1 to 4")]
    loss: Annotated[float, Gt(0.0), Le(1.0), doc("[-] share of thrust and torque lost; 1 is all of it")]
    duration: Annotated[Seconds | None, doc("[s] time until the rotor recovers; absent: never")] = None

    def text(self) -> str:
        """Describe the event."""
        return f"rotor {self.rotor} loses {100.0 * self.loss:.3g} %"


@dataclass(frozen=True, kw_only=True)
class RotorChange:
    """From `at` [s] on, a rotor has the share `efficiency` of the thrust and torque of its speed.

    It is the product over all losses in force.  At 0 the rotor has lost its propeller: it has neither drag nor
    momentum.
    """

    at: float
    rotor: int
    efficiency: float


def efficiency_changes(losses: Sequence[RotorLoss], worn: Sequence[float]) -> Iterator[RotorChange]:
    """Yield each rotor's efficiency whenever a loss starts or ends: the product over the losses in force.

    Args:
        losses: of any rotors.
        worn: (4,) the rotors' efficiencies without a loss.
    """
    for rotor, efficiency in enumerate(worn, start=1):
        of_rotor = [loss for loss in losses if loss.rotor == rotor]
        for time, losses_in_force in in_force(of_rotor):
            left = math.prod(1.0 - loss.loss for loss in losses_in_force)
            yield RotorChange(at=time, rotor=rotor, efficiency=efficiency * left)


@dataclass(frozen=True, kw_only=True)
class LagChange:
    """The rotor time constants change."""

    at: Instant
    type: Annotated[Literal["rotor_lag"], doc("kind of event: rotor_lag")] = "rotor_lag"
    rise: Annotated[NonNegative, doc("[s] time constant while speeding up; 0: at once")]
    fall: Annotated[NonNegative | None, doc("[s] time constant while slowing down; absent: equal to rise")] = None

    def __post_init__(self) -> None:
        require_floor(self, "rise", "fall", unit="s")

    def text(self) -> str:
        """Describe the event."""
        if self.fall in (None, self.rise):
            fall = ""
        else:
            fall = f", {self.fall:g} s downwards"
        return f"rotors lag by {self.rise:g} s{fall}"
