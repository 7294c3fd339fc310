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

WIDTH: Final = 5.5  # of a file [in]
_HEIGHT: Final = 4.0  # of the panel, which makes it about square
_ARC: Final = np.radians(np.linspace(0.0, 270.0, 61))  # of an arrow
_INNER: Final = 0.82  # radius of an arrow over the propeller's
_DIRECTIONS: Final = {1: ("clockwise", CYCLE[1]), -1: ("counter-clockwise", CYCLE[0])}
"""How a rotor turns, seen from above, by the sign of its reaction torque about body +z, which opposes the turn."""


def drawing_file(path: Path | str, *, overwrite: bool = False) -> Path:
    """Return where a drawing will be; errors as `quadsim.report.to_matplotlib.figure_file`."""
    return figure_file(path, overwrite=overwrite)


def write_drawing(vehicle: Vehicle, path: Path, *, overwrite: bool = False) -> None:
    """Write the drawing as PDF, SVG or PNG; errors as `quadsim.report.to_matplotlib.write_figure`."""
    write_figure(vehicle_figure(vehicle), path, width=WIDTH, overwrite=overwrite)


def vehicle_figure(vehicle: Vehicle) -> Figure:
    """The drawing; propellers of unknown size are drawn as large as they fit."""
    hubs = vehicle.hubs
    places = on_page(hubs)
    arms = np.hypot(*hubs[:, :2].T)
    radius = vehicle.rotor_radius or 0.5 * vehicle.closest_rotors
    reach = vehicle.longest_arm + radius
    level = not np.any(hubs[:, 2])
    digits = max(0, 2 - math.floor(math.log10(reach)))  # three, for a length of this size
    areas: list[Area] = []
    lines: list[Series] = []
    labels: list[Label] = []
    for number, (hub, place, arm, spin) in enumerate(
        zip(hubs, places, arms.tolist(), vehicle.rotor_spins, strict=True), start=1
    ):
        turning, colour = _DIRECTIONS[spin]
        arrow = place + _INNER * radius * _unit(0.5 * math.pi + spin * (0.75 * math.pi - _ARC))
        areas.append(Area(outline=place + radius * _unit(np.linspace(0.0, math.tau, 73)), colour=colour, opacity=0.15))
        areas.append(_arrow_head(arrow[-5], arrow[-1], 0.12 * radius, colour))
        if arm > radius:
            lines.append(_line(np.stack([np.zeros(2), (1.0 - radius / arm) * place]), COLOUR.measured, width=2.0))
        lines.append(_line(arrow, colour, label=f"turns {turning}"))
        where = ", ".join(f"{value:z.{digits}f}" for value in hub[: 2 if level else 3])
        for height, text in ((0.32, str(number)), (0.0, where), (-0.28, f"arm {arm:.{digits}f}")):
            labels.append(_label(place + np.array([0.0, height * radius]), text, bold=text == str(number)))
    for tip, name, colour in (((0.0, 1.0), "x", COLOUR.axis_x), ((-1.0, 0.0), "y", COLOUR.axis_y)):
        end = 0.28 * reach * np.array(tip)
        areas.append(_arrow_head(0.85 * end, end, 0.03 * reach, colour))
        lines.append(_line(np.stack([np.zeros(2), 0.9 * end]), colour, width=2.5))
        labels.append(_label(end + _beside(end, 0.06 * reach), name, colour=colour, bold=True))
    top = np.array([0.0, float(places[:, 1].max()) + 1.5 * radius])
    areas.append(_arrow_head(top - np.array([0.0, 0.2 * radius]), top, 0.15 * radius, COLOUR.axis_x))
    labels.append(_label(top + np.array([0.5 * radius, -0.1 * radius]), "front", bold=True))
    if vehicle.rotor_radius:
        unknown = ""
    else:
        unknown = "; propellers of unknown size, as large as fit"
    panel = Panel(
        title=f"hubs: {'x, y' if level else 'x, y, z'} [m], arm [m]; {2.0 * reach:.3g} m across{unknown}",
        areas=tuple(areas),
        series=tuple(lines),
        labels=tuple(labels),
        x_label="to the right, -y [m]",
        y_label="to the front, x [m]",
        equal=True,
        height=_HEIGHT,
    )
    return Figure(key="vehicle", title=f"{vehicle.name} from above, {vehicle.mass:.4g} kg", panels=(panel,), columns=1)


def on_page(points: Array) -> Array:
    """(n, 2) to the right and up on the page, for points (n, 3) in body axes [m]."""
    return np.stack([-points[:, 1], points[:, 0]], axis=1)


def _unit(angles: Array) -> Array:
    """(n, 2) directions of angles (n,) [rad], counter-clockwise from the right."""
    return np.stack([np.cos(angles), np.sin(angles)], axis=1)


def _beside(direction: Array, distance: float) -> Array:
    """(2,) a step of this length to the right of a direction."""
    return distance * np.array([direction[1], -direction[0]]) / math.hypot(*direction)


def _arrow_head(base: Array, tip: Array, half_width: float, colour: str) -> Area:
    side = _beside(tip - base, half_width)
    return Area(outline=np.stack([base - side, tip, base + side]), colour=colour, opacity=1.0)


def _line(points: Array, colour: str, label: str = "", width: float = 1.6) -> Series:
    return Series(x=points[:, 0], y=points[:, 1], colour=colour, label=label, width=width)


def _label(place: Array, text: str, *, colour: str = "", bold: bool = False) -> Label:
    return Label(x=float(place[0]), y=float(place[1]), text=text, colour=colour, bold=bold)
