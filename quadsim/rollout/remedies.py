"""Fly the changes that the explanation of a failure suggests: what does not prevent it is not advised.

Each changed scenario is flown from its start to `AFTER` seconds past the period without an answer.  These flights are
ordinary ones, except that nobody asks them for a diagnosis.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final, TypeAlias

import numpy as np

from quadsim.errors import InputError
from quadsim.flight.metrics import unrecovered
from quadsim.mpc.laws.constrained import Constrained
from quadsim.mpc.laws.robust import Robust
from quadsim.rollout.flown import Flight
from quadsim.rollout.infeasibility import Settings, change_text, changed_scenario
from quadsim.scenarios.assembly import Assembly
from quadsim.scenarios.feasibility_check import hover_notes, hover_speeds
from quadsim.scenarios.mismatch import unmodelled
from quadsim.scenarios.schema.scenario import Scenario
from quadsim.state import Array

FlyUntil: TypeAlias = Callable[[Assembly, float], Flight]

AFTER: Final = 5.0  # flown beyond the first period without an answer [s]
LONGEST_TRIAL: Final = 60.0  # longest flight of a change [s]; what would have to be flown for longer is not flown
MOST_FLOWN: Final = 6  # flights of one diagnosis
RETURNING: Final = 0.9  # violation at the end of a flight, over its largest, up to which it is passing
HOVER_RESERVE: Final = 0.1  # distance of the advised bound on rotor speeds from hover, over hover
_SPEED: Final = "controller.input_bounds.speed"


def tried(explanation: Mapping[str, Any], flight: Flight, fly: FlyUntil) -> dict[str, Any]:
    """Fly each suggestion of a flight's `diagnose`; return the report with those that prevent the failure as advice.

    `suggestions` are then those with an answer in every period, or the fallback, and a flight that is satisfied as far
    as it goes; if there are none, those that violate constraints (`violated`) on the way back to them, as from a start
    beyond a bound.  The others are in `rejected`, each with a reason `why`.

    A flight with code that was passed in cannot be repeated, nor can one be continued in the middle: where an event had
    changed the controller, or the failure is late, the advice says that it was not flown.

    Args:
        explanation: of `quadsim.rollout.infeasibility.diagnose`.
        flight: the flight.
        fly: flies an assembly until a time [s].
    """
    report, scenario, assembly = {**explanation, "rejected": []}, flight.scenario, flight.assembly
    notes = hover_notes(assembly)
    report["sentence"] = "; ".join([*notes, report["sentence"]])
    modelling = _modelling(scenario, assembly) if report["feasible"] is False else []
    candidates = _reaching_hover(scenario, assembly) if notes else [*modelling, *report["suggestions"]]
    if not candidates:
        return report
    until = min(report["time"] + AFTER, scenario.duration)
    if unflown := _not_flown(flight, report["time"], until):
        report["advice"] = f"to try, not flown, as {unflown}: {'; '.join(map(change_text, candidates))}"
        return {**report, "suggestions": candidates}
    trials = [_trial(scenario, assembly, change["settings"], until, fly) for change in candidates[:MOST_FLOWN]]
    flown = [{**change, "violated": [*trial.violated]} for change, trial in zip(candidates, trials, strict=False)]
    flying = [change for change, trial in zip(flown, trials, strict=True) if not trial.why]
    kept = [change for change in flying if not change["violated"]] or flying
    reasons = [trial.why or f"violated: {', '.join(trial.violated)}" for trial in trials]
    left = [{**change, "why": why} for change, why in zip(flown, reasons, strict=True) if change not in kept]
    report |= {"suggestions": kept, "rejected": left}
    until_text = f"flown until {until:.4g} s"
    if kept:
        report["advice"] = f"to try, each {until_text}: {'; '.join(map(change_text, kept))}"
    else:
        failed = "; ".join(f"{change_text(change)} ({change['why']})" for change in report["rejected"])
        report["advice"] = f"{until_text}, no change prevents it: {failed}"
    return report


def _not_flown(flight: Flight, time: float, until: float) -> str:
    """Say why no change of a flight can be flown; empty if it can."""
    if flight.own_code:
        return "the scenario does not repeat code that was passed in"
    if flight.scenario.controller_at(time) != flight.scenario.controller:
        return "an event had changed the controller"
    return f"it would take more than {LONGEST_TRIAL:g} s of flight" if until > LONGEST_TRIAL else ""


@dataclass(frozen=True, kw_only=True)
class _Trial:
    """The flight of a change."""

    why: str = ""  # why it fails; empty if it does not
    violated: tuple[str, ...] = ()  # required constraints that it violates, while it returns to them


def _trial(scenario: Scenario, assembly: Assembly, settings: Settings, until: float, fly: FlyUntil) -> _Trial:
    """Fly a scenario with other fields."""
    changed = changed_scenario(scenario, settings)
    if changed is None:
        return _Trial(why="the file would be refused")
    try:
        flight = fly(assembly.of(changed), until)
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
    if flight.departure is not None and flight.departure.leaving:
        return _Trial(why=f"{flight.departure.distance:.3g} m off its course at its end, and leaving it")
    violated = [each.limit.name for each in flight.findings if each.limit.required and each.verdict == "violated"]
    lasting = [name for name in violated if _lasts(flight.margins[name])]
    return _Trial(why=f"violated: {', '.join(violated)}" if lasting else "", violated=tuple(violated))


def _lasts(margins: Array) -> bool:
    """Return whether a constraint's margins (K,), of which some are negative, end near the worst one."""
    margins = margins[np.isfinite(margins)]
    return bool(margins[-1] < RETURNING * margins.min())


def _modelling(scenario: Scenario, assembly: Assembly) -> list[dict[str, Any]]:
    """Return the changes by which a linear MPC has what the scenario states and its model lacks.

    All together come first, then each alone; with soft bounds, as a state that the old model led to may lie beyond hard
    ones, and a heading without them as well.
    """
    spec = scenario.controller
    if not isinstance(spec, Constrained | Robust):
        return []
    lacking = [dict(entry.settings) for entry in unmodelled(assembly) if entry.settings]
    if not lacking:
        return []
    law: Settings = {} if isinstance(spec, Robust) else {"controller.type": "robust"}
    soft: Settings = {} if isinstance(spec, Robust) and spec.soft is not None else {"controller.soft": {}}
    together: dict[str, Any] = {}
    for settings in lacking:
        together |= settings
    changes: list[Settings] = [{**law, **soft, **together}]
    if len(lacking) > 1:
        changes += [{**law, **soft, **settings} for settings in lacking]
    if soft and "controller.heading" in together:
        changes.append({**law, "controller.heading": True})
    return [{"settings": settings, "after": None} for settings in changes]


def _reaching_hover(scenario: Scenario, assembly: Assembly) -> list[dict[str, Any]]:
    """Return the change that gives the bound on rotor speeds room about hover, as far as the rotors have it."""
    spec, vehicle, hover = scenario.controller, assembly.vehicle, hover_speeds(assembly)
    if not isinstance(spec, Constrained | Robust):
        return []
    lower, upper = spec.input_bounds.speed
    ends = (-1.0, float(hover.min())), (1.0, float(hover.max()))
    low, high = (float(f"{(1.0 + side * HOVER_RESERVE) * speed:.4g}") for side, speed in ends)
    speeds = [max(min(lower, low), vehicle.speed_min), min(max(upper, high), max(upper, vehicle.speed_max))]
    return [{"settings": {_SPEED: speeds}, "after": None}]
