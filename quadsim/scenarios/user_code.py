"""Controllers, forces and references passed in by a caller, and the scenario file that represents them.

The file names controllers and forces by the import path of their code; a reference becomes a table.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from quadsim.border import numbers_of, user_code
from quadsim.controller import AutopilotLoop, Controller
from quadsim.errors import InputError, ParameterError
from quadsim.mpc.pilot.pilot import Pilot
from quadsim.scenarios.assembly import Assembly
from quadsim.scenarios.courses.csv_course import LARGEST_NUMBER, tabulated
from quadsim.scenarios.plugin import import_plugin, make_force, make_law, reason_of, refer_to, require_importable
from quadsim.scenarios.preflight import checked
from quadsim.scenarios.schema.scenario import Scenario
from quadsim.scenarios.schema.writing import plain
from quadsim.sim.effects import Force
from quadsim.state import Array


def named(scenario: Scenario, controller: object, forces: Sequence[object] = ()) -> Scenario:
    """Return a scenario whose file names the given controller and forces."""
    changes: dict[str, Any] = {}
    horizon = scenario.controller.horizon
    if isinstance(controller, str):
        changes["controller"] = {"type": controller, "horizon": horizon}
    elif controller is not None:
        changes["controller"] = plain(refer_to(controller, horizon))
    if forces:
        tables = []
        for spec in (*scenario.forces, *map(refer_to, forces)):
            table = plain(spec)
            table.pop("horizon", None)  # which a controller has
            tables.append(table)
        changes["forces"] = tables
    if changes:
        return scenario.replace(changes)
    return scenario


def importable(scenario: Scenario, controller: object, forces: Sequence[object] = ()) -> Scenario:
    """Return the scenario of `named` for code that other processes can import.

    Raises:
        ParameterError: the code cannot be imported.
    """
    if controller is not None and not isinstance(controller, str):
        require_importable(controller)
    for force in forces:
        require_importable(force, "forces")
    return named(scenario, controller, forces)


def following(assembly: Assembly, reference: object) -> Assembly:
    """Return the assembly with a function of time [s] as course, sampled at t_0 .. t_{K+N}, without a filter.

    Raises:
        InputError: the function raises, or does not return x, y, z [m], yaw [rad].
    """
    scenario = assembly.scenario
    if not callable(reference):
        raise ParameterError("", "reference", reference, "a function f(t) that returns x, y, z [m], yaw [rad]")
    longest_horizon = scenario.controller.horizon
    for _, spec in scenario.controller_changes:
        longest_horizon = max(longest_horizon, spec.horizon)
    samples = scenario.periods + longest_horizon + 1
    t = scenario.control_period * np.arange(samples, dtype=np.float64)
    poses = np.array([_pose(reference, time) for time in t.tolist()])
    course = tabulated("reference.csv", t, poses)
    return checked(Assembly(scenario.altered(reference=course, duration=scenario.duration), assembly.vehicle))


def _pose(reference: Callable[[float], Any], time: float) -> Array:
    """Return (4,) what the function gives for a time [s]: x, y, z [m], yaw [rad]."""
    with user_code(lambda error: InputError(f"reference: f({time:g}) cannot be used: {reason_of(error)}")):
        answer = reference(time)
        pose = numbers_of(answer)
    if pose.shape != (4,) or not (np.abs(pose) <= LARGEST_NUMBER).all():
        rule = f"four numbers within +-{LARGEST_NUMBER:g}: x, y, z [m], yaw [rad]"
        raise InputError(f"reference: f({time:g}) must be {rule}; got {answer!r:.200}")
    return pose


def set_up(
    assembly: Assembly,
    controller: object,
    forces: Sequence[object],
    reference: object = None,
    autopilot: AutopilotLoop | None = None,
) -> tuple[Assembly, Controller | None, list[Force] | None]:
    """Return the assembly with the reference and the autopilot, and the controller and forces for the closed loop.

    Raises:
        InputError: the controller, a force or the reference cannot be set up.
    """
    if reference is not None:
        assembly = following(assembly, reference)
    assembly.user_autopilot = autopilot
    scenario = assembly.scenario
    pilot = None
    acting = None
    flown = named(scenario, controller, forces)
    if controller is not None and not isinstance(controller, str):
        spec = refer_to(controller, scenario.controller.horizon)
        user_controller = make_law(controller, spec, assembly.vehicle, scenario.control_period)
        pilot = assembly.with_autopilot(Pilot(user_controller, assembly.vehicle))
    if forces:
        codes = [*map(import_plugin, scenario.forces), *forces]
        rng = assembly.generator("forces")
        acting = []
        for code, force_spec in zip(codes, flown.forces, strict=True):
            acting.append(make_force(code, force_spec, assembly.actual, rng))
    return assembly.of(flown), pilot, acting
