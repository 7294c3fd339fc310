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
from quadsim.mpc.problem.polytope import Polytope
from quadsim.mpc.tables.controller import Range
from quadsim.report.table import format_number
from quadsim.scenarios.plugin import PluginController
from quadsim.scenarios.user_bounds import user_limits
from quadsim.space import AnyObstacle, Corridor, Fence
from quadsim.vehicle import Vehicle

if TYPE_CHECKING:
    from quadsim.scenarios.schema.scenario import Scenario


def signal_limits(scenario: Scenario, bounds: Mapping[str, Range]) -> list[Limit]:
    """Return the constraints of a scenario on single signals, then its controller's `bounds` without a constraint."""
    return [*_stated(scenario, bounds), *_unnamed(scenario, bounds)]


def with_user_bounds(scenario: Scenario, controller: Controller) -> Scenario:
    """Return the scenario with the bounds of a user's controller as constraints; see `user_limits`."""
    if isinstance(controller, Pilot):
        controller = controller.law
    if not isinstance(controller, PluginController):
        return scenario
    replaced = _signals_replaced(scenario)
    limits = []
    for limit in user_limits(controller.law, scenario.audited_names):
        if limit.signal == SUM or limit.signal not in replaced:
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
    notes = []
    unnamed = [limit.name for limit in _unnamed(scenario, bounds)]
    if len(unnamed) == 1:
        notes.append(f"{unnamed[0]}: audited as the controller bounds it")
    elif unnamed:
        notes.append(f"{', '.join(unnamed)}: audited as the controller bounds them")
    if not audited:
        notes.append(UNAUDITED_ADVICE)
    absent = []
    for entry in scenario.constraints:
        if not (entry.has_bounds or entry.signal in bounds):
            absent.append(entry.name)
    if absent:
        notes.append(f"{', '.join(absent)}: not audited, the controller has no such bound and the entry states none")
    return notes + _differing_bounds(scenario, vehicle, signal_limits(scenario, bounds))


def _differing_bounds(scenario: Scenario, vehicle: Vehicle, limits: Iterable[Limit]) -> list[str]:
    """Return a note on each bound of a controller of the flight that differs from the limit on the same signal."""
    bounds_from = [(0.0, scenario.controller.audited(vehicle))]
    for at, spec in scenario.controller_changes:
        bounds_from.append((at, spec.audited(vehicle)))
    notes = []
    for limit in limits:
        before = None
        for at, bounds in bounds_from:
            pair = bounds.get(limit.signal)
            if pair is not None and pair not in (before, (limit.lower, limit.upper)):
                note = (
                    f"{limit.name}: audited against {_range(limit.lower, limit.upper)} {limit.unit}, the controller "
                    f"bounds {_range(*pair)} {limit.unit}"
                )
                if at:
                    note += f" from {at:g} s"
                notes.append(note)
            before = pair
    return notes


def flyable(bounds: Mapping[str, Range], vehicle: Vehicle) -> dict[str, Range]:
    """Return a controller's bounds, those on speeds within the range that the actual vehicle's rotors have."""
    flown = dict(bounds)
    if "speed" in bounds:
        slowest, fastest = bounds["speed"]
        lower = max(slowest, vehicle.speed_min)
        upper = min(fastest, vehicle.speed_max)
        if lower < upper:
            flown["speed"] = (lower, upper)
        else:
            flown["speed"] = (vehicle.speed_min, vehicle.speed_max)
    return flown


def _stated(scenario: Scenario, bounds: Mapping[str, Range]) -> list[Limit]:
    """Return the entries of `[[constraints]]` with their bounds; those without any available are dropped."""
    limits = []
    for entry in scenario.constraints:
        if entry.has_bounds:
            limits.append(entry)
        elif entry.signal in bounds:
            lower, upper = bounds[entry.signal]
            limits.append(replace(entry, lower=lower, upper=upper))
    return limits


def _unnamed(scenario: Scenario, bounds: Mapping[str, Range]) -> Iterator[Limit]:
    """Yield a limit for each controller bound without an entry."""
    replaced = _signals_replaced(scenario)
    for signal, (lower, upper) in bounds.items():
        if signal in replaced:
            continue
        if signal in scenario.audited_names:
            name = f"controller.{signal}"
        else:
            name = signal
        yield Limit(name=name, signal=signal, lower=lower, upper=upper)


def _signals_replaced(scenario: Scenario) -> set[str]:
    """Return the signals whose entry replaces the controller's bounds."""
    signals = set()
    for entry in scenario.constraints:
        applies_throughout = entry.start <= 0.0 and math.isinf(entry.stop)
        if applies_throughout or not entry.has_bounds:
            signals.add(entry.signal)
    return signals


def _range(lower: float, upper: float) -> str:
    """Return bounds in words."""
    if math.isinf(upper):
        return f"at least {format_number(lower)}"
    if math.isinf(lower):
        return f"at most {format_number(upper)}"
    if lower == -upper:
        return f"±{format_number(upper)}"
    return f"{format_number(lower)} .. {format_number(upper)}"


def space_limits(
    obstacles: Iterable[AnyObstacle], regions: Iterable[Corridor | Fence], radius: float
) -> tuple[SpaceLimit, ...]:
    """Return the obstacles, then the regions, as limits of a vehicle within a ball of a radius [m]."""
    limits = []
    for obstacle in obstacles:
        limits.append(SpaceLimit(name=obstacle.name, shape=obstacle, radius=radius))
    for region in regions:
        limit = SpaceLimit(
            name=region.name,
            shape=region,
            radius=radius,
            tolerance=region.tolerance,
            tolerance_sampled=region.tolerance,
            required=region.required,
            start=region.start,
            stop=region.stop,
        )
        limits.append(limit)
    return tuple(limits)


def sum_limits(scenario: Scenario) -> tuple[Limit, ...]:
    """Return the rows of the controller's polytopes as limits."""
    limits: list[Limit] = []
    for polytope in scenario.polytopes:
        limits += _row_limits(polytope)
    return tuple(limits)


def _row_limits(polytope: Polytope) -> list[Limit]:
    """Return the rows of a polytope as limits, lower <= sum of factor * signal <= upper."""
    limits = []
    for i, name in enumerate(polytope.row_names):
        terms = {}
        for signal, factor in zip(polytope.of, polytope.rows[i], strict=True):
            if factor:
                terms[signal] = factor
        lower = -math.inf
        if polytope.lower is not None:
            lower = polytope.lower[i]
        upper = math.inf
        if polytope.upper is not None:
            upper = polytope.upper[i]
        limit = Limit(
            name=name,
            signal=SUM,
            terms=terms,
            lower=lower,
            upper=upper,
            tolerance=polytope.tolerance,
            tolerance_sampled=polytope.tolerance_sampled,
            required=polytope.required,
        )
        limits.append(limit)
    return limits
