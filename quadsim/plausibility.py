"""A vehicle's numbers checked together: ratios that no real quadrotor has, and the unit that would explain them.

Each number alone may be anything; what gives a wrong unit away is its ratio to the others.  The ranges cover quadrotors
of 30 g to 30 kg with room to spare.  They are for warnings: a vehicle outside them still flies.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from quadsim.errors import ParameterError
from quadsim.vehicle import ARMS, N_ROTORS, THRUST, VEHICLE_UNITS, Vehicle

AIR_DENSITY: Final = 1.225  # [kg/m^3]
LARGEST_SAMPLES: Final = {
    "position": 1e7,
    "velocity": 1e3,
    "specific_force": 1e4,
    "attitude": 1e3,
    "euler": 1e5,
    "rates": 1e3,
    "commands": 1e6,
    "throttle": 1e6,
    "speeds": 1e6,
    "erpm": 1e7,
    "voltage": 1e5,
}
"""Largest magnitude of a logged quantity, in the unit of a table: far above what a vehicle does."""
EDGE: Final = 0.05
"""Share of a range at either end, on a logarithmic scale, where no unit is guessed: a factor of 100 takes most numbers
that are a little too large to within a range of nearly that width."""
UNKNOWN_RADIUS: Final = 0.5  # radius of a propeller whose file states none, in arm lengths


@dataclass(frozen=True, kw_only=True)
class Ratio:
    """A ratio of a vehicle's numbers, and the range that quadrotors have."""

    of: tuple[str, ...]  # parameters that it depends on, the one most likely wrong first
    text: str  # what it is, in words
    value: Callable[[Vehicle], float | None]  # None where the vehicle does not state it
    low: float
    high: float

    def misfit(self, vehicle: Vehicle) -> float:
        """Return by how many factors of e a vehicle is outside the range; 0 inside, or where it states nothing."""
        value = self.value(vehicle)
        if value is None:
            return 0.0
        if value <= 0.0:
            if self.low > 0.0:
                return math.inf
            return 0.0
        misfit = max(math.log(value / self.high), 0.0)
        if self.low > 0.0:
            misfit = max(misfit, math.log(self.low / value))
        return misfit

    def is_usual(self, vehicle: Vehicle) -> bool:
        """Return whether a vehicle is within the range, and not at its edge, or states nothing."""
        value = self.value(vehicle)
        if value is None:
            return True
        if self.misfit(vehicle) > 0.0:
            return False
        if self.low <= 0.0:
            return True
        edge = EDGE * math.log(self.high / self.low)
        return min(math.log(self.high / value), math.log(value / self.low)) >= edge


def _radius(vehicle: Vehicle) -> float:
    if vehicle.rotor_radius is None:
        return UNKNOWN_RADIUS * vehicle.longest_arm
    return vehicle.rotor_radius


def _over(value: float | None, other: float) -> float | None:
    if value is None:
        return None
    return value / other


def _thrust_coefficient(vehicle: Vehicle) -> float:
    """C_T = b / (rho pi R^4)."""
    return vehicle.mean_coefficient / (AIR_DENSITY * math.pi * _radius(vehicle) ** 4)


def _slowing(vehicle: Vehicle) -> float | None:
    """Share of the speed that the rotors' drag takes per second at hover [1/s]."""
    return _over(vehicle.rotor_drag, vehicle.mass / (N_ROTORS * vehicle.hover_speed))


def _drag_share(vehicle: Vehicle) -> float | None:
    """The largest area of drag over that of the arms' circle."""
    if vehicle.body_drag is None:
        return None
    return max(vehicle.body_drag) / (math.pi * vehicle.longest_arm**2)


def _fall_over_rise(vehicle: Vehicle) -> float | None:
    """Time constant of a rotor's speed when it falls over that when it rises."""
    if vehicle.rotor_rise is None:
        return None
    return _over(vehicle.rotor_fall, vehicle.rotor_rise)


def _time_constant(name: str) -> Ratio:
    """Return the ratio of a rotor's time constant to what its propeller's size suggests."""
    return Ratio(
        of=(name, "rotor_radius"),
        text=f"{name} [s] over 0.12 s + rotor_radius / (1 m/s)",
        value=lambda v: _over(getattr(v, name), 0.12 + _radius(v)),
        low=5e-3,
        high=1.0,
    )


RATIOS: Final = (
    Ratio(of=("gravity",), text="gravity [m/s^2]", value=lambda v: v.gravity, low=1.3, high=26.0),
    Ratio(
        of=("arm_length", "mass"),
        text="mass / arm_length^3 [kg/m^3]",
        value=lambda v: v.mass / v.longest_arm**3,
        low=8.0,
        high=3000.0,
    ),
    Ratio(
        of=("inertia", "arm_length", "mass"),
        text="the larger of Ixx and Iyy over mass arm_length^2",
        value=lambda v: max(v.inertia[:2]) / (v.mass * v.longest_arm**2),
        low=0.02,
        high=1.5,
    ),
    Ratio(
        of=("inertia", "arm_length", "mass"),
        text="the smaller of Ixx and Iyy over mass arm_length^2",
        value=lambda v: min(v.inertia[:2]) / (v.mass * v.longest_arm**2),
        low=0.02,
        high=1.5,
    ),
    Ratio(
        of=("inertia", "arm_length", "mass"),
        text="Izz over mass arm_length^2",
        value=lambda v: v.inertia[2] / (v.mass * v.longest_arm**2),
        low=0.04,
        high=3.0,
    ),
    Ratio(
        of=("speed_max", "thrust_coefficient", "mass"),
        text="largest thrust over weight",
        value=lambda v: float(v.thrusts(np.full(N_ROTORS, v.speed_max)).sum()) / (v.mass * v.gravity),
        low=1.0,
        high=12.0,
    ),
    Ratio(
        of=("rotor_azimuths", "rotor_spins"),
        text="largest over smallest share of the weight that a rotor carries in hover",
        value=lambda v: v.thrust_shares.max() / v.thrust_shares.min(),
        low=1.0,
        high=3.0,
    ),
    Ratio(
        of=("thrust_coefficient", "rotor_radius", "arm_length"),
        text="thrust_coefficient over rho pi rotor_radius^4",
        value=_thrust_coefficient,
        low=1e-3,
        high=0.6,
    ),
    Ratio(
        of=("speed_max", "rotor_radius", "thrust_coefficient"),
        text="tip speed of the rotors at hover [m/s]",
        value=lambda v: v.hover_speed * _radius(v),
        low=4.0,
        high=200.0,
    ),
    Ratio(
        of=("rotor_radius", "arm_length"),
        text="rotor_radius over arm_length",
        value=lambda v: _over(v.rotor_radius, v.longest_arm),
        low=0.12,
        high=1.0,
    ),
    Ratio(
        of=("drag_to_thrust", "rotor_radius", "arm_length"),
        text="drag_to_thrust over rotor_radius",
        value=lambda v: v.drag_to_thrust / _radius(v),
        low=0.03,
        high=0.6,
    ),
    Ratio(
        of=("rotor_inertia", "rotor_radius", "mass"),
        text="rotor_inertia over mass rotor_radius^2",
        value=lambda v: _over(v.rotor_inertia, v.mass * _radius(v) ** 2),
        low=1e-5,
        high=6e-3,
    ),
    Ratio(
        of=("rotor_drag", "mass"),
        text="share of the speed that rotor_drag takes per second at hover",
        value=_slowing,
        low=1e-3,
        high=1.2,
    ),
    Ratio(
        of=("inflow", "mass"),
        text="share of the climb that inflow takes per second at hover",
        value=lambda v: _over((v.inflow or 0.0) * float(v.hover_speeds.sum()) or None, v.mass),
        low=1e-2,
        high=10.0,
    ),
    Ratio(
        of=("rotor_moment", "thrust_coefficient", "inertia"),
        text="angular acceleration of rotor_moment at hover per air speed [rad/(m s)]",
        value=lambda v: v.turned_by_air or None,
        low=1e-3,
        high=300.0,
    ),
    Ratio(
        of=("inflow_moment", "inertia"),
        text="angular acceleration of inflow_moment per squared air speed [rad/m^2]",
        value=lambda v: _over(max(map(abs, v.inflow_moment or (0.0,))) or None, min(v.inertia[:2])),
        low=1e-2,
        high=300.0,
    ),
    Ratio(
        of=("rate_damping", "inertia"),
        text="share of a body rate that rate_damping takes per second",
        value=lambda v: _over(max(v.rate_damping or (0.0,)) or None, min(v.inertia)),
        low=1e-3,
        high=300.0,
    ),
    Ratio(
        of=("body_drag", "arm_length"),
        text="the largest body_drag over pi arm_length^2",
        value=_drag_share,
        low=1e-3,
        high=3.0,
    ),
    _time_constant("rotor_rise"),
    _time_constant("rotor_fall"),
    Ratio(
        of=("rotor_fall", "rotor_rise"),
        text="rotor_fall over rotor_rise",
        value=_fall_over_rise,
        low=0.4,
        high=5.0,
    ),
    Ratio(
        of=("extent", "arm_length"),
        text="extent over arm_length + rotor_radius",
        value=lambda v: _over(v.extent, v.longest_arm + (v.rotor_radius or 0.0)),
        low=0.999,
        high=3.0,
    ),
)
Factors = dict[str, float | tuple[float, ...]]
_LENGTHS: Final[Factors] = {"mm": 1e-3, "cm": 1e-2, "inches": 0.0254}
_TIMES: Final[Factors] = {"ms": 1e-3}
_MOMENTS: Final[Factors] = {"kg cm^2": 1e-4, "g cm^2": 1e-7, "kg mm^2": 1e-6, "g mm^2": 1e-9}
_RPM: Final = 30.0 / math.pi  # in a rad/s
_SPEEDS: Final[Factors] = {"rpm": math.pi / 30.0}
UNITS: Final[dict[str, Factors]] = {
    **dict.fromkeys(("arm_length", "rotor_positions", "rotor_radius", "drag_to_thrust", "extent"), _LENGTHS),
    **dict.fromkeys(("inertia", "products_of_inertia", "rotor_inertia"), _MOMENTS),
    **dict.fromkeys(("rotor_rise", "rotor_fall"), _TIMES),
    **dict.fromkeys(("speed_min", "speed_max"), _SPEEDS),
    "thrust_coefficient": {"N/rpm^2": _RPM**2, "g/rpm^2": 9.80665e-3 * _RPM**2},
    "thrust_of_speed": {"N/rpm and N/rpm^2": (_RPM, _RPM**2), "g s/rad and g s^2/rad^2": 9.80665e-3},
    "thrust_of_throttle": {"g": 9.80665e-3},
    "body_drag": {"cm^2": 1e-4, "mm^2": 1e-6},
    "mass": {"g": 1e-3},
}
"""Units, with their factors to the file's, in which each parameter is given by mistake."""


def implausible(vehicle: Vehicle) -> list[str]:
    """Return a line per ratio outside its range, or one about the unit that would explain all of them."""
    off = _ratios_off(vehicle)
    if not off:
        return []
    explanation = _explanation(vehicle)
    if explanation is not None:
        more = ""
        if len(off) > 1:
            more = f", and {len(off) - 1} more ratios are off"
        return [f"vehicle: {explanation}; as it is, {_ratio_line(off[0], vehicle)}{more}"]
    lines = []
    for ratio in off:
        parameters = ", ".join(_stated_names(ratio.of, vehicle))
        lines.append(f"vehicle: {_ratio_line(ratio, vehicle)}; check {parameters}")
    return lines


def _ratios_off(vehicle: Vehicle) -> list[Ratio]:
    """Return the ratios outside their ranges."""
    return [ratio for ratio in RATIOS if ratio.misfit(vehicle) > 0.0]


def _stated_names(names: Sequence[str], vehicle: Vehicle) -> list[str]:
    """Return the parameters as the vehicle states them: arms by `rotor_positions`, thrust by a map."""
    (thrust,) = [name for name in THRUST if getattr(vehicle, name) is not None]
    stated = []
    for name in names:
        if name == THRUST[0]:
            stated.append(thrust)
        elif name in ARMS and vehicle.rotor_positions is not None:
            stated.append("rotor_positions")
        else:
            stated.append(name)
    return stated


def _ratio_line(ratio: Ratio, vehicle: Vehicle) -> str:
    return f"{ratio.text} is {ratio.value(vehicle):.3g}, usually {ratio.low:g} to {ratio.high:g}"


def _explanation(vehicle: Vehicle) -> str | None:
    """Return which one parameter in another unit would make the vehicle plausible; None if none would.

    Every ratio that was off and that the unit changes must then be usual.
    """
    before = _total_misfit(vehicle)
    best = None
    off = _ratios_off(vehicle)
    for name, unit, other in _converted(vehicle):
        misfit = _total_misfit(other)
        changed = [ratio for ratio in off if ratio.value(other) != ratio.value(vehicle)]
        usual = all(ratio.is_usual(other) for ratio in changed)
        if usual and misfit < 0.2 * before and (best is None or misfit < best[0] - 1e-9):
            given = _value_text(getattr(vehicle, name))
            fits = _value_text(getattr(other, name))
            best = misfit, f"is {name} = {given} given in {unit}? {fits} {VEHICLE_UNITS[name]} would fit"
    if best is None:
        return None
    return best[1]


def _total_misfit(vehicle: Vehicle) -> float:
    return sum(ratio.misfit(vehicle) for ratio in RATIOS)


def _converted(vehicle: Vehicle) -> Iterator[tuple[str, str, Vehicle]]:
    """Yield the vehicle with one parameter, or all that depend on rotor speeds, taken to be in another unit."""
    speeds = {name: _in_other_unit(getattr(vehicle, name), _SPEEDS["rpm"]) for name in ("speed_min", "speed_max")}
    for name, unit in (("thrust_coefficient", "N/rpm^2"), ("thrust_of_speed", "N/rpm and N/rpm^2")):
        thrust = getattr(vehicle, name)
        if thrust is None:
            continue
        with contextlib.suppress(ParameterError):
            together = {**speeds, name: _in_other_unit(thrust, UNITS[name][unit])}
            yield "speed_max", f"rpm, and {name} in {unit}", replace(vehicle, **together)
    for name, units in UNITS.items():
        value: Any = getattr(vehicle, name)
        if value is None:
            continue
        for unit, factor in units.items():
            changes: dict[str, Any] = {name: _in_other_unit(value, factor)}
            try:
                yield name, unit, replace(vehicle, **changes)
            except ParameterError:  # no vehicle at all
                continue


def _in_other_unit(value: Any, factor: float | tuple[float, ...]) -> Any:
    if isinstance(factor, tuple):
        return tuple(_in_other_unit(entry, one) for entry, one in zip(value, factor, strict=True))
    if isinstance(value, tuple):
        return tuple(_in_other_unit(entry, factor) for entry in value)
    return factor * value


def _value_text(value: Any) -> str:
    if isinstance(value, tuple):
        return ", ".join(_value_text(entry) for entry in value)
    return f"{value:.4g}"
