"""A finished run -> the paper's figures, and several runs overlaid."""

from __future__ import annotations

import dataclasses
import io
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from quadsim.flight.audit import SIGNALS, Limit, SpaceLimit
from quadsim.flight.rundir import Run
from quadsim.report.comparison import distinct_courses, run_names
from quadsim.report.curves import bounds_of, break_at_wraps, commanded_speeds, effect_curves, reference_curve
from quadsim.report.figures.canvas import finish_figure, keep_least_span, new_figure, run_title, write_drawings
from quadsim.report.palette import BOUND, OBSTACLE, REFERENCE, line_colour
from quadsim.report.scene import has_space, obstacles_in, outlines, region_edges
from quadsim.state import POSITION, REFERENCE_NAMES, STATE_NAMES, Array
from quadsim.vehicle import N_ROTORS

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

PAPER_FIGURES: Final = {
    "paper-unconstrained": ("figure2_", "figure3_"),
    "paper-constrained": ("figure4_", "figure5_"),
}
"""Before the names of the figures of states and of inputs, by scenario: their numbers in the paper."""


def write_figures(run: Run, directory: Path) -> list[Path]:
    """Draw one run: states and inputs in the paper's arrangement, the solve times, and its effects where it has any.

    The two scenarios of the paper carry its figure numbers in their file names, e.g. `figure4_states.png`.  Nothing is
    drawn where no control period was flown; else see `quadsim.report.figures.canvas.write_drawings`.
    """
    if not run.log.control.t.size:
        return []
    states, inputs = PAPER_FIGURES.get(run.name, ("", ""))
    drawings = {
        f"{states}states": lambda: _draw_states(run),
        f"{inputs}inputs": lambda: _draw_inputs(run),
        "solve_times": lambda: _draw_solve_times(run),
    }
    if has_effects(run):
        drawings["effects"] = lambda: draw_effects(run)
    if has_space(run.limits):
        drawings["space"] = lambda: draw_space(run)
    return write_drawings(drawings, directory)


def comparison_figure(runs: Sequence[Run], directory: Path) -> list[Path]:
    """Overlay one or more runs of any course and vehicle as `comparison.png` and `.svg`; errors as `write_drawings`.

    They show position, roll and pitch, and between which speeds the rotors turned.
    """
    return write_drawings({"comparison": lambda: _draw_comparison(runs)}, directory)


def _draw_states(run: Run) -> Figure:
    figure = new_figure(run_title(run, "position and attitude"), 9.6, 6.4)
    panels = figure.subplots(3, 2, sharex=True)
    shown: dict[str, Artist] = {}
    plant = run.log.plant
    names = ("x", "y", "z", "tilt") if plant.attitude is not None else ("x", "y", "z", "roll", "pitch", "yaw")
    for axes, name in zip(panels.T.flat, names, strict=False):
        shown |= draw_signal(axes, run, name)
    if plant.attitude is not None and plant.body_rates is not None:  # may turn upside down
        _draw_several(panels[1, 1], plant.t, plant.attitude, "wxyz", "quaternion")
        _draw_several(panels[2, 1], plant.t, np.degrees(plant.body_rates), "xyz", "body rates [deg/s]")
    return finish_figure(figure, panels[-1], shown, run.end)


def plot_signals(run: Run, names: Sequence[str]) -> list[Axes]:
    """The same in a figure of pyplot, which notebooks and `pyplot.show` show; see `draw_signals`."""
    from matplotlib import pyplot

    return draw_signals(pyplot.figure(figsize=(8.0, 0.9 + 1.4 * len(names)), layout="constrained"), run, names)


def signals_png(run: Run, names: Sequence[str]) -> bytes:
    """A small PNG of signals of the audit."""
    from matplotlib.figure import Figure

    figure, png = Figure(figsize=(6.0, 3.2), layout="constrained"), io.BytesIO()
    draw_signals(figure, run, names)
    figure.savefig(png, format="png", dpi=90)
    return png.getvalue()


def draw_signals(figure: Figure, run: Run, names: Sequence[str]) -> list[Axes]:
    """Draw signals of the audit over time, a panel each, into an empty figure; returns the panels, top to bottom."""
    panels = list(figure.subplots(len(names), 1, sharex=True, squeeze=False)[:, 0])
    shown: dict[str, Artist] = {}
    for axes, name in zip(panels, names, strict=True):
        shown |= draw_signal(axes, run, name)
        axes.grid(alpha=0.4)
    finish_figure(figure, panels[-1:], shown, run.end)
    return panels


def draw_signal(axes: Axes, run: Run, name: str) -> dict[str, Artist]:
    """Draw a signal of the audit with its reference and its bounds; returns the legend's entries."""
    signal, control = SIGNALS[name], run.log.control
    shown: dict[str, Artist] = {}
    sampled = signal.sampled(control)
    if sampled.ndim == 1 and signal.plant is not None:
        shown["flight"] = _draw_plant(axes, run, name, line_colour(0))
    else:
        for i, values in enumerate(np.atleast_2d(sampled.T)):
            label = "flight" if sampled.ndim == 1 else f"rotor {i + 1}"
            shown[label] = axes.plot(control.t, values, color=line_colour(i), drawstyle="steps-post", linewidth=1.0)[0]
    shown |= _draw_measured(axes, run, name) if name in STATE_NAMES else {}
    shown |= _draw_reference(axes, run, name)
    shown |= _draw_bounds(axes, run.limits, name, run.end)
    axes.set_ylabel(f"{name} [{signal.unit}]")
    keep_least_span(axes, signal.unit)
    return shown


def _draw_inputs(run: Run) -> Figure:
    figure = new_figure(run_title(run, "rotor speeds and their steps"), 9.6, 5.6)
    panels = figure.subplots(2, 1, sharex=True)
    shown: dict[str, Artist] = {}
    labels = {"speed": "rotor speed [rad/s]", "slew": "step per period [rad/s]"}
    for axes, (name, label) in zip(panels, labels.items(), strict=True):
        values = SIGNALS[name].sampled(run.log.control)
        for rotor in range(N_ROTORS):
            width = 2.2 - 0.5 * rotor  # where rotors turn alike, each is seen beneath the next
            shown[f"rotor {rotor + 1}"] = axes.plot(
                run.log.control.t, values[:, rotor], color=line_colour(rotor), drawstyle="steps-post", linewidth=width
            )[0]
        shown |= _draw_bounds(axes, run.limits, name, run.end)
        axes.set_ylabel(label)
        keep_least_span(axes, SIGNALS[name].unit)
    return finish_figure(figure, panels[-1:], shown, run.end)


def _draw_solve_times(run: Run) -> Figure:
    figure = new_figure(run_title(run, "time to compute a command"), 9.6, 6.0)
    times, iterations, active = figure.subplots(3, 1, sharex=True, height_ratios=(2.4, 1.0, 1.0))
    timing, control = run.log.timing, run.log.control
    deadline = run.summary["controller"]["deadline_ms"]
    for i, (name, values) in enumerate({"whole step": timing.step_ms, "optimum alone": timing.solve_ms}.items()):
        p50, p99 = np.percentile(values, [50, 99])
        label = f"{name}: median {p50:.3g}, p99 {p99:.3g}, max {values.max():.3g} ms"
        shown = values > 0.0  # a clock may read 0, which has no place on a logarithmic axis
        times.plot(timing.t[shown], values[shown], ".", markersize=2.5, color=line_colour(i), label=label)
    times.axhline(deadline, color=BOUND, linestyle="--", linewidth=1.1, label=f"deadline: {deadline:g} ms")
    times.set_yscale("log")
    times.yaxis.set_major_formatter("{x:g}")
    times.set_ylabel("time [ms]")
    iterations.plot(control.t, control.iterations, drawstyle="steps-post", color=line_colour(2), linewidth=1.0)
    active.plot(control.t, control.active, drawstyle="steps-post", color=line_colour(3), linewidth=1.0)
    for axes, label in ((iterations, "iterations"), (active, "active constraints")):
        axes.set_ylabel(label)
        top = max(1.0, axes.get_ylim()[1])
        axes.set_ylim(-0.05 * top, top)
        axes.locator_params(axis="y", integer=True, min_n_ticks=1)
    times.legend(
        loc="lower left", bbox_to_anchor=(0.0, 1.0), borderaxespad=0.2, ncols=3, fontsize=8.2, columnspacing=1.2
    )
    return finish_figure(figure, (active,), {}, run.end)


def _draw_comparison(runs: Sequence[Run]) -> Figure:
    figure = new_figure("", 9.6, 6.4)
    panels = figure.subplots(3, 2, sharex=True)
    signals = dict(zip(("x", "y", "z", "roll", "pitch", "speed"), panels.T.flat, strict=True))
    end = max(run.end for run in runs)
    shown: dict[str, Artist] = {}
    for run in distinct_courses(runs):
        for name in ("x", "y", "z"):
            shown |= _draw_reference(signals[name], run, name)
    for i, (label, run) in enumerate(zip(run_names(runs), runs, strict=True)):
        colour = line_colour(i)
        for name in ("x", "y", "z", "roll", "pitch"):
            shown[label] = _draw_plant(signals[name], run, name, colour)
        t, speeds = run.log.control.t, run.log.control.speeds
        signals["speed"].fill_between(
            t, speeds.min(axis=1), speeds.max(axis=1), step="post", color=colour, alpha=0.6, linewidth=0.9
        )
    limits = [limit for run in runs for limit in run.limits]
    for name, axes in signals.items():
        shown |= _draw_bounds(axes, limits, name, end)
        axes.set_ylabel(f"{name} [{SIGNALS[name].unit}]")
        keep_least_span(axes, SIGNALS[name].unit)
    signals["speed"].set_ylabel("lowest to highest\nrotor speed [rad/s]")
    return finish_figure(figure, panels[-1], shown, end)


def _draw_plant(axes: Axes, run: Run, name: str, colour: str) -> Artist:
    """Draw a signal of the plant; returns the legend's entry for it."""
    signal = SIGNALS[name].plant
    assert signal is not None, name
    drawn = break_at_wraps(run.log.plant.t, signal(run.log.plant), SIGNALS[name].unit)
    return axes.plot(*drawn, color=colour)[0]


def _draw_measured(axes: Axes, run: Run, name: str) -> dict[str, Artist]:
    """Draw a state as measured, beneath the true one; none where they are the same."""
    control, signal = run.log.control, SIGNALS[name]
    if control.measured_perfectly:
        return {}
    measured = signal.sampled(dataclasses.replace(control, truth=control.state))
    drawn = break_at_wraps(control.t, measured, signal.unit)
    return {"measured": axes.plot(*drawn, color=line_colour(1), linewidth=0.7, zorder=1.9)[0]}


def _draw_reference(axes: Axes, run: Run, name: str) -> dict[str, Artist]:
    """Draw the filtered reference of a signal that has one; returns the legend's entry for it."""
    if name not in REFERENCE_NAMES:
        return {}
    values = reference_curve(run.log.control, name)
    line = axes.plot(run.log.control.t, values, color=REFERENCE, linestyle=(0, (5, 2)), linewidth=1.1)[0]
    return {"reference, filtered": line}


def _draw_bounds(axes: Axes, limits: Sequence[Limit], signal: str, end: float) -> dict[str, Artist]:
    """Draw the bounds on a signal over the times they hold for; returns the legend's entry for them."""
    shown: dict[str, Artist] = {}
    for bound, start, stop in bounds_of(limits, signal, end):
        shown["bound"] = axes.hlines(bound, start, stop, color=BOUND, linestyle="--", linewidth=1.1)
    return shown


_MOST_NAMED: Final = 9  # obstacles and regions of which each is named in the legend
_NEAR: Final = 3.0  # clearance [m] below which a moving obstacle is drawn, and up to which curves are shown
_EVERY: Final = 0.25  # how often it is drawn [s]


def draw_space(run: Run) -> Figure:
    """A flight among obstacles and regions from above, and how far it stays clear of each over time."""
    figure = new_figure(run_title(run, "from above, and clearances"), 9.6, 7.4)
    above, below = figure.subplots(2, 1, height_ratios=(3.0, 2.0))
    shown: dict[str, Artist] = {}
    clear = [limit for limit in run.limits if isinstance(limit, SpaceLimit)]
    clearances = {limit.name: limit.source.finest(run.log) for limit in clear}
    for obstacle in obstacles_in(run.limits):
        t, values = clearances[obstacle.name]
        near = t[values < _NEAR]
        for instant in np.arange(near[0], near[-1], _EVERY) if obstacle.moves and near.size else [0.0]:
            for outline, _ in outlines(obstacle, instant, 0.0, np.inf):
                alpha = 0.3 if obstacle.moves else 0.55
                shown["obstacle"] = above.fill(*outline.T, color=OBSTACLE, alpha=alpha, linewidth=0.0)[0]
    for _, edges in region_edges(run):
        for edge in edges[:, :, :2]:
            shown["region"] = above.plot(*edge.T, color=BOUND, linestyle="--", linewidth=0.9)[0]
    course, path = run.log.control.reference, run.log.plant.state[:, POSITION]
    shown["reference, filtered"] = above.plot(
        course[:, 0], course[:, 1], color=REFERENCE, linestyle=(0, (5, 2)), linewidth=1.1
    )[0]
    shown["flight"] = above.plot(path[:, 0], path[:, 1], color=line_colour(0))[0]
    above.set_aspect("equal", adjustable="datalim")
    above.set_xlabel("x [m]")
    above.set_ylabel("y [m]")
    for limit in clear:
        t, values = clearances[limit.name]
        below.plot(t, np.where(limit.holds_at(t), values, np.nan), linewidth=1.0, label=limit.name)
    below.axhline(0.0, color=BOUND, linestyle="--", linewidth=1.1)
    below.set_ylabel("clearance [m]")
    below.set_ylim(top=min(below.get_ylim()[1], _NEAR))
    if len(clear) <= _MOST_NAMED:
        below.legend(loc="upper right", ncols=3, fontsize=8.0)
    return finish_figure(figure, (below,), shown, run.end)


_ERRORS: Final = {"position": ("x", "y", "z"), "attitude": ("roll", "pitch", "yaw")}
_ROTORS: Final = tuple(f"rotor {i}" for i in range(1, N_ROTORS + 1))


def has_effects(run: Run) -> bool:
    """Whether there is anything to draw: a command that acted otherwise, a force, wind, an imperfect measurement."""
    log = run.log
    return commanded_speeds(log) is not None or bool(effect_curves(log)) or not log.control.measured_perfectly


def draw_effects(run: Run) -> Figure:
    """Commanded and acting speed of each rotor, forces, torques, wind, and estimation errors: those that there are."""
    log = run.log
    commanded, curves = commanded_speeds(log), effect_curves(log)
    halves = [] if commanded is None else [_ROTORS[:2], _ROTORS[2:]]
    halves += [] if log.control.measured_perfectly else [tuple(_ERRORS)]
    wholes = [(entry.key, entry.key) for entry in curves]
    figure = new_figure(run_title(run, "effects"), 9.6, 1.1 + 1.9 * len(halves + wholes))
    panels = figure.subplot_mosaic([list(row) for row in halves + wholes], sharex=True)
    shown: dict[str, Artist] = {}
    if commanded is not None:
        for name, command, turned in zip(_ROTORS, commanded.T, log.plant.speeds.T, strict=True):
            shown["commanded"] = panels[name].plot(
                log.plant.t, command, color=REFERENCE, drawstyle="steps-post", linewidth=1.0
            )[0]
            shown["acting"] = panels[name].plot(log.plant.t, turned, color=line_colour(0), linewidth=1.0)[0]
            panels[name].set_ylabel(f"{name} [rad/s]")
    for entry in curves:
        _draw_several(panels[entry.key], log.plant.t, entry.values, "xyz", f"{entry.title}\n[{entry.unit}]")
        keep_least_span(panels[entry.key], entry.unit)
    if not log.control.measured_perfectly:
        for what, names in _ERRORS.items():
            signals = [SIGNALS[f"{name}_estimate_error"] for name in names]
            values = np.stack([signal.sampled(log.control) for signal in signals], axis=1)
            label = f"{what} as measured,\nless the true one [{signals[0].unit}]"
            _draw_several(panels[what], log.control.t, values, names, label, drawstyle="steps-post")
            keep_least_span(panels[what], signals[0].unit)
    bottom = [panels[name] for rows in (halves, wholes) if rows for name in dict.fromkeys(rows[-1])]
    for axes in bottom:
        axes.tick_params(labelbottom=True)
    return finish_figure(figure, bottom, shown, run.end)


def _draw_several(axes: Axes, t: Array, values: Array, names: Sequence[str], label: str, **style: Any) -> None:
    """Draw curves (M, n), with the panel's own legend above it, where it hides nothing."""
    for i, (name, column) in enumerate(zip(names, values.T, strict=True)):
        axes.plot(t, column, color=line_colour(1 + i), linewidth=1.0, label=name, **style)
    axes.set_ylabel(label)
    axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), borderaxespad=0.1, ncols=len(names))
