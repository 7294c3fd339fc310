"""What an identification gives: each parameter with its interval, and the verdict of its gates."""

from __future__ import annotations

from dataclasses import dataclass, field

from quadsim.vehicle import Vehicle


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
    """Why a gate refuses the value, so that the start's stays; empty where the value is identified."""
    advice: str = ""  # what to fly so that it can be identified
    in_file: bool = True  # whether a vehicle file has a field for it


@dataclass(frozen=True, kw_only=True)
class Identification:
    """The fit of one or several logs."""

    estimates: tuple[ParameterEstimate, ...]
    vehicle: Vehicle  # the start with what was identified in its place
    delay: float  # of the commands, or by which measured speeds are logged late [s]
    offset: tuple[float, float]  # x and y of the centre of mass in the rotors' frame [m]
    wind: tuple[float, float] = (0.0, 0.0)  # mean, world x and y, where drag shows it [m/s]
    throttle_curve: float = 1.0  # a of w^2 / w_max^2 = (1 - a) u + a u^2, u the throttle [-]
    yaw_trim: float = 0.0  # constant yaw torque that is not the rotors' [N m]
    voltage_exponent: float = 0.0  # n of thrust over voltage, (V / V0)^n [-]
    voltage: float | None = None  # V0, at which the thrust coefficient holds [V]; None without a battery in the log
    whiteness: dict[str, float] = field(default_factory=dict)  # largest |autocorrelation| of innovations by axis [-]
    cross_check: dict[str, float] = field(default_factory=dict)  # output-error estimate over this one, by parameter [-]
