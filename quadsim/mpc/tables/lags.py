"""Time constants in tables `[controller]`: of rotors, of an autopilot, and delays."""

from __future__ import annotations

from typing import Annotated, Final, Literal

from annotated_types import Ge, Le, Len

from quadsim.errors import ParameterError
from quadsim.mpc.problem.model import SHORTEST_LAG
from quadsim.vehicle import Vehicle

LagSeconds = Annotated[float, Ge(0.0), Le(10.0)]
InnerLag = Annotated[tuple[LagSeconds, ...], Len(4, 4)]
INNER_LAG: Final = (
    "[s] time constants of thrust, p, q, r behind their targets, 0 for none; only where an autopilot flies; "
    "absent: identified by steps on the autopilot at set-up"
)
"""Meaning of the field `inner_lag`."""
AttitudeLag = Annotated[tuple[Annotated[float, Ge(1e-3), Le(10.0)], ...], Len(3, 3)]
ATTITUDE_LAG: Final = (
    "[s] time constants of roll, pitch and yaw behind a commanded attitude, each one over the autopilot's gain from an "
    'attitude error to a body rate; only where commands = "attitude"; absent: identified by steps on the autopilot at '
    "set-up"
)
"""Meaning of the field `attitude_lag`."""
Lag = LagSeconds | Literal["vehicle"]  # a time constant, or the one in the vehicle file


def resolved_lag(lag: float | str, vehicle: Vehicle) -> float:
    """Return the rotor time constant that the controller predicts [s].

    Raises:
        ParameterError: the vehicle's is asked for, and is missing or too short.
    """
    if not isinstance(lag, str):
        return lag
    if vehicle.rotor_rise is None:
        rule = f"a number of seconds where the vehicle has no rotor_rise, and {vehicle.name} has none"
        raise ParameterError("controller", "rotor_lag", lag, rule)
    if 0.0 < vehicle.rotor_rise < SHORTEST_LAG:
        rule = f"a number of seconds where the vehicle's rotor_rise is below {SHORTEST_LAG:g} s, as {vehicle.name}'s is"
        raise ParameterError("controller", "rotor_lag", lag, rule)
    return vehicle.rotor_rise


def require_lag(lag: float | str) -> None:
    """Reject a time constant for which gains cannot be computed."""
    if not isinstance(lag, str) and 0.0 < lag < SHORTEST_LAG:
        raise ValueError(f"rotor_lag must be 0, or at least {SHORTEST_LAG:g} s; got {lag:g}")


def require_lags(inner_lag: tuple[float, ...] | None) -> tuple[float, ...]:
    """Return the lags of an autopilot; raises ParameterError where there are none."""
    if inner_lag is None:
        rule = "four time constants [s]: give them, or identify them on the vehicle's autopilot before it is built"
        raise ParameterError("controller", "inner_lag", None, rule)
    return inner_lag


def require_attitude_lag(attitude_lag: tuple[float, ...] | None) -> tuple[float, ...]:
    """Return the lags of an autopilot's attitude; raises ParameterError where there are none."""
    if attitude_lag is None:
        rule = "three time constants [s]: give them, or identify them on the vehicle's autopilot before it is built"
        raise ParameterError("controller", "attitude_lag", None, rule)
    return attitude_lag
