"""Bounds of a scenario that a vehicle cannot meet, with reasons: the question of `quadsim vehicle --scenario`.

The bounds on rotor speeds and their steps, on tilt and on the audited rotor speeds are compared with the vehicle's
numbers at hover (`authority.py`); the course is then assessed by differential flatness (`flight/feasibility.py`).
"""

from __future__ import annotations

import math
from typing import Final

from quadsim.features.design.authority import Authority, control_authority
from quadsim.mpc.laws.parts.feedback import Baseline
from quadsim.mpc.laws.robust import Robust
from quadsim.mpc.tables.bounded import Bounded
from quadsim.mpc.tables.commands import InputBounds
from quadsim.scenarios.assembly import Assembly
from quadsim.scenarios.feasibility_check import report
from quadsim.scenarios.schema.scenario import Scenario
from quadsim.vehicle import Vehicle, span

SLOWEST_ANSWER: Final = 1.0
"""Time [s] within which steps of the command, as they are bounded, should come from hover to the highest speed."""


def shortfalls(scenario: Scenario, vehicle: Vehicle) -> tuple[str, ...]:
    """Return a line for each bound of a scenario that the vehicle cannot meet."""
    missed = _of_controller(scenario, vehicle)
    slowest = float(vehicle.hover_speeds.min())
    fastest = float(vehicle.hover_speeds.max())
    for limit in scenario.constraints:
        if limit.signal == "speed" and not (limit.lower <= slowest and fastest <= limit.upper):
            sides = f"{limit.lower:g} to {limit.upper:g}"
            missed.append(
                f"constraint {limit.name}: hover is {span(vehicle.hover_speeds)} rad/s, the audit allows {sides}"
            )
    if any("hover is" in line for line in missed):  # the course's rotor speeds would repeat it
        return tuple(missed)
    required = report(Assembly(scenario))
    missed += [f"the course needs {problem}" for problem in required.problems]
    if required.advice:
        missed.append(required.advice)
    return tuple(missed)


def _of_controller(scenario: Scenario, vehicle: Vehicle) -> list[str]:
    """Return a line for each number of the controller that the vehicle cannot meet or does not give."""
    spec = scenario.controller
    authority = control_authority(vehicle)
    missed: list[str] = []
    if isinstance(spec, Bounded | Baseline) and spec.input_bounds is not None:
        missed += _inputs(spec.input_bounds, vehicle, scenario.control_period)
    if isinstance(spec, Bounded):
        for name in ("roll", "pitch"):
            if name in spec.output_bounds:
                lower, upper = spec.output_bounds[name]
                largest = max(abs(lower), abs(upper))
                missed += _tilt(f"controller.output_bounds.{name}", largest, authority)
    elif isinstance(spec, Baseline):
        missed += _tilt("controller.tilt", spec.tilt, authority)
    if isinstance(spec, Robust) and spec.rotor_lag == "vehicle" and vehicle.rotor_rise is None:
        missed.append("controller.rotor_lag is the vehicle's, whose file gives no rotor_rise: give a number of seconds")
    return missed


def _inputs(bounds: InputBounds, vehicle: Vehicle, period: float) -> list[str]:
    """Return a line for each bound on rotor speeds, or on their steps, that the vehicle cannot meet."""
    lower, upper = bounds.speed
    speed = "controller.input_bounds.speed"
    hover = vehicle.hover_speeds
    missed = []
    if hover.max() > upper:
        missed.append(f"{speed}: hover is {span(hover)} rad/s, the scenario allows {upper:g}")
    elif hover.min() < lower:
        missed.append(f"{speed}: hover is {span(hover)} rad/s, the scenario requires at least {lower:g}")
    if upper > vehicle.speed_max:
        missed.append(f"{speed}: the scenario counts on {upper:g} rad/s, the rotors reach {vehicle.speed_max:g}")
    if lower < vehicle.speed_min:
        missed.append(
            f"{speed}: the scenario counts on {lower:g} rad/s, the rotors hold at least {vehicle.speed_min:g}"
        )
    return missed + _slew(bounds.slew[1], vehicle, period)


def _slew(largest_step: float, vehicle: Vehicle, period: float) -> list[str]:
    """Return a line if bounded steps [rad/s per period] take too long from hover to the highest speed."""
    needed = vehicle.speed_max - float(vehicle.hover_speeds.max())
    if largest_step * SLOWEST_ANSWER >= needed * period:
        return []
    if largest_step:
        time = f"{needed * period / largest_step:.3g} s"
    else:
        time = "for ever"
    return [
        f"controller.input_bounds.slew: {largest_step:g} rad/s per period take {time} from hover to the highest speed, "
        f"{needed:.4g} rad/s more; too slow to control tilt and height"
    ]


def _tilt(name: str, bound: float, authority: Authority) -> list[str]:
    """Return a line if the rotors do not carry the weight at a tilt bound [deg]."""
    steady = math.degrees(authority.steady_tilt)
    if bound <= steady:
        return []
    return [
        f"{name}: {bound:g} deg, but from {steady:.3g} deg on the rotors do not carry the weight "
        f"(thrust to weight {authority.thrust_to_weight:.3g})"
    ]
