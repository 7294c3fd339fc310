"""A study of what constraints cost -> its figures."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from quadsim.report.figures.canvas import new_figure, write_drawings
from quadsim.report.palette import BOUND, REFERENCE, line_colour
from scenarios.cost.cost_curves import Panel, lost_at, step_curves, sweep_panels
from scenarios.cost.study import CostStudy, Sweep

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def write_cost_figures(study: CostStudy, directory: Path) -> list[Path]:
    """Draw step times and both sweeps: `cost_steps`, `cost_tilt` and `cost_horizon`, PNG and SVG of each.

    Raises:
        OutputError: the directory cannot be written.
    """
    steps = {"cost_steps": lambda: _draw_steps(study)} if study.candidates else {}
    sweeps = {
        "cost_tilt": lambda: _draw_sweep(study, study.tilt, "over the bound on roll and pitch"),
        "cost_horizon": lambda: _draw_sweep(study, study.horizons, "over the horizon"),
    }
    return write_drawings({**steps, **sweeps}, directory)


def _draw_steps(study: CostStudy) -> Figure:
    figure = new_figure(f"{study.name}: time to compute a command, by what computes it", 9.6, 4.2)
    axes = figure.subplots()
    for curve in step_curves(study):
        axes.plot(curve.x, curve.y, color=line_colour(curve.colour), linewidth=1.6, label=curve.label)
    axes.axvline(study.deadline_ms, color=BOUND, linestyle="--", linewidth=1.1, label="the control period")
    axes.set_xscale("log")
    axes.xaxis.set_major_formatter("{x:g}")
    axes.set(xlabel="time of a whole controller step [ms]", ylabel="periods answered by then [%]")
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure


def _draw_sweep(study: CostStudy, sweep: Sweep, over: str) -> Figure:
    figure = new_figure(f"{study.name}: what constraints cost {over}", 9.6, 8.0)
    panels = figure.subplots(3, 2, sharex=True)
    for axes, panel in zip(panels.flat, sweep_panels(study, sweep), strict=True):
        _draw_panel(axes, panel)
        _draw_marks(axes, sweep, panel)
        if sweep.base is not None:
            axes.axvline(sweep.base, color=REFERENCE, linestyle=":", linewidth=1.0)
    for axes in panels[-1]:
        axes.set_xlabel(f"{sweep.name} [{sweep.unit}]")
    figure.align_ylabels()
    with_them, without = lost_at(sweep)
    parts = ["dashed: without constraints", "dotted: the flight that is studied"]
    parts += ["grey x: lost without constraints"] * bool(without) + ["red x: lost with constraints"] * bool(with_them)
    parts += ["red triangle: does not settle"] * any(panel.never for panel in sweep_panels(study, sweep))
    figure.supxlabel(";  ".join(parts), fontsize=8.5, color="#5b6067")
    return figure


def _draw_panel(axes: Axes, panel: Panel) -> None:
    from matplotlib.ticker import LogLocator, NullFormatter

    named = []
    for curve in panel.curves:
        (line,) = axes.plot(curve.x, curve.y, color=line_colour(curve.colour), label=curve.label)
        if curve.dashed:
            line.set(linestyle="--", linewidth=1.0)
        else:
            line.set(marker="o", markersize=3.5)
            named.append(line)
    if panel.logarithmic:
        axes.set_yscale("log")
        axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.yaxis.set_major_formatter("{x:g}")
        axes.yaxis.set_minor_formatter(NullFormatter())
    axes.set_ylabel(panel.label)
    if len(named) > 1:
        axes.legend(handles=named, fontsize=8.2)


def _draw_marks(axes: Axes, sweep: Sweep, panel: Panel) -> None:
    """Crosses at the foot of a panel where the vehicle is lost, and what never settles at its head."""
    with_them, without = lost_at(sweep)
    free = without if any(curve.dashed for curve in panel.curves) else []
    across = axes.get_xaxis_transform()
    for values, text, y, colour in (
        (free, "x", 0.01, REFERENCE),
        (with_them, "x", 0.01, BOUND),
        (panel.never, "▲", 0.95, BOUND),
    ):
        for value in values:
            axes.text(value, y, text, transform=across, color=colour, ha="center", fontsize=8, fontweight="bold")
