"""From `[[constraints]]` and `[lost]` to what a flight is audited against, and what ends it."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from quadsim.flight.audit import SUM, Limit
from quadsim.flight.lost import LossCriteria
from scenarios.schema.optimisation import BoundedSpec, PolytopeSpec

if TYPE_CHECKING:
    from scenarios.schema.scenario import Scenario


def build_loss(scenario: Scenario) -> LossCriteria:
    """When the flight is lost."""
    return LossCriteria(**{name: limit for name, limit in scenario.lost if limit is not False})


def build_limits(scenario: Scenario) -> tuple[Limit, ...]:
    """What the flight is audited against: its constraints, and the controller's polytopes."""

    def or_infinite(value: float | None, sign: float) -> float:
        return sign * math.inf if value is None else value

    return tuple(
        Limit(
            name=spec.name,
            signal=spec.signal,
            lower=or_infinite(spec.lower, -1.0),
            upper=or_infinite(spec.upper, 1.0),
            tolerance=spec.tolerance,
            tolerance_sampled=spec.tolerance_sampled,
            required=spec.required,
            start=spec.start,
            stop=or_infinite(spec.stop, 1.0),
        )
        for spec in scenario.constraints
    ) + tuple(
        Limit(
            name=name,
            signal=SUM,
            terms=tuple((of, factor) for of, factor in zip(polytope.of, row, strict=True) if factor),
            lower=or_infinite(None if polytope.lower is None else polytope.lower[i], -1.0),
            upper=or_infinite(None if polytope.upper is None else polytope.upper[i], 1.0),
            tolerance=polytope.tolerance,
            tolerance_sampled=polytope.tolerance_sampled,
            required=polytope.required,
        )
        for polytope in _polytopes(scenario)
        for i, (name, row) in enumerate(zip(polytope.row_names, polytope.rows, strict=True))
    )


def _polytopes(scenario: Scenario) -> list[PolytopeSpec]:
    controller = scenario.controller
    return controller.polytopes if isinstance(controller, BoundedSpec) else []
