"""What a scenario's tables alone do not show: whether it can be flown with its vehicle, on its floor, on its course."""

from __future__ import annotations

from quadsim.airframe import outline
from quadsim.effects.load import mass_properties
from quadsim.errors import ParameterError
from quadsim.phase import AIRBORNE, TOUCH, clearance
from quadsim.vehicle import Vehicle
from scenarios.build import build_initial_state, build_vehicle
from scenarios.courses.build import build_course
from scenarios.effects import build_effects, moving_air
from scenarios.spec import Scenario


def check_parts(scenario: Scenario) -> None:
    """Refuse, before anything is flown, parts that do not go together.

    Raises:
        InputError: there is no such vehicle, it cannot hover, an effect is not possible with it, the course cannot be
            built, or the flight starts below the floor, or in the air with rotors at rest.
    """
    vehicle = build_vehicle(scenario)
    load = build_effects(scenario, vehicle).load
    mass_properties(vehicle, load, load.payloads)
    moving_air(scenario, vehicle)
    build_course(scenario)
    ground = scenario.effects.ground
    if ground is not None and (ground.contact or ground.effect):
        _check_start(scenario, vehicle)


def _check_start(scenario: Scenario, vehicle: Vehicle) -> None:
    """Refuse a start below the floor, or one in the air with rotors at rest."""
    shape, state, position = outline(vehicle), build_initial_state(scenario)[None, :], scenario.initial.position
    feet = float(clearance(state, shape.feet, shape.foot_radius, shape.floor)[0])
    hull = float(clearance(state, shape.hull, 0.0, shape.floor)[0])
    lowest = min(feet, hull)
    if lowest < -TOUCH:
        roll, pitch, _ = scenario.initial.euler
        rule = f"{-lowest:.3g} m higher, at roll {roll:g} and pitch {pitch:g} deg, for feet and hull to clear the floor"
        raise ParameterError("initial", "position", position, rule)
    if scenario.initial.cold and feet > AIRBORNE:
        rule = f"on the floor where initial.cold is true, or it would fall: its feet are {feet:.3g} m above it"
        raise ParameterError("initial", "position", position, rule)
