"""Figures of flights: one flight in the colours of its rotors and axes, or several overlaid in one colour each."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from quadsim.errors import InputError, UnknownNameError
from quadsim.flight.audit import SIGNALS, TERM_SIGNALS, Limit, Signal, SpaceLimit, margins_at
from quadsim.flight.log import ControlLog
from quadsim.flight.metrics import percentiles
from quadsim.flight.record import FlightRecord
from quadsim.palette import COLOUR, CYCLE, line_colour
from quadsim.report.comparison import distinct_courses, run_names
from quadsim.report.figure import (
    LEAST_SPANS,
    Area,
    Band,
    Bound,
    Figure,
    Panel,
    Scene,
    Series,
    bounds_of,
    break_at_wraps,
    commanded_speeds,
    effect_curves,
    extent,
    has_space,
    obstacles_in,
    outlines,
    reference_curve,
    region_edges,
)
from quadsim.report.to_matplotlib import write_pngs
from quadsim.space import Obstacle
from quadsim.state import POSITION, REFERENCE_NAMES, STATE_NAMES, Array
from quadsim.vehicle import N_ROTORS

PAPER_FIGURES: Final = {
    "paper-unconstrained": ("figure2_", "figure3_"),
    "paper-constrained": ("figure4_", "figure5_"),
}
"""Prefixes of the keys of the state and input figures, by scenario: their numbers in the paper."""
_REFERENCE: Final[dict[str, Any]] = {
    "colour": COLOUR.reference,
    "label": "reference, filtered",
    "dashed": True,
    "width": 1.1,
}
_MARGIN: Final = "margin."  # prefix of a constraint's name: its margin
_PanelOf = Callable[[Sequence[FlightRecord], str], Panel]  # of the signal of a name
_CLOCKS: Final = {"step_ms": "whole step", "solve_ms": "optimum alone"}  # columns of `timing.parquet`
_NEAR_CLEARANCE: Final = 3.0
"""Clearance [m] below which a moving obstacle is drawn; upper limit of the curves."""
_LEAST_MOTION: Final = 0.1  # smallest span of a course [m] that counts as motion along an axis
_OUTLINE_PERIOD: Final = 0.25  # time between the outlines of a moving obstacle [s]
_MOST_NAMED: Final = 9  # largest number of obstacles and regions named in the legend
_DIRECTIONS: Final = 300  # number of directions that sample the hull of a solid


def write_figures(run: FlightRecord, directory: Path) -> list[Path]:
    """Write the figures of one run as PNG; none if no control period was flown.

    The two scenarios of the paper carry its figure numbers in their file names, e.g. `figure4_states.png`.

    Raises:
        OutputError: the directory cannot be written.
    """
    if not run.log.control.t.size:
        return []
    name = run.name
    if run.log.reason is not None:
        name = f"{name} (aborted)"
    prefixes = dict(zip(("states", "inputs"), PAPER_FIGURES.get(run.name, ("", "")), strict=True))
    figures = []
    for figure in (states([run]), inputs([run]), *targets(run), times([run]), *effects(run), *space(run), *xy(run)):
        key = prefixes.get(figure.key, "") + figure.key
        figures.append(replace(figure, key=key, title=f"{name}: {figure.title}"))
    return write_pngs(figures, directory)


def page_figures(runs: Sequence[FlightRecord]) -> list[Figure | Scene]:
    """Return a page's figures of the runs that flew at least one control period."""
    if not any(run.log.control.t.size for run in runs):
        return []
    figures: list[Figure | Scene] = [states(runs), inputs(runs), times(runs)]
    if len(runs) == 1:
        figures += [*targets(runs[0]), *effects(runs[0]), *space(runs[0]), *xy(runs[0])]
    return [*figures, path(runs)]


def overview(runs: Sequence[FlightRecord]) -> Figure:
    """Plot position, roll, pitch and rotor speeds of runs."""
    return replace(signals(runs, ("x", "roll", "y", "pitch", "z", "speed")), key="comparison", columns=2)


def signals(runs: Sequence[FlightRecord], names: Sequence[str]) -> Figure:
    """Plot one panel per name over time, each with all runs that have it.

    Args:
        runs: the flights, one colour each; a single one has the colours of its rotors.
        names: signals of the audit (`x`, `tilt`, `x_error`, `slew`, ...); `speed_1` .. `speed_4`, the acting speed of
            one rotor; `command`, the commanded speeds; `margin.NAME`, the signed margin to a constraint; `error`, the
            distance from the filtered reference; `step_ms` and `solve_ms`, the time of the whole controller step and
            of the solver alone; `xy`, the paths from above; what a controller logged.

    Raises:
        UnknownNameError: no run has such a signal.
        InputError: runs have it in different units.
    """
    known = _panels(runs)
    for name in names:
        if name not in known:
            is_margin = name.startswith(_MARGIN)
            alike = [other for other in known if other.startswith(_MARGIN) == is_margin]
            raise UnknownNameError("signal", name, alike)
    panels = tuple(known[name](runs, name) for name in names)
    return _timed("signals", "", panels, runs, columns=1)


def _panels(runs: Sequence[FlightRecord]) -> dict[str, _PanelOf]:
    """What `signals` can plot of these runs: the panel of each name."""
    panels: dict[str, _PanelOf] = {}
    for run in runs:
        panels.update(dict.fromkeys(run.log.control.logged, _logged))
    for run in runs:
        for limit in run.limits:
            panels[f"{_MARGIN}{limit.name}"] = _margin
    panels.update(dict.fromkeys(_CLOCKS, _clock))
    panels["error"] = _error
    panels["command"] = _command
    panels["xy"] = _paths
    panels.update(dict.fromkeys((*SIGNALS, *TERM_SIGNALS), _signal))
    return panels


def states(runs: Sequence[FlightRecord]) -> Figure:
    """Plot position and attitude; also tilt and quaternion if the vehicle may turn upside down."""
    names: tuple[str, ...]
    if all(run.log.plant.attitude is None for run in runs):
        names = ("x", "roll", "y", "pitch", "z", "yaw")
    elif len(runs) > 1:
        names = ("x", "tilt", "y", "roll", "z", "pitch", "yaw")
    else:
        names = ("x", "tilt", "y", "z")
    panels = [_signal(runs, name) for name in names]
    if len(runs) == 1 and runs[0].log.plant.attitude is not None:
        quaternion, body_rates = _attitude_panels(runs[0])
        panels.insert(3, quaternion)  # beside y
        panels.append(body_rates)  # beside z
    return _timed("states", "position and attitude", tuple(panels), runs)


def _attitude_panels(run: FlightRecord) -> tuple[Panel, Panel]:
    """Plot quaternion and body rates of a flight that Euler angles do not describe."""
    plant = run.log.plant
    assert plant.attitude is not None
    assert plant.body_rates is not None
    quaternion = _several("quaternion", "", plant.t, plant.attitude, "wxyz")
    body_rates = _several("body rates", "deg/s", plant.t, np.degrees(plant.body_rates), "xyz")
    return quaternion, body_rates


def inputs(runs: Sequence[FlightRecord]) -> Figure:
    """Plot rotor speeds and their steps: one panel for a single run, one panel per rotor for several."""
    titles = {"speed": "rotor speed", "slew": "step per period"}
    panels = []
    if len(runs) == 1:
        for name, title in titles.items():
            panels.append(replace(_signal(runs, name), title=title, height=1.3))
        return _timed("inputs", "rotor speeds and their steps", tuple(panels), runs, columns=1)
    for rotor in range(N_ROTORS):
        for name, title in titles.items():
            signal = SIGNALS[name]
            curves = []
            for i, label, run in _flown(runs):
                values = signal.sampled(run.log.control)[:, rotor]
                curves.append(_run_curve(i, label, run.log.control.t, values, style="steps"))
            title = f"{title}, rotor {rotor + 1}"
            panels.append(Panel(title=title, unit=signal.unit, series=tuple(curves), bounds=_bounds(runs, name)))
    return _timed("inputs", "rotor speeds and their steps", tuple(panels), runs)


def targets(run: FlightRecord) -> list[Figure]:
    """Plot thrust and body rates that an autopilot was to fly, and what it flew; no figure without one."""
    target = run.log.control.target
    if target is None or run.log.plant.thrust is None:
        return []
    thrust = _target_panel(run, "thrust", target[:, 0], "collective thrust")
    panels = [thrust]
    for i, axis in enumerate("xyz", start=1):
        rates = math.degrees(1.0) * target[:, i]
        panels.append(_target_panel(run, f"body_rate_{axis}", rates, f"body rate about {axis}"))
    return [_timed("targets", "targets of the autopilot", tuple(panels), [run])]


def _target_panel(run: FlightRecord, name: str, target: Array, title: str) -> Panel:
    """Plot a signal as flown, and its target, in the unit of the signal."""
    signal = SIGNALS[name]
    t, flown = signal.finest(run.log)
    curves = (
        Series(x=t, y=flown, colour=COLOUR.flown, label="flown"),
        Series(x=run.log.control.t, y=target, colour=COLOUR.reference, label="target", style="steps"),
    )
    return Panel(title=title, unit=signal.unit, series=curves, bounds=_bounds([run], name), legend=True)


def times(runs: Sequence[FlightRecord]) -> Figure:
    """Plot computation times against the deadline, iterations and active constraints."""
    panels = []
    for key in _CLOCKS:
        if any(np.isfinite(getattr(run.log.timing, key)).any() for run in runs):
            panels.append(_clock(runs, key))
    for title, key in (("solver iterations", "iterations"), ("active constraints", "active")):
        curves = []
        for i, label, run in _flown(runs):
            counts = getattr(run.log.control, key).astype(float)
            curves.append(_run_curve(i, label, run.log.control.t, counts, style="steps"))
        panels.append(Panel(title=title, y_label="count", series=tuple(curves), whole=True))
    return _timed("solve_times", "time to compute a command", tuple(panels), runs)


def _clock(runs: Sequence[FlightRecord], key: str) -> Panel:
    """Plot a computation time per period, and the deadline of a whole step."""
    curves = []
    deadlines = set()
    title = _CLOCKS[key]
    for i, label, run in _flown(runs):
        values = getattr(run.log.timing, key)
        # a clock may read 0, which a logarithmic axis cannot show
        shown = np.where(values > 0.0, values, np.nan)
        curves.append(_run_curve(i, label, run.log.timing.t, shown, style="points", width=2.0))
        if len(runs) == 1:
            spent = percentiles(values)
            title = f"{title}: median {spent['p50']:.3g}, p99 {spent['p99']:.3g}, max {spent['max']:.3g}"
        if key == "step_ms":
            deadlines.add(float(run.numbers["controller"]["deadline_ms"]))
    bounds = tuple(Bound(value=deadline, start=0.0, stop=_end(runs)) for deadline in sorted(deadlines))
    return Panel(title=title, y_label="time [ms]", y_log=True, series=tuple(curves), bounds=bounds)


def effects(run: FlightRecord) -> list[Figure]:
    """Plot, as far as recorded: commanded and actual rotor speeds, forces, wind, battery, measurement errors."""
    plant = run.log.plant
    control = run.log.control
    panels = []
    commanded = commanded_speeds(run.log)
    if commanded is not None:
        for rotor in range(N_ROTORS):
            panels.append(_rotor_panel(rotor, plant.t, commanded, plant.speeds))
    for effect in effect_curves(run.log):
        panels.append(_several(effect.title, effect.unit, plant.t, effect.values, effect.names))
    if not control.measured_perfectly:
        for quantity, names in (("position", ("x", "y", "z")), ("attitude", ("roll", "pitch", "yaw"))):
            errors = [SIGNALS[f"{name}_estimate_error"] for name in names]
            values = np.stack([error.sampled(control) for error in errors], axis=1)
            panels.append(_several(f"error of the measured {quantity}", errors[0].unit, control.t, values, names))
    if panels:
        return [_timed("effects", "effects", tuple(panels), [run])]
    return []


def space(run: FlightRecord) -> list[Figure]:
    """Plot a flight among obstacles and regions from above, and its clearances; no figure without any."""
    if not has_space(run.limits):
        return []
    panels = (_from_above([run]), _clearances(run))
    return [_timed("space", "from above, and clearances", panels, [run], columns=1)]


def _clearances(run: FlightRecord) -> Panel:
    """Plot the distance to each obstacle and region while it is in force."""
    limits = [limit for limit in run.limits if isinstance(limit, SpaceLimit)]
    curves = []
    for i, limit in enumerate(limits):
        t, values = limit.source.finest(run.log)
        shown = np.where(limit.holds_at(t), values, np.nan)
        label = ""
        if len(limits) <= _MOST_NAMED:
            label = limit.name
        curves.append(Series(x=t, y=shown, colour=line_colour(i), label=label, width=1.0))
    low, high = extent([curve.y for curve in curves]) or (0.0, 0.0)
    return Panel(
        title="clearance",
        unit="m",
        series=tuple(curves),
        bounds=(Bound(value=0.0),),
        y_range=(min(0.0, low) - 0.1, min(high, _NEAR_CLEARANCE) + 0.1),
        legend=True,
        height=1.5,
    )


def xy(run: FlightRecord) -> list[Figure]:
    """Plot a flight from above if its course moves in x and y at one height, and `space` does not show it."""
    course = run.log.control.reference[:, :3]
    spans = course.max(axis=0) - course.min(axis=0)
    planar = spans[:2].min() > _LEAST_MOTION and spans[2] < LEAST_SPANS["m"]
    if planar and not has_space(run.limits):
        return [_timed("xy", "path", (_from_above([run]),), [run], columns=1)]
    return []


def _from_above(runs: Sequence[FlightRecord]) -> Panel:
    """Plot flights and their courses from above, with obstacles and the edges of regions."""
    areas = []
    lines = []
    ends = []
    for run in _first_with_limits(runs):
        for limit in run.limits:
            if isinstance(limit, SpaceLimit) and isinstance(limit.shape, Obstacle):
                areas += _obstacle_areas(limit, limit.shape, run)
        for _, edges in region_edges(run.limits, run.log):
            for edge in edges:
                lines.append(_region_edge(edge))
    for run in distinct_courses(runs):
        course = run.log.control.reference
        lines.append(Series(x=course[:, 0], y=course[:, 1], **_REFERENCE))
    for i, label, run in _flown(runs):
        position = run.log.plant.state[:, POSITION]
        colour = line_colour(i)
        lines.append(_run_curve(i, label, position[:, 0], position[:, 1]))
        ends.append(_point(position[0], "start", colour, width=9.0))
        ends.append(_point(position[-1], "end", colour, width=5.0, marker="square"))
    return Panel(
        title="from above",
        x_label="x [m]",
        y_label="y [m]",
        equal=True,
        height=2.0,
        areas=tuple(areas),
        series=(*lines, *ends),
    )


def _first_with_limits(runs: Sequence[FlightRecord]) -> list[FlightRecord]:
    """Return the first of the runs with each set of limits."""
    first: dict[tuple[Limit, ...], FlightRecord] = {}
    for run in runs:
        first.setdefault(run.limits, run)
    return list(first.values())


def _obstacle_areas(limit: SpaceLimit, obstacle: Obstacle, run: FlightRecord) -> list[Area]:
    """From above, the outlines of an obstacle; of one that moves, all that the flight comes near, or its first."""
    instants = np.zeros(1)
    opacity = 0.55
    if obstacle.moves:
        opacity = 0.3
        t, clearance = limit.source.finest(run.log)
        near = t[clearance < _NEAR_CLEARANCE]
        if near.size:
            instants = np.arange(near[0], near[-1], _OUTLINE_PERIOD)
    areas = []
    for instant in instants:
        for outline in outlines(obstacle, instant):
            areas.append(Area(outline=outline, colour=COLOUR.obstacle, opacity=opacity, label="obstacle"))
    return areas


def _region_edge(edge: Array) -> Series:
    return Series(x=edge[:, 0], y=edge[:, 1], colour=COLOUR.bound, label="region", dashed=True, width=0.9)


def _point(place: Array, label: str, colour: str, **looks: Any) -> Series:
    return Series(x=place[:1], y=place[1:2], label=label, colour=colour, style="points", **looks)


def path(runs: Sequence[FlightRecord]) -> Scene:
    """Draw flights and courses in space, with obstacles at their start and the edges of regions."""
    solids = []
    paths = []
    directions = np.random.default_rng(0).normal(size=(_DIRECTIONS, 3))
    for run in _first_with_limits(runs):
        for obstacle in obstacles_in(run.limits):
            for solid in obstacle.solids:
                corners = np.unique(solid.support(directions).round(4), axis=0)
                solids.append((corners + obstacle.position, obstacle.name))
        for limit, edges in region_edges(run.limits, run.log):
            lines = np.insert(edges, 2, np.nan, axis=1).reshape(-1, 3)
            paths.append((lines, limit.name, COLOUR.bound, "", True))
    for run in distinct_courses(runs):
        paths.append((run.log.control.reference[:, :3], "reference", COLOUR.reference, "", True))
    for i, label, run in _flown(runs):
        paths.append((run.log.plant.state[:, POSITION], label, line_colour(i), f"run{i}", False))
    return Scene(key="path", title="path in space", paths=tuple(paths), solids=tuple(solids))


def _signal(runs: Sequence[FlightRecord], name: str) -> Panel:
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
            curves.append(Series(x=control.t, y=reference_curve(control, name), **_REFERENCE))
    for i, label, run in _flown(runs):
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
            curves.append(_run_curve(i, label, t, values))
        else:
            curves.append(_run_curve(i, label, control.t, sampled, style="steps"))
    if name in SIGNALS:
        bounds = _bounds(runs, name)
    else:
        bounds = _bounds(runs, "speed")
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
        curve = _run_curve(0, label, t, column, style="steps")
        curves.append(replace(curve, colour=line_colour(j), label=f"rotor {j + 1}", width=2.2 - 0.5 * j))
    return curves


def _command(runs: Sequence[FlightRecord], name: str) -> Panel:
    """Plot the commanded speeds."""
    return replace(_signal(runs, "speed"), title="commanded rotor speed")


def _paths(runs: Sequence[FlightRecord], name: str) -> Panel:
    """Plot the paths from above."""
    return _from_above(runs)


def _run_curve(i: int, label: str, x: Array, y: Array, **looks: Any) -> Series:
    """Return a curve of the i-th run; where the colours repeat, it is dashed."""
    dashed = i // len(CYCLE) % 2 == 1
    return Series(x=x, y=y, colour=line_colour(i), label=label, group=f"run{i}", dashed=dashed, **looks)


def _error(runs: Sequence[FlightRecord], name: str) -> Panel:
    """Plot the distance of the true position from the filtered reference."""
    curves = []
    for i, label, run in _flown(runs):
        control = run.log.control
        distance = np.linalg.norm(control.tracking_error[:, :3], axis=1)
        curves.append(_run_curve(i, label, control.t, distance))
    return Panel(title="position error", unit="m", series=tuple(curves))


def _margin(runs: Sequence[FlightRecord], name: str) -> Panel:
    """Plot the signed margin to a constraint, negative beyond its bound, at the highest rate of its signal."""
    curves = []
    units = []
    for i, label, run in _flown(runs):
        for limit in run.limits:
            if f"{_MARGIN}{limit.name}" != name:
                continue
            t, values = limit.source.finest(run.log)
            margins = margins_at(limit, t, values)
            if limit.source.plant is None:
                curves.append(_run_curve(i, label, t, margins, style="steps"))
            else:
                curves.append(_run_curve(i, label, t, margins))
            units.append(limit.unit)
    bound = Bound(value=0.0, start=0.0, stop=_end(runs))
    title = f"margin of {name.removeprefix(_MARGIN)}"
    return Panel(title=title, unit=_one_unit(name, units), series=tuple(curves), bounds=(bound,))


def _logged(runs: Sequence[FlightRecord], name: str) -> Panel:
    """Plot a signal that the controller logged."""
    curves = []
    units = []
    for i, label, run in _flown(runs):
        control = run.log.control
        if name in control.logged:
            unit, values = control.logged[name]
            curves.append(_run_curve(i, label, control.t, values))
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


def _several(title: str, unit: str, t: Array, values: Array, names: Sequence[str]) -> Panel:
    """Plot curves (M, n) in one panel with its own legend."""
    first = 4 - len(names)  # x, y and z have the same colours with and without w
    curves = []
    for i, (name, column) in enumerate(zip(names, values.T, strict=True)):
        curves.append(Series(x=t, y=column, colour=line_colour(first + i), label=name, width=1.0))
    return Panel(title=title, unit=unit, series=tuple(curves), legend=True)


def _rotor_panel(rotor: int, t: Array, commanded: Array, speeds: Array) -> Panel:
    """Plot commanded and actual speed of a rotor."""
    command = Series(x=t, y=commanded[:, rotor], colour=COLOUR.reference, label="commanded", style="steps", width=1.0)
    actual = Series(x=t, y=speeds[:, rotor], colour=COLOUR.flown, label="actual", width=1.0)
    return Panel(title=f"rotor {rotor + 1}", unit=SIGNALS["speed"].unit, series=(command, actual))


def _bounds(runs: Sequence[FlightRecord], signal: str) -> tuple[Bound, ...]:
    """The distinct bounds of all runs on a signal."""
    limits = list[Limit]()
    for run in runs:
        limits += run.limits
    bounds = []
    for value, start, stop in bounds_of(limits, signal, _end(runs)):
        bounds.append(Bound(value=value, start=start, stop=stop))
    return tuple(bounds)


def _end(runs: Sequence[FlightRecord]) -> float:
    return max(run.end for run in runs)


def _flown(runs: Sequence[FlightRecord]) -> Iterator[tuple[int, str, FlightRecord]]:
    """Yield number, name and run of runs that flew a period; a single run without a label is named `flight`."""
    names: tuple[str, ...]
    if len(runs) == 1 and runs[0].label is None:
        names = ("flight",)
    else:
        names = run_names(runs)
    for i, (name, run) in enumerate(zip(names, runs, strict=True)):
        if run.log.control.t.size:
            yield i, name, run


def _timed(key: str, title: str, panels: tuple[Panel, ...], runs: Sequence[FlightRecord], columns: int = 2) -> Figure:
    return Figure(key=key, title=title, panels=panels, columns=columns, end=_end(runs))
