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
        specs = [*scenario.forces, *(refer_to(force) for force in forces)]
        changes["forces"] = [{name: part for name, part in plain(spec).items() if name != "horizon"} for spec in specs]
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
    specs = [scenario.controller, *(spec for _, spec in scenario.controller_changes)]
    samples = scenario.periods + max(spec.horizon for spec in specs) + 1
    t = scenario.control_period * np.arange(samples, dtype=np.float64)
    course = tabulated("reference.csv", t, np.array([_pose(reference, time) for time in t.tolist()]))
    return checked(Assembly(scenario.altered(reference=course, duration=scenario.duration), assembly.vehicle))


def _pose(reference: Callable[[float], Any], time: float) -> Array:
    with user_code(lambda error: InputError(f"reference: f({time:g}) cannot be used: {reason_of(error)}")):
        pose = numbers_of(answer := reference(time))
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
    law = None
    acting = None
    flown = named(scenario, controller, forces)
    if controller is not None and not isinstance(controller, str):
        spec = refer_to(controller, scenario.controller.horizon)
        own = make_law(controller, spec, assembly.vehicle, scenario.control_period)
        law = assembly.with_autopilot(Pilot(own, assembly.vehicle))
    if forces:
        rng = assembly.generator("forces")
        pairs = [(import_plugin(spec), spec) for spec in scenario.forces]
        pairs += zip(forces, flown.forces[len(pairs) :], strict=True)
        acting = [make_force(force, spec, assembly.actual, rng) for force, spec in pairs]
    return assembly.of(flown), law, acting
