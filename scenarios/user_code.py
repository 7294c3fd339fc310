"""Controllers and forces that a caller passes in, and the scenario that names them by the place of their code."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from quadsim.controller import Controller
from quadsim.sim.effects import Force
from scenarios.loading import check_parts
from scenarios.parts.randomness import generator
from scenarios.parts.vehicle import build_actual, build_vehicle
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
    scenario: Scenario, controller: object, forces: Sequence[object]
) -> tuple[Scenario, Controller | None, list[Force] | None]:
    """The same, checked, and the controller and the forces as the closed loop takes them.

    Raises:
        InputError: the scenario cannot be flown, or the controller cannot be set up.
    """
    flown, law, own = named(scenario, controller, forces), None, None
    if controller is not None and not isinstance(controller, str):
        spec = refer_to(controller, scenario.controller.horizon)
        law = make_law(controller, spec, build_vehicle(scenario), scenario.control_period)
    if forces:
        vehicle = build_actual(scenario, build_vehicle(scenario))
        rng = generator(scenario.seed, "forces")
        pairs = [(import_plugin(spec), spec) for spec in scenario.forces]
        pairs += zip(forces, flown.forces[len(pairs) :], strict=True)
        own = [make_force(force, spec, vehicle, rng) for force, spec in pairs]
    check_parts(flown)
    return flown, law, own
