"""What is rejected before a flight: parts that do not fit together, and starts from which nothing can fly.

`checked` builds vehicle, effects and course of an assembly without flying, so that a wrong combination of valid fields
is an `InputError` before the first period.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from quadsim.errors import ParameterError
from quadsim.flight.phase import AIRBORNE, TOUCH, clearance, touching_speed
from quadsim.sim.airframe import outline
from quadsim.sim.effects.load import Load, mass_properties
from quadsim.sim.plant import check_free
from quadsim.space import Region
from quadsim.state import POSITION

if TYPE_CHECKING:
    from quadsim.scenarios.assembly import Assembly

_ROUNDING_SPEED: Final = 1e-9  # vertical speed attributed to rounding [m/s]


def checked(assembly: Assembly) -> Assembly:
    """Return the assembly, or reject, before the flight, parts that do not fit together.

    Raises:
        InputError: the vehicle does not exist or cannot hover, an effect is impossible with it or with the
            integrator, the course cannot be built or lacks the motion on which the flight starts, or the flight
            starts below the floor, into it, in the air with `cold` rotors, or with rotors beyond their range.
    """
    _check_effects(assembly)
    _check_course(assembly)
    _check_rotor_speeds(assembly)
    ground = assembly.scenario.effects.ground
    if ground is not None and (ground.contact or ground.effect):
        _check_start_above_floor(assembly)
    if ground is not None and ground.contact:
        _check_start_into_floor(assembly)
    _check_space(assembly)
    return assembly


def _check_effects(assembly: Assembly) -> None:
    """Reject a vehicle that cannot hover, and effects that are impossible with it or with the integrator."""
    scenario = assembly.scenario
    load = assembly.effects.load or Load()
    mass_properties(assembly.actual, load, load.payloads)  # refuses what is no rigid body
    _ = assembly.moving_air  # refuses wind that has nothing to push
    changes = assembly.changes()
    if scenario.plant.integrator == "rk4":
        check_free(assembly.effects, changes, scenario.obstacles)


def _check_course(assembly: Assembly) -> None:
    """Reject a course that cannot be built, or without the motion on which the flight starts."""
    scenario = assembly.scenario
    course = assembly.course
    if scenario.initial.on_reference and course.derivatives is None:
        rule = f"false where the course states positions alone, as one of type {scenario.reference.type} does"
        raise ParameterError("initial", "on_reference", True, rule)


def _check_rotor_speeds(assembly: Assembly) -> None:
    """Reject a start with rotors beyond their range."""
    speeds = assembly.initial_speeds
    fastest = assembly.actual.speed_max
    if assembly.scenario.initial.rotor_speeds is not None and speeds.max() > fastest:
        rule = f"at most {fastest:g} rad/s each, the speed_max of {assembly.actual.name}"
        raise ParameterError("initial", "rotor_speeds", speeds.tolist(), rule)


def _check_start_above_floor(assembly: Assembly) -> None:
    """Reject a start below the floor, or one in the air with rotors at rest."""
    initial = assembly.scenario.initial
    position = list(initial.position)
    shape = outline(assembly.actual)
    state = assembly.initial_state()[None, :]
    feet = float(clearance(state, shape.feet, shape.foot_radius, shape.floor)[0])
    hull = float(clearance(state, shape.hull, 0.0, shape.floor)[0])
    lowest = min(feet, hull)
    if lowest < -TOUCH:
        tilt = f"roll {initial.euler[0]:g} and pitch {initial.euler[1]:g} deg"
        rule = f"{-lowest:.3g} m higher, at {tilt}, for feet and hull to clear the floor"
        raise ParameterError("initial", "position", position, rule)
    if initial.cold and feet > AIRBORNE:
        rule = f"on the floor where initial.cold is true, or it would fall: its feet are {feet:.3g} m above it"
        raise ParameterError("initial", "position", position, rule)


def _check_start_into_floor(assembly: Assembly) -> None:
    """Reject a start on the floor at which a part moves into it."""
    initial = assembly.scenario.initial
    shape = outline(assembly.actual)
    state = assembly.initial_state()[None, :]
    sinking = -touching_speed(state, np.radians(initial.body_rates), shape)
    if sinking > _ROUNDING_SPEED:
        if initial.velocity[2] < 0.0:
            name = "velocity"
        else:
            name = "body_rates"
        rule = f"such that no part on the floor moves into it: one does, at {sinking:.3g} m/s"
        raise ParameterError("initial", name, list(getattr(initial, name)), rule)


def _check_space(assembly: Assembly) -> None:
    """Reject a start in an obstacle, or outside a region that holds from the start."""
    limits = assembly.space_limits
    if not limits:
        return
    t = np.zeros(1)
    start = assembly.initial_state(assembly.motion)[None, list(POSITION)]
    for limit in limits:
        if limit.start > 0.0:
            continue
        clear = float(limit.shape.clearance(t, start)[0]) - limit.radius
        if limit.violated(clear):
            side = "clear of"
            if isinstance(limit.shape, Region):
                side = "inside"
            ball = f"the radius of {limit.radius:.3g} m of the ball that represents the vehicle"
            raise ParameterError("initial", "position", start[0].tolist(), f"{side} {limit.name}, by {ball}")
