"""Scenarios that differ from a constrained one in one thing, and what two must share to be compared."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

from scenarios.parts.vehicle import build_vehicle
from scenarios.schema.controller import ConstrainedSpec, UnconstrainedSpec
from scenarios.schema.scenario import Scenario

_NOT_THE_COURSE: Final = {
    "name",
    "description",
    "group",
    "expect",
    "log_rate",
    "vehicle",
    "controller",
    "lost",
    "constraints",
}
"""Fields in which flights that are compared by their controllers may differ; vehicles are compared by their numbers."""


def with_controller(scenario: Scenario, **changes: Any) -> Scenario:
    """The scenario with other fields of its controller."""
    return scenario.model_copy(update={"controller": scenario.controller.model_copy(update=changes)})


def with_tilt(scenario: Scenario, tilt: float) -> Scenario:
    """The constrained scenario with other bounds on roll and pitch [deg]."""
    assert isinstance(scenario.controller, ConstrainedSpec)
    bounds = {**scenario.controller.output_bounds, "roll": [-tilt, tilt], "pitch": [-tilt, tilt]}
    return with_controller(scenario, output_bounds=bounds)


def with_vehicles(
    scenario: Scenario, arm_lengths: Sequence[float], drags: Sequence[float]
) -> dict[tuple[float, float], Scenario]:
    """The scenario with each pair of an arm length L [m] and a drag-to-thrust ratio d/b [m]."""

    def varied(arm: float, drag: float) -> Scenario:
        vehicle = scenario.vehicle.model_copy(update={"arm_length": arm, "drag_to_thrust": drag})
        return scenario.model_copy(update={"vehicle": vehicle})

    return {(arm, drag): varied(arm, drag) for arm in arm_lengths for drag in drags}


def without_constraints(scenario: Scenario) -> Scenario:
    """The counterpart: same weights and horizon, flown by the unconstrained controller."""
    spec = scenario.controller
    assert isinstance(spec, ConstrainedSpec)
    free = UnconstrainedSpec(
        type="unconstrained", horizon=spec.horizon, output_weights=spec.output_weights, input_weights=spec.input_weights
    )
    return scenario.model_copy(update={"controller": free})


def course(scenario: Scenario) -> tuple[Any, ...]:
    """What two flights must share to be compared by their controllers."""
    shared = [name for name in type(scenario).model_fields if name not in _NOT_THE_COURSE]
    return (*(getattr(scenario, name) for name in shared), build_vehicle(scenario))


def named(scenarios: Sequence[Scenario]) -> dict[str, Scenario]:
    """Scenarios by name, those that share one numbered."""
    numbered: dict[str, Scenario] = {}
    for each in scenarios:
        shared = sum(each.name == other.name for other in numbered.values())
        numbered[f"{each.name} ({shared + 1})" if shared else each.name] = each
    return numbered


def is_counterpart(scenario: Scenario, constrained: Scenario) -> bool:
    """Whether an unconstrained flight of the course is the constrained one, but for its constraints."""
    free = without_constraints(constrained)
    return all(getattr(scenario, name) == getattr(free, name) for name in ("controller", "vehicle", "plant"))
