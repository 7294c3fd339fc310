"""From a scenario file to the things that fly: vehicle, plant, reference, controller, limits."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from mpc.constrained import ConstrainedMPC
from mpc.model import hover_model
from mpc.problem import Bounds, Objective, Problem
from mpc.solvers import QPSolver
from mpc.unconstrained import UnconstrainedMPC
from quadsim.airframe import outline
from quadsim.assets import vehicle_path
from quadsim.audit import Limit
from quadsim.controller import Controller
from quadsim.errors import InputError
from quadsim.phase import PhaseMonitor
from quadsim.plant import Plant
from quadsim.state import INDEX, N_STATES, STATE_NAMES, Array, make_state
from quadsim.vehicle import N_ROTORS, OPTIONAL_PARAMETERS, VEHICLE_UNITS, Vehicle, load_vehicle
from scenarios.courses import build_course_steps as build_course_steps
from scenarios.courses import build_reference as build_reference
from scenarios.effects import build_effects, build_wind, resolve_effects
from scenarios.randomness import generator
from scenarios.spec import ANGLES, ConstrainedSpec, Scenario

CONTROLLERS: Final = {
    "unconstrained": "the paper's Sec. 4: a constant gain from the unconstrained optimum",
    "constrained": "the paper's Sec. 5: at most one QP per period, tilt, rotor speeds and their steps bounded",
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
    numbers: dict[str, Any] = {
        name: list(value) if isinstance(value, tuple) else value
        for name in type(scenario.vehicle).model_fields
        if name != "file" and (value := getattr(vehicle, name)) is not None
    }
    return scenario.model_copy(
        update={
            "vehicle": scenario.vehicle.model_copy(update=numbers),
            "effects": resolve_effects(scenario.effects, vehicle),
        }
    )


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


def build_initial_state(scenario: Scenario) -> Array:
    """(12,) state at t = 0."""
    x, y, z = scenario.initial.position
    roll, pitch, yaw = np.radians(scenario.initial.euler)
    return make_state(position=(x, y, z), euler=(roll, pitch, yaw))


def build_initial_speeds(scenario: Scenario, vehicle: Vehicle) -> Array:
    """(4,) u(-1), and the rotor speeds at t = 0 [rad/s]."""
    return np.full(N_ROTORS, 0.0 if scenario.initial.cold else vehicle.hover_speed)


def build_problem(scenario: Scenario, vehicle: Vehicle) -> Problem:
    """The controller's optimisation."""
    spec = scenario.controller
    regulated = [name for name in STATE_NAMES if name in spec.output_weights]
    objective = Objective(
        C_r=_selection(regulated),
        Q_y=np.diag([spec.output_weights[name] for name in regulated]),
        Q_u=np.diag(np.broadcast_to(np.asarray(spec.input_weights.speed, float), N_ROTORS)),
    )
    bounds = _build_bounds(spec) if isinstance(spec, ConstrainedSpec) else None
    model = hover_model(vehicle, scenario.control_period)
    return Problem(model=model, horizon=spec.horizon, objective=objective, bounds=bounds)


def build_controller(scenario: Scenario, vehicle: Vehicle) -> Controller:
    """The controller, set up and ready to be flown.

    Raises:
        InputError: no gain can be computed from these numbers.
    """
    problem = build_problem(scenario, vehicle)
    if isinstance(scenario.controller, ConstrainedSpec):
        solver = QPSolver(scenario.controller.solver, problem)
        return ConstrainedMPC(problem, solver, shortcut=scenario.controller.shortcut)
    try:
        return UnconstrainedMPC(problem)
    except np.linalg.LinAlgError as error:
        raise InputError(
            "the controller's gain cannot be computed: its weights and the vehicle's numbers are too many orders of "
            f"magnitude apart ({error})"
        ) from error


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


def _selection(names: Sequence[str]) -> Array:
    """Rows of the identity that pick states by name."""
    return np.eye(N_STATES)[[INDEX[name] for name in names]]


def _build_bounds(spec: ConstrainedSpec) -> Bounds:
    constrained = [name for name in STATE_NAMES if name in spec.output_bounds]
    scale = np.array([math.radians(1.0) if name in ANGLES else 1.0 for name in constrained])
    pairs = np.array([spec.output_bounds[name] for name in constrained], float).reshape(-1, 2)
    lower_speed, upper_speed = spec.input_bounds.speed
    lower_slew, upper_slew = spec.input_bounds.slew
    return Bounds(
        C_c=_selection(constrained),
        y_min=scale * pairs[:, 0],
        y_max=scale * pairs[:, 1],
        delta_min=np.full(N_ROTORS, lower_slew),
        delta_max=np.full(N_ROTORS, upper_slew),
        u_min=np.full(N_ROTORS, lower_speed),
        u_max=np.full(N_ROTORS, upper_speed),
    )
