"""From a scenario file to the things that fly: vehicle, plant, reference, controller, limits."""

from __future__ import annotations

from collections.abc import Sequence

from mpc.bounded import Bounded, Weighted
from mpc.ocp import Problem
from mpc.solvers import CORE_OR_PIQP
from quadsim.controller import Controller
from quadsim.errors import ParameterError
from quadsim.sim.airframe import outline
from quadsim.sim.effects import Force
from quadsim.sim.phase import PhaseMonitor
from quadsim.sim.plant import Plant
from quadsim.vehicle import Vehicle
from scenarios.parts.effects import build_changes, build_wind
from scenarios.parts.randomness import generator
from scenarios.parts.vehicle import actual_effects, build_actual, resolve_vehicle, saturates
from scenarios.plugin import import_plugin, make_force
from scenarios.reference import timed_regions
from scenarios.schema.scenario import Scenario


def resolve(scenario: Scenario, vehicle: Vehicle) -> Scenario:
    """The scenario with every number that it leaves to its vehicle written out: its file alone defines the flight."""
    return resolve_vehicle(scenario, vehicle).model_copy(update={"effects": actual_effects(scenario, vehicle)})


def preferring_core(scenario: Scenario) -> Scenario:
    """The scenario with `core-or-piqp` in place of `piqp`, the default: for where a step's time matters."""
    controller = scenario.controller
    if isinstance(controller, Bounded) and controller.solver == "piqp":
        return scenario.replace({"controller.solver": CORE_OR_PIQP})
    return scenario


def build_plant(scenario: Scenario, vehicle: Vehicle, forces: Sequence[Force] | None = None) -> Plant:
    """The simulated vehicle as it really is, and what acts on it; `forces` instead of those that the scenario names.

    Raises:
        InputError: a combination of effects is not possible, or a force cannot be imported.
    """
    rng, actual = generator(scenario.seed, "forces"), build_actual(scenario, vehicle)
    return Plant(
        actual,
        timestep=scenario.plant.timestep,
        integrator=scenario.plant.integrator,
        limit_speeds=saturates(scenario),
        effects=actual_effects(scenario, vehicle),
        changes=build_changes(scenario),
        wind=build_wind(scenario, vehicle),
        forces=[make_force(import_plugin(spec), spec, actual, rng) for spec in scenario.forces]
        if forces is None
        else forces,
        obstacles=scenario.obstacles,
        rng=generator(scenario.seed, "disturbance"),
    )


def build_ground(scenario: Scenario, vehicle: Vehicle) -> PhaseMonitor | None:
    """What knows where the flight stands with the ground and obstacles; None where there are none."""
    ground = scenario.effects.ground
    there = ground is not None and ground.contact
    if not there and not scenario.obstacles:
        return None
    actual = build_actual(scenario, vehicle)
    return PhaseMonitor(
        outline(actual) if there else None,
        period=scenario.control_period,
        obstacles=scenario.obstacles,
        radius=actual.enclosing_radius,
    )


def build_problem(scenario: Scenario, vehicle: Vehicle) -> Problem:
    """The controller's optimisation.

    Raises:
        InputError: the controller has none.
    """
    spec = scenario.controller
    if not isinstance(spec, Weighted):
        raise ParameterError("controller", "type", spec.type, "one that minimises over a horizon")
    return spec.problem(vehicle, scenario.control_period)


def build_controller(scenario: Scenario, vehicle: Vehicle) -> Controller:
    """The controller, set up and ready to be flown.

    Raises:
        InputError: it cannot be made from these numbers, or its code cannot be found or called.
    """
    shapes = (*scenario.obstacles, *timed_regions(scenario))
    return scenario.controller.build(vehicle, scenario.control_period, shapes)
