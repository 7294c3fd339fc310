"""Audit a finished run again: compare its files with their hashes, and its verdict with its tables.

It finds damage and mistakes, ours included: integrity, not authenticity.  Nothing in `summary.json` on the verdict is
trusted: the limits come from the run's `scenario.toml`, the values from its tables.  The recorded audit used every
physics step, but the tables have the plant at the log rate, so there the recorded margin may be smaller, never larger;
at the control samples both use the same numbers.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from quadsim.controller import MISSED
from quadsim.errors import FileError, InputError, printable
from quadsim.flight import metrics, rundir
from quadsim.flight.audit import Finding, audit, margins_at
from quadsim.flight.log import ControlLog, FlightLog, PlantLog, columns_of
from quadsim.flight.parquet import FLIGHT_FILE, HORIZON_FILE, PLANT_FILE, TIMING_FILE
from quadsim.flight.rundir import limit_to_json
from quadsim.rollout.flown import Check, Flight
from quadsim.rollout.stored import read_flight
from quadsim.scenarios.assembly import Assembly
from quadsim.scenarios.schema.scenario import Scenario
from quadsim.scenarios.schema.settings import leaves
from quadsim.sim.computation import physics_steps
from quadsim.sim.effects.rotors import LagChange
from quadsim.state import ANGLES, REFERENCE_NAMES, STATE_NAMES, Array, wrapped

TABLE_FILES: Final = (FLIGHT_FILE, PLANT_FILE, TIMING_FILE)
OURS: Final = {*TABLE_FILES, HORIZON_FILE, rundir.SCENARIO_FILE, rundir.RECORDING_FILE, rundir.VIDEO_FILE}
"""Files that only a run writes under these names."""
ARITHMETIC_TOLERANCE: Final = 1e-9
"""Tolerance for another machine's arithmetic, relative to 1 or to the larger number."""
ROUNDING_TILT: Final = 1e-6  # the same for the tilt: near level, an arc cosine has half of a number's digits
MOST_REPORTED: Final = 6  # differences that one message names
_COMMANDED: Final = tuple(columns_of(ControlLog)["speeds"].units)
_TURNING: Final = tuple(columns_of(PlantLog)["speeds"].units)


def reaudit(directory: Path, *, products: bool = True) -> Flight:
    """Read a finished run, audit it again from its tables, and compare the result with its summary.

    Film, recording and figures must be present if `products` is true; they can be made again.

    Raises:
        FileError: a file is missing, changed or damaged, or the summary contradicts the tables; the message names the
            differences.
    """
    try:
        flight = read_flight(directory)
        assembly = Assembly(flight.scenario)
        again = audit(flight.log, assembly.limits)
    except InputError as error:
        changed = list(_changed(directory, rundir.read_summary(directory), products=products))
        raise _contradiction(directory, changed or [f"it cannot be audited again: {error}"]) from None
    summary = flight.summary
    differing = list(_changed(directory, summary, products=products))
    differing += _inconsistencies(flight)
    differing += _differences(flight, again, assembly.course_steps)
    if differing:
        raise _contradiction(directory, differing)
    notes = []
    unlisted = _unlisted(directory, summary)
    if unlisted:
        shown = ", ".join(unlisted[:MOST_REPORTED])
        if len(unlisted) > MOST_REPORTED:
            shown += " ..."
        notes.append(f"not of this run: {printable(shown)}")
    return replace(flight, checked=Check(notes=tuple(notes), again=again))


def _changed(directory: Path, summary: Mapping[str, Any], *, products: bool) -> Iterator[str]:
    """Yield the files that differ from those written."""
    needed = (*TABLE_FILES, rundir.SCENARIO_FILE)
    for name in rundir.damaged_files(directory, summary):
        if (directory / name).is_file():
            yield f"{name} is not the file that was written"
        elif products or name in (*needed, HORIZON_FILE):
            yield f"{name} is missing"
    for name in needed:
        if name not in summary["files"]:
            yield f"{rundir.SUMMARY_FILE} has no hash of {name}"
    for name in _unlisted(directory, summary):
        if name in OURS and name not in needed:
            yield f"{name} is there, and {rundir.SUMMARY_FILE} does not list it"


def _unlisted(directory: Path, summary: Mapping[str, Any]) -> list[str]:
    """Return files in a run's directory that its summary does not list, sorted."""
    files = set()
    for path in directory.rglob("*"):
        if not path.is_dir():
            files.add(path.relative_to(directory).as_posix())
    return sorted(files - {rundir.SUMMARY_FILE, *summary["files"]})


def _inconsistencies(flight: Flight) -> Iterator[str]:
    """Yield contradictions among a run's tables, or with the scenario's rates."""
    yield from _not_finite(flight.log)
    wrong_times = [*_wrong_times(flight)]
    yield from wrong_times
    if not wrong_times:  # rows of the tables belong together
        yield from _wrong_states(flight)
        yield from _wrong_speeds(flight)


def _not_finite(log: FlightLog) -> Iterator[str]:
    """Yield the columns with entries that are no finite numbers."""
    control = log.control
    plant = log.plant
    for name, columns, rows, t in (
        (FLIGHT_FILE, STATE_NAMES, control.truth, control.t),
        (FLIGHT_FILE, REFERENCE_NAMES, control.reference, control.t),
        (FLIGHT_FILE, _COMMANDED, control.speeds, control.t),
        (PLANT_FILE, STATE_NAMES, plant.state, plant.t),
        (PLANT_FILE, _TURNING, plant.speeds, plant.t),
    ):
        yield from _where(~np.isfinite(rows), columns, t, f"of {name} is no finite number")


def _wrong_times(flight: Flight) -> Iterator[str]:
    """Yield the first table whose rows are not at the times that the scenario's rates give."""
    scenario = flight.scenario
    log = flight.log
    period = scenario.control_period
    periods = log.control.t.size
    plant_rows = periods * scenario.steps_per_period // scenario.plant_stride + 1
    plant_spacing = scenario.plant_stride * scenario.plant.timestep
    for name, t, spacing, expected in (
        (FLIGHT_FILE, log.control.t, period, periods),
        (TIMING_FILE, log.timing.t, period, periods),
        (PLANT_FILE, log.plant.t, plant_spacing, plant_rows),
    ):
        if t.size != expected or (np.abs(t - spacing * np.arange(t.size)) > ARITHMETIC_TOLERANCE).any():
            yield f"{name} does not have the {expected} times k * {spacing:g} s"
            return


def _wrong_states(flight: Flight) -> Iterator[str]:
    """Yield the states that differ between the tables, where a control period starts with a row of the plant."""
    control = flight.log.control
    starts = flight.scenario.steps_per_period * np.arange(control.t.size)
    stride = flight.scenario.plant_stride
    common = np.flatnonzero(starts % stride == 0)
    difference = control.truth[common] - flight.log.plant.state[starts[common] // stride]
    difference[:, ANGLES] = wrapped(difference[:, ANGLES])
    what = f"differs between {FLIGHT_FILE} and {PLANT_FILE}"
    yield from _where(np.abs(difference) > ROUNDING_TILT, STATE_NAMES, control.t[common], what)


def _wrong_speeds(flight: Flight) -> Iterator[str]:
    """Yield the rotors that do not turn at their commanded speed, where rotors have no lag."""
    scenario = flight.scenario
    plant = flight.log.plant
    if not _holds_commands(scenario):
        return
    starts = np.arange(plant.t.size - 1) * scenario.plant_stride  # the last row ends the flight
    commanded, known = _in_force(scenario, flight.log.control, starts)
    if scenario.plant.limit_speeds:
        applied = np.clip(commanded, flight.actual.speed_min, flight.actual.speed_max)
    else:
        applied = np.clip(commanded, 0.0, None)
    tolerance = ARITHMETIC_TOLERANCE * np.maximum(1.0, applied)
    wrong = (np.abs(applied - plant.speeds[:-1]) > tolerance) & known[:, None]
    yield from _where(wrong, _TURNING, plant.t, f"of {PLANT_FILE} is not the speed that {FLIGHT_FILE} commands")


def _where(wrong: np.ndarray[Any, np.dtype[np.bool_]], columns: Sequence[str], t: Array, what: str) -> Iterator[str]:
    """Yield the columns with errors, each with the first time of one."""
    for i in np.flatnonzero(wrong.any(axis=0)).tolist():
        yield f"{columns[i]} at t = {t[np.argmax(wrong[:, i])]:g} s {what}"


def _in_force(
    scenario: Scenario, control: ControlLog, at: NDArray[np.int64]
) -> tuple[Array, np.ndarray[Any, np.dtype[np.bool_]]]:
    """Return the commands in force (M, 4) [rad/s] at physics steps (M,), and where the tables have them (M,).

    They do not have the steps of a plan that bridge the time from when a command is due to when it arrives.
    """
    timestep = scenario.plant.timestep
    starts = scenario.steps_per_period * np.arange(control.t.size)
    due = starts
    if scenario.computation is not None:
        due = starts + physics_steps(scenario.computation.delay, timestep)
    waits = [physics_steps(delay, timestep) for delay in control.delay.tolist()]
    missed = [status == MISSED for status in control.status]  # their rows have what acts from when they were due
    arrives = np.where(missed, due, starts + np.array(waits, dtype=np.int64))
    planning = _bridges_delays(scenario, control.t)
    coming = np.searchsorted(arrives, at, side="right")
    unknown_from = np.append(np.where(planning, due, math.inf), math.inf)
    return np.vstack([control.speeds_before, control.speeds])[coming], at < unknown_from[coming]


def _bridges_delays(scenario: Scenario, t: Array) -> np.ndarray[Any, np.dtype[np.bool_]]:
    """Return (K,) whether steps of a plan bridge the wait for the command in the periods that start at t (K,) [s]."""
    assembly = Assembly(scenario)
    controllers = [(0.0, scenario.controller), *scenario.controller_changes]
    plans = []
    for _, spec in controllers:
        computation = assembly.computation(spec)
        plans.append(computation is not None and bool(computation.plan))
    changes = [time for time, _ in controllers]
    in_command = np.searchsorted(changes, t + ARITHMETIC_TOLERANCE, side="right") - 1
    return np.array(plans)[in_command]


def _holds_commands(scenario: Scenario) -> bool:
    """Return whether the rotors turn at the commanded speeds throughout each period."""
    changed = [spec for _, spec in scenario.controller_changes]
    commands_held = all(spec.holds_speeds for spec in (scenario.controller, *changed))
    lagging = any(isinstance(event, LagChange) for event in scenario.events)
    return commands_held and not lagging and Assembly(scenario).effects.rotors is None


def _differences(flight: Flight, findings: Sequence[Finding], course: Sequence[metrics.CourseStep]) -> Iterator[str]:
    """Yield differences of a flight's summary from its scenario, its tables and the audit made of them."""
    summary = flight.summary
    yield from _wrong_outline(flight)
    deadline_ms = 1e3 * flight.scenario.control_period
    numbers = metrics.flight_numbers(flight.log, deadline_ms=deadline_ms, course=course)
    recorded = dict(leaves({key: summary[key] for key in numbers}))
    for key, again in leaves(numbers):
        yield from _recorded(key, recorded.get(key, again), again, "the tables give", ARITHMETIC_TOLERANCE)
    names = [entry["name"] for entry in summary["constraints"]]
    expected = [finding.limit.name for finding in findings]
    if names != expected:
        yield f"the constraints recorded are {', '.join(names) or 'none'}, and the scenario's {', '.join(expected)}"
        return
    for entry, written, finding in zip(summary["constraints"], flight.findings, findings, strict=True):
        for difference in _constraint_differences(entry, finding, flight.scenario, flight.log):
            yield f"{finding.limit.name}: {difference}"
        implied = written.verdict
        if entry["satisfied"] != written.satisfied or entry.get("verdict", implied) != implied:
            yield f"{entry['name']}: satisfied is {entry['satisfied']}, and its worst margins say {implied}"
    yield from _wrong_verdict(flight)


def _wrong_outline(flight: Flight) -> Iterator[str]:
    """Yield what a summary states wrongly of the scenario, and of how much of it was flown."""
    summary = flight.summary
    scenario = flight.scenario
    periods = flight.log.control.t.size
    duration = round(periods * scenario.control_period, 9)
    stated = {"scenario": scenario.name, "seed": scenario.seed, "expected": scenario.expect, "duration": duration}
    for key, again in stated.items():
        yield from _recorded(key, summary.get(key, again), again, "the run's files give")
    completed = summary["status"] == "completed"
    if completed and periods != scenario.periods:
        yield f"status is recorded as 'completed', and {periods} of {scenario.periods} periods were flown"
    reason = summary["reason"]
    if completed != (reason is None):
        yield f"status is recorded as {summary['status']!r:.40}, and reason as {reason!r:.80}"


def _wrong_verdict(flight: Flight) -> Iterator[str]:
    """Yield what of a summary's verdict does not follow from the audit and the outcome that it records."""
    summary = flight.summary
    outcome = flight.outcome
    expected = flight.scenario.expect
    yield from _recorded("satisfied", summary["satisfied"], outcome == "satisfied", "its audit and outcome make it")
    yield from _recorded("verdict", summary["verdict"], outcome, "its audit and outcome make it")
    if summary.get("as_expected") and outcome != expected:
        yield f"as_expected is recorded as True, and the flight is {outcome} where {expected} is expected"


def _recorded(key: str, before: Any, again: Any, source: str, rounding: float = 0.0) -> Iterator[str]:
    """Yield a message if a recorded value differs by more than rounding."""
    numbers = isinstance(before, int | float) and isinstance(again, int | float)
    if before != again and not (numbers and math.isclose(before, again, rel_tol=rounding, abs_tol=rounding)):
        yield f"{key} is recorded as {before!r:.80}, and {source} {again!r:.80}"


_STATED: Final = (
    "signal", "terms", "shape", "radius", "unit", "lower", "upper", "tolerance", "tolerance_sampled", "required",
    "start", "stop",
)  # fmt: skip
"""The scenario's fields of a constraint."""


def _constraint_differences(
    entry: Mapping[str, Any], finding: Finding, scenario: Scenario, log: FlightLog
) -> Iterator[str]:
    """Yield differences of a summary from the tables in one constraint."""
    again = limit_to_json(finding)
    limit = finding.limit
    for key in _STATED:
        if entry.get(key) != again.get(key):
            yield f"{key} is recorded as {entry.get(key)!r:.80}, and is {again.get(key)!r:.80} in the scenario"
    rounding = ARITHMETIC_TOLERANCE
    if limit.signal == "tilt":
        rounding = ROUNDING_TILT
    for key in ("peak_sampled", "worst_margin_sampled"):
        yield from _recorded(key, entry[key], again[key], "the tables give", rounding)
    has_every_value = limit.source.plant is None or scenario.plant_stride == 1 or not log.control.t.size
    if has_every_value:
        for key in ("peak_plant", "worst_margin"):
            yield from _recorded(key, entry[key], again[key], "the tables give", rounding)
        if not _is_worst_time(entry["worst_time"], finding, log):
            yield f"worst_time is recorded as {entry['worst_time']!r:.40}, and the tables give {again['worst_time']}"
    margin = entry["worst_margin"]
    margin_again = again["worst_margin"]
    if not has_every_value and _is_milder(margin, margin_again, rounding):
        yield f"worst_margin is recorded as {margin}, and the tables go down to {margin_again:.6g}"
    yield from _wrong_peak(entry, finding, rounding)
    beyond = margin is not None and limit.violated(margin)
    least, most = _time_beyond(finding, scenario, log)
    recorded = entry["time_violated"]
    if (recorded > 0.0 and not beyond) or not least <= recorded <= most:
        yield f"time_violated is recorded as {recorded}, and the tables give {again['time_violated']:.6g}"


def _is_milder(recorded: float | None, again: float | None, rounding: float) -> bool:
    """Return whether a recorded worst margin is larger than that of the tables, by more than rounding."""
    if again is None:
        return False
    return recorded is None or recorded > again + rounding * max(1.0, abs(again))


def _wrong_peak(entry: Mapping[str, Any], finding: Finding, rounding: float) -> Iterator[str]:
    """Yield a message if a constraint's recorded peak does not have its recorded worst margin."""
    limit = finding.limit
    peak = "peak_plant"
    if limit.source.plant is None:
        peak = "peak_sampled"
    margin = entry["worst_margin"]
    if margin is None:
        return
    at_peak = None
    if entry[peak] is not None:
        at_peak = float(limit.margin(np.array([entry[peak]]))[0])
    if at_peak is None or not -rounding <= at_peak - margin <= limit.tie:  # of tied peaks the first is recorded
        yield from _recorded("worst_margin", margin, at_peak, f"by its {peak}", rounding)


def _is_worst_time(recorded: float | None, finding: Finding, log: FlightLog) -> bool:
    """Return whether the margin is tied with the smallest at this time [s]; earlier versions recorded another of them.

    `log` has every value of the limit's signal.
    """
    if recorded is None or math.isnan(finding.worst_time):
        return recorded is None and math.isnan(finding.worst_time)
    limit = finding.limit
    t, values = limit.source.finest(log)
    margin = margins_at(limit, t, values)[np.isclose(t, recorded, rtol=0.0, atol=ARITHMETIC_TOLERANCE)]
    return bool((margin <= finding.worst_margin + limit.tie).any() or np.isnan(margin).any())


def _time_beyond(finding: Finding, scenario: Scenario, log: FlightLog) -> tuple[float, float]:
    """Return the least and the most time beyond a bound and its tolerance that the tables allow [s].

    Rows at the log rate cover at least one physics step each, and the last of them may come before the end.
    """
    limit = finding.limit
    signal = limit.source
    row = 0.0
    if scenario.plant_stride > 1:
        row = 1.0 / scenario.log_rate
    if signal.plant is None or not log.control.t.size or scenario.plant_stride == 1:
        time = finding.time_violated
        return time - ARITHMETIC_TOLERANCE, time + row + ARITHMETIC_TOLERANCE
    t = log.plant.t[:-1]  # the last row ends the flight, and lasts no time
    beyond = limit.excess(limit.margin(signal.plant(log.plant)))[:-1] > ROUNDING_TILT
    rows = np.count_nonzero(limit.holds_at(t) & beyond)
    return max(0.0, (rows - 1) * scenario.plant.timestep), math.inf


def _contradiction(directory: Path, differing: Sequence[str]) -> FileError:
    """Return the error that names the first differences."""
    shown = printable("; ".join(differing[:MOST_REPORTED]))
    if len(differing) > MOST_REPORTED:
        shown += f"; and {len(differing) - MOST_REPORTED} more"
    return FileError(directory, f"is not as it was written: {shown}")
