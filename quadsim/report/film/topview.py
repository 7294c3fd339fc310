"""The map in a film: course, flight and what acts on the vehicle, seen from above."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from quadsim.flight.rundir import Run
from quadsim.report.film import painter as ink
from quadsim.report.film.frames import Footage
from quadsim.report.film.painter import Painter
from quadsim.report.scene import has_space, obstacles_in, outlines, region_edges
from quadsim.state import Array

_LONGEST_ARROW: Final = 34.0  # how long the strongest level wind or force of a flight is drawn [design pixels]
_AROUND: Final = 1.0  # how much more is shown around where there are obstacles or regions [m]


class TopView:
    """A map of the course seen from above, width by height [design pixels], with the flight's height beside it.

    Obstacles at the vehicle's height are bright, others faint.  Where `acting`, it shows the wind as an arrow towards
    the vehicle, and the external force as one away from it.
    """

    def __init__(self, run: Run, footage: Footage, width: float, height: float, *, acting: bool) -> None:
        self._footage, self.width, self.height = footage, width, height
        plant, none = run.log.plant, np.zeros((footage.times.size, 2))
        self._wind = none if plant.wind is None or footage.wind is None else _arrows(footage.wind, plant.wind)
        self._force = none if plant.wrench is None or footage.force is None else _arrows(footage.force, plant.wrench)
        self._acting = acting
        self._obstacles, self._regions = obstacles_in(run.limits), list(region_edges(run))
        self._radius = run.vehicle.enclosing_radius
        low, high = footage.course.min(axis=0), footage.course.max(axis=0)
        slack = max(float((high - low).max()), 1.0)
        path = np.clip(footage.path, low - slack, high + slack)  # a lost vehicle leaves the map
        self._low, self._high = np.minimum(low, path.min(axis=0)), np.maximum(high, path.max(axis=0))
        if has_space(run.limits):
            self._low[:2] -= _AROUND
            self._high[:2] += _AROUND
        self._middle = 0.5 * (self._low + self._high)

    def draw(self, painter: Painter, x: float, y: float, i: int) -> None:
        """Draw the map and the height scale into a box with its corner at (x, y)."""
        width, height = self.width, self.height
        room = np.array([width - 64.0, height - 66.0])
        extent = np.maximum(self._high - self._low, 0.5)
        unit = float((room / extent[:2]).min())
        centre = np.array([x + 14 + 0.5 * room[0], y + 32 + 0.5 * room[1]])

        def place(points: Array) -> Array:
            inside: Array = np.clip(points, self._low, self._high) - self._middle
            placed: Array = centre + inside[..., :2] * (unit, -unit)
            return placed

        footage = self._footage
        flown = footage.path[: np.searchsorted(footage.path_times, footage.times[i], side="right")]
        painter.text(x + 10, y + 6, "from above", size=13, colour=ink.GREY)
        for obstacle in self._obstacles:
            for outline, meets in outlines(obstacle, footage.times[i], footage.position[i, 2], self._radius):
                points = centre + (np.clip(outline, self._low[:2], self._high[:2]) - self._middle[:2]) * (unit, -unit)
                painter.polygon(points, ink.BRICK if meets else ink.FAINT)
        for region, edges in self._regions:
            for edge in edges if region.holds_at(footage.times[i : i + 1])[0] else ():
                if not ((edge < self._low).all(axis=0) | (edge > self._high).all(axis=0))[:2].any():
                    painter.line(place(edge), ink.GREY, width=1.0)
        painter.line(place(footage.course), ink.AMBER, width=1.2)
        painter.line(place(np.concatenate([flown, footage.position[i : i + 1]])), ink.BLUE, width=2.2)
        spot = place(footage.position[i])
        yaw = footage.euler[i, 2]
        painter.line(np.stack([spot, spot + 11.0 * np.array([math.cos(yaw), -math.sin(yaw)])]), ink.WHITE, width=2.5)
        painter.dot(spot, 4.0, ink.WHITE)
        if self._acting:
            painter.arrow(spot - 1.25 * self._wind[i], self._wind[i], ink.CYAN)
            painter.arrow(spot, self._force[i], ink.VIOLET)
        longest = 0.22 * width / unit  # of 1, 2, 5 times a power of ten
        power = 10.0 ** math.floor(math.log10(longest))
        metres = max(power * factor for factor in (1.0, 2.0, 5.0) if power * factor <= longest)
        painter.box(x + width - 60 - unit * metres, y + 18, unit * metres, 2, ink.GREY)
        painter.text(x + width - 60, y + 4, f"{metres:g} m", size=12, colour=ink.GREY, anchor="ra")

        rise = room[1] / extent[2]
        bar, bottom = x + width - 26, y + 32 + room[1]

        def level(z: float) -> float:
            return float(bottom - rise * (np.clip(z, self._low[2], self._high[2]) - self._low[2]))

        painter.text(bar + 4, y + 6, "z", size=13, colour=ink.GREY, anchor="ma")
        painter.box(bar, bottom, 8, -room[1], ink.FAINT)
        painter.box(bar, bottom, 8, level(footage.position[i, 2]) - bottom, ink.BLUE)
        legend = (0.05, "reference", ink.AMBER), (0.40, "flown", ink.BLUE), (0.64, "predicted", ink.GREEN)
        for right, label, colour in legend:
            painter.text(x + right * width, y + height - 20, label, size=0.056 * width, colour=colour)


def _arrows(vectors: Array, of_flight: Array) -> Array:
    """Vectors (F, 3), world, as arrows on the map (F, 2); the longest of the flight's (M, 3 or more) sets the scale."""
    longest = max(float(np.linalg.norm(of_flight[:, :2], axis=1).max()), 1e-9)
    arrows: Array = vectors[:, :2] * (1.0, -1.0) * (_LONGEST_ARROW / longest)
    return arrows
