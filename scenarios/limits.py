"""From `[[constraints]]` and the polytopes of a controller to what a flight is audited against."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from quadsim.flight.audit import Limit, SpaceLimit, SumLimit
from scenarios.courses.windows import timed_regions
from scenarios.parts.vehicle import build_actual, build_vehicle
from scenarios.schema.nonlinear import NonlinearPartsSpec
from scenarios.schema.optimisation import BoundedSpec, PolytopeSpec

if TYPE_CHECKING:
    from scenarios.schema.scenario import Scenario


def build_limits(scenario: Scenario) -> tuple[Limit, ...]:
    """What the flight is audited against: its constraints, obstacles and regions, and the controller's polytopes."""
    return (*scenario.constraints, *_sum_limits(scenario), *space_limits(scenario))


def space_limits(scenario: Scenario) -> tuple[SpaceLimit, ...]:
    """The obstacles to keep clear of, then the regions to stay in."""
    regions = timed_regions(scenario)
    if not scenario.obstacles and not regions:
        return ()
    radius = build_actual(scenario, build_vehicle(scenario)).enclosing_radius
    return (
        *(SpaceLimit(name=obstacle.name, shape=obstacle, radius=radius) for obstacle in scenario.obstacles),
        *(
            SpaceLimit(
                name=region.name,
                shape=region,
                radius=radius,
                tolerance=region.tolerance,
                tolerance_sampled=region.tolerance,
                required=region.required,
                start=region.start,
                stop=region.stop,
            )
            for region in regions
        ),
    )


def _sum_limits(scenario: Scenario) -> tuple[Limit, ...]:
    return tuple(
        SumLimit(
            name=name,
            terms=tuple((of, factor) for of, factor in zip(polytope.of, row, strict=True) if factor),
            lower=-math.inf if polytope.lower is None else polytope.lower[i],
            upper=math.inf if polytope.upper is None else polytope.upper[i],
            tolerance=polytope.tolerance,
            tolerance_sampled=polytope.tolerance_sampled,
            required=polytope.required,
        )
        for polytope in _polytopes(scenario)
        for i, (name, row) in enumerate(zip(polytope.row_names, polytope.rows, strict=True))
    )


def _polytopes(scenario: Scenario) -> list[PolytopeSpec]:
    controller = scenario.controller
    return controller.polytopes if isinstance(controller, BoundedSpec | NonlinearPartsSpec) else []
