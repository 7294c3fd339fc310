"""Fly the changes that the explanation of a failure suggests: what does not prevent it is not advised.

Each changed scenario of `quadsim.rollout.infeasibility` is flown from its start to `AFTER` seconds past the period
without an answer.  These flights are ordinary ones, except that nobody asks them for a diagnosis.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, TypeAlias

import numpy as np

from quadsim.errors import InputError
from quadsim.flight.metrics import unrecovered
from quadsim.mpc.laws.constrained import Constrained
from quadsim.mpc.laws.robust import Robust
from quadsim.rollout.flown import Flight
from quadsim.rollout.growth import MeasureGrowth
from quadsim.rollout.infeasibility import Settings, change_text, changed_scenario, fields_text
from quadsim.scenarios.assembly import Assembly
from quadsim.scenarios.feasibility_check import hover_notes, hover_speeds
from quadsim.scenarios.mismatch import modelling_changes, unmodelled, unpredicted, worst_heading
from quadsim.scenarios.schema.scenario import Scenario
from quadsim.state import Array

FlyUntil: TypeAlias = Callable[[Assembly, float], Flight]

AFTER: Final = 5.0  # flown beyond the first period without an answer [s]
LONGEST_TRIAL: Final = 60.0  # longest flight of a change [s]; what would have to be flown for longer is not flown
MOST_FLOWN: Final = 6  # flights of one diagnosis
MOST_PAIRS: Final = 4  # pairs of hovers without what the model lacks, and with changes, each
RETURNING: Final = 0.9  # violation at the end of a flight, over its largest, up to which it is passing
HOVER_RESERVE: Final = 0.1  # distance of the advised bound on rotor speeds from hover, over hover
_CHANGED_CONTROLLER: Final = "an event had changed the controller"
_SPEED: Final = "controller.input_bounds.speed"


def tried(explanation: Mapping[str, Any], flight: Flight, fly: FlyUntil, measure: MeasureGrowth) -> dict[str, Any]:
    """Fly each suggestion of a flight's `diagnose`; return the report with those that prevent the failure as advice.

    `suggestions` are then those with an answer in every period, or the fallback, and a flight that is satisfied as far
    as it goes; if there are none, those that violate constraints (`violated`) on the way back to them, as from a start
    beyond a bound.  The others are in `rejected`, each with a reason `why`.

    Changes by which the model has what the scenario states are flown first.  `loop` has how a push grows with each of
    them, and without each thing that the model lacks; those with which it still grows are not flown further.

    A flight with code that was passed in cannot be repeated, nor can one be continued in the middle: where an event had
    changed the controller, or the failure is late, the advice says that it was not flown.

    Args:
        explanation: of `quadsim.rollout.infeasibility.diagnose`.
        flight: the flight.
        fly: flies an assembly until a time [s].
        measure: measures the loop of a scenario.
    """
    report = {**explanation, "rejected": []}
    scenario = flight.scenario
    assembly = flight.assembly
    notes = hover_notes(assembly)
    report["sentence"] = "; ".join([*notes, report["sentence"]])
    until = min(report["time"] + AFTER, scenario.duration)
    unflown = _not_flown(flight, report["time"], until)
    if notes:
        candidates = _reaching_hover(scenario, assembly)
    else:
        modelling = []
        if flight.controller == scenario.controller.type and unflown != _CHANGED_CONTROLLER:
            modelling = [_change(settings) for settings in modelling_changes(assembly)]
        if modelling and not unflown:
            report["loop"] = _loop_report(assembly, measure)
        others = [change for change in report["suggestions"] if change not in modelling]
        candidates = [*modelling, *others]
    if not candidates:
        return report
    if unflown:
        report["advice"] = f"to try, not flown, as {unflown}: {'; '.join(map(change_text, candidates))}"
        report["suggestions"] = candidates
        return report
    trials = []
    for change in candidates[:MOST_FLOWN]:
        settings = change["settings"]
        growing = _still_grows(settings, report.get("loop", {}))
        if growing:
            trials.append((change, _Trial(why=growing)))
        else:
            trials.append((change, _trial(scenario, assembly, settings, until, fly)))
    kept, rejected = _kept_and_rejected(trials)
    return {**report, "suggestions": kept, "rejected": rejected, "advice": _advice(kept, rejected, until)}


def _change(settings: Settings) -> dict[str, Any]:
    """Return a suggestion of fields."""
    return {"settings": settings, "after": None}


def _kept_and_rejected(
    trials: Sequence[tuple[dict[str, Any], _Trial]],
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Return the changes to advise, and the rejected ones with the reason `why`, each with what it violated."""
    flying = []
    for change, trial in trials:
        if not trial.why:
            flying.append({**change, "violated": [*trial.violated]})
    satisfied = [change for change in flying if not change["violated"]]
    kept = satisfied or flying
    rejected = []
    for change, trial in trials:
        flown = {**change, "violated": [*trial.violated]}
        if flown not in kept:
            why = trial.why or f"violated: {', '.join(trial.violated)}"
            rejected.append({**flown, "why": why})
    return kept, rejected


def _advice(kept: Sequence[Mapping[str, Any]], rejected: Sequence[Mapping[str, Any]], until: float) -> str:
    """Return the advice of flights until a time [s]."""
    if kept:
        return f"to try, each flown until {until:.4g} s: {'; '.join(map(change_text, kept))}"
    failed = "; ".join(f"{change_text(change)} ({change['why']})" for change in rejected)
    return f"flown until {until:.4g} s, no change prevents it: {failed}"


def _not_flown(flight: Flight, time: float, until: float) -> str:
    """Say why no change of a flight can be flown; empty if it can."""
    if flight.own_code:
        return "the scenario does not repeat code that was passed in"
    if flight.scenario.controller_at(time) != flight.scenario.controller:
        return _CHANGED_CONTROLLER
    if until > LONGEST_TRIAL:
        return f"it would take more than {LONGEST_TRIAL:g} s of flight"
    return ""


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
    unanswered = flight.infeasible_period
    if flight.log.reason is not None:
        return _Trial(why=f"{flight.outcome} at t = {flight.time.size * scenario.control_period:.4g} s")
    if unanswered is not None and unanswered.converges is None and "controller.fallback" not in settings:
        return _Trial(why=f"no answer at t = {unanswered.time:.4g} s")
    if flight.log.control.crashed:
        return _Trial(why="crashed")
    if unrecovered(flight.log.control):
        return _Trial(why="in fallback to its end")
    if flight.departure is not None and flight.departure.leaving:
        return _Trial(why=f"{flight.departure.distance:.3g} m off its course at its end, and leaving it")
    violated = []
    for finding in flight.findings:
        if finding.limit.required and finding.verdict == "violated":
            violated.append(finding.limit.name)
    why = ""
    if any(_lasts(flight.margins[name]) for name in violated):
        why = f"violated: {', '.join(violated)}"
    return _Trial(why=why, violated=tuple(violated))


def _lasts(margins: Array) -> bool:
    """Return whether a constraint's margins (K,), of which some are negative, end near the worst one."""
    margins = margins[np.isfinite(margins)]
    return bool(margins[-1] < RETURNING * margins.min())


def _still_grows(settings: Settings, loop: Mapping[str, Any]) -> str:
    """Say that a push was measured to grow with a change, soft bounds or not; empty if it was not."""
    hard = {path: value for path, value in settings.items() if path != "controller.soft"}
    for entry in loop.get("with", ()):
        if entry["settings"] == hard and entry.get("unstable", False):
            return f"in hover a push still {_rate_text(entry)}"
    return ""


def _loop_report(assembly: Assembly, measure: MeasureGrowth) -> dict[str, Any]:
    """Return how a push grows in hover: as stated, without each thing that the model lacks, with each field set.

    Where it does not grow as stated, nothing else is measured.
    """
    scenario = assembly.scenario
    heading = worst_heading(assembly)
    report = {"heading": heading, **_grows(scenario, heading, measure), "without": [], "with": []}
    if _is_stable(report):
        return report
    lacking = unmodelled(assembly)
    effects = unpredicted(assembly)
    for entry in (*lacking, *effects)[:MOST_PAIRS]:
        held_heading = heading
        if entry.quantity == "heading":
            held_heading = 0.0
        grows = _grows(_replaced(scenario, entry.absent), held_heading, measure)
        report["without"].append({"lacks": entry.text, **grows})
    for entry in (*lacking, *effects)[:MOST_PAIRS]:
        report["with"].append(_grows_with(dict(entry.settings), scenario, heading, measure))
    if len(lacking) > 1 and not any(map(_is_stable, report["with"])):
        together: Settings = {}
        for entry in lacking:
            together |= entry.settings
        report["with"].append(_grows_with(together, scenario, heading, measure))
    return {**report, "sentence": _loop_sentence(report)}


def _grows_with(settings: Settings, scenario: Scenario, heading: float, measure: MeasureGrowth) -> dict[str, Any]:
    """Return fields, and how a push grows with them."""
    return {"settings": settings, **_grows(changed_scenario(scenario, settings), heading, measure)}


def _replaced(scenario: Scenario, fields: Mapping[str, Any]) -> Scenario | None:
    """Return a scenario with other fields; None if that would be refused."""
    try:
        return scenario.replace(fields)
    except InputError:
        return None


def _grows(scenario: Scenario | None, heading: float, measure: MeasureGrowth) -> dict[str, Any]:
    """Return whether a push grows, at which rate [1/s], and why a flight ended; nothing where none can be flown."""
    if scenario is None:
        return {}
    try:
        growth = measure(scenario, heading)
    except InputError:
        return {}
    entry: dict[str, Any] = {"unstable": growth.notable}
    if math.isfinite(growth.rate):
        entry["rate"] = growth.rate
    if growth.ended:
        entry["ended"] = growth.ended
    return entry


def _loop_sentence(report: Mapping[str, Any]) -> str:
    """Say that a push grows, and which single thing, taken away or known to the controller, lets it shrink."""
    cures = []
    for entry in report["without"]:
        if _is_stable(entry):
            cures.append(f"without {entry['lacks']} it {_rate_text(entry)}")
    for entry in report["with"]:
        if _is_stable(entry):
            cures.append(f"with {fields_text(entry['settings'])} it {_rate_text(entry)}")
    shown = "; ".join(cures) or "nothing of what the model lacks, taken away or set, changes that"
    return f"in hover a push {_rate_text(report)}; {shown}"


def _is_stable(entry: Mapping[str, Any]) -> bool:
    """Return whether the loop was measured and is stable."""
    return not entry.get("unstable", True)


def _rate_text(entry: Mapping[str, Any]) -> str:
    """Return e.g. `grows at 1.88 1/s`."""
    rate = entry.get("rate")
    if rate is None:
        return f"ends {entry['ended']}"
    if entry["unstable"]:
        return f"grows at {abs(rate):.3g} 1/s"
    return f"shrinks at {abs(rate):.3g} 1/s"


def _reaching_hover(scenario: Scenario, assembly: Assembly) -> list[dict[str, Any]]:
    """Return the change that gives the bound on rotor speeds room about hover, as far as the rotors have it."""
    spec = scenario.controller
    vehicle = assembly.vehicle
    hover = hover_speeds(assembly)
    if not isinstance(spec, Constrained | Robust) or spec.input_bounds is None:
        return []
    lower, upper = spec.input_bounds.speed
    low = float(f"{(1.0 - HOVER_RESERVE) * float(hover.min()):.4g}")
    high = float(f"{(1.0 + HOVER_RESERVE) * float(hover.max()):.4g}")
    lowest = max(min(lower, low), vehicle.speed_min)
    highest = min(max(upper, high), max(upper, vehicle.speed_max))
    return [_change({_SPEED: [lowest, highest]})]
