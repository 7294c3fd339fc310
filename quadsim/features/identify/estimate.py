"""What an identification gives: each parameter with its interval, and why it is refused where it is.

`fit` and `disturbance` fill these; `prediction`, `vehicle_file` and `report` read them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Final, NamedTuple

from quadsim.features.identify.noise import AxisNoise
from quadsim.vehicle import Vehicle

VECTORS: Final = {"inertia": "xyz", "rotor_moment": "xy", "inflow_moment": "xy", "rate_damping": "xyz"}
"""Fields of a vehicle file whose numbers are parameters of their own, with their axes: `inertia_x`."""


def field_of(name: str) -> str:
    """Return the field of a vehicle file that holds a parameter: `inertia` of `inertia_x`."""
    if name[:-2] in VECTORS:
        return name[:-2]
    return name


def number_in(vehicle: Vehicle, name: str) -> float | None:
    """Return what a vehicle has for a parameter; of `body_drag` the first number, as the others follow it.

    What `thrust_coefficient` is where a map of thrust takes its place, or each rotor has its own: the mean b.
    """
    if name == "thrust_coefficient":
        return vehicle.mean_coefficient
    file_field = field_of(name)
    value = getattr(vehicle, file_field, None)
    if not isinstance(value, tuple):
        return value
    if file_field == name:
        return value[0]
    return value["xyz".index(name[-1])]


@dataclass(frozen=True, kw_only=True)
class ParameterEstimate:
    """One parameter."""

    name: str  # as in the vehicle file, an inertia with its axis: inertia_x
    unit: str
    value: float
    low: float  # of the 95 % interval
    high: float
    start: float | None  # value of the start file, None if it has none
    refused: str = ""
    """Why the value is not identified, so that the start's stays; empty where it is."""
    advice: str = ""  # what to fly so that it can be identified
    in_file: bool = True  # whether a vehicle file has a field for it


@dataclass(frozen=True, kw_only=True)
class DisturbanceEstimate:
    """An unknown torque about a body axis, or force along a world axis: a random one with a time constant."""

    kind: str  # torque or force
    axis: str
    unit: str
    deviation: float
    deviation_interval: tuple[float, float]  # 95 %
    time: float  # constant with which it decays [s]
    time_interval: tuple[float, float]  # 95 % [s]
    refused: str = ""  # why it is not identified; empty where it is


class FlightNumbers(NamedTuple):
    """What differs from flight to flight of one vehicle."""

    delay: float
    offset: tuple[float, float]
    wind: tuple[float, float, float]


@dataclass(frozen=True, kw_only=True)
class Identification:
    """The fit of one or several logs."""

    estimates: tuple[ParameterEstimate, ...]
    vehicle: Vehicle  # the start with what was identified in its place
    delay: float  # of the commands, or by which measured speeds are logged late [s]
    offset: tuple[float, float]  # x and y of the centre of mass in the rotors' frame [m]
    wind: tuple[float, float, float] = (0.0, 0.0, 0.0)  # mean, world [m/s]
    flights: tuple[FlightNumbers, ...] = ()  # of each log, what the three above are the means of
    throttle_curve: float = 1.0  # a of w^2 / w_max^2 = (1 - a) v + a v^2, v `Vehicle.effective_throttle` [-]
    yaw_trim: float = 0.0  # constant yaw torque that is not the rotors' [N m]
    voltage_exponent: float = 0.0  # n of thrust over voltage, (V / V0)^n [-]
    voltage: float | None = None  # V0, at which the thrust coefficient holds [V]; None without a battery in the log
    noise: tuple[AxisNoise, ...] = ()  # what is not modelled, in the order of `INCREMENTS`; or empty
    disturbance: tuple[DisturbanceEstimate, ...] = ()  # the same as torques and forces
    rates_last: float = math.inf  # time constant with which body rates decay [s]
    whiteness: dict[str, float] = field(default_factory=dict)  # largest |autocorrelation| of innovations by axis [-]

    def of_flight(self, flight: int) -> Identification:
        """The same with a log's own numbers."""
        return replace(self, **self.flights[flight]._asdict())
