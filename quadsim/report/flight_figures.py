"""Figures of flights: one flight in the colours of its rotors and axes, or several overlaid in one colour each."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from quadsim.errors import InputError, UnknownNameError
from quadsim.flight.audit import SIGNALS, TERM_SIGNALS, SpaceLimit, margins_at
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
_CLOCKS: Final = {"step_ms": "whole step", "solve_ms": "optimum alone"}  # columns of `timing.parquet`
_NEAR: Final = 3.0  # clearance [m] below which a moving obstacle is drawn; upper limit of the curves
_MOVES: Final = 0.1  # smallest span of a course [m] that counts as motion along an axis
_EVERY: Final = 0.25  # time between drawings of it [s]
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
    prefixes = dict(zip(("states", "inputs"), PAPER_FIGURES.get(run.name, ("", "")), strict=True))
    ended = "" if run.log.reason is None else " (aborted)"
    figures = [states([run]), inputs([run]), *targets(run), times([run]), *effects(run), *space(run), *xy(run)]
    return write_pngs(
        (
            replace(figure, key=prefixes.get(figure.key, "") + figure.key, title=f"{run.name}{ended}: {figure.title}")
            for figure in figures
        ),
        directory,
    )


def page_figures(runs: Sequence[FlightRecord]) -> list[Figure | Scene]:
    """Return a page's figures of the runs that flew at least one control period."""
    flown = [run for run in runs if run.log.control.t.size]
    if not flown:
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
            kind = [other for other in known if other.startswith(_MARGIN) == name.startswith(_MARGIN)]
            raise UnknownNameError("signal", name, kind)
    return _timed("signals", "", tuple(known[name](runs, name) for name in names), runs, columns=1)


def _panels(runs: Sequence[FlightRecord]) -> dict[str, Callable[[Sequence[FlightRecord], str], Panel]]:
    """What `signals` can plot of these runs: the panel of each name."""
    return {
        **dict.fromkeys((name for run in runs for name in run.log.control.logged), _logged),
        **dict.fromkeys((f"{_MARGIN}{limit.name}" for run in runs for limit in run.limits), _margin),
        **dict.fromkeys(_CLOCKS, _clock),
        "error": _error,
        "command": lambda runs, _: replace(_signal(runs, "speed"), title="commanded rotor speed"),
        "xy": lambda runs, _: _above(runs),
        **dict.fromkeys((*SIGNALS, *TERM_SIGNALS), _signal),
    }


def states(runs: Sequence[FlightRecord]) -> Figure:
    """Plot position and attitude; also tilt and quaternion if the vehicle may turn upside down."""
    plants = [run.log.plant for run in runs]
    if all(plant.attitude is None for plant in plants):
        panels = [_signal(runs, name) for name in ("x", "roll", "y", "pitch", "z", "yaw")]
    elif len(runs) > 1:
        panels = [_signal(runs, name) for name in ("x", "tilt", "y", "roll", "z", "pitch", "yaw")]
    else:
        t = plants[0].t
        attitude = plants[0].attitude
        rates = plants[0].body_rates
        assert attitude is not None
        assert rates is not None
        more = (
            _several("quaternion", "", t, attitude, "wxyz"),
            _several("body rates", "deg/s", t, np.degrees(rates), "xyz"),
        )
        panels = [_signal(runs, name) for name in ("x", "tilt", "y", "z")]
        panels = [*panels[:3], more[0], panels[3], more[1]]
    return _timed("states", "position and attitude", tuple(panels), runs)


def inputs(runs: Sequence[FlightRecord]) -> Figure:
    """Plot rotor speeds and their steps: one panel for a single run, one panel per rotor for several."""
    titles = {"speed": "rotor speed", "slew": "step per period"}
    if len(runs) == 1:
        panels = [replace(_signal(runs, name), title=title, height=1.3) for name, title in titles.items()]
        return _timed("inputs", "rotor speeds and their steps", tuple(panels), runs, columns=1)
    panels = []
    for rotor in range(N_ROTORS):
        for name, title in titles.items():
            curves = tuple(
                _of_run(i, label, run.log.control.t, SIGNALS[name].sampled(run.log.control)[:, rotor], style="steps")
                for i, label, run in _flown(runs)
            )
            title = f"{title}, rotor {rotor + 1}"
            panels.append(Panel(title=title, unit=SIGNALS[name].unit, series=curves, bounds=_bounds(runs, name)))
    return _timed("inputs", "rotor speeds and their steps", tuple(panels), runs)


def targets(run: FlightRecord) -> list[Figure]:
    """Plot thrust and body rates that an autopilot was to fly, and what it flew; no figure without one."""
    target = run.log.control.target
    plant = run.log.plant
    if target is None or plant.thrust is None:
        return []
    panels = []
    for i, name in enumerate(("thrust", "body_rate_x", "body_rate_y", "body_rate_z")):
        signal = SIGNALS[name]
        scale = 1.0 if i == 0 else math.degrees(1.0)
        curves = (
            Series(x=plant.t, y=signal.finest(run.log)[1], colour=COLOUR.flown, label="flown"),
            Series(x=run.log.control.t, y=scale * target[:, i], colour=COLOUR.reference, label="target", style="steps"),
        )
        if i == 0:
            title = "collective thrust"
        else:
            title = f"body rate about {name[-1]}"
        panels.append(Panel(title=title, unit=signal.unit, series=curves, bounds=_bounds([run], name), legend=True))
    return [_timed("targets", "targets of the autopilot", tuple(panels), [run])]


def times(runs: Sequence[FlightRecord]) -> Figure:
    """Plot computation times against the deadline, iterations and active constraints."""
    reported = [key for key in _CLOCKS if any(np.isfinite(getattr(run.log.timing, key)).any() for run in runs)]
    panels = [_clock(runs, key) for key in reported]
    for title, key in (("solver iterations", "iterations"), ("active constraints", "active")):
        counts = tuple(
            _of_run(i, label, run.log.control.t, getattr(run.log.control, key).astype(float), style="steps")
            for i, label, run in _flown(runs)
        )
        panels.append(Panel(title=title, y_label="count", series=counts, whole=True))
    return _timed("solve_times", "time to compute a command", tuple(panels), runs)


def _clock(runs: Sequence[FlightRecord], key: str) -> Panel:
    """Plot a computation time per period, and the deadline of a whole step."""
    curves = []
    title = _CLOCKS[key]
    for i, label, run in _flown(runs):
        values = getattr(run.log.timing, key)
        # a clock may read 0, which a logarithmic axis cannot show
        shown = np.where(values > 0.0, values, np.nan)
        curves.append(_of_run(i, label, run.log.timing.t, shown, style="points", width=2.0))
        if len(runs) == 1:
            spent = percentiles(values)
            title = f"{title}: median {spent['p50']:.3g}, p99 {spent['p99']:.3g}, max {spent['max']:.3g}"
    deadlines = (
        {float(run.numbers["controller"]["deadline_ms"]) for _, _, run in _flown(runs)} if key == "step_ms" else ()
    )
    bounds = tuple(Bound(value=deadline, start=0.0, stop=_end(runs)) for deadline in sorted(deadlines))
    return Panel(title=title, y_label="time [ms]", y_log=True, series=tuple(curves), bounds=bounds)


def effects(run: FlightRecord) -> list[Figure]:
    """Plot, as far as recorded: commanded and actual rotor speeds, forces, wind, battery, measurement errors."""
    plant = run.log.plant
    control = run.log.control
    commanded = commanded_speeds(run.log)
    if commanded is None:
        panels = []
    else:
        panels = [_acting(rotor, plant.t, commanded, plant.speeds) for rotor in range(N_ROTORS)]
    panels += [_several(each.title, each.unit, plant.t, each.values, each.names) for each in effect_curves(run.log)]
    if not control.measured_perfectly:
        for what, names in {"position": ("x", "y", "z"), "attitude": ("roll", "pitch", "yaw")}.items():
            errors = [SIGNALS[f"{name}_estimate_error"] for name in names]
            values = np.stack([error.sampled(control) for error in errors], axis=1)
            panels.append(_several(f"error of the measured {what}", errors[0].unit, control.t, values, names))
    if panels:
        return [_timed("effects", "effects", tuple(panels), [run])]
    return []


def space(run: FlightRecord) -> list[Figure]:
    """Plot a flight among obstacles and regions from above, and its clearances; no figure without any."""
    if not has_space(run.limits):
        return []
    limits = [limit for limit in run.limits if isinstance(limit, SpaceLimit)]
    clearances = {limit.name: limit.source.finest(run.log) for limit in limits}
    curves = []
    for i, limit in enumerate(limits):
        t, values = clearances[limit.name]
        shown = np.where(limit.holds_at(t), values, np.nan)
        label = limit.name if len(limits) <= _MOST_NAMED else ""
        curves.append(Series(x=t, y=shown, colour=line_colour(i), label=label, width=1.0))
    drawn = np.concatenate([curve.y[np.isfinite(curve.y)] for curve in curves])
    if drawn.size:
        low, high = (float(drawn.min()), float(drawn.max()))
    else:
        low, high = (0.0, 0.0)
    ends = (min(0.0, low) - 0.1, min(high, _NEAR) + 0.1)
    clear = Panel(title="clearance", unit="m", series=tuple(curves), bounds=(Bound(value=0.0),), y_range=ends,
                  legend=True, height=1.5)  # fmt: skip
    return [_timed("space", "from above, and clearances", (_above([run]), clear), [run], columns=1)]


def xy(run: FlightRecord) -> list[Figure]:
    """Plot a flight from above if its course moves in x and y at one height, and `space` does not show it."""
    course = run.log.control.reference[:, :3]
    spans = course.max(axis=0) - course.min(axis=0)
    planar = spans[:2].min() > _MOVES and spans[2] < LEAST_SPANS["m"]
    if planar and not space(run):
        return [_timed("xy", "path", (_above([run]),), [run], columns=1)]
    return []


def _above(runs: Sequence[FlightRecord]) -> Panel:
    """Plot flights and their courses from above, with obstacles and the edges of regions."""
    areas = []
    regions = []
    for run in {run.limits: run for run in reversed(runs)}.values():  # the first run with these limits
        for limit in run.limits:
            if not isinstance(limit, SpaceLimit) or not isinstance(limit.shape, Obstacle):
                continue
            t, values = limit.source.finest(run.log)
            near = t[values < _NEAR]
            for instant in np.arange(near[0], near[-1], _EVERY) if limit.shape.moves and near.size else [0.0]:
                for outline in outlines(limit.shape, instant):
                    opacity = 0.3 if limit.shape.moves else 0.55
                    areas.append(Area(outline=outline, colour=COLOUR.obstacle, opacity=opacity, label="obstacle"))
        regions += [
            Series(x=edge[:, 0], y=edge[:, 1], colour=COLOUR.bound, label="region", dashed=True, width=0.9)
            for _, edges in region_edges(run.limits, run.log)
            for edge in edges
        ]
    courses = (run.log.control.reference for run in distinct_courses(runs))
    lines = [Series(x=course[:, 0], y=course[:, 1], **_REFERENCE) for course in courses]
    ends = []
    for i, label, run in _flown(runs):
        position = run.log.plant.state[:, POSITION]
        lines.append(_of_run(i, label, position[:, 0], position[:, 1]))
        ends += [
            _point(position[0], "start", line_colour(i), width=9.0),
            _point(position[-1], "end", line_colour(i), width=5.0, marker="square"),
        ]
    return Panel(title="from above", x_label="x [m]", y_label="y [m]", equal=True, height=2.0, areas=tuple(areas),
                 series=(*regions, *lines, *ends))  # fmt: skip


def _point(place: Array, label: str, colour: str, **looks: Any) -> Series:
    return Series(x=place[:1], y=place[1:2], label=label, colour=colour, style="points", **looks)


def path(runs: Sequence[FlightRecord]) -> Scene:
    """Draw flights and courses in space, with obstacles at their start and the edges of regions."""
    solids = []
    paths = []
    directions = np.random.default_rng(0).normal(size=(_DIRECTIONS, 3))
    for limits in dict.fromkeys(run.limits for run in runs if has_space(run.limits)):
        for obstacle in obstacles_in(limits):
            for solid in obstacle.solids:
                corners = np.unique(solid.support(directions).round(4), axis=0)
                solids.append((corners + obstacle.position, obstacle.name))
        first = next(run for run in runs if run.limits == limits)
        for limit, edges in region_edges(limits, first.log):
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
    curves = []
    bands = []
    for run in distinct_courses(runs) if name in REFERENCE_NAMES else ():
        curves.append(Series(x=run.log.control.t, y=reference_curve(run.log.control, name), **_REFERENCE))
    for i, label, run in _flown(runs):
        control = run.log.control
        sampled = signal.sampled(control)
        if len(runs) == 1 and name in STATE_NAMES and not control.measured_perfectly:
            t, values = break_at_wraps(control.t, signal.sampled(replace(control, truth=control.state)), signal.unit)
            curves.append(Series(x=t, y=values, colour=COLOUR.measured, label="measured", width=0.7))
        if sampled.ndim == 2 and len(runs) > 1:
            low = sampled.min(axis=1)
            high = sampled.max(axis=1)
            bands.append(Band(x=control.t, low=low, high=high, colour=line_colour(i), label=label, opacity=0.6))
        elif sampled.ndim == 2:
            for j, values in enumerate(sampled.T):  # equal curves of several rotors stay visible beneath one another
                curve = _of_run(i, label, control.t, values, style="steps")
                curves.append(replace(curve, colour=line_colour(j), label=f"rotor {j + 1}", width=2.2 - 0.5 * j))
        elif signal.plant is not None:
            curves.append(_of_run(i, label, *break_at_wraps(run.log.plant.t, signal.plant(run.log.plant), signal.unit)))
        else:
            curves.append(_of_run(i, label, control.t, sampled, style="steps"))
    title = f"{name}, all rotors" if bands else name
    bounds = _bounds(runs, name if name in SIGNALS else "speed")
    return Panel(title=title, unit=signal.unit, series=tuple(curves), bands=tuple(bands), bounds=bounds)


def _of_run(i: int, label: str, x: Array, y: Array, **looks: Any) -> Series:
    """Return a curve of the i-th run; where the colours repeat, it is dashed."""
    dashed = i // len(CYCLE) % 2 == 1
    return Series(x=x, y=y, colour=line_colour(i), label=label, group=f"run{i}", dashed=dashed, **looks)


def _error(runs: Sequence[FlightRecord], name: str) -> Panel:
    """Plot the distance of the true position from the filtered reference."""
    curves = tuple(
        _of_run(i, label, run.log.control.t, np.linalg.norm(run.log.control.tracking_error[:, :3], axis=1))
        for i, label, run in _flown(runs)
    )
    return Panel(title="position error", unit="m", series=curves)


def _margin(runs: Sequence[FlightRecord], name: str) -> Panel:
    """Plot the signed margin to a constraint, negative beyond its bound, at the highest rate of its signal."""
    curves = []
    units = []
    for i, label, run in _flown(runs):
        for limit in run.limits:
            if f"{_MARGIN}{limit.name}" == name:
                t, values = limit.source.finest(run.log)
                style = "steps" if limit.source.plant is None else "line"
                curves.append(_of_run(i, label, t, margins_at(limit, t, values), style=style))
                units.append(limit.unit)
    bound = Bound(value=0.0, start=0.0, stop=_end(runs))
    title = f"margin of {name.removeprefix(_MARGIN)}"
    return Panel(title=title, unit=_one_unit(name, units), series=tuple(curves), bounds=(bound,))


def _logged(runs: Sequence[FlightRecord], name: str) -> Panel:
    """Plot a signal that the controller logged."""
    logs = [(i, label, run.log.control) for i, label, run in _flown(runs) if name in run.log.control.logged]
    curves = tuple(_of_run(i, label, log.t, log.logged[name][1]) for i, label, log in logs)
    return Panel(title=name, unit=_one_unit(name, [log.logged[name][0] for _, _, log in logs]), series=curves)


def _one_unit(name: str, units: Sequence[str]) -> str:
    """Return the unit that the runs have in common; none without a run."""
    if len(distinct := dict.fromkeys(units)) > 1:
        shown = " and ".join(f"[{unit}]" for unit in distinct)
        raise InputError(f"{name} is in {shown}, which one axis cannot show; plot these flights apart")
    return next(iter(distinct), "")


def _several(title: str, unit: str, t: Array, values: Array, names: Sequence[str]) -> Panel:
    """Plot curves (M, n) in one panel with its own legend."""
    first = 4 - len(names)  # x, y and z have the same colours with and without w
    curves = []
    for i, (name, column) in enumerate(zip(names, values.T, strict=True)):
        curves.append(Series(x=t, y=column, colour=line_colour(first + i), label=name, width=1.0))
    return Panel(title=title, unit=unit, series=tuple(curves), legend=True)


def _acting(rotor: int, t: Array, commanded: Array, speeds: Array) -> Panel:
    """Plot commanded and actual speed of a rotor."""
    command = Series(x=t, y=commanded[:, rotor], colour=COLOUR.reference, label="commanded", style="steps", width=1.0)
    acting = Series(x=t, y=speeds[:, rotor], colour=COLOUR.flown, label="actual", width=1.0)
    return Panel(title=f"rotor {rotor + 1}", unit=SIGNALS["speed"].unit, series=(command, acting))


def _bounds(runs: Sequence[FlightRecord], signal: str) -> tuple[Bound, ...]:
    limits = [limit for run in runs for limit in run.limits]
    bounds = bounds_of(limits, signal, _end(runs))
    return tuple(Bound(value=value, start=start, stop=stop) for value, start, stop in bounds)


def _end(runs: Sequence[FlightRecord]) -> float:
    return max(run.end for run in runs)


def _flown(runs: Sequence[FlightRecord]) -> Iterator[tuple[int, str, FlightRecord]]:
    """Return number, name and run of runs that flew a period; a single run without a label is named `flight`."""
    names = ("flight",) if len(runs) == 1 and runs[0].label is None else run_names(runs)
    return ((i, name, run) for i, (name, run) in enumerate(zip(names, runs, strict=True)) if run.log.control.t.size)


def _timed(key: str, title: str, panels: tuple[Panel, ...], runs: Sequence[FlightRecord], columns: int = 2) -> Figure:
    return Figure(key=key, title=title, panels=panels, columns=columns, end=_end(runs))
