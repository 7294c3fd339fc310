"""Explain why a flight's QP had no answer, in the terms and units of the scenario file, and suggest remedies.

Each suggestion is a change of the file that was tried: the problem is rebuilt from the changed file and solved for the
same period.  `quadsim.rollout.remedies` flies them.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, Final

from quadsim.controller import NOT_CONVERGED
from quadsim.errors import InputError
from quadsim.mpc.laws.constrained import Constrained
from quadsim.mpc.laws.parts.builders import build
from quadsim.mpc.laws.robust import Robust
from quadsim.mpc.problem.constraints import Origin
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
    case = (_Case if isinstance(spec, Bounded) else _OwnCase)(infeasible_period, scenario, spec, vehicle)
    conflict = find_conflict(infeasible_period)
    if conflict is None:
        entries = []
    else:
        entries = _merged([*case.entries(conflict)])
    if conflict is None or conflict.feasible:
        suggestions = []
    else:
        suggestions = [*case.suggestions(conflict)]
    report = {
        "time": round(infeasible_period.time, 9),
        "status": infeasible_period.status,
        "feasible": None if conflict is None else conflict.feasible,
        "conflict": entries,
        "suggestions": suggestions,
    }
    if isinstance(case, _OwnCase):
        advice = case.widenings(conflict)
    else:
        advice = _advice(report)
    return {**report, "sentence": _sentence(report), "advice": advice}


def lacking_report(assembly: Assembly, time: float) -> dict[str, Any] | None:
    """Return `diagnosis` of a flight that was lost at a time [s], though every problem that it solved had an answer.

    It names what the scenario states and the law's model lacks; None where that is nothing.
    """
    lacking = [*unmodelled(assembly), *unpredicted(assembly)]
    if not lacking:
        return None
    suggestions = [{"settings": settings, "after": None} for settings in modelling_changes(assembly)]
    stated = ", ".join(entry.text for entry in lacking)
    changes = map(change_text, suggestions)
    return {
        "time": round(time, 9),
        "status": "lost",
        "feasible": None,
        "conflict": [],
        "suggestions": suggestions,
        "sentence": f"lost, and the model of {assembly.scenario.controller.type} lacks: {stated}",
        "advice": f"to try: {'; '.join(changes)}",
    }


def changed_scenario(scenario: Scenario, settings: Settings) -> Scenario | None:
    """Return the scenario with other fields of its file; None if that would be refused."""
    table = scenario.tables
    defaults = plain(scenario)
    for field, value in settings.items():
        set_field(table, field, value, source="diagnosis", defaults=defaults)
    if "controller.type" in settings:
        law = table["controller"]
        known = fields_of(TABLES[settings["controller.type"]])
        table["controller"] = {name: value for name, value in law.items() if name in known}
    try:
        return scenario.derive(table)
    except InputError:
        return None


def _unconverged(
    infeasible_period: InfeasiblePeriod, converges: Callable[[int], bool], before: int, statuses: Sequence[str]
) -> dict[str, Any]:
    """Return the diagnosis of a period whose QPs were solved but whose SQP did not converge."""
    if statuses:
        count = f" in {sum(status == NOT_CONVERGED for status in statuses)} of {len(statuses)} periods"
    else:
        count = ""
    enough = next((count for count in ITERATIONS if count > before and converges(count)), None)
    if enough is None:
        suggestions = []
    else:
        suggestions = [{"settings": {"controller.iterations": enough}, "after": None}]
    never = f"it does not within {ITERATIONS[-1]} iterations either"
    if enough is None:
        advice = never
    else:
        advice = f"to try: {change_text(suggestions[0])}"
    return {
        "time": round(infeasible_period.time, 9),
        "status": infeasible_period.status,
        "feasible": True,
        "conflict": [],
        "suggestions": suggestions,
        "sentence": f"the SQP did not converge{count}, first at t = {infeasible_period.time:.2f} s: "
        "every QP was solved, but the plans do not follow the nonlinear dynamics",
        "advice": advice,
    }


class _Case:
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

    def _together(self, side: Side) -> set[Side]:
        """Return the sides of its constraint that have one name, and where a file states them, one number in it."""
        rows = self._infeasible_period.problem.every_constraint[side.place].lower.shape[-1]
        sides = [side._replace(row=row) for row in range(rows)]
        return {other for other in sides if self.origin(other)._replace(rotor=0) == self.origin(side)._replace(rotor=0)}

    def _field(self, side: Side) -> str:
        return self.origin(side).place(upper=side.upper)[0]

    def entries(self, conflict: Conflict) -> Iterator[dict[str, Any]]:
        """Yield the violated bounds, the largest share first, and the blocking ones, with times and amounts.

        Bounds whose shares are tied (`quadsim.ties`) are in the order of the problem's constraints.
        """
        delay = self._infeasible_period.delay
        period = self._period
        declared = sorted(conflict.violated.items())
        for i in in_order([-violation.share for _, violation in declared]):
            side, violation = declared[i]
            first, last = (round(delay + steps * period, 9) for steps in (violation.first, violation.last))
            origin = self.origin(side)
            yield {**_named(origin, side), "by": violation.amount * origin.factor, "start": first, "stop": last}
        for side in conflict.blocking:
            yield {**_named(self.origin(side), side), "by": 0.0, "start": None, "stop": None}

    def suggestions(self, conflict: Conflict) -> Iterator[dict[str, Any]]:
        """Yield changes of the file that make the period feasible: single bounds, smallest first; softness."""
        giving = {self._field(side) for side in conflict.violated}
        fields: dict[str, set[Side]] = {}
        for side in (*conflict.violated, *conflict.blocking):
            field = self._field(side)
            if field and (side in conflict.violated or field not in giving):
                fields.setdefault(field, set()).update(self._together(side))
        least = {field: smallest_widening(self._infeasible_period, sides) for field, sides in fields.items()}
        changes = [{field: (fields[field], amount)} for field, amount in least.items() if amount is not None]
        alone = [settings for change in changes if (settings := self._widened(change))]
        if not alone:
            most: dict[str, float] = {}
            for side, violation in conflict.violated.items():
                field = self._field(side)
                most[field] = max(violation.amount, most.get(field, 0.0))
            together = self._widened({field: (sides, most[field]) for field, sides in fields.items() if field in most})
            alone = [together] if together else []
        for settings in (*alone, *self._softened(conflict)):
            yield {"settings": settings, "after": None}
        yield from self._fallback()

    def _softened(self, conflict: Conflict) -> list[Settings]:
        """Return changes that soften one violated constraint, or all of them, at the largest penalty that works."""
        tables = [*dict.fromkeys(table for side in conflict.violated if (table := self.origin(side).soft))]
        softened = [settings for table in tables if (settings := self._soft([table]))]
        if not softened and len(tables) > 1 and (settings := self._soft(tables)):
            softened = [settings]
        return softened

    def _soft(self, tables: Sequence[str]) -> Settings | None:
        other_law = "controller.soft" in tables and not isinstance(self._spec, Robust)
        law: Settings
        if other_law:
            law = {"controller.type": "robust"}
        else:
            law = {}
        return next(filter(self._helps, ({**law, **dict.fromkeys(tables, soft)} for soft in SOFT)), None)

    def _widened(self, amounts: Mapping[str, tuple[set[Side], float]]) -> Settings | None:
        """Return fields with bounds moved outwards by at least these amounts, if that helps."""
        table = plain(self._scenario)
        for more in WIDER:
            settings: Settings = {}
            for field, (sides, amount) in amounts.items():
                numbers = [*(before := get_field(table, field))]
                for side in sides:  # several rotors share an entry
                    origin = self.origin(side)
                    _, entry = origin.place(upper=side.upper)
                    numbers[entry] = _outwards(before[entry], more * amount * origin.factor, upper=side.upper)
                settings[field] = numbers
            if self._helps(settings):
                return settings
        return None

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
        space = tuple(part for part in self._infeasible_period.problem.constraints if part.origin(0).soft == SOFT_SPACE)
        if spec.avoidance is not None and (soft := spec.avoidance.soft) is not None:
            space = tuple(replace(part, penalty=soft.penalty(part.lower.shape[1])) for part in space)
        return has_answer(replace(problem, constraints=(*problem.constraints, *space)), self._infeasible_period.query)

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


class _OwnCase(_Case):
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
        alike = dict.fromkeys(frozenset(self._together(side)) for side in (*conflict.violated, *conflict.blocking))
        widenings = []
        for sides in alike:
            side = next(iter(sides))
            least = smallest_widening(self._infeasible_period, sides)
            origin = self.origin(side)
            if least is not None:
                amount = f"{least * origin.factor:.3g} {origin.unit.replace('-', '')}".rstrip()
                widenings.append(f"{origin.name} {_which(side)} wider by {amount}")
        if widenings:
            return f"has an answer with {'; or '.join(widenings)}"
        return "no bound alone gives it an answer"


def _which(side: Side) -> str:
    if side.upper:
        return "upper"
    return "lower"


def _named(origin: Origin, side: Side) -> dict[str, Any]:
    return {
        "name": origin.name,
        "rotors": [origin.rotor] if origin.rotor else [],
        "side": _which(side),
        "unit": origin.unit,
        "field": origin.place(upper=side.upper)[0],
    }


def _merged(entries: list[dict[str, Any]]) -> list[dict[str, Any]]:
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
    if amount > 0.0:
        digits = 2 - math.floor(math.log10(amount))
    else:
        digits = 0
    moved = math.ceil(round(amount * 10.0**digits, 6)) / 10.0**digits
    return round(bound + moved if upper else bound - moved, max(digits, 0) + 3)


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
    which = f" of rotor{'s' if len(rotors) > 1 else ''} {', '.join(map(str, rotors))}" if rotors else ""
    name = f"{entry['name']}{which} {entry['side']}"
    if not entry["by"]:
        return name
    times = dict.fromkeys(f"+{entry[key]:.2f} s" for key in ("start", "stop"))
    return f"{name} at {' .. '.join(times)} by {entry['by']:.3g} {entry['unit'].replace('-', '')}".rstrip()


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
    after = change["after"]
    fields = fields_text(settings)
    fields += " (without the field solver)" if settings.get("controller.type") == "robust" else ""
    if (count := settings.get("controller.iterations")) is not None:
        fields += f", which takes up to {count} times as long"
    fields += f" (level hover; an answer again after {after:.2f} s, by the model)" if after else ""
    violated = ", ".join(change.get("violated", ()))
    return fields + (f" (violates {violated} on its way)" if violated and "why" not in change else "")


def fields_text(settings: Mapping[str, Any]) -> str:
    """Return fields and values as after `--set`."""
    return ", ".join(f"{field} = {_toml(value)}" for field, value in settings.items())


def _toml(value: object) -> str:
    """Format a text, a list of numbers, or a table of numbers as in a scenario file."""
    if not isinstance(value, dict):
        return json.dumps(value)
    if value:
        return f"{{ {', '.join(f'{name} = {number:g}' for name, number in value.items())} }}"
    return "{}"
