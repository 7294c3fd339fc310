"""Bounds of a scenario that a vehicle cannot meet, with reasons."""

from __future__ import annotations

import math
from typing import Final

from quadsim.features.design.authority import Authority, authority
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
    spec = scenario.controller
    can = authority(vehicle)
    missed: list[str] = []
    if isinstance(spec, Bounded | Baseline) and spec.input_bounds is not None:
        missed += _inputs(spec.input_bounds, vehicle, scenario.control_period)
    if isinstance(spec, Bounded):
        for name in ("roll", "pitch"):
            if name in spec.output_bounds:
                missed += _tilt(f"controller.output_bounds.{name}", max(map(abs, spec.output_bounds[name])), can)
    elif isinstance(spec, Baseline):
        missed += _tilt("controller.tilt", spec.tilt, can)
    if isinstance(spec, Robust) and spec.rotor_lag == "vehicle" and vehicle.rotor_rise is None:
        missed.append("controller.rotor_lag is the vehicle's, whose file gives no rotor_rise: give a number of seconds")
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
    assembly = Assembly(scenario)
    required = report(assembly)
    missed += [f"the course needs {problem}" for problem in required.problems]
    if required.advice:
        return (*missed, required.advice)
    return tuple(missed)


def _inputs(bounds: InputBounds, vehicle: Vehicle, period: float) -> list[str]:
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
    up = bounds.slew[1]
    needed = vehicle.speed_max - float(hover.max())
    if up * SLOWEST_ANSWER < needed * period:
        if up:
            time = f"{needed * period / up:.3g} s"
        else:
            time = "for ever"
        missed.append(
            f"controller.input_bounds.slew: {up:g} rad/s per period take {time} from hover to the highest speed, "
            f"{needed:.4g} rad/s more; too slow to control tilt and height"
        )
    return missed


def _tilt(name: str, bound: float, can: Authority) -> list[str]:
    """Return a tilt [deg] at which the rotors no longer carry the weight."""
    steady = math.degrees(can.steady_tilt)
    if bound <= steady:
        return []
    return [
        f"{name}: {bound:g} deg, but from {steady:.3g} deg on the rotors do not carry the weight "
        f"(thrust to weight {can.thrust_to_weight:.3g})"
    ]
