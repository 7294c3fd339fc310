"""A labelled drawing of a vehicle from above: numbers, spins, places and arms of its rotors, its front and its axes.

The page is the body's x-y plane seen against body z: x, the front, points up, y to the left.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Final

import numpy as np

from quadsim.palette import COLOUR, CYCLE
from quadsim.report.figure import Area, Figure, Label, Panel, Series
from quadsim.report.to_matplotlib import figure_file, write_figure
from quadsim.state import Array
from quadsim.vehicle import Vehicle

DRAWING_WIDTH: Final = 5.5  # of a file [in]
_HEIGHT: Final = 4.0  # of the panel, which makes it about square
_ARC: Final = np.radians(np.linspace(0.0, 270.0, 61))  # angles along the arrow that shows how a rotor turns
_ARROW_RADIUS: Final = 0.82  # of that arrow, over the propeller's
_TURNS: Final = {1: ("clockwise", CYCLE[1]), -1: ("counter-clockwise", CYCLE[0])}
"""How a rotor turns, seen from above, by the sign of its reaction torque about body +z, which opposes the turn."""


def drawing_file(path: Path | str, *, overwrite: bool = False) -> Path:
    """Return where a drawing will be; errors as `quadsim.report.to_matplotlib.figure_file`."""
    return figure_file(path, overwrite=overwrite)


def write_drawing(vehicle: Vehicle, path: Path, *, overwrite: bool = False) -> None:
    """Write the drawing as PDF, SVG or PNG; errors as `quadsim.report.to_matplotlib.write_figure`."""
    write_figure(vehicle_figure(vehicle), path, width=DRAWING_WIDTH, overwrite=overwrite)


def vehicle_figure(vehicle: Vehicle) -> Figure:
    """The drawing; propellers of unknown size are drawn as large as they fit."""
    radius = vehicle.rotor_radius or 0.5 * vehicle.closest_rotors
    reach = vehicle.longest_arm + radius
    places = on_page(vehicle.hubs)
    drawing = _Drawing()
    _draw_rotors(drawing, vehicle, places, radius)
    _draw_axis(drawing, np.array([0.0, 1.0]), "x", COLOUR.axis_x, reach)
    _draw_axis(drawing, np.array([-1.0, 0.0]), "y", COLOUR.axis_y, reach)
    top = np.array([0.0, float(places[:, 1].max()) + 1.5 * radius])
    drawing.arrow_head(top - np.array([0.0, 0.2 * radius]), top, 0.15 * radius, COLOUR.axis_x)
    drawing.label(top + np.array([0.5 * radius, -0.1 * radius]), "front", bold=True)
    coordinates = "x, y, z"
    if _level(vehicle):
        coordinates = "x, y"
    title = f"hubs: {coordinates} [m], arm [m]; {2.0 * reach:.3g} m across"
    if not vehicle.rotor_radius:
        title += "; propellers of unknown size, as large as fit"
    panel = Panel(
        title=title,
        areas=tuple(drawing.areas),
        series=tuple(drawing.lines),
        labels=tuple(drawing.labels),
        x_label="to the right, -y [m]",
        y_label="to the front, x [m]",
        equal=True,
        height=_HEIGHT,
    )
    return Figure(key="vehicle", title=f"{vehicle.name} from above, {vehicle.mass:.4g} kg", panels=(panel,), columns=1)


def _draw_rotors(drawing: _Drawing, vehicle: Vehicle, places: Array, radius: float) -> None:
    """Draw each rotor at its place on the page: propeller, arm, number, coordinates and how it turns."""
    reach = vehicle.longest_arm + radius
    digits = max(0, 2 - math.floor(math.log10(reach)))  # three, for a length of this size
    arms = np.hypot(*vehicle.hubs[:, :2].T).tolist()
    circle = radius * _unit(np.linspace(0.0, math.tau, 73))
    for i, (hub, place, arm, spin) in enumerate(zip(vehicle.hubs, places, arms, vehicle.rotor_spins, strict=True)):
        turning, colour = _TURNS[spin]
        arrow = place + _ARROW_RADIUS * radius * _unit(0.5 * math.pi + spin * (0.75 * math.pi - _ARC))
        drawing.areas.append(Area(outline=place + circle, colour=colour, opacity=0.15))
        drawing.arrow_head(arrow[-5], arrow[-1], 0.12 * radius, colour)
        if arm > radius:
            drawing.line(np.stack([np.zeros(2), (1.0 - radius / arm) * place]), COLOUR.measured, width=2.0)
        drawing.line(arrow, colour, label=f"turns {turning}")
        coordinates = hub
        if _level(vehicle):
            coordinates = hub[:2]
        where = ", ".join(f"{value:z.{digits}f}" for value in coordinates)
        drawing.label(place, str(i + 1), above=0.32 * radius, bold=True)
        drawing.label(place, where)
        drawing.label(place, f"arm {arm:.{digits}f}", above=-0.28 * radius)


def _draw_axis(drawing: _Drawing, direction: Array, name: str, colour: str, reach: float) -> None:
    """Draw one of the body's axes."""
    end = 0.28 * reach * direction
    drawing.arrow_head(0.85 * end, end, 0.03 * reach, colour)
    drawing.line(np.stack([np.zeros(2), 0.9 * end]), colour, width=2.5)
    drawing.label(end + _beside(end, 0.06 * reach), name, colour=colour, bold=True)


def _level(vehicle: Vehicle) -> bool:
    """Whether all hubs are at the height of the centre of mass."""
    return not np.any(vehicle.hubs[:, 2])


def on_page(points: Array) -> Array:
    """(n, 2) to the right and up on the page, for points (n, 3) in body axes [m]."""
    return np.stack([-points[:, 1], points[:, 0]], axis=1)


def _unit(angles: Array) -> Array:
    """(n, 2) directions of angles (n,) [rad], counter-clockwise from the right."""
    return np.stack([np.cos(angles), np.sin(angles)], axis=1)


def _beside(direction: Array, distance: float) -> Array:
    """(2,) a step of this length to the right of a direction."""
    return distance * np.array([direction[1], -direction[0]]) / math.hypot(*direction)


class _Drawing:
    """What is drawn so far."""

    def __init__(self) -> None:
        self.areas: list[Area] = []
        self.lines: list[Series] = []
        self.labels: list[Label] = []

    def arrow_head(self, base: Array, tip: Array, half_width: float, colour: str) -> None:
        side = _beside(tip - base, half_width)
        self.areas.append(Area(outline=np.stack([base - side, tip, base + side]), colour=colour, opacity=1.0))

    def line(self, points: Array, colour: str, label: str = "", width: float = 1.6) -> None:
        self.lines.append(Series(x=points[:, 0], y=points[:, 1], colour=colour, label=label, width=width))

    def label(self, place: Array, text: str, *, above: float = 0.0, colour: str = "", bold: bool = False) -> None:
        """Write a text at a place, or `above` it."""
        x, y = (place + np.array([0.0, above])).tolist()
        self.labels.append(Label(x=x, y=y, text=text, colour=colour, bold=bold))
