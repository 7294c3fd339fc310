"""Bandwidths of nested loops at a control period; the gains of PID and geometric control follow from them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

from quadsim.errors import ParameterError
from quadsim.vehicle import Vehicle

SEPARATION: Final = 2.0  # bandwidth of each loop over that of the loop around it
YAW_SHARE: Final = 0.4  # bandwidth of heading over that of roll and pitch: about PX4's MC_YAW_P / MC_ROLL_P = 2.8 / 6.5


def require_positive(name: str, value: float) -> None:
    """Reject a setting that is not a positive, finite number.

    Raises:
        ParameterError: it is not.
    """
    if not 0.0 < value < math.inf:
        raise ParameterError("controller", name, value, "positive and finite")


@dataclass(frozen=True, kw_only=True)
class Bandwidths:
    """Bandwidths of the loops of a cascade [rad/s], each the gain from an error to the rate of change demanded."""

    rate: float  # roll and pitch rate: angular acceleration per rate error
    attitude: float  # roll and pitch: rate per angle error
    yaw_rate: float  # yaw rate, limited by the weak reaction torques
    yaw: float  # heading
    velocity: float  # velocity: acceleration per velocity error
    position: float  # position: velocity per position error

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            require_positive(name, value)


def lag_to_allow_for(vehicle: Vehicle, period: float) -> float:
    """Delay [s] that the gains must tolerate besides sampling: the rotor lag, but at least half a period."""
    return max(0.5 * period, vehicle.rotor_rise or 0.0, vehicle.rotor_fall or 0.0)


def bandwidths(*, period: float, lag: float) -> Bandwidths:
    """Return the bandwidths of a cascade for a control period and a `lag` of rotors and computation [s].

    A held command acts half a period late on average, and the lag adds to it: theta = period / 2 + lag.  The innermost
    loop, an integrator with that dead time, gets the gain 1 / (2 theta) (SIMC, Skogestad, "Simple analytic rules for
    model reduction and PID controller tuning", 2003: time constant equal to dead time). Each outer loop is slower by
    `SEPARATION`, which then equals every characteristic ratio a_i^2 / (a_{i-1} a_{i+1}) of the closed loop's polynomial
    s^4 + k1 s^3 + k1 k2 s^2 + k1 k2 k3 s + k1 k2 k3 k4; a ratio of 2 is the damping optimum (Naslin, 1960). The heading
    loops have `YAW_SHARE` of the bandwidth of roll and pitch.  At a period of 50 ms and a lag of 25 ms: 10, 5, 2.5 and
    1.25 rad/s; PX4 uses 6.5, 1.8 and 0.95 from attitude to position.

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
