"""From `[vehicle]` and `[initial]` to the modelled vehicle and its initial state."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from quadsim.assets import vehicle_path
from quadsim.errors import InputError
from quadsim.motion import Motion
from quadsim.sim.physics import physics_to_state
from quadsim.state import Array, make_state
from quadsim.vehicle import N_ROTORS, OPTIONAL_PARAMETERS, VEHICLE_UNITS, Vehicle, load_vehicle

if TYPE_CHECKING:
    from scenarios.schema.scenario import Scenario


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
