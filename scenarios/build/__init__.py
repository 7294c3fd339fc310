"""From a scenario file to the things that fly: vehicle, plant, reference, controller, limits."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, Final

import numpy as np

from mpc.problem import Problem
from quadsim.sim.airframe import outline
from quadsim.assets import vehicle_path
from quadsim.flight.audit import Limit
from quadsim.controller import Controller
from quadsim.errors import InputError, ParameterError
from quadsim.flight.lost import LossCriteria
from quadsim.sim.phase import PhaseMonitor
from quadsim.sim.plant import Plant
from quadsim.state import Array, make_state
from quadsim.vehicle import N_ROTORS, OPTIONAL_PARAMETERS, VEHICLE_UNITS, Vehicle, load_vehicle
from scenarios.build.controllers import make_controller, make_problem
from scenarios.courses.make import build_course_steps as build_course_steps
from scenarios.courses.make import build_reference as build_reference
from scenarios.build.effects import build_effects, build_wind, resolve_effects
from scenarios.build.randomness import generator
from scenarios.schema.scenario import Scenario
from scenarios.schema.optimisation import WeightedSpec

CONTROLLERS: Final = {
    "unconstrained": "the paper's Sec. 4: a constant gain from the unconstrained optimum",
    "constrained": "the paper's Sec. 5: a QP's optimum in every period, tilt, rotor speeds and their steps bounded",
    "robust": "constrained, with soft bounds, rotor lag, delay, disturbances, heading and more, each switched on alone",
    "lqr": "infinite-horizon LQR on the hover model, following the reference's velocity",
    "pid": "cascaded PID, as autopilots fly it",
    "geometric": "geometric tracking control on SE(3)",
}


def build_vehicle(scenario: Scenario) -> Vehicle:
    """The vehicle file with the scenario's overrides; a resolved scenario has every number, and needs no file."""
    file, overrides = scenario.vehicle.file, scenario.vehicle.overrides()
    try:
        path = vehicle_path(file)
    except InputError:
        if not overrides.keys() >= VEHICLE_UNITS.keys() - set(OPTIONAL_PARAMETERS):
            raise
        return Vehicle(name=Path(file).stem, **overrides)
    return load_vehicle(path, overrides)


def resolve(scenario: Scenario, vehicle: Vehicle) -> Scenario:
    """The scenario with every number that it leaves to its vehicle written out: its file alone defines the flight."""
    return resolve_vehicle(scenario, vehicle).model_copy(update={"effects": resolve_effects(scenario.effects, vehicle)})


def resolve_vehicle(scenario: Scenario, vehicle: Vehicle) -> Scenario:
    """The scenario with the numbers of its vehicle's file in it; effects go on taking theirs from the vehicle."""
    numbers: dict[str, Any] = {
        name: list(value) if isinstance(value, tuple) else value
        for name in type(scenario.vehicle).model_fields
        if name != "file" and (value := getattr(vehicle, name)) is not None
    }
    return scenario.model_copy(update={"vehicle": scenario.vehicle.model_copy(update=numbers)})


def build_plant(scenario: Scenario, vehicle: Vehicle, kind: type[Plant] = Plant) -> Plant:
    """The simulated vehicle, and what acts on it.

    Raises:
        ParameterError: a combination of effects is not possible.
    """
    return kind(
        vehicle,
        timestep=scenario.plant.timestep,
        limit_speeds=scenario.plant.limit_speeds,
        effects=build_effects(scenario, vehicle),
        wind=build_wind(scenario, vehicle),
        rng=generator(scenario.seed, "disturbance"),
    )


def build_ground(scenario: Scenario, vehicle: Vehicle) -> PhaseMonitor | None:
    """What knows where the flight stands with the ground; None where there is none."""
    ground = scenario.effects.ground
    if ground is None or not ground.contact:
        return None
    return PhaseMonitor(outline(vehicle), period=scenario.control_period)


def build_loss(scenario: Scenario) -> LossCriteria:
    """When the flight is lost."""
    return LossCriteria(**{name: limit for name, limit in scenario.lost if limit is not False})


def build_initial_state(scenario: Scenario) -> Array:
    """(12,) state at t = 0."""
    x, y, z = scenario.initial.position
    roll, pitch, yaw = np.radians(scenario.initial.euler)
    return make_state(position=(x, y, z), euler=(roll, pitch, yaw))


def build_initial_speeds(scenario: Scenario, vehicle: Vehicle) -> Array:
    """(4,) u(-1), and the rotor speeds at t = 0 [rad/s]."""
    return np.full(N_ROTORS, 0.0 if scenario.initial.cold else vehicle.hover_speed)


def build_problem(scenario: Scenario, vehicle: Vehicle) -> Problem:
    """The controller's optimisation.

    Raises:
        InputError: the controller has none.
    """
    spec = scenario.controller
    if not isinstance(spec, WeightedSpec):
        raise ParameterError("controller", "type", spec.type, "one that minimises over a horizon")
    return make_problem(spec, vehicle, scenario.control_period)


def build_controller(scenario: Scenario, vehicle: Vehicle) -> Controller:
    """The controller, set up and ready to be flown.

    Raises:
        InputError: it cannot be made from these numbers, or its code cannot be found or called.
    """
    return make_controller(scenario.controller, vehicle, scenario.control_period)


def build_limits(scenario: Scenario) -> tuple[Limit, ...]:
    """What the flight is audited against."""

    def or_infinite(value: float | None, sign: float) -> float:
        return sign * math.inf if value is None else value

    return tuple(
        Limit(
            name=spec.name,
            signal=spec.signal,
            lower=or_infinite(spec.lower, -1.0),
            upper=or_infinite(spec.upper, 1.0),
            tolerance=spec.tolerance,
            tolerance_sampled=spec.tolerance_sampled,
            required=spec.required,
            start=spec.start,
            stop=or_infinite(spec.stop, 1.0),
        )
        for spec in scenario.constraints
    )
