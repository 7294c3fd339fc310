"""The limits of the audit: the bounds of the controller, and `[[constraints]]`, obstacles and regions.

The controller's bounds are audited automatically.  An entry of `[[constraints]]` without bounds takes the controller's,
with its own tolerance or window.  One with bounds replaces the controller's on the same signal if it applies throughout
the flight; `audit_notes` reports differences.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

from quadsim.controller import Controller
from quadsim.flight.audit import SUM, UNAUDITED_ADVICE, Limit, SpaceLimit
from quadsim.mpc.pilot.pilot import Pilot
from quadsim.mpc.tables.controller import Range
from quadsim.report.table import format_number
from quadsim.scenarios.law_bounds import law_limits
from quadsim.scenarios.plugin import PluginController
from quadsim.space import AnyObstacle, Corridor, Fence
from quadsim.vehicle import Vehicle

if TYPE_CHECKING:
    from quadsim.scenarios.schema.scenario import Scenario


def signal_limits(scenario: Scenario, bounds: Mapping[str, Range]) -> list[Limit]:
    """Return the constraints of a scenario on single signals, then its controller's `bounds` without a constraint."""
    return [*_stated(scenario, bounds), *_unnamed(scenario, bounds)]


def with_law_bounds(scenario: Scenario, controller: Controller) -> Scenario:
    """Return the scenario with the bounds of a user's controller as constraints; see `law_limits`."""
    if isinstance(controller, Pilot):
        adapted = controller.law
    else:
        adapted = controller
    if not isinstance(adapted, PluginController):
        return scenario
    named = _named(scenario)
    limits = []
    for limit in law_limits(adapted.law, scenario.audited_names):
        if limit.signal == SUM or limit.signal not in named:
            limits.append(limit)
    if limits:
        return scenario.altered(constraints=[*scenario.constraints, *limits])
    return scenario


def audit_notes(scenario: Scenario, vehicle: Vehicle, bounds: Mapping[str, Range], *, audited: bool) -> list[str]:
    """Return notes on the audit: bounds without a constraint, and constraints that differ from the controller's.

    Args:
        scenario: the scenario.
        vehicle: the modelled vehicle.
        bounds: the controller's, see `Assembly.bounds`.
        audited: whether anything is audited at all.
    """
    unnamed = [limit.name for limit in _unnamed(scenario, bounds)]
    absent = []
    for entry in scenario.constraints:
        if not (entry.has_bounds or entry.signal in bounds):
            absent.append(entry.name)
    notes = []
    if unnamed:
        notes.append(f"{', '.join(unnamed)}: audited as the controller bounds {'it' if len(unnamed) == 1 else 'them'}")
    if not audited:
        notes.append(UNAUDITED_ADVICE)
    if absent:
        notes.append(f"{', '.join(absent)}: not audited, the controller has no such bound and the entry states none")
    specs = [(0.0, scenario.controller), *scenario.controller_changes]
    changes = [(at, spec.audited(vehicle)) for at, spec in specs]
    for limit in signal_limits(scenario, bounds):
        for (at, now), (_, before) in zip(changes, [(0.0, {}), *changes], strict=False):
            pair = now.get(limit.signal)
            if pair is not None and pair not in (before.get(limit.signal), (limit.lower, limit.upper)):
                since = f" from {at:g} s" if at else ""
                notes.append(
                    f"{limit.name}: audited against {_range(limit.lower, limit.upper)} {limit.unit}, the controller "
                    f"bounds {_range(*pair)} {limit.unit}{since}"
                )
    return notes


def flyable(bounds: Mapping[str, Range], vehicle: Vehicle) -> dict[str, Range]:
    """Return a controller's bounds, those on speeds within the range that the actual vehicle's rotors have."""
    if "speed" in bounds:
        lower = max(bounds["speed"][0], vehicle.speed_min)
        upper = min(bounds["speed"][1], vehicle.speed_max)
        bounds = {**bounds, "speed": (lower, upper) if lower < upper else (vehicle.speed_min, vehicle.speed_max)}
    return dict(bounds)


def _stated(scenario: Scenario, bounds: Mapping[str, Range]) -> list[Limit]:
    """Return the entries of `[[constraints]]` with their bounds; those without any available are dropped."""
    return [
        entry if entry.has_bounds else replace(entry, lower=bounds[entry.signal][0], upper=bounds[entry.signal][1])
        for entry in scenario.constraints
        if entry.has_bounds or entry.signal in bounds
    ]


def _unnamed(scenario: Scenario, bounds: Mapping[str, Range]) -> Iterator[Limit]:
    """Yield a limit for each controller bound without an entry."""
    named = _named(scenario)
    for signal, (lower, upper) in bounds.items():
        if signal in named:
            continue
        if signal in scenario.audited_names:
            name = f"controller.{signal}"
        else:
            name = signal
        yield Limit(name=name, signal=signal, lower=lower, upper=upper)


def _named(scenario: Scenario) -> set[str]:
    """Return the signals whose entry replaces the controller's bounds."""
    return {
        entry.signal
        for entry in scenario.constraints
        if not entry.has_bounds or (entry.start <= 0.0 and math.isinf(entry.stop))
    }


def _range(lower: float, upper: float) -> str:
    if math.isinf(lower) or math.isinf(upper):
        if math.isinf(upper):
            return f"at least {format_number(lower)}"
        return f"at most {format_number(upper)}"
    if lower == -upper:
        return f"±{format_number(upper)}"
    return f"{format_number(lower)} .. {format_number(upper)}"


def space_limits(
    obstacles: Iterable[AnyObstacle], regions: Iterable[Corridor | Fence], radius: float
) -> tuple[SpaceLimit, ...]:
    """Return the obstacles, then the regions, as limits of a vehicle within a ball of a radius [m]."""
    return (
        *(SpaceLimit(name=obstacle.name, shape=obstacle, radius=radius) for obstacle in obstacles),
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


def sum_limits(scenario: Scenario) -> tuple[Limit, ...]:
    """Return the rows of the controller's polytopes as limits."""
    return tuple(
        Limit(
            name=name,
            signal=SUM,
            terms={of: factor for of, factor in zip(polytope.of, row, strict=True) if factor},
            lower=-math.inf if polytope.lower is None else polytope.lower[i],
            upper=math.inf if polytope.upper is None else polytope.upper[i],
            tolerance=polytope.tolerance,
            tolerance_sampled=polytope.tolerance_sampled,
            required=polytope.required,
        )
        for polytope in scenario.polytopes
        for i, (name, row) in enumerate(zip(polytope.row_names, polytope.rows, strict=True))
    )
