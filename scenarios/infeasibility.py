"""Explain why a flight's QP had no answer, in the terms and units of the scenario file, and suggest remedies.

Each suggestion is a change of the file that was tried: the problem is rebuilt from the changed file and solved for the
same period.  Then the changed scenario is flown, from its start to `AFTER` seconds past that period: what does not
prevent the failure is not advised.  These flights are ordinary ones, except that nobody asks them for a diagnosis.
"""

from __future__ import annotations

import json
import math
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from mpc.bounded import Bounded
from mpc.builders import build
from mpc.constrained import Constrained
from mpc.constraints import Origin
from mpc.diagnosis import Conflict, Side, find_conflict, has_answer, recovery, smallest_widening
from mpc.model import SHORTEST_LAG
from mpc.obstacles import SOFT_SPACE
from mpc.ocp import InfeasiblePeriod
from mpc.robust.settings import Robust
from quadsim.errors import InputError
from quadsim.flight.metrics import unrecovered
from quadsim.state import N_STATES, REFERENCE_STATES, Array
from quadsim.vehicle import Vehicle
from scenarios.feasibility_check import hover_notes, hover_speed
from scenarios.schema.base import fields_of
from scenarios.schema.scenario import Scenario
from scenarios.schema.settings import get_field, set_field

if TYPE_CHECKING:
    from scenarios.assembly import Assembly
    from scenarios.flight import Flight

Settings = dict[str, Any]
WIDER: Final = (1.0, 1.02, 1.1, 1.5)
"""The smallest widening, rounded outwards, and larger trials: close to infeasible, solvers give up, and a wider bound
may be tightened by more."""
SOFT: Final[tuple[dict[str, float], ...]] = ({}, {"linear": 1e4}, {"linear": 1e3}, {"linear": 1e2})
"""Penalties of softness, the usual one first; far from feasible, a solver gives up at high ones."""
ITERATIONS: Final = (2, 3, 5, 10, 20, 50, 100)
"""Numbers of iterations to try if sequential quadratic programming did not converge."""
AFTER: Final = 5.0  # flown beyond the first period without an answer [s]
LONGEST: Final = 60.0  # longest flight of a change [s]; what would have to be flown for longer is not flown
MOST_FLOWN: Final = 6  # flights of one diagnosis
LEAVING_FROM, LEAVING_FOR = 1.0, 1.0
"""Distance from the reference [m], and time for which it has grown [s], from which on a vehicle is leaving it."""
RETURNING: Final = 0.9  # violation at the end of a flight, over its largest, up to which it is passing
HOVER_RESERVE: Final = 0.1  # distance of the advised bound on rotor speeds from hover, over hover
_SPEED: Final = "controller.input_bounds.speed"


def diagnose(infeasible_period: InfeasiblePeriod, scenario: Scenario, vehicle: Vehicle) -> dict[str, Any]:
    """Return `diagnosis` of a flight's summary.

    The bounds of a user's own controller are not in a scenario file: the problem names them, and the advice states by
    how much a single one would have to be wider.
    """
    if infeasible_period.converges is not None:
        return _unconverged(infeasible_period, infeasible_period.converges, scenario.controller.iterations)
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


def tried(explanation: Mapping[str, Any], flight: Flight) -> dict[str, Any]:
    """Fly each suggestion of a flight's `diagnose`; return the report with those that prevent the failure as advice.

    `suggestions` are then those with an answer in every period, or the fallback, and a flight that is satisfied as far
    as it goes; if there are none, those that violate constraints (`violated`) on the way back to them, as from a start
    beyond a bound.  The others are in `rejected`, each with a reason `why`.

    A flight with code that was passed in cannot be repeated, nor can one be continued in the middle: where an event had
    changed the controller, or the failure is late, the advice says that it was not flown.
    """
    report, scenario, assembly = {**explanation, "rejected": []}, flight.scenario, flight.assembly
    notes = hover_notes(assembly)
    report["sentence"] = "; ".join([*notes, report["sentence"]])
    lagging = _predicting_lag(scenario, assembly) if report["feasible"] is False else []
    candidates = _reaching_hover(scenario, assembly) if notes else [*lagging, *report["suggestions"]]
    if not candidates:
        return report
    until = min(report["time"] + AFTER, scenario.duration)
    if unflown := _not_flown(flight, report["time"], until):
        report["advice"] = f"to try, not flown, as {unflown}: {'; '.join(map(_change_text, candidates))}"
        return {**report, "suggestions": candidates}
    trials = [_trial(scenario, assembly, change["settings"], until) for change in candidates[:MOST_FLOWN]]
    flown = [{**change, "violated": [*trial.violated]} for change, trial in zip(candidates, trials, strict=False)]
    flying = [change for change, trial in zip(flown, trials, strict=True) if not trial.why]
    kept = [change for change in flying if not change["violated"]] or flying
    reasons = [trial.why or f"violated: {', '.join(trial.violated)}" for trial in trials]
    left = [{**change, "why": why} for change, why in zip(flown, reasons, strict=True) if change not in kept]
    report |= {"suggestions": kept, "rejected": left}
    until_text = f"flown until {until:.4g} s"
    if kept:
        report["advice"] = f"to try, each {until_text}: {'; '.join(map(_change_text, kept))}"
    else:
        failed = "; ".join(f"{_change_text(change)} ({change['why']})" for change in report["rejected"])
        report["advice"] = f"{until_text}, no change prevents it: {failed}"
    return report


def _not_flown(flight: Flight, time: float, until: float) -> str:
    """Say why no change of a flight can be flown; empty if it can."""
    if flight.own_code:
        return "the scenario does not repeat code that was passed in"
    if flight.scenario.controller_at(time) != flight.scenario.controller:
        return "an event had changed the controller"
    return f"it would take more than {LONGEST:g} s of flight" if until > LONGEST else ""


@dataclass(frozen=True, kw_only=True)
class _Trial:
    """The flight of a change."""

    why: str = ""  # why it fails; empty if it does not
    violated: tuple[str, ...] = ()  # required constraints that it violates, while it returns to them


def _trial(scenario: Scenario, assembly: Assembly, settings: Settings, until: float) -> _Trial:
    """Fly a scenario with other fields."""
    from scenarios.rollout import Rollout  # which imports flights, and these this module

    changed = changed_scenario(scenario, settings)
    if changed is None:
        return _Trial(why="the file would be refused")
    try:
        flight = Rollout(assembly.of(changed)).fly(until=until)
    except InputError as error:
        return _Trial(why=str(error))
    if flight.log.interrupted:
        raise KeyboardInterrupt
    unanswered, period = flight.infeasible_period, scenario.control_period
    if flight.log.reason is not None:
        return _Trial(why=f"{flight.outcome} at t = {flight.time.size * period:.4g} s")
    if unanswered is not None and unanswered.converges is None and "controller.fallback" not in settings:
        return _Trial(why=f"no answer at t = {unanswered.time:.4g} s")
    if flight.log.control.crashed or unrecovered(flight.log.control):
        return _Trial(why="crashed" if flight.log.control.crashed else "in fallback to its end")
    distance = np.linalg.norm([flight.state[axis] - flight.reference[axis] for axis in "xyz"], axis=0)
    last = distance[-max(round(LEAVING_FOR / period), 1) - 1 :]
    if last[-1] > LEAVING_FROM and (np.diff(last) > 0.0).all():
        return _Trial(why=f"{last[-1]:.3g} m from the reference at its end, and leaving")
    violated = [each.limit.name for each in flight.findings if each.limit.required and each.verdict == "violated"]
    lasting = [name for name in violated if _lasts(flight.margins[name])]
    return _Trial(why=f"violated: {', '.join(violated)}" if lasting else "", violated=tuple(violated))


def _lasts(margins: Array) -> bool:
    """Return whether a constraint's margins (K,), of which some are negative, end near the worst one."""
    margins = margins[np.isfinite(margins)]
    return bool(margins[-1] < RETURNING * margins.min())


def _predicting_lag(scenario: Scenario, assembly: Assembly) -> list[dict[str, Any]]:
    """Return the change by which a linear MPC predicts the rotors' lag, if it does not and they have one."""
    spec, rotors = scenario.controller, assembly.effects.rotors
    lag = 0.0 if rotors is None else rotors.rise or 0.0
    if not isinstance(spec, Constrained | Robust) or lag < SHORTEST_LAG:
        return []
    if isinstance(spec, Robust) and spec.rotor_lag:
        return []
    law: Settings = {} if isinstance(spec, Robust) else {"controller.type": "robust"}
    soft: Settings = {} if isinstance(spec, Robust) and spec.soft is not None else {"controller.soft": {}}
    return [{"settings": {**law, **soft, "controller.rotor_lag": lag}, "after": None}]


def _reaching_hover(scenario: Scenario, assembly: Assembly) -> list[dict[str, Any]]:
    """Return the change that gives the bound on rotor speeds room about hover, as far as the rotors have it."""
    spec, vehicle, hover = scenario.controller, assembly.vehicle, hover_speed(assembly)
    if not isinstance(spec, Constrained | Robust):
        return []
    lower, upper = spec.input_bounds.speed
    low, high = (float(f"{(1.0 + side * HOVER_RESERVE) * hover:.4g}") for side in (-1.0, 1.0))
    speeds = [max(min(lower, low), vehicle.speed_min), min(max(upper, high), max(upper, vehicle.speed_max))]
    return [{"settings": {_SPEED: speeds}, "after": None}]


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
    advice = never if enough is None else f"to try: {_change_text(suggestions[0])}"
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
        """Yield the violated bounds, the largest share first, and the blocking ones, with times and amounts."""
        delay, period = self._infeasible_period.delay, self._period
        for side, violation in sorted(conflict.violated.items(), key=lambda item: -item[1].share):
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
        law: Settings = {"controller.type": "robust"} if other_law else {}
        return next(filter(self._helps, ({**law, **dict.fromkeys(tables, soft)} for soft in SOFT)), None)

    def _widened(self, amounts: Mapping[str, tuple[set[Side], float]]) -> Settings | None:
        """Return fields with bounds moved outwards by at least these amounts, if that helps."""
        table = tomllib.loads(self._scenario.to_toml())
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
        if spec is None or spec.input_bounds.speed[1] > max(self._vehicle.speed_max, self._spec.input_bounds.speed[1]):
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
        changed, query = self._changed(settings), self._infeasible_period.query
        assert changed is not None
        pilot = build(changed, self._vehicle, self._period)
        guard = pilot.guard
        assert guard is not None
        target = np.zeros(N_STATES)
        target[[*REFERENCE_STATES]] = query.state[[*REFERENCE_STATES]]
        bounds = changed.input_bounds.actuators(self._vehicle)
        plan = guard.hover.plan(
            query.state[:N_STATES], target, query.u_before, bounds, changed.horizon, guard.trim(pilot.law)
        )
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
            least, origin = smallest_widening(self._infeasible_period, sides), self.origin(side)
            if least is not None:
                amount = f"{least * origin.factor:.3g} {origin.unit.replace('-', '')}".rstrip()
                widenings.append(f"{origin.name} {_which(side)} wider by {amount}")
        return f"has an answer with {'; or '.join(widenings)}" if widenings else "no bound alone gives it an answer"


def _which(side: Side) -> str:
    return "upper" if side.upper else "lower"


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
    changes = "; ".join(map(_change_text, report["suggestions"]))
    return f"to try: {changes}" if changes else "no bound alone, nor all of them by as much, gives it an answer"


def _change_text(change: Mapping[str, Any]) -> str:
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
