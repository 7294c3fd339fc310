"""The quantities whose margins can be measured: their values, their ranges, and the fields that set them.

A quantity changes the plant, the delay or the control period, and the controller is as the scenario has it: what it
tolerates is the margin.  `margins` searches along a quantity; adding one is a function and an entry of `_ALL`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Final, Literal, TypeAlias

import numpy as np

from quadsim.errors import ParameterError, UnknownNameError
from quadsim.scenarios.assembly import Assembly
from quadsim.scenarios.mismatch import course_headings
from quadsim.sim.effects import Disturbance
from quadsim.sim.effects.rotors import RotorDynamics
from quadsim.sim.effects.wind import Air
from quadsim.state import wrapped
from quadsim.vehicle import THRUST

FieldValues: TypeAlias = dict[str, Any]

HEADING: Final = "heading"
"""The quantity that is no field of a scenario, but the hover's own."""
MOST_FACTOR: Final = 8.0  # largest factor that is searched, and inverse of the smallest
MOST_TURN: Final = 180.0  # [deg]
MOST_MILLISECONDS: Final = 200.0  # range of delay and rotor lag beyond the nominal [ms]
LEAST_LAG: Final = 1.0  # [ms]
MOST_DRAG: Final = 8.0  # [1/s]
MOST_TILT: Final = 60.0  # [deg]


@dataclass(frozen=True, kw_only=True)
class VariedQuantity:
    """A quantity that is varied about its nominal value.

    Attributes:
        name: the word after `--over`.
        unit: of its values; `x` is a factor of the nominal.
        nominal: its value in a scenario.
        ends: the range that is searched, given the nominal value.
        fields: the fields that give it a value, with their values.
        step: of which values are whole multiples; 0 where they may have any value.
        geometric: whether equal steps are equal factors.
        measure: what a margin is divided by to be compared with others: its nominal value, or the range searched.
    """

    name: str
    unit: str
    nominal: Callable[[Assembly], float]
    ends: Callable[[float], tuple[float, float]]
    fields: Callable[[Assembly, float], FieldValues]
    step: Callable[[Assembly], float] = lambda assembly: 0.0
    geometric: bool = False
    measure: Literal["nominal", "range"] = "range"

    def between(self, start: float, end: float, share: float, step: float = 0.0) -> float:
        """Return the value at a share of the way from one value to another, a whole multiple of a step if there is one.

        The start itself is left as it is.
        """
        if share == 0.0:
            return start
        if self.geometric:
            value = start * (end / start) ** share
        else:
            value = start + (end - start) * share
        if step == 0.0:
            return value
        steps = round(value / step)
        if end != 0.0:
            steps = max(steps, 1)
        return round(steps * step, 9)

    def distance(self, nominal: float, value: float) -> float:
        """Return how far a value is from the nominal, as `measure` says."""
        if self.measure == "nominal":
            return abs(value - nominal) / abs(nominal)
        low, high = self.ends(nominal)
        return abs(value - nominal) / max(high - nominal, nominal - low)

    @property
    def label(self) -> str:
        """Name and unit."""
        return f"{self.name} [{self.unit}]"


def _usual_heading(assembly: Assembly) -> float:
    """Return the median of the course's heading, within half a turn of zero [deg]."""
    return round(math.degrees(float(np.median(wrapped(course_headings(assembly))))), 9)


def _delay(assembly: Assembly) -> float:
    """Return the time from measurement to command [ms]."""
    computation = assembly.scenario.computation
    if computation is None:
        return 0.0
    return 1e3 * computation.delay


def _set_delay(assembly: Assembly, value: float) -> FieldValues:
    return {"computation.delay": round(1e-3 * value, 9)}


def _step(assembly: Assembly) -> float:
    """Return the physics step [ms], of which a flight takes whole ones."""
    return 1e3 * assembly.scenario.plant.timestep


def _lag(assembly: Assembly) -> float:
    """Return the rotors' time constant, that of the rise where there are two [ms]."""
    rotors = assembly.effects.rotors or RotorDynamics()
    return 1e3 * (rotors.rise or rotors.fall or 0.0)


def _set_lag(assembly: Assembly, value: float) -> FieldValues:
    """Set both time constants, in the proportion that they have."""
    rotors = assembly.effects.rotors
    fall = 1.0
    if rotors is not None and rotors.rise and rotors.fall:
        fall = rotors.fall / rotors.rise
    changes: FieldValues = {"effects.rotors.rise": 1e-3 * value, "effects.rotors.fall": 1e-3 * value * fall}
    if rotors is None:
        changes["effects.rotors.inertia"] = 0.0  # the lag alone, whatever else the vehicle states
    return changes | _without_actual(assembly, "rotor_rise", "rotor_fall")


def _without_actual(assembly: Assembly, *names: str) -> FieldValues:
    """Remove values of `[actual]` that would contradict those of an effect."""
    changes: FieldValues = {}
    if assembly.scenario.actual is not None:
        stated = assembly.scenario.actual.overrides()
        for name in names:
            if name in stated:
                changes[f"actual.{name}"] = None
    return changes


def _times(value: Any, factor: float) -> Any:
    """Return a number, or numbers, times a factor."""
    if isinstance(value, Sequence):
        return [factor * number for number in value]
    return factor * value


def _scaled(*names: str) -> Callable[[Assembly, float], FieldValues]:
    """Return the fields that scale parameters of the actual vehicle, of those that it has."""

    def fields(assembly: Assembly, factor: float) -> FieldValues:
        changes: FieldValues = {}
        for name in names:
            value = getattr(assembly.actual, name)
            if value is not None:
                changes[f"actual.{name}"] = _times(value, factor)
        return changes

    return fields


def _set_period(assembly: Assembly, value: float) -> FieldValues:
    """Set the control period, for which the controller is built anew."""
    return {"control_period": round(1e-3 * value, 12)}


def _set_drag(assembly: Assembly, value: float) -> FieldValues:
    """Add linear drag of the body to what the scenario states."""
    air = assembly.scenario.effects.air
    if air is None:
        stated = Air().linear_drag
    else:
        stated = air.linear_drag
    added = value * assembly.actual.mass
    drag = [axis + added for axis in stated]
    changes: FieldValues = {"effects.air.linear_drag": drag}
    if air is None:  # that drag alone, whatever else the vehicle states
        changes |= {"effects.air.rotor_drag": 0.0, "effects.air.inflow": 0.0}
        changes |= {"effects.air.rotor_moment": [0.0, 0.0], "effects.air.rate_damping": [0.0, 0.0, 0.0]}
    return changes


def _set_tilt(assembly: Assembly, value: float) -> FieldValues:
    """Add the side force along x against which the vehicle has to hold this tilt."""
    x, y, z = (assembly.scenario.effects.disturbance or Disturbance()).force
    vehicle = assembly.actual
    side = vehicle.mass * vehicle.gravity * math.tan(math.radians(value))
    return {"effects.disturbance.force": [x - side, y, z]}


def _zero(assembly: Assembly) -> float:
    return 0.0


def _one(assembly: Assembly) -> float:
    return 1.0


def _factors(nominal: float) -> tuple[float, float]:
    """Return the range of a quantity whose equal steps are equal factors."""
    return nominal / MOST_FACTOR, nominal * MOST_FACTOR


def _from_zero(most: float) -> Callable[[float], tuple[float, float]]:
    """Return the range from 0 to `most` beyond the nominal value."""
    return lambda nominal: (0.0, nominal + most)


def _lags(nominal: float) -> tuple[float, float]:
    """Return the range of the rotors' time constant [ms], which is never 0."""
    return min(LEAST_LAG, nominal), nominal + MOST_MILLISECONDS


def _about(most: float) -> Callable[[float], tuple[float, float]]:
    """Return the range that reaches `most` to either side of the nominal value."""
    return lambda nominal: (nominal - most, nominal + most)


_ALL: Final = (
    VariedQuantity(
        name=HEADING,
        unit="deg",
        nominal=_usual_heading,
        ends=_about(MOST_TURN),
        fields=lambda assembly, value: {},
    ),
    VariedQuantity(
        name="delay",
        unit="ms",
        nominal=_delay,
        ends=_from_zero(MOST_MILLISECONDS),
        fields=_set_delay,
        step=_step,
    ),
    VariedQuantity(
        name="lag",
        unit="ms",
        nominal=_lag,
        ends=_lags,
        fields=_set_lag,
    ),
    VariedQuantity(
        name="mass",
        unit="x",
        nominal=_one,
        ends=_factors,
        fields=_scaled("mass"),
        geometric=True,
        measure="nominal",
    ),
    VariedQuantity(
        name="thrust",  # thrust and torque of the actual rotors at a speed: the gain of the loop
        unit="x",
        nominal=_one,
        ends=_factors,
        fields=_scaled(*THRUST),
        geometric=True,
        measure="nominal",
    ),
    VariedQuantity(
        name="inertia",
        unit="x",
        nominal=_one,
        ends=_factors,
        fields=_scaled("inertia", "products_of_inertia"),
        geometric=True,
        measure="nominal",
    ),
    VariedQuantity(
        name="period",  # for which the controller is built anew
        unit="ms",
        nominal=lambda assembly: 1e3 * assembly.scenario.control_period,
        ends=_factors,
        fields=_set_period,
        step=_step,
        geometric=True,
        measure="nominal",
    ),
    VariedQuantity(
        name="drag",  # linear drag of the body over its mass, in addition to the scenario's
        unit="1/s",
        nominal=_zero,
        ends=_from_zero(MOST_DRAG),
        fields=_set_drag,
    ),
    VariedQuantity(
        name="tilt",  # held against a steady side force along x
        unit="deg",
        nominal=_zero,
        ends=_about(MOST_TILT),
        fields=_set_tilt,
    ),
)
VARIED: Final[Mapping[str, VariedQuantity]] = MappingProxyType({quantity.name: quantity for quantity in _ALL})
"""By name, in the order in which they are shown."""


def quantities_named(names: Sequence[str]) -> tuple[VariedQuantity, ...]:
    """Return the quantities of these names, all if there is none.

    Raises:
        UnknownNameError: there is no such quantity.
        ParameterError: one is named twice.
    """
    for name in names:
        if name not in VARIED:
            raise UnknownNameError("quantity", name, VARIED)
        if list(names).count(name) > 1:
            raise ParameterError("", "--over", list(names), "names of different quantities")
    return tuple(VARIED[name] for name in names or VARIED)


def point(assembly: Assembly, values: Mapping[str, float]) -> tuple[float, FieldValues]:
    """Return the heading [deg] and the fields that give quantities their values.

    Those at their nominal value are left as the scenario has them, which is exact.

    Args:
        assembly: the nominal one.
        values: by name of a quantity, in its unit.
    """
    heading = values.get(HEADING, _usual_heading(assembly))
    changes: FieldValues = {}
    for name, value in values.items():
        quantity = VARIED[name]
        if value != quantity.nominal(assembly):
            changes |= quantity.fields(assembly, value)
    return heading, changes
