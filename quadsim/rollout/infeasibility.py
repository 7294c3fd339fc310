"""Explain why a flight's QP had no answer, in the terms and units of the scenario file, and suggest remedies.

Each suggestion is a change of the file that was tried: the problem is rebuilt from the changed file and solved for the
same period.  The conflict is that of `quadsim.rollout.conflicts`; `quadsim.rollout.remedies` flies the changes.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, Final

from quadsim.controller import NOT_CONVERGED
from quadsim.errors import InputError
from quadsim.mpc.laws.constrained import Constrained
from quadsim.mpc.laws.parts.builders import build
from quadsim.mpc.laws.robust import Robust
from quadsim.mpc.problem.constraints import Constraint, Origin
from quadsim.mpc.problem.ocp import InfeasiblePeriod
from quadsim.mpc.space import SOFT_SPACE
from quadsim.mpc.tables.bounded import Bounded
from quadsim.rollout.conflicts import Conflict, Side, find_conflict, has_answer, recovery, smallest_widening
from quadsim.scenarios.assembly import Assembly
from quadsim.scenarios.mismatch import modelling_changes, unmodelled, unpredicted
from quadsim.scenarios.schema.base import fields_of
from quadsim.scenarios.schema.controllers import TABLES
from quadsim.scenarios.schema.scenario import Scenario
from quadsim.scenarios.schema.settings import get_field, set_field
from quadsim.scenarios.schema.writing import plain
from quadsim.state import N_STATES
from quadsim.ties import in_order
from quadsim.vehicle import Vehicle

Settings = dict[str, Any]
WIDER: Final = (1.0, 1.02, 1.1, 1.5)
"""The smallest widening, rounded outwards, and larger trials: close to infeasible, solvers give up, and a wider bound
may be tightened by more."""
SOFT: Final[tuple[dict[str, float], ...]] = ({}, {"linear": 1e4}, {"linear": 1e3}, {"linear": 1e2})
"""Penalties of softness, the usual one first; far from feasible, a solver gives up at high ones."""
ITERATIONS: Final = (2, 3, 5, 10, 20, 50, 100)
"""Numbers of iterations to try if sequential quadratic programming did not converge."""


def diagnose(
    infeasible_period: InfeasiblePeriod, scenario: Scenario, vehicle: Vehicle, statuses: Sequence[str] = ()
) -> dict[str, Any]:
    """Return `diagnosis` of a flight's summary; `statuses` are those of its periods.

    The bounds of a user's own controller are not in a scenario file: the problem names them, and the advice states by
    how much a single one would have to be wider.
    """
    if infeasible_period.converges is not None:
        before = scenario.controller.iterations
        return _unconverged(infeasible_period, infeasible_period.converges, before, statuses)
    spec = scenario.controller
    if isinstance(spec, Bounded):
        period = _FailedPeriod(infeasible_period, scenario, spec, vehicle)
    else:
        period = _UserControllerPeriod(infeasible_period, scenario, spec, vehicle)
    report: dict[str, Any] = {
        "time": round(infeasible_period.time, 9),
        "status": infeasible_period.status,
        "feasible": None,
        "conflict": [],
        "suggestions": [],
    }
    conflict = find_conflict(infeasible_period)
    if conflict is not None:
        report["feasible"] = conflict.feasible
        report["conflict"] = _merged(period.entries(conflict))
        if not conflict.feasible:
            report["suggestions"] = [*period.suggestions(conflict)]
    report["sentence"] = _sentence(report)
    if isinstance(period, _UserControllerPeriod):
        report["advice"] = period.widenings(conflict)
    else:
        report["advice"] = _advice(report)
    return report


def lacking_report(assembly: Assembly, time: float) -> dict[str, Any] | None:
    """Return `diagnosis` of a flight that was lost at a time [s], though every problem that it solved had an answer.

    It names what the scenario states and the controller's model lacks; None where that is nothing.
    """
    lacking = [*unmodelled(assembly), *unpredicted(assembly)]
    if not lacking:
        return None
    suggestions = [{"settings": settings, "after": None} for settings in modelling_changes(assembly)]
    stated = ", ".join(entry.text for entry in lacking)
    changes = "; ".join(map(change_text, suggestions))
    return {
        "time": round(time, 9),
        "status": "lost",
        "feasible": None,
        "conflict": [],
        "suggestions": suggestions,
        "sentence": f"lost, and the model of {assembly.scenario.controller.type} lacks: {stated}",
        "advice": f"to try: {changes}",
    }


def changed_scenario(scenario: Scenario, settings: Settings) -> Scenario | None:
    """Return the scenario with other fields of its file; None if that would be refused."""
    table = scenario.tables
    defaults = plain(scenario)
    for field, value in settings.items():
        set_field(table, field, value, source="diagnosis", defaults=defaults)
    if "controller.type" in settings:
        fields = table["controller"]
        known = fields_of(TABLES[settings["controller.type"]])
        table["controller"] = {name: value for name, value in fields.items() if name in known}
    try:
        return scenario.derive(table)
    except InputError:
        return None


def _unconverged(
    infeasible_period: InfeasiblePeriod, converges: Callable[[int], bool], before: int, statuses: Sequence[str]
) -> dict[str, Any]:
    """Return the diagnosis of a period whose QPs were solved but whose SQP did not converge."""
    often = ""
    if statuses:
        often = f" in {statuses.count(NOT_CONVERGED)} of {len(statuses)} periods"
    suggestions = []
    advice = f"it does not within {ITERATIONS[-1]} iterations either"
    for count in ITERATIONS:
        if count > before and converges(count):
            change = {"settings": {"controller.iterations": count}, "after": None}
            suggestions.append(change)
            advice = f"to try: {change_text(change)}"
            break
    return {
        "time": round(infeasible_period.time, 9),
        "status": infeasible_period.status,
        "feasible": True,
        "conflict": [],
        "suggestions": suggestions,
        "sentence": f"the SQP did not converge{often}, first at t = {infeasible_period.time:.2f} s: "
        "every QP was solved, but the plans do not follow the nonlinear dynamics",
        "advice": advice,
    }


class _FailedPeriod:
    """One period's problem and its scenario file."""

    def __init__(self, infeasible_period: InfeasiblePeriod, scenario: Scenario, spec: Any, vehicle: Vehicle) -> None:
        self._infeasible_period = infeasible_period
        self._spec = spec
        self._vehicle = vehicle
        self._period = scenario.control_period
        self._scenario = scenario

    def origin(self, side: Side) -> Origin:
        """Return where a side comes from."""
        return self._infeasible_period.problem.every_constraint[side.place].origin(side.row)

    def _alike(self, side: Side) -> set[Side]:
        """Return the sides of its constraint that have one name, and where a file states them, one number in it."""
        origin = self.origin(side)._replace(rotor=0)
        rows = self._infeasible_period.problem.every_constraint[side.place].lower.shape[-1]
        alike = set()
        for row in range(rows):
            other = side._replace(row=row)
            if self.origin(other)._replace(rotor=0) == origin:
                alike.add(other)
        return alike

    def _field(self, side: Side) -> str:
        """Return the field of the file that states a side; empty if none does."""
        field, _ = self.origin(side).place(upper=side.upper)
        return field

    def entries(self, conflict: Conflict) -> Iterator[dict[str, Any]]:
        """Yield the violated bounds, the largest share first, and the blocking ones, with times and amounts.

        Bounds whose shares are tied (`quadsim.ties`) are in the order of the problem's constraints.
        """
        delay = self._infeasible_period.delay
        period = self._period
        declared = sorted(conflict.violated.items())
        for i in in_order([-violation.share for _, violation in declared]):
            side, violation = declared[i]
            origin = self.origin(side)
            yield {
                **_named(origin, side),
                "by": violation.amount * origin.factor,
                "start": round(delay + violation.first * period, 9),
                "stop": round(delay + violation.last * period, 9),
            }
        for side in conflict.blocking:
            yield {**_named(self.origin(side), side), "by": 0.0, "start": None, "stop": None}

    def suggestions(self, conflict: Conflict) -> Iterator[dict[str, Any]]:
        """Yield changes of the file that make the period feasible: single bounds, smallest first; softness."""
        fields = self._sides_by_field(conflict)
        changes = self._single_widenings(fields)
        if not changes:
            changes = self._common_widenings(fields, conflict)
        for settings in (*changes, *self._softened(conflict)):
            yield {"settings": settings, "after": None}
        yield from self._fallback()

    def _sides_by_field(self, conflict: Conflict) -> dict[str, set[Side]]:
        """Return the sides that each field states of which a side is violated, or blocking and none is violated."""
        violated_fields = {self._field(side) for side in conflict.violated}
        fields: dict[str, set[Side]] = {}
        for side in (*conflict.violated, *conflict.blocking):
            field = self._field(side)
            if field and (side in conflict.violated or field not in violated_fields):
                fields.setdefault(field, set()).update(self._alike(side))
        return fields

    def _single_widenings(self, fields: Mapping[str, set[Side]]) -> list[Settings]:
        """Return the changes of a single field that widen its bounds by enough."""
        changes = []
        for field, sides in fields.items():
            amount = smallest_widening(self._infeasible_period, sides)
            if amount is None:
                continue
            settings = self._widened({field: (sides, amount)})
            if settings is not None:
                changes.append(settings)
        return changes

    def _common_widenings(self, fields: Mapping[str, set[Side]], conflict: Conflict) -> list[Settings]:
        """Return the change that widens all violated fields by their violations, if it is enough."""
        amounts: dict[str, float] = {}
        for side, violation in conflict.violated.items():
            field = self._field(side)
            amounts[field] = max(violation.amount, amounts.get(field, 0.0))
        settings = self._widened(
            {field: (sides, amounts[field]) for field, sides in fields.items() if field in amounts}
        )
        if settings:
            return [settings]
        return []

    def _softened(self, conflict: Conflict) -> list[Settings]:
        """Return changes that soften one violated constraint, or all of them, at the largest penalty that works."""
        tables: list[str] = []
        for side in conflict.violated:
            table = self.origin(side).soft
            if table and table not in tables:
                tables.append(table)
        changes = []
        for table in tables:
            settings = self._soft([table])
            if settings is not None:
                changes.append(settings)
        if not changes and len(tables) > 1:
            settings = self._soft(tables)
            if settings is not None:
                changes.append(settings)
        return changes

    def _soft(self, tables: Sequence[str]) -> Settings | None:
        """Return tables of softness with the largest penalty that helps; None if none does."""
        other_type: Settings = {}
        if "controller.soft" in tables and not isinstance(self._spec, Robust):
            other_type = {"controller.type": "robust"}
        for penalty in SOFT:
            settings = {**other_type, **dict.fromkeys(tables, penalty)}
            if self._helps(settings):
                return settings
        return None

    def _widened(self, amounts: Mapping[str, tuple[set[Side], float]]) -> Settings | None:
        """Return fields with bounds moved outwards by at least these amounts, if that helps."""
        table = plain(self._scenario)
        for more in WIDER:
            settings: Settings = {}
            for field, (sides, amount) in amounts.items():
                settings[field] = self._moved(get_field(table, field), sides, more * amount)
            if self._helps(settings):
                return settings
        return None

    def _moved(self, stated: Sequence[float], sides: Collection[Side], amount: float) -> list[float]:
        """Return a field's numbers with these sides moved outwards by an amount; several rotors share an entry."""
        numbers = [*stated]
        for side in sides:
            origin = self.origin(side)
            _, entry = origin.place(upper=side.upper)
            numbers[entry] = _outwards(stated[entry], amount * origin.factor, upper=side.upper)
        return numbers

    def _helps(self, settings: Settings) -> bool:
        """Return whether the period has an answer with these fields."""
        spec = self._changed(settings)
        if spec is None:
            return False
        if spec.input_bounds is not None and self._spec.input_bounds is not None:
            fastest = max(self._vehicle.speed_max, self._spec.input_bounds.speed[1])
            if spec.input_bounds.speed[1] > fastest:
                return False
        try:
            problem = spec.problem(self._vehicle, self._period)
        except InputError:
            return False
        constraints = (*problem.constraints, *self._space_constraints(spec))
        return has_answer(replace(problem, constraints=constraints), self._infeasible_period.query)

    def _space_constraints(self, spec: Constrained | Robust) -> list[Constraint]:
        """Return the half-spaces of the period's problem, as soft as a controller's table has them."""
        soft = None
        if spec.avoidance is not None:
            soft = spec.avoidance.soft
        constraints = []
        for constraint in self._infeasible_period.problem.constraints:
            if constraint.origin(0).soft != SOFT_SPACE:
                continue
            if soft is not None:
                constraint = replace(constraint, penalty=soft.penalty(constraint.lower.shape[1]))
            constraints.append(constraint)
        return constraints

    def _changed(self, settings: Settings) -> Constrained | Robust | None:
        """Return the controller with other fields; None if the file would be rejected."""
        scenario = changed_scenario(self._scenario, settings)
        if scenario is None:
            return None
        changed = scenario.controller
        assert isinstance(changed, Constrained | Robust)
        return changed

    def _fallback(self) -> Iterator[dict[str, Any]]:
        """Yield the fallback, if there is none yet, with the time in level hover until the problem has an answer."""
        fallback = self._spec.fallback
        if fallback is not None and fallback.enabled:
            return
        settings: Settings = {"controller.fallback": {}}
        changed = self._changed(settings)
        query = self._infeasible_period.query
        assert changed is not None
        pilot = build(changed, self._vehicle, self._period)
        guard = pilot.guard
        assert guard is not None
        plan = guard.hover(pilot.law, query.state[:N_STATES], query.u_before)
        periods = recovery(self._infeasible_period, plan)
        if periods is not None:
            yield {"settings": settings, "after": round(periods * self._period, 9)}


class _UserControllerPeriod(_FailedPeriod):
    """The same for a user's own controller, which no file describes."""

    def origin(self, side: Side) -> Origin:
        """Return where a side comes from, in no file."""
        return super().origin(side)._replace(field="", row=None, soft="")

    def suggestions(self, conflict: Conflict) -> Iterator[dict[str, Any]]:
        """Yield nothing: there is no file to change."""
        yield from ()

    def widenings(self, conflict: Conflict | None) -> str:
        """Return by how much each single side, for all rotors together, would have to be wider."""
        if conflict is None or conflict.feasible:
            return ""
        groups: list[set[Side]] = []
        for side in (*conflict.violated, *conflict.blocking):
            alike = self._alike(side)
            if alike not in groups:
                groups.append(alike)
        widenings = []
        for sides in groups:
            amount = smallest_widening(self._infeasible_period, sides)
            if amount is not None:
                side = next(iter(sides))
                origin = self.origin(side)
                shown = _with_unit(amount * origin.factor, origin.unit)
                widenings.append(f"{origin.name} {_which(side)} wider by {shown}")
        if widenings:
            return f"has an answer with {'; or '.join(widenings)}"
        return "no bound alone gives it an answer"


def _which(side: Side) -> str:
    if side.upper:
        return "upper"
    return "lower"


def _with_unit(value: float, unit: str) -> str:
    """Return a value in three digits, with its unit where it has one."""
    if unit == "-":
        return f"{value:.3g}"
    return f"{value:.3g} {unit}"


def _named(origin: Origin, side: Side) -> dict[str, Any]:
    """Return the first entries of a bound in a report: what it is called, and where it is stated."""
    rotors = []
    if origin.rotor:
        rotors.append(origin.rotor)
    field, _ = origin.place(upper=side.upper)
    return {"name": origin.name, "rotors": rotors, "side": _which(side), "unit": origin.unit, "field": field}


def _merged(entries: Iterable[dict[str, Any]]) -> list[dict[str, Any]]:
    """Merge the same side of several rotors into one entry, with the largest amount and the whole time span."""
    merged: dict[tuple[Any, ...], dict[str, Any]] = {}
    for entry in entries:
        key = (entry["name"], entry["side"], entry["by"] > 0.0)
        if key not in merged:
            merged[key] = entry
            continue
        other = merged[key]
        times = {"start": other["start"], "stop": other["stop"]}
        if entry["by"]:
            times = {"start": min(other["start"], entry["start"]), "stop": max(other["stop"], entry["stop"])}
        rotors = sorted(other["rotors"] + entry["rotors"])
        merged[key] = {**other, **times, "rotors": rotors, "by": max(other["by"], entry["by"])}
    return list(merged.values())


def _outwards(bound: float, amount: float, *, upper: bool) -> float:
    """Move a bound outwards by an amount, rounded up to three digits."""
    digits = 0
    if amount > 0.0:
        digits = 2 - math.floor(math.log10(amount))
    step = math.ceil(round(amount * 10.0**digits, 6)) / 10.0**digits
    if upper:
        moved = bound + step
    else:
        moved = bound - step
    return round(moved, max(digits, 0) + 3)


def _sentence(report: Mapping[str, Any]) -> str:
    """Return when it happened, and which bounds conflict."""
    opening = f"no answer at t = {report['time']:.2f} s ({report['status']})"
    if report["feasible"] is None:
        return f"{opening}, nor to its elastic problem: its numbers are beyond what can be solved"
    if report["feasible"]:
        return f"{opening}, though all constraints can hold together: it is the solver that failed"
    return f"{opening}; cannot hold together: {'; '.join(map(_phrase, report['conflict']))}"


def _phrase(entry: Mapping[str, Any]) -> str:
    """Describe one bound, e.g. `roll upper at +0.15 s .. +0.40 s by 0.8 deg`, or `slew of rotor 3 lower`."""
    rotors = entry["rotors"]
    name = entry["name"]
    if len(rotors) == 1:
        name += f" of rotor {rotors[0]}"
    elif rotors:
        name += f" of rotors {', '.join(map(str, rotors))}"
    name += f" {entry['side']}"
    if not entry["by"]:
        return name
    times = f"+{entry['start']:.2f} s"
    stop = f"+{entry['stop']:.2f} s"
    if stop != times:
        times += f" .. {stop}"
    return f"{name} at {times} by {_with_unit(entry['by'], entry['unit'])}"


def _advice(report: Mapping[str, Any]) -> str:
    """Return the advice."""
    if report["feasible"] is not False:
        return ""
    changes = "; ".join(map(change_text, report["suggestions"]))
    if changes:
        return f"to try: {changes}"
    return "no bound alone, nor all of them by as much, gives it an answer"


def change_text(change: Mapping[str, Any]) -> str:
    """Return a change as after `--set`, with what has to be known about it."""
    settings = change["settings"]
    text = fields_text(settings)
    if settings.get("controller.type") == "robust":
        text += " (without the field solver)"
    if settings.get("controller.iterations") is not None:
        text += f", which takes up to {settings['controller.iterations']} times as long"
    if change["after"]:
        text += f" (level hover; an answer again after {change['after']:.2f} s, by the model)"
    violated = ", ".join(change.get("violated", ()))
    if violated and "why" not in change:
        text += f" (violates {violated} on its way)"
    return text


def fields_text(settings: Mapping[str, Any]) -> str:
    """Return fields and values as after `--set`."""
    return ", ".join(f"{field} = {_toml(value)}" for field, value in settings.items())


def _toml(value: object) -> str:
    """Format a text, a list of numbers, or a table of numbers as in a scenario file."""
    if not isinstance(value, dict):
        return json.dumps(value)
    if not value:
        return "{}"
    entries = ", ".join(f"{name} = {number:g}" for name, number in value.items())
    return f"{{ {entries} }}"
