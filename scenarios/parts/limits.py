"""From `[[constraints]]` and `[lost]` to what a flight is audited against, and what ends it."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from quadsim.flight.audit import Limit
from quadsim.flight.lost import LossCriteria

if TYPE_CHECKING:
    from scenarios.schema.scenario import Scenario


def build_loss(scenario: Scenario) -> LossCriteria:
    """When the flight is lost."""
    return LossCriteria(**{name: limit for name, limit in scenario.lost if limit is not False})


def build_limits(scenario: Scenario) -> tuple[Limit, ...]:
    """What the flight is audited against."""

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
    )
