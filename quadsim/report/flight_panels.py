"""Panels over time, of one flight or several: a signal with its bounds, a margin, an error or a computation time."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np

from quadsim.errors import InputError
from quadsim.flight.audit import SIGNALS, TERM_SIGNALS, Limit, Signal, margins_at
from quadsim.flight.log import ControlLog
from quadsim.flight.metrics import percentiles
from quadsim.flight.record import FlightRecord
from quadsim.palette import COLOUR, CYCLE, line_colour
from quadsim.report.comparison import distinct_courses, run_names
from quadsim.report.figure import (
    Band,
    Bound,
    Panel,
    Series,
    bounds_of,
    break_at_wraps,
    reference_curve,
)
from quadsim.state import REFERENCE_NAMES, STATE_NAMES, Array

REFERENCE_LOOK: Final[dict[str, Any]] = {
    "colour": COLOUR.reference,
    "label": "reference, filtered",
    "dashed": True,
    "width": 1.1,
}
MARGIN_PREFIX: Final = "margin."  # prefix of a constraint's name: its margin
CLOCKS: Final = {"step_ms": "whole step", "solve_ms": "optimum alone"}  # columns of `timing.parquet`


def signal_panel(runs: Sequence[FlightRecord], name: str) -> Panel:
    """Plot a signal of the audit with reference and bounds; for a single run also the measured state if it differs.

    What every rotor has is a curve per rotor for a single run, and for several the range over the rotors of each.
    """
    signal = {**TERM_SIGNALS, **SIGNALS}[name]
    title = name
    curves = []
    bands = []
    if name in REFERENCE_NAMES:
        for run in distinct_courses(runs):
            control = run.log.control
            curves.append(Series(x=control.t, y=reference_curve(control, name), **REFERENCE_LOOK))
    for i, label, run in flown_runs(runs):
        control = run.log.control
        if len(runs) == 1 and name in STATE_NAMES and not control.measured_perfectly:
            curves.append(_measured_curve(control, signal))
        sampled = signal.sampled(control)
        if sampled.ndim == 2 and len(runs) > 1:
            title = f"{name}, all rotors"
            low = sampled.min(axis=1)
            high = sampled.max(axis=1)
            bands.append(Band(x=control.t, low=low, high=high, colour=line_colour(i), label=label, opacity=0.6))
        elif sampled.ndim == 2:
            curves += _rotor_curves(label, control.t, sampled)
        elif signal.plant is not None:
            t, values = break_at_wraps(run.log.plant.t, signal.plant(run.log.plant), signal.unit)
            curves.append(run_curve(i, label, t, values))
        else:
            curves.append(run_curve(i, label, control.t, sampled, style="steps"))
    if name in SIGNALS:
        bounds = bounds_on(runs, name)
    else:
        bounds = bounds_on(runs, "speed")
    return Panel(title=title, unit=signal.unit, series=tuple(curves), bands=tuple(bands), bounds=bounds)


def _measured_curve(control: ControlLog, signal: Signal) -> Series:
    """Plot a signal of the state as measured."""
    measured = signal.sampled(replace(control, truth=control.state))
    t, values = break_at_wraps(control.t, measured, signal.unit)
    return Series(x=t, y=values, colour=COLOUR.measured, label="measured", width=0.7)


def _rotor_curves(label: str, t: Array, values: Array) -> list[Series]:
    """Plot values (K, 4) of a single run, a curve per rotor; equal ones stay visible beneath one another."""
    curves = []
    for j, column in enumerate(values.T):
        curve = run_curve(0, label, t, column, style="steps")
        curves.append(replace(curve, colour=line_colour(j), label=f"rotor {j + 1}", width=2.2 - 0.5 * j))
    return curves


def clock_panel(runs: Sequence[FlightRecord], key: str) -> Panel:
    """Plot a computation time per period, and the deadline of a whole step."""
    curves = []
    deadlines = set()
    title = CLOCKS[key]
    for i, label, run in flown_runs(runs):
        values = getattr(run.log.timing, key)
        # a clock may read 0, which a logarithmic axis cannot show
        shown = np.where(values > 0.0, values, np.nan)
        curves.append(run_curve(i, label, run.log.timing.t, shown, style="points", width=2.0))
        if len(runs) == 1:
            spent = percentiles(values)
            title = f"{title}: median {spent['p50']:.3g}, p99 {spent['p99']:.3g}, max {spent['max']:.3g}"
        if key == "step_ms":
            deadlines.add(float(run.numbers["controller"]["deadline_ms"]))
    bounds = tuple(Bound(value=deadline, start=0.0, stop=last_time(runs)) for deadline in sorted(deadlines))
    return Panel(title=title, y_label="time [ms]", y_log=True, series=tuple(curves), bounds=bounds)


def error_panel(runs: Sequence[FlightRecord], name: str) -> Panel:
    """Plot the distance of the true position from the filtered reference."""
    curves = []
    for i, label, run in flown_runs(runs):
        control = run.log.control
        distance = np.linalg.norm(control.tracking_error[:, :3], axis=1)
        curves.append(run_curve(i, label, control.t, distance))
    return Panel(title="position error", unit="m", series=tuple(curves))


def margin_panel(runs: Sequence[FlightRecord], name: str) -> Panel:
    """Plot the signed margin to a constraint, negative beyond its bound, at the highest rate of its signal."""
    curves = []
    units = []
    for i, label, run in flown_runs(runs):
        for limit in run.limits:
            if f"{MARGIN_PREFIX}{limit.name}" != name:
                continue
            t, values = limit.source.finest(run.log)
            margins = margins_at(limit, t, values)
            if limit.source.plant is None:
                curves.append(run_curve(i, label, t, margins, style="steps"))
            else:
                curves.append(run_curve(i, label, t, margins))
            units.append(limit.unit)
    bound = Bound(value=0.0, start=0.0, stop=last_time(runs))
    title = f"margin of {name.removeprefix(MARGIN_PREFIX)}"
    return Panel(title=title, unit=_one_unit(name, units), series=tuple(curves), bounds=(bound,))


def logged_panel(runs: Sequence[FlightRecord], name: str) -> Panel:
    """Plot a signal that the controller logged."""
    curves = []
    units = []
    for i, label, run in flown_runs(runs):
        control = run.log.control
        if name in control.logged:
            unit, values = control.logged[name]
            curves.append(run_curve(i, label, control.t, values))
            units.append(unit)
    return Panel(title=name, unit=_one_unit(name, units), series=tuple(curves))


def _one_unit(name: str, units: Sequence[str]) -> str:
    """Return the unit that the runs have in common; none without a run."""
    distinct = list(dict.fromkeys(units))
    if len(distinct) > 1:
        shown = " and ".join(f"[{unit}]" for unit in distinct)
        raise InputError(f"{name} is in {shown}, which one axis cannot show; plot these flights apart")
    if distinct:
        return distinct[0]
    return ""


def target_panel(run: FlightRecord, name: str, target: Array, title: str) -> Panel:
    """Plot a signal as flown, and its target, in the unit of the signal."""
    signal = SIGNALS[name]
    t, flown = signal.finest(run.log)
    curves = (
        Series(x=t, y=flown, colour=COLOUR.flown, label="flown"),
        Series(x=run.log.control.t, y=target, colour=COLOUR.reference, label="target", style="steps"),
    )
    return Panel(title=title, unit=signal.unit, series=curves, bounds=bounds_on([run], name), legend=True)


def rotor_panel(rotor: int, t: Array, commanded: Array, speeds: Array) -> Panel:
    """Plot commanded and actual speed of a rotor."""
    command = Series(x=t, y=commanded[:, rotor], colour=COLOUR.reference, label="commanded", style="steps", width=1.0)
    actual = Series(x=t, y=speeds[:, rotor], colour=COLOUR.flown, label="actual", width=1.0)
    return Panel(title=f"rotor {rotor + 1}", unit=SIGNALS["speed"].unit, series=(command, actual))


def curves_panel(title: str, unit: str, t: Array, values: Array, names: Sequence[str]) -> Panel:
    """Plot curves (M, n) in one panel with its own legend."""
    first = 4 - len(names)  # x, y and z have the same colours with and without w
    curves = []
    for i, (name, column) in enumerate(zip(names, values.T, strict=True)):
        curves.append(Series(x=t, y=column, colour=line_colour(first + i), label=name, width=1.0))
    return Panel(title=title, unit=unit, series=tuple(curves), legend=True)


def run_curve(i: int, label: str, x: Array, y: Array, **looks: Any) -> Series:
    """Return a curve of the i-th run; where the colours repeat, it is dashed."""
    dashed = i // len(CYCLE) % 2 == 1
    return Series(x=x, y=y, colour=line_colour(i), label=label, group=f"run{i}", dashed=dashed, **looks)


def flown_runs(runs: Sequence[FlightRecord]) -> Iterator[tuple[int, str, FlightRecord]]:
    """Yield number, name and run of runs that flew a period; a single run without a label is named `flight`."""
    names: tuple[str, ...]
    if len(runs) == 1 and runs[0].label is None:
        names = ("flight",)
    else:
        names = run_names(runs)
    for i, (name, run) in enumerate(zip(names, runs, strict=True)):
        if run.log.control.t.size:
            yield i, name, run


def bounds_on(runs: Sequence[FlightRecord], signal: str) -> tuple[Bound, ...]:
    """Return the distinct bounds of all runs on a signal."""
    limits = list[Limit]()
    for run in runs:
        limits += run.limits
    bounds = []
    for value, start, stop in bounds_of(limits, signal, last_time(runs)):
        bounds.append(Bound(value=value, start=start, stop=stop))
    return tuple(bounds)


def last_time(runs: Sequence[FlightRecord]) -> float:
    """Return when the longest of the flights ended [s]."""
    return max(run.end for run in runs)
