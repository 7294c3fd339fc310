"""How fast nested loops may be at a control period: the gains of PID and geometric control follow from it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

from quadsim.errors import ParameterError
from quadsim.vehicle import Vehicle

SEPARATION: Final = 2.0  # bandwidth of each loop over that of the loop around it
YAW_SHARE: Final = 0.4  # bandwidth of heading over that of roll and pitch: about PX4's MC_YAW_P / MC_ROLL_P = 2.8 / 6.5


def require_positive(name: str, value: float) -> None:
    """A setting that has to be a positive, finite number.

    Raises:
        ParameterError: it is not.
    """
    if not 0.0 < value < math.inf:
        raise ParameterError("controller", name, value, "positive and finite")


@dataclass(frozen=True, kw_only=True)
class Bandwidths:
    """Bandwidths of the loops of a cascade [rad/s], each the gain from an error to the rate of change demanded."""

    rate: float  # of roll and pitch rate; an angular acceleration per rate error
    attitude: float  # of roll and pitch; a rate per angle
    yaw_rate: float  # of the yaw rate, which reaction torques alone can change
    yaw: float  # of the heading
    velocity: float  # an acceleration per velocity error
    position: float  # a velocity per position error

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            require_positive(name, value)


def lag_to_allow_for(vehicle: Vehicle, period: float) -> float:
    """The delay [s] that gains have to tolerate besides sampling: the rotors' own lag, but half a period at least."""
    return max(0.5 * period, vehicle.rotor_rise or 0.0, vehicle.rotor_fall or 0.0)


def bandwidths(*, period: float, lag: float) -> Bandwidths:
    """Bandwidths of a cascade at a control period, with rotors and computation that lag [s].

    A held command acts half a period late on average, and the lag adds to that: theta = period / 2 + lag.  The
    innermost loop, an integrator with that dead time, gets the gain 1 / (2 theta) (SIMC, Skogestad, "Simple analytic
    rules for model reduction and PID controller tuning", 2003: time constant and dead time equal).  Each loop outside
    is slower by `SEPARATION`, which is then every characteristic ratio a_i^2 / (a_{i-1} a_{i+1}) of the closed loop's
    polynomial s^4 + k1 s^3 + k1 k2 s^2 + k1 k2 k3 s + k1 k2 k3 k4; 2 is the damping optimum (Naslin, 1960).  The
    heading's loops have the share `YAW_SHARE` of roll's and pitch's.  At 50 ms and 25 ms of lag: 10, 5, 2.5 and 1.25
    rad/s, where PX4 has 6.5, 1.8 and 0.95 from attitude to position.

    Raises:
        ParameterError: a number is out of range.
    """
    require_positive("period", period)
    if not 0.0 <= lag < math.inf:
        raise ParameterError("controller", "lag", lag, "at least 0 and finite")
    rate = 1.0 / (2.0 * (0.5 * period + lag))
    attitude = rate / SEPARATION
    velocity = attitude / SEPARATION
    return Bandwidths(
        rate=rate,
        attitude=attitude,
        yaw_rate=YAW_SHARE * rate,
        yaw=YAW_SHARE * attitude,
        velocity=velocity,
        position=velocity / SEPARATION,
    )
