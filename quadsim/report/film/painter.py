"""What the captions of films are drawn with, and the map among them.  Pillow alone."""

from __future__ import annotations

import functools
import math
from typing import Any, Final

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from quadsim.flight.rundir import Run
from quadsim.report.film.frames import Footage
from quadsim.report.scene import has_space, obstacles_in, outlines, region_edges
from quadsim.state import Array

Picture = np.ndarray[Any, np.dtype[np.uint8]]
Colour = tuple[int, int, int]

WHITE: Final = (240, 243, 246)
GREY: Final = (158, 168, 178)
FAINT: Final = (74, 82, 92)
RED: Final = (255, 84, 66)
BLUE: Final = (72, 176, 255)
AMBER: Final = (255, 184, 77)
GREEN: Final = (120, 222, 150)
CYAN: Final = (126, 232, 232)
VIOLET: Final = (225, 120, 205)
BRICK: Final = (206, 104, 82)

_TEXTS: Final = 2048
"""Texts that are cached as pictures, of each size of font: a film shows most of its words in every frame."""
_SHADE: Final = (np.arange(256) * 0.24 + 12.0).astype(np.uint8)


class Painter:
    """Draws on one picture; lengths are design pixels, of `scale` real ones each."""

    def __init__(self, image: Image.Image, scale: float) -> None:
        self._canvas, self._scale = ImageDraw.Draw(image), scale

    def text(
        self, x: float, y: float, text: str, *, size: float = 15, colour: Colour = WHITE, anchor: str = "la"
    ) -> None:
        """Write at a place; `anchor` is Pillow's, `ra` for right-aligned."""
        font = _font(max(6, round(size * self._scale)))
        self._canvas.text((x * self._scale, y * self._scale), text, fill=colour, font=font, anchor=anchor)

    def box(self, x: float, y: float, width: float, height: float, colour: Colour) -> None:
        """Fill a rectangle; a negative width or height reaches to the left or up."""
        left, right = sorted((x * self._scale, (x + width) * self._scale))
        top, bottom = sorted((y * self._scale, (y + height) * self._scale))
        self._canvas.rectangle(
            (round(left), round(top), max(round(right) - 1, round(left)), max(round(bottom) - 1, round(top))),
            fill=colour,
        )

    def line(self, points: Array, colour: Colour, *, width: float = 1.5) -> None:
        """Draw through points (n, 2)."""
        if len(points) > 1:
            self._canvas.line(
                (points * self._scale).ravel().tolist(), fill=colour, width=max(1, round(width * self._scale))
            )

    def polygon(self, points: Array, colour: Colour) -> None:
        """Fill an outline (n, 2)."""
        self._canvas.polygon((points * self._scale).ravel().tolist(), fill=colour)

    def dot(self, place: Array, radius: float, colour: Colour) -> None:
        """Fill a circle."""
        self._canvas.circle((place * self._scale).tolist(), radius * self._scale, fill=colour)

    def arrow(self, start: Array, reach: Array, colour: Colour) -> None:
        """Draw from a place (2,) by `reach` (2,); nothing where that is shorter than its head."""
        head, length = 6.0, math.hypot(*reach)
        if length < head:
            return
        along = head / length * reach
        across, tip = 0.6 * np.array([-along[1], along[0]]), start + reach
        self.line(np.stack([start, tip]), colour, width=2.0)
        self.line(np.stack([tip - along + across, tip, tip - along - across]), colour, width=2.0)


def shade(frame: Picture, x: float, y: float, width: float, height: float, *, scale: float) -> None:
    """Darken a rectangle of a frame, in place, so that text on it can be read."""
    rows = slice(round(y * scale), round((y + height) * scale))
    columns = slice(round(x * scale), round((x + width) * scale))
    frame[rows, columns] = _SHADE.take(frame[rows, columns])


@functools.lru_cache(maxsize=_TEXTS)
def text_width(text: str, size: float, *, scale: float) -> float:
    """How long a text is [design pixels]."""
    return _font(max(6, round(size * scale))).getlength(text) / scale


@functools.lru_cache(maxsize=32)
def _font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    font = ImageFont.load_default(size)
    if isinstance(font, ImageFont.FreeTypeFont):  # else it is Pillow's own bitmap, which takes no time
        font.getmask2 = functools.lru_cache(maxsize=_TEXTS)(font.getmask2)  # type: ignore[assignment,method-assign]
    return font


_LONGEST_ARROW: Final = 34.0  # how long the strongest level wind or force of a flight is drawn [design pixels]
_AROUND: Final = 1.0  # how much more is shown around where there are obstacles or regions [m]


class TopView:
    """A map of the course seen from above, width by height [design pixels], with the flight's height beside it.

    Obstacles at the vehicle's height are bright, others faint.  The wind is an arrow towards the vehicle, the external
    force one away from it.
    """

    def __init__(self, run: Run, footage: Footage, width: float, height: float) -> None:
        self._footage, self.width, self.height = footage, width, height
        plant, none = run.log.plant, np.zeros((footage.times.size, 2))
        self._wind = none if plant.wind is None or footage.wind is None else _arrows(footage.wind, plant.wind)
        self._force = none if plant.wrench is None or footage.force is None else _arrows(footage.force, plant.wrench)
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
        painter.text(x + 10, y + 6, "from above", size=13, colour=GREY)
        for obstacle in self._obstacles:
            for outline, meets in outlines(obstacle, footage.times[i], footage.position[i, 2], self._radius):
                points = centre + (np.clip(outline, self._low[:2], self._high[:2]) - self._middle[:2]) * (unit, -unit)
                painter.polygon(points, BRICK if meets else FAINT)
        for region, edges in self._regions:
            for edge in edges if region.holds_at(footage.times[i : i + 1])[0] else ():
                if not ((edge < self._low).all(axis=0) | (edge > self._high).all(axis=0))[:2].any():
                    painter.line(place(edge), GREY, width=1.0)
        painter.line(place(footage.course), AMBER, width=1.2)
        painter.line(place(np.concatenate([flown, footage.position[i : i + 1]])), BLUE, width=2.2)
        spot = place(footage.position[i])
        yaw = footage.euler[i, 2]
        painter.line(np.stack([spot, spot + 11.0 * np.array([math.cos(yaw), -math.sin(yaw)])]), WHITE, width=2.5)
        painter.dot(spot, 4.0, WHITE)
        painter.arrow(spot - 1.25 * self._wind[i], self._wind[i], CYAN)
        painter.arrow(spot, self._force[i], VIOLET)
        longest = 0.22 * width / unit  # of 1, 2, 5 times a power of ten
        power = 10.0 ** math.floor(math.log10(longest))
        metres = max(power * factor for factor in (1.0, 2.0, 5.0) if power * factor <= longest)
        painter.box(x + width - 60 - unit * metres, y + 18, unit * metres, 2, GREY)
        painter.text(x + width - 60, y + 4, f"{metres:g} m", size=12, colour=GREY, anchor="ra")

        rise = room[1] / extent[2]
        bar, bottom = x + width - 26, y + 32 + room[1]

        def level(z: float) -> float:
            return float(bottom - rise * (np.clip(z, self._low[2], self._high[2]) - self._low[2]))

        painter.text(bar + 4, y + 6, "z", size=13, colour=GREY, anchor="ma")
        painter.box(bar, bottom, 8, -room[1], FAINT)
        painter.box(bar, bottom, 8, level(footage.position[i, 2]) - bottom, BLUE)
        legend = (0.05, "reference", AMBER), (0.40, "flown", BLUE), (0.64, "predicted", GREEN)
        for right, label, colour in legend:
            painter.text(x + right * width, y + height - 20, label, size=0.056 * width, colour=colour)


def _arrows(vectors: Array, of_flight: Array) -> Array:
    """Vectors (F, 3), world, as arrows on the map (F, 2); the longest of the flight's (M, 3 or more) sets the scale."""
    longest = max(float(np.linalg.norm(of_flight[:, :2], axis=1).max()), 1e-9)
    arrows: Array = vectors[:, :2] * (1.0, -1.0) * (_LONGEST_ARROW / longest)
    return arrows
