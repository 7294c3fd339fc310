"""The mismatch benchmark -> its figure: a coloured cell per controller and condition, red where the vehicle is lost."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Final, NamedTuple

from quadsim.report.figures.canvas import new_figure
from quadsim.report.palette import BOUND
from scenarios.bench.mismatch.survival import ARRIVED, FAR, MismatchBench, MismatchFlight

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_SHADES: Final = ("#bfe3d3", "#f6edb5", "#f0b968")
"""Good, fair, poor; what is lost is drawn as bounds are."""
_TILTED: Final = 0.5  # how far beyond its bound [deg] a tilt is still fair


class _Panel(NamedTuple):
    """A number of each flight, and up to where it is good, and fair."""

    title: str
    value: Callable[[MismatchFlight], float | None]
    good: float
    fair: float
    unit: str


def draw_mismatch(measured: MismatchBench) -> Figure:
    """The outcome of every controller in every condition."""
    bound = measured.tilt_bound
    tilt = f"peak tilt between samples too [deg]; the bound is {bound:g} deg"
    panels = (
        _Panel("distance from the reference at the end [m]", lambda flight: flight.end_error, ARRIVED, FAR, "m"),
        _Panel(tilt, lambda flight: flight.peak_tilt, bound, bound + _TILTED, "deg"),
    )
    width = 2.6 + 0.62 * len(measured.conditions)
    height = 1.9 + 2 * 0.27 * len(measured.controllers)
    figure = new_figure(f"{measured.scenario}: what each controller survives", max(width, 9.0), max(height, 3.4))
    for axes, panel in zip(figure.subplots(len(panels), 1, sharex=True), panels, strict=True):
        _draw_panel(axes, measured, panel)
    return figure


def _draw_panel(axes: Axes, measured: MismatchBench, panel: _Panel) -> None:
    from matplotlib.patches import Rectangle

    for row, controller in enumerate(measured.controllers):
        for column, condition in enumerate(measured.conditions):
            flight = measured.flights[controller, condition]
            colour, text = _look(flight, panel)
            axes.add_patch(Rectangle((column, row), 1.0, 1.0, facecolor=colour, edgecolor="white", linewidth=1.2))
            dark = "#1c1e21" if flight.survived else "white"
            axes.text(column + 0.5, row + 0.5, text, ha="center", va="center", fontsize=7.5, color=dark)
    axes.set(xlim=(0.0, len(measured.conditions)), ylim=(len(measured.controllers), 0.0))
    positions = [column + 0.5 for column in range(len(measured.conditions))]
    axes.set_xticks(positions, [_broken(name) for name in measured.conditions], fontsize=7.5)
    axes.set_yticks([row + 0.5 for row in range(len(measured.controllers))], [*measured.controllers], fontsize=8.5)
    axes.tick_params(length=0.0)
    axes.grid(visible=False)
    axes.spines[:].set_visible(False)
    axes.set_title(panel.title, loc="left", fontsize=9.5)
    labels = (f"up to {panel.good:g} {panel.unit}", f"up to {panel.fair:g} {panel.unit}", "more", "lost")
    keys = [Rectangle((0.0, 0.0), 1.0, 1.0, facecolor=colour) for colour in (*_SHADES, BOUND)]
    axes.legend(keys, labels, loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=4, fontsize=8.0, handlelength=1.0)


def _look(flight: MismatchFlight, panel: _Panel) -> tuple[str, str]:
    value = panel.value(flight)
    if not flight.survived or value is None:
        return BOUND, flight.fate.replace("lost, ", "")
    shade = _SHADES[0] if value <= panel.good else _SHADES[1] if value <= panel.fair else _SHADES[2]
    return shade, f"{value:.2f}"


def _broken(name: str) -> str:
    """A condition's name over as many lines as it has words, a number staying beside its unit."""
    words = name.split(" ")
    lines: list[str] = []
    for word in words:
        if lines and (lines[-1][-1].isdigit() or len(lines[-1]) + len(word) < 7):
            lines[-1] += f" {word}"
        else:
            lines.append(word)
    return "\n".join(lines)
