"""A finished run -> what acted on its vehicle beyond the paper's model, and what its controller was told wrong."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from quadsim.audit import SIGNALS
from quadsim.effect_curves import commanded_speeds, effect_curves
from quadsim.figures.canvas import finish_figure, keep_least_span, new_figure, run_end, run_title
from quadsim.palette import REFERENCE, line_colour
from quadsim.rundir import Run
from quadsim.state import Array
from quadsim.vehicle import N_ROTORS

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

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
        for name, asked, turned in zip(_ROTORS, commanded.T, log.plant.speeds.T, strict=True):
            shown["commanded"] = panels[name].plot(
                log.plant.t, asked, color=REFERENCE, drawstyle="steps-post", linewidth=1.0
            )[0]
            shown["acting"] = panels[name].plot(log.plant.t, turned, color=line_colour(0), linewidth=1.0)[0]
            panels[name].set_ylabel(f"{name} [rad/s]")
    for entry in curves:
        _draw_triple(panels[entry.key], log.plant.t, entry.values, "xyz", f"{entry.title}\n[{entry.unit}]")
        keep_least_span(panels[entry.key], entry.unit)
    if not log.control.measured_perfectly:
        for what, names in _ERRORS.items():
            signals = [SIGNALS[f"{name}_estimate_error"] for name in names]
            values = np.stack([signal.sampled(log.control) for signal in signals], axis=1)
            label = f"{what} as told,\nless the true one [{signals[0].unit}]"
            _draw_triple(panels[what], log.control.t, values, names, label, drawstyle="steps-post")
            keep_least_span(panels[what], signals[0].unit)
    bottom = [panels[name] for rows in (halves, wholes) if rows for name in dict.fromkeys(rows[-1])]
    for axes in bottom:
        axes.tick_params(labelbottom=True)
    finish_figure(figure, bottom, shown, run_end(run))
    return figure


def _draw_triple(axes: Axes, t: Array, values: Array, names: Sequence[str], label: str, **style: Any) -> None:
    """Draw three curves (M, 3), with the panel's own legend above it, where it hides nothing."""
    for i, (name, column) in enumerate(zip(names, values.T, strict=True)):
        axes.plot(t, column, color=line_colour(1 + i), linewidth=1.0, label=name, **style)
    axes.set_ylabel(label)
    axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), borderaxespad=0.1, ncols=3)
