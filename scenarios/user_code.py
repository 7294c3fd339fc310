"""Controllers and forces that a caller passes in, and the scenario that names them by the place of their code."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from quadsim.controller import Controller
from quadsim.sim.effects import Force
from scenarios.assembly import Assembly
from scenarios.plugin import import_plugin, make_force, make_law, refer_to, require_importable
from scenarios.schema.scenario import Scenario
from scenarios.schema.writing import plain


def named(scenario: Scenario, controller: object, forces: Sequence[object] = ()) -> Scenario:
    """A scenario whose file names the controller and the forces that were passed in."""
    changes: dict[str, Any] = {}
    horizon = scenario.controller.horizon
    if isinstance(controller, str):
        changes["controller"] = {"type": controller, "horizon": horizon}
    elif controller is not None:
        changes["controller"] = plain(refer_to(controller, horizon))
    if forces:
        specs = [*scenario.forces, *(refer_to(force) for force in forces)]
        changes["forces"] = [{name: part for name, part in plain(spec).items() if name != "horizon"} for spec in specs]
    return scenario.replace(changes) if changes else scenario


def importable(scenario: Scenario, controller: object, forces: Sequence[object] = ()) -> Scenario:
    """The same, of code that other processes import by its place.

    Raises:
        ParameterError: they cannot.
    """
    if controller is not None and not isinstance(controller, str):
        require_importable(controller)
    for force in forces:
        require_importable(force, "forces")
    return named(scenario, controller, forces)


def set_up(
    assembly: Assembly, controller: object, forces: Sequence[object]
) -> tuple[Assembly, Controller | None, list[Force] | None]:
    """The same, and the controller and the forces as the closed loop takes them.

    Raises:
        InputError: the controller or a force cannot be set up.
    """
    scenario, law, acting = assembly.scenario, None, None
    flown = named(scenario, controller, forces)
    if controller is not None and not isinstance(controller, str):
        spec = refer_to(controller, scenario.controller.horizon)
        law = make_law(controller, spec, assembly.vehicle, scenario.control_period)
    if forces:
        rng = assembly.generator("forces")
        pairs = [(import_plugin(spec), spec) for spec in scenario.forces]
        pairs += zip(forces, flown.forces[len(pairs) :], strict=True)
        acting = [make_force(force, spec, assembly.actual, rng) for force, spec in pairs]
    return assembly.of(flown), law, acting
