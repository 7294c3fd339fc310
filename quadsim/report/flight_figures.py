"""Figures of flights: one flight in the colours of its rotors and axes, or several overlaid in one colour each."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from quadsim.errors import UnknownNameError
from quadsim.flight.audit import SIGNALS, TERM_SIGNALS
from quadsim.flight.record import FlightRecord
from quadsim.report.figure import (
    LEAST_SPANS,
    Figure,
    Panel,
    Scene,
    commanded_speeds,
    effect_curves,
    has_space,
)
from quadsim.report.flight_panels import (
    CLOCKS,
    MARGIN_PREFIX,
    bounds_on,
    clock_panel,
    curves_panel,
    error_panel,
    flown_runs,
    last_time,
    logged_panel,
    margin_panel,
    rotor_panel,
    run_curve,
    signal_panel,
    target_panel,
)
from quadsim.report.space_panels import clearance_panel, from_above, path_scene
from quadsim.report.to_matplotlib import write_pngs
from quadsim.vehicle import N_ROTORS

PAPER_FIGURES: Final = {
    "paper-unconstrained": ("figure2_", "figure3_"),
    "paper-constrained": ("figure4_", "figure5_"),
}
"""Prefixes of the keys of the state and input figures, by scenario: their numbers in the paper."""
_INPUTS: Final = {"speed": "rotor speed", "slew": "step per period"}
"""Titles of the panels of `inputs`, by signal."""
_PanelOf = Callable[[Sequence[FlightRecord], str], Panel]  # of the signal of a name
_LEAST_MOTION: Final = 0.1  # smallest span of a course [m] that counts as motion along an axis


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
    return [*figures, path_scene(runs)]


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
            raise _unknown_signal(name, known)
    panels = tuple(known[name](runs, name) for name in names)
    return _timed("signals", "", panels, runs, columns=1)


def signal_names(runs: Sequence[FlightRecord]) -> list[str]:
    """Return the names that `signals` takes for these runs, margins last, in order."""
    names = list(_panels(runs))
    return sorted(names, key=lambda name: (name.startswith(MARGIN_PREFIX), name))


def _unknown_signal(name: str, known: Iterable[str]) -> UnknownNameError:
    """Return the error about a signal that no run has: all names there are, of margins or of other signals."""
    is_margin = name.startswith(MARGIN_PREFIX)
    alike = [other for other in known if other.startswith(MARGIN_PREFIX) == is_margin]
    hint = ""
    if not is_margin:
        hint = f"{MARGIN_PREFIX}NAME is the margin of a constraint"
    return UnknownNameError("signal", name, alike, hint, whole=True)


def _panels(runs: Sequence[FlightRecord]) -> dict[str, _PanelOf]:
    """What `signals` can plot of these runs: the panel of each name."""
    panels: dict[str, _PanelOf] = {}
    for run in runs:
        panels.update(dict.fromkeys(run.log.control.logged, logged_panel))
    for run in runs:
        for limit in run.limits:
            panels[f"{MARGIN_PREFIX}{limit.name}"] = margin_panel
    panels.update(dict.fromkeys(CLOCKS, clock_panel))
    panels["error"] = error_panel
    panels["command"] = _command
    panels["xy"] = _paths
    panels.update(dict.fromkeys((*SIGNALS, *TERM_SIGNALS), signal_panel))
    return panels


def states(runs: Sequence[FlightRecord]) -> Figure:
    """Plot position and attitude; also tilt and quaternion if the vehicle may turn upside down.

    Other signals with a violated bound have a panel each behind these, unless `inputs` has it.
    """
    names: tuple[str, ...]
    if all(run.log.plant.attitude is None for run in runs):
        names = ("x", "roll", "y", "pitch", "z", "yaw")
    elif len(runs) > 1:
        names = ("x", "tilt", "y", "roll", "z", "pitch", "yaw")
    else:
        names = ("x", "tilt", "y", "z")
    panels = [signal_panel(runs, name) for name in names]
    if len(runs) == 1 and runs[0].log.plant.attitude is not None:
        quaternion, body_rates = _attitude_panels(runs[0])
        panels.insert(3, quaternion)  # beside y
        panels.append(body_rates)  # beside z
    title = "position and attitude"
    others = _violated_signals(runs, {*names, *_INPUTS})
    if others:
        title = "position, attitude and other violated signals"
    for name in others:
        panels.append(signal_panel(runs, name))
    return _timed("states", title, tuple(panels), runs)


def _violated_signals(runs: Sequence[FlightRecord], drawn: Collection[str]) -> list[str]:
    """Return the signals of violated bounds of any run, but for those that are drawn, in order."""
    violated = dict[str, None]()
    for run in runs:
        for finding in run.findings:
            signal = finding.limit.signal
            if finding.verdict == "violated" and signal in SIGNALS and signal not in drawn:
                violated[signal] = None
    return list(violated)


def _attitude_panels(run: FlightRecord) -> tuple[Panel, Panel]:
    """Plot quaternion and body rates of a flight that Euler angles do not describe."""
    plant = run.log.plant
    assert plant.attitude is not None
    assert plant.body_rates is not None
    quaternion = curves_panel("quaternion", "", plant.t, plant.attitude, "wxyz")
    body_rates = curves_panel("body rates", "deg/s", plant.t, np.degrees(plant.body_rates), "xyz")
    return quaternion, body_rates


def inputs(runs: Sequence[FlightRecord]) -> Figure:
    """Plot rotor speeds and their steps: one panel for a single run, one panel per rotor for several."""
    panels = []
    if len(runs) == 1:
        for name, title in _INPUTS.items():
            panels.append(replace(signal_panel(runs, name), title=title, height=1.3))
        return _timed("inputs", "rotor speeds and their steps", tuple(panels), runs, columns=1)
    for rotor in range(N_ROTORS):
        for name, title in _INPUTS.items():
            signal = SIGNALS[name]
            curves = []
            for i, label, run in flown_runs(runs):
                values = signal.sampled(run.log.control)[:, rotor]
                curves.append(run_curve(i, label, run.log.control.t, values, style="steps"))
            title = f"{title}, rotor {rotor + 1}"
            panels.append(Panel(title=title, unit=signal.unit, series=tuple(curves), bounds=bounds_on(runs, name)))
    return _timed("inputs", "rotor speeds and their steps", tuple(panels), runs)


def targets(run: FlightRecord) -> list[Figure]:
    """Plot thrust and body rates that an autopilot was to fly, and what it flew; no figure without one."""
    target = run.log.control.target
    if target is None or run.log.plant.thrust is None:
        return []
    thrust = target_panel(run, "thrust", target[:, 0], "collective thrust")
    panels = [thrust]
    for i, axis in enumerate("xyz", start=1):
        rates = math.degrees(1.0) * target[:, i]
        panels.append(target_panel(run, f"body_rate_{axis}", rates, f"body rate about {axis}"))
    return [_timed("targets", "targets of the autopilot", tuple(panels), [run])]


def times(runs: Sequence[FlightRecord]) -> Figure:
    """Plot computation times against the deadline, iterations and active constraints."""
    panels = []
    for key in CLOCKS:
        if any(np.isfinite(getattr(run.log.timing, key)).any() for run in runs):
            panels.append(clock_panel(runs, key))
    for title, key in (("solver iterations", "iterations"), ("active constraints", "active")):
        curves = []
        for i, label, run in flown_runs(runs):
            counts = getattr(run.log.control, key).astype(float)
            curves.append(run_curve(i, label, run.log.control.t, counts, style="steps"))
        panels.append(Panel(title=title, y_label="count", series=tuple(curves), whole=True))
    return _timed("solve_times", "time to compute a command", tuple(panels), runs)


def effects(run: FlightRecord) -> list[Figure]:
    """Plot, as far as recorded: commanded and actual rotor speeds, forces, wind, battery, measurement errors."""
    plant = run.log.plant
    control = run.log.control
    panels = []
    commanded = commanded_speeds(run.log)
    if commanded is not None:
        for rotor in range(N_ROTORS):
            panels.append(rotor_panel(rotor, plant.t, commanded, plant.speeds))
    for effect in effect_curves(run.log):
        panels.append(curves_panel(effect.title, effect.unit, plant.t, effect.values, effect.names))
    if not control.measured_perfectly:
        for quantity, names in (("position", ("x", "y", "z")), ("attitude", ("roll", "pitch", "yaw"))):
            errors = [SIGNALS[f"{name}_estimate_error"] for name in names]
            values = np.stack([error.sampled(control) for error in errors], axis=1)
            panels.append(curves_panel(f"error of the measured {quantity}", errors[0].unit, control.t, values, names))
    if panels:
        return [_timed("effects", "effects", tuple(panels), [run])]
    return []


def space(run: FlightRecord) -> list[Figure]:
    """Plot a flight among obstacles and regions from above, and its clearances; no figure without any."""
    if not has_space(run.limits):
        return []
    panels = (from_above([run]), clearance_panel(run))
    return [_timed("space", "from above, and clearances", panels, [run], columns=1)]


def xy(run: FlightRecord) -> list[Figure]:
    """Plot a flight from above if its course moves in x and y at one height, and `space` does not show it."""
    course = run.log.control.reference[:, :3]
    spans = course.max(axis=0) - course.min(axis=0)
    planar = spans[:2].min() > _LEAST_MOTION and spans[2] < LEAST_SPANS["m"]
    if planar and not has_space(run.limits):
        return [_timed("xy", "path", (from_above([run]),), [run], columns=1)]
    return []


def _command(runs: Sequence[FlightRecord], name: str) -> Panel:
    """Plot the commanded speeds."""
    return replace(signal_panel(runs, "speed"), title="commanded rotor speed")


def _paths(runs: Sequence[FlightRecord], name: str) -> Panel:
    """Plot the paths from above."""
    return from_above(runs)


def _timed(key: str, title: str, panels: tuple[Panel, ...], runs: Sequence[FlightRecord], columns: int = 2) -> Figure:
    return Figure(key=key, title=title, panels=panels, columns=columns, end=last_time(runs))
