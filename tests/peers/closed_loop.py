"""Closed loop: the paper's constrained flight, by the same controller, on MuJoCo and on RotorPy."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from peers.checks import Check
from peers.rotorpy_plant import RotorPyPlant

from quadsim.flight.audit import audit
from quadsim.flight.log import FlightLog
from quadsim.flight.metrics import tracking
from quadsim.scenarios.assembly import Assembly
from quadsim.scenarios.loading import load_scenario
from quadsim.scenarios.schema.scenario import Scenario
from quadsim.sim.loop import fly
from quadsim.sim.plant import Plant

SCENARIO: Final = "paper-constrained"


@dataclass(frozen=True, kw_only=True)
class Quantity:
    """One number of a flight on each plant."""

    name: str
    unit: str
    mujoco: float
    rotorpy: float

    @property
    def difference(self) -> float:
        """How far the two are apart."""
        return abs(self.mujoco - self.rotorpy)


@dataclass(frozen=True, kw_only=True)
class ClosedLoop:
    """What was found."""

    scenario: Scenario  # what was flown
    mujoco: FlightLog  # the flight on our plant
    rotorpy: FlightLog  # the flight on RotorPy's

    @property
    def peaks(self) -> tuple[Quantity, ...]:
        """The largest roll and pitch at the samples and at 1 kHz, signed, as the audit reports them [deg]."""
        limits = Assembly(self.scenario).limits
        pairs = zip(audit(self.mujoco, limits), audit(self.rotorpy, limits), strict=True)
        return tuple(
            Quantity(
                name=f"peak {ours.limit.name} {where}", unit="deg", mujoco=getattr(ours, of), rotorpy=getattr(its, of)
            )
            for ours, its in pairs
            if ours.limit.signal in ("roll", "pitch")
            for where, of in (("at the samples", "peak_sampled"), ("at 1 kHz", "peak_plant"))
        )

    @property
    def rmse(self) -> tuple[Quantity, ...]:
        """Tracking errors."""
        ours = tracking(self.mujoco.control)
        its = tracking(self.rotorpy.control)
        return tuple(
            Quantity(name=f"RMS error {name}", unit=unit, mujoco=ours["rmse"][name], rotorpy=its["rmse"][name])
            for name, unit in ours["unit"].items()
        )

    @property
    def checks(self) -> tuple[Check, ...]:
        """Peaks and errors, then everything: each state at each millisecond, each command."""

        def largest(quantities: tuple[Quantity, ...]) -> float:
            return max(quantity.difference for quantity in quantities)

        states = float(np.abs(self.mujoco.plant.state - self.rotorpy.plant.state).max())
        commands = float(np.abs(self.mujoco.control.speeds - self.rotorpy.control.speeds).max())
        return (
            Check(what="flight: peaks", peer="rotorpy", measured=largest(self.peaks), allowed=1e-6, unit="deg"),
            Check(what="flight: RMS errors", peer="rotorpy", measured=largest(self.rmse), allowed=1e-6, unit="m, rad"),
            Check(what="flight: states at 1 kHz", peer="rotorpy", measured=states, allowed=1e-6, unit="SI"),
            Check(what="flight: commands", peer="rotorpy", measured=commands, allowed=1e-6, unit="rad/s"),
        )


def measure() -> ClosedLoop:
    """Fly the scenario on both plants."""
    scenario = load_scenario(SCENARIO)
    vehicle = Assembly(scenario).vehicle
    with Assembly(scenario).plant() as plant:
        mujoco = fly_on(plant, scenario)
    return ClosedLoop(scenario=scenario, mujoco=mujoco, rotorpy=fly_on(RotorPyPlant(vehicle), scenario))


def fly_on(plant: Plant | RotorPyPlant, scenario: Scenario) -> FlightLog:
    """Fly a scenario on a plant, with a controller of its own."""
    controller = Assembly(scenario).controller()
    return fly(
        plant,
        controller,
        Assembly(scenario).reference(scenario.periods + controller.horizon),
        initial_state=Assembly(scenario).initial_state(),
        initial_speeds=np.full(4, plant.vehicle.hover_speed),
        periods=scenario.periods,
        steps_per_period=scenario.steps_per_period,
    )
