"""From `[vehicle]` and `[initial]` to the modelled vehicle and its initial state."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from quadsim.assets import vehicle_path
from quadsim.errors import InputError, ParameterError
from quadsim.motion import Motion
from quadsim.sim.effects import Effects
from quadsim.sim.effects.rotors import RotorDynamics
from quadsim.sim.effects.wind import Air
from quadsim.sim.physics import physics_to_state
from quadsim.state import Array, make_state
from quadsim.vehicle import N_ROTORS, OPTIONAL_PARAMETERS, VEHICLE_UNITS, Vehicle, load_vehicle

if TYPE_CHECKING:
    from scenarios.schema.scenario import Scenario

_SIZES: Final = {
    "rotor_rise": ("rotors", "rise", RotorDynamics),
    "rotor_fall": ("rotors", "fall", RotorDynamics),
    "rotor_inertia": ("rotors", "inertia", RotorDynamics),
    "rotor_drag": ("air", "rotor_drag", Air),
    "body_drag": ("air", "body_drag", Air),
    "rotor_radius": ("ground", "rotor_radius", None),
}
"""Parameters of vehicles that act in an effect: its table, the field that states it too, and what switches it on."""


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


def resolve_vehicle(scenario: Scenario, vehicle: Vehicle) -> Scenario:
    """The scenario with the numbers of its vehicle's file in it; effects go on taking theirs from the vehicle."""
    numbers = {name: getattr(vehicle, name) for name in VEHICLE_UNITS}
    return scenario.model_copy(update={"vehicle": scenario.vehicle.model_copy(update=numbers)})


def build_actual(scenario: Scenario, vehicle: Vehicle) -> Vehicle:
    """The vehicle as it really is: the modelled one, with `[actual]` in its place.

    Plant, forces, drawings and audit have it; controller, estimator and reference have the modelled one.

    Raises:
        ParameterError: there can be no such vehicle.
    """
    try:
        return replace(vehicle, **_actual(scenario))
    except ParameterError as error:
        raise ParameterError("actual", error.name, error.value, error.rule) from error


def actual_effects(scenario: Scenario, vehicle: Vehicle) -> Effects:
    """What acts on the plant: `[effects]`, with every size that it leaves to the vehicle as it really is.

    Lag, rotor inertia and drag that `[actual]` states act, whether or not `[effects]` has their table.

    Raises:
        ParameterError: `[effects]` states another size than `[actual]`, or lacks one, or a combination is not possible.
    """
    effects = scenario.effects
    acting: dict[str, Any] = {}
    for name, size in _actual(scenario).items():
        table, field, kind = _SIZES.get(name, ("", "", None))
        settings = getattr(effects, table, None) or (kind and kind())
        if settings is None:
            continue
        stated = getattr(settings, field)
        if stated not in (None, size):
            raise ParameterError("actual", name, size, f"absent where effects.{table}.{field} = {stated} states it")
        acting[table] = settings
    return replace(effects, **acting).resolved(build_actual(scenario, vehicle))


def saturates(scenario: Scenario) -> bool:
    """Whether rotors saturate at the actual vehicle's speeds: `[plant]` says so, or `[actual]` gives one of them."""
    return scenario.plant.limit_speeds or not {"speed_min", "speed_max"}.isdisjoint(_actual(scenario))


def _actual(scenario: Scenario) -> dict[str, Any]:
    """The parameters of vehicles that `[actual]` states."""
    return {} if scenario.actual is None else scenario.actual.overrides()


def build_initial_state(scenario: Scenario, motion: Motion | None = None) -> Array:
    """(12,) state at t = 0, of the reference motion where the scenario starts on it."""
    if scenario.initial.on_reference and motion is not None:
        physics = np.array([0.0, *motion.position[0], *motion.attitude[0], *motion.velocity[0], *motion.body_rates[0]])
        return physics_to_state(physics[None], yaw=math.radians(scenario.initial.euler[2]))[0]
    x, y, z = scenario.initial.position
    roll, pitch, yaw = np.radians(scenario.initial.euler)
    return make_state(position=(x, y, z), euler=(roll, pitch, yaw))


def build_initial_speeds(scenario: Scenario, vehicle: Vehicle) -> Array:
    """(4,) u(-1), and the rotor speeds at t = 0 [rad/s]."""
    return np.full(N_ROTORS, 0.0 if scenario.initial.cold else vehicle.hover_speed)
