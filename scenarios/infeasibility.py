"""Explain why a flight's QP had no answer, in the terms and units of the scenario file, and suggest remedies.

Each suggestion is a change of the file that was tried: the problem is rebuilt from the changed file and solved for the
same period.  `scenarios.remedies` flies them.
"""

from __future__ import annotations

import json
import math
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from mpc.bounded import IN_DEGREES, Bounded, Polytope
from mpc.constrained import Constrained
from mpc.diagnosis import Conflict, Side, find_conflict, has_answer, recovery, smallest_widening
from mpc.fallback.contract import Guarded
from mpc.ocp import InfeasiblePeriod
from mpc.robust.settings import Robust
from quadsim.errors import InputError
from quadsim.flight.audit import TERM_SIGNALS, sum_signal
from quadsim.state import N_STATES, REFERENCE_STATES, STATE_NAMES
from quadsim.vehicle import N_ROTORS, Vehicle
from scenarios.schema.base import fields_of
from scenarios.schema.scenario import Scenario
from scenarios.schema.settings import get_field, set_field

Settings = dict[str, Any]
WIDER: Final = (1.0, 1.02, 1.1, 1.5)
"""The smallest widening, rounded outwards, and larger trials: close to infeasible, solvers give up, and a wider bound
may be tightened by more."""
SOFT: Final[tuple[dict[str, float], ...]] = ({}, {"linear": 1e4}, {"linear": 1e3}, {"linear": 1e2})
"""Penalties of softness, the usual one first; far from feasible, a solver gives up at high ones."""
ITERATIONS: Final = (2, 3, 5, 10, 20, 50, 100)
"""Numbers of iterations to try if sequential quadratic programming did not converge."""
_ROTORS: Final = {1: "slew", 2: "speed"}
"""Fields of `input_bounds` by the index of their constraint in `mpc.constraints.Bounds.constraints`."""


@dataclass(frozen=True, kw_only=True)
class _Bound:
    """A side of a row, in terms of the file."""

    name: str  # name in reports, without its rotor
    side: str  # `lower` or `upper`
    entry: int  # index in its field
    rotor: int = 0  # 1 to 4, or 0
    unit: str = "-"  # unit of the bound in the file
    factor: float = 1.0  # file units per unit of the row
    field: str = ""  # field of the file, a list of numbers


def diagnose(infeasible_period: InfeasiblePeriod, scenario: Scenario, vehicle: Vehicle) -> dict[str, Any]:
    """Return `diagnosis` of a flight's summary.

    The bounds of a user's own controller are not in a scenario file: the problem names them, and the advice states by
    how much a single one would have to be wider.
    """
    if infeasible_period.converges is not None:
        return _unconverged(
            infeasible_period, infeasible_period.converges, getattr(scenario.controller, "iterations", 1)
        )
    spec = scenario.controller
    case = (_Case if isinstance(spec, Bounded) else _OwnCase)(infeasible_period, scenario, spec, vehicle)
    conflict = find_conflict(infeasible_period)
    entries = [] if conflict is None else _merged([*case.entries(conflict)])
    suggestions = [] if conflict is None or conflict.feasible else [*case.suggestions(conflict)]
    report = {
        "time": round(infeasible_period.time, 9),
        "status": infeasible_period.status,
        "feasible": None if conflict is None else conflict.feasible,
        "conflict": entries,
        "suggestions": suggestions,
    }
    advice = case.widenings(conflict) if isinstance(case, _OwnCase) else _advice(report)
    return {**report, "sentence": _sentence(report), "advice": advice}


def changed_scenario(scenario: Scenario, settings: Settings) -> Scenario | None:
    """Return the scenario with other fields of its file; None if that would be refused."""
    table = tomllib.loads(scenario.to_toml())
    for field, value in settings.items():
        set_field(table, field, value, source="diagnosis")
    if "controller.type" in settings:
        law = table["controller"]
        table["controller"] = {name: value for name, value in law.items() if name in fields_of(Robust)}
    try:
        changed = Scenario.parse(table)
    except InputError:
        return None
    # A reference that was passed in as a function has its rows in memory.
    return changed.altered(reference=scenario.reference) if changed.reference == scenario.reference else changed


def _unconverged(infeasible_period: InfeasiblePeriod, converges: Callable[[int], bool], before: int) -> dict[str, Any]:
    """Return the diagnosis of a period whose QPs were solved but whose SQP did not converge."""
    enough = next((count for count in ITERATIONS if count > before and converges(count)), None)
    suggestions = [] if enough is None else [{"settings": {"controller.iterations": enough}, "after": None}]
    never = f"it does not within {ITERATIONS[-1]} iterations either"
    advice = never if enough is None else f"to try: {change_text(suggestions[0])}"
    return {
        "time": round(infeasible_period.time, 9),
        "status": infeasible_period.status,
        "feasible": True,
        "conflict": [],
        "suggestions": suggestions,
        "sentence": f"the QP was solved at t = {infeasible_period.time:.2f} s, but the SQP did not converge: "
        "the plan does not follow the nonlinear dynamics",
        "advice": advice,
    }


class _Case:
    """One period's problem and its scenario file."""

    def __init__(self, infeasible_period: InfeasiblePeriod, scenario: Scenario, spec: Any, vehicle: Vehicle) -> None:
        self._infeasible_period, self._spec, self._vehicle = infeasible_period, spec, vehicle
        self._period, self._scenario = scenario.control_period, scenario

    def bound(self, side: Side) -> _Bound:
        """Return a side in terms of the file."""
        which, entry = ("lower", "upper")[side.upper], int(side.upper)
        if side.place in _ROTORS:
            name = _ROTORS[side.place]
            field, rotor = f"controller.input_bounds.{name}", side.row + 1
            return _Bound(name=name, rotor=rotor, side=which, unit="rad/s", field=field, entry=entry)
        if side.place == 0:
            name = [state for state in STATE_NAMES if state in self._spec.output_bounds][side.row]
            factor, field = math.degrees(1.0) if name in IN_DEGREES else 1.0, f"controller.output_bounds.{name}"
            return _Bound(name=name, side=which, unit=TERM_SIGNALS[name].unit, factor=factor, field=field, entry=entry)
        polytope, name = self._polytope(side), self._infeasible_period.problem.every_constraint[side.place].name
        if self._is_space(side):
            return _Bound(name=name, side=which, unit="m", entry=side.row)
        if polytope is None:  # of an unknown kind
            return _Bound(name=f"{name}, row {side.row + 1},", side=which, entry=side.row)
        row = zip(polytope.of, polytope.rows[side.row], strict=True)
        unit = sum_signal({of: factor for of, factor in row if factor}).unit
        name, field = polytope.row_names[side.row], f"controller.polytopes.{polytope.name}.{which}"
        return _Bound(name=name, side=which, unit=unit, field=field, entry=side.row)

    def _polytope(self, side: Side) -> Polytope | None:
        name = self._infeasible_period.problem.every_constraint[side.place].name
        return next((polytope for polytope in self._spec.polytopes if polytope.name == name), None)

    def _is_space(self, side: Side) -> bool:
        """Return whether it is a half-space of an obstacle or region."""
        C = self._infeasible_period.problem.every_constraint[side.place].C
        return C is not None and C.ndim == 3

    def entries(self, conflict: Conflict) -> Iterator[dict[str, Any]]:
        """Yield the violated bounds, the largest share first, and the blocking ones, with times and amounts."""
        delay, period = self._infeasible_period.delay, self._period
        for side, violation in sorted(conflict.violated.items(), key=lambda item: -item[1].share):
            bound = self.bound(side)
            first, last = (round(delay + steps * period, 9) for steps in (violation.first, violation.last))
            yield {**_named(bound), "by": violation.amount * bound.factor, "start": first, "stop": last}
        for side in conflict.blocking:
            yield {**_named(self.bound(side)), "by": 0.0, "start": None, "stop": None}

    def suggestions(self, conflict: Conflict) -> Iterator[dict[str, Any]]:
        """Yield changes of the file that make the period feasible: single bounds, smallest first; softness."""
        giving = {self.bound(side).field for side in conflict.violated}
        fields: dict[str, set[Side]] = {}
        for side in (*conflict.violated, *conflict.blocking):
            field = self.bound(side).field
            if field and (side in conflict.violated or field not in giving):
                rotors = range(N_ROTORS) if side.place in _ROTORS else (side.row,)
                fields.setdefault(field, set()).update(side._replace(row=row) for row in rotors)
        least = {field: smallest_widening(self._infeasible_period, sides) for field, sides in fields.items()}
        changes = [{field: (fields[field], amount)} for field, amount in least.items() if amount is not None]
        alone = [settings for change in changes if (settings := self._widened(change))]
        if not alone:
            most: dict[str, float] = {}
            for side, violation in conflict.violated.items():
                field = self.bound(side).field
                most[field] = max(violation.amount, most.get(field, 0.0))
            together = self._widened({field: (sides, most[field]) for field, sides in fields.items() if field in most})
            alone = [together] if together else []
        for settings in (*alone, *self._softened(conflict)):
            yield {"settings": settings, "after": None}
        yield from self._fallback()

    def _softened(self, conflict: Conflict) -> list[Settings]:
        """Return changes that soften one violated constraint, or all of them, at the largest penalty that works."""
        polytopes = (self._polytope(side) for side in conflict.violated if side.place not in (0, *_ROTORS))
        tables = ["controller.soft"] if any(side.place == 0 for side in conflict.violated) else []
        tables += dict.fromkeys(f"controller.polytopes.{each.name}.soft" for each in polytopes if each is not None)
        tables += ["controller.avoidance.soft"] if any(map(self._is_space, conflict.violated)) else []
        softened = [settings for table in tables if (settings := self._soft([table]))]
        if not softened and len(tables) > 1 and (settings := self._soft(tables)):
            softened = [settings]
        return softened

    def _soft(self, tables: Sequence[str]) -> Settings | None:
        other_law = "controller.soft" in tables and not isinstance(self._spec, Robust)
        law: Settings = {"controller.type": "robust"} if other_law else {}
        return next(filter(self._helps, ({**law, **dict.fromkeys(tables, soft)} for soft in SOFT)), None)

    def _widened(self, amounts: Mapping[str, tuple[set[Side], float]]) -> Settings | None:
        """Return fields with bounds moved outwards by at least these amounts, if that helps."""
        table = tomllib.loads(self._scenario.to_toml())
        for more in WIDER:
            settings: Settings = {}
            for field, (sides, amount) in amounts.items():
                numbers = [*(before := get_field(table, field))]
                for bound in map(self.bound, sides):  # several rotors share an entry
                    moved = more * amount * bound.factor
                    numbers[bound.entry] = _outwards(before[bound.entry], moved, upper=bound.side == "upper")
                settings[field] = numbers
            if self._helps(settings):
                return settings
        return None

    def _helps(self, settings: Settings) -> bool:
        """Return whether the period has an answer with these fields."""
        spec = self._changed(settings)
        if spec is None or spec.input_bounds.speed[1] > max(self._vehicle.speed_max, self._spec.input_bounds.speed[1]):
            return False
        try:
            problem = spec.problem(self._vehicle, self._period)
        except InputError:
            return False
        space = tuple(
            part for part in self._infeasible_period.problem.constraints if part.C is not None and part.C.ndim == 3
        )
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
        fallback = getattr(self._spec, "fallback", None)
        if fallback is not None and fallback.enabled:
            return
        settings: Settings = {"controller.fallback": {}}
        changed, query = self._changed(settings), self._infeasible_period.query
        assert changed is not None
        law = changed.build(self._vehicle, self._period)
        assert isinstance(law, Guarded)
        target = np.zeros(N_STATES)
        target[[*REFERENCE_STATES]] = query.state[[*REFERENCE_STATES]]
        bounds = changed.input_bounds.actuators(self._vehicle)
        plan = law.law.plan(query.state[:N_STATES], target, query.u_before, bounds, changed.horizon, law.trim)
        periods = recovery(self._infeasible_period, plan)
        if periods is not None:
            yield {"settings": settings, "after": round(periods * self._period, 9)}


class _OwnCase(_Case):
    """The same for a user's own controller, which no file describes."""

    def bound(self, side: Side) -> _Bound:
        """Return a side in terms of the problem."""
        problem = self._infeasible_period.problem
        name, rotor, factor, unit = problem.every_constraint[side.place].name, 0, 1.0, "-"
        if problem.bounds is not None and side.place in _ROTORS:
            name, rotor, unit = _ROTORS[side.place], side.row + 1, "rad/s"
        elif problem.bounds is not None and side.place == 0:
            name, factor, unit = problem.bounds.output(side.row)
        elif len(problem.every_constraint[side.place].lower.T) > 1:
            name = f"{name}, row {side.row + 1},"
        which = ("lower", "upper")[side.upper]
        return _Bound(name=name, rotor=rotor, side=which, unit=unit, factor=factor, entry=side.row)

    def suggestions(self, conflict: Conflict) -> Iterator[dict[str, Any]]:
        """Yield nothing: there is no file to change."""
        yield from ()

    def widenings(self, conflict: Conflict | None) -> str:
        """Return by how much each single side, for all rotors together, would have to be wider."""
        if conflict is None or conflict.feasible:
            return ""
        sides: dict[tuple[str, str], set[Side]] = {}
        for side in (*conflict.violated, *conflict.blocking):
            rows = range(N_ROTORS) if self.bound(side).rotor else (side.row,)
            key = (self.bound(side).name, self.bound(side).side)
            sides.setdefault(key, set()).update(side._replace(row=row) for row in rows)
        widenings = []
        for (name, which), alike in sides.items():
            least, bound = smallest_widening(self._infeasible_period, alike), self.bound(next(iter(alike)))
            if least is not None:
                amount = f"{least * bound.factor:.3g} {bound.unit.replace('-', '')}".rstrip()
                widenings.append(f"{name} {which} wider by {amount}")
        return f"has an answer with {'; or '.join(widenings)}" if widenings else "no bound alone gives it an answer"


def _named(bound: _Bound) -> dict[str, Any]:
    rotors = [bound.rotor] if bound.rotor else []
    return {"name": bound.name, "rotors": rotors, "side": bound.side, "unit": bound.unit, "field": bound.field}


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
    digits = 2 - math.floor(math.log10(amount)) if amount > 0.0 else 0
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
    return f"to try: {changes}" if changes else "no bound alone, nor all of them by as much, gives it an answer"


def change_text(change: Mapping[str, Any]) -> str:
    """Return a change as after `--set`, with what has to be known about it."""
    settings, after = change["settings"], change["after"]
    fields = ", ".join(f"{field} = {_toml(value)}" for field, value in settings.items())
    fields += " (without the field solver)" if "controller.type" in settings else ""
    if (count := settings.get("controller.iterations")) is not None:
        fields += f", which takes up to {count} times as long"
    fields += f" (level hover; an answer again after {after:.2f} s, by the model)" if after else ""
    violated = ", ".join(change.get("violated", ()))
    return fields + (f" (violates {violated} on its way)" if violated and "why" not in change else "")


def _toml(value: object) -> str:
    """Format a text, a list of numbers, or a table of numbers as in a scenario file."""
    if not isinstance(value, dict):
        return json.dumps(value)
    return f"{{ {', '.join(f'{name} = {number:g}' for name, number in value.items())} }}" if value else "{}"
