"""The captions of a film: what the flight's numbers are at this frame, and which limits it breaks.  Pillow alone."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any, Final

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from quadsim.audit import Limit
from quadsim.controller import ACCEPTED
from quadsim.footage import Footage
from quadsim.rundir import Run
from quadsim.state import INDEX, REFERENCE_NAMES, REFERENCE_STATES, Array

Picture = np.ndarray[Any, np.dtype[np.uint8]]
Colour = tuple[int, int, int]
_Panel = Callable[[float, float, int], None]

WHITE: Final = (240, 243, 246)
GREY: Final = (158, 168, 178)
FAINT: Final = (74, 82, 92)
RED: Final = (255, 84, 66)
BLUE: Final = (72, 176, 255)
AMBER: Final = (255, 184, 77)
GREEN: Final = (120, 222, 150)

_SHADE: Final = (np.arange(256) * 0.24 + 12.0).astype(np.uint8)
_STRIP: Final = 150
"""Height of the bottom strip, in design pixels of a 1280 x 720 frame."""
_COMPACT_SCALE: Final = 1.6
_MAP: Final = (236, 190)
"""Width and height of the map, in design pixels."""
_COMPACT_MAP: Final = (180, 150)
_MOST_MARGINS: Final = 6


class Overlay:
    """Draws the captions of one film onto its frames.

    Lengths below are design pixels of a 1280 x 720 frame, scaled to the frame's real size.
    """

    def __init__(self, run: Run, footage: Footage, *, width: int, height: int, compact: bool = False) -> None:
        self._run, self._footage, self._compact = run, footage, compact
        self._scale = min(width / 1280.0, height / 720.0) * (_COMPACT_SCALE if compact else 1.0)
        self._width, self._height = width / self._scale, height / self._scale
        controller = run.summary.get("controller", {})
        self._subtitle = "  ·  ".join(filter(None, (controller.get("name"), controller.get("solver"))))
        self._top_view = _TopView(footage, *(_COMPACT_MAP if compact else _MAP))
        self._pen: ImageDraw.ImageDraw

    def draw(self, frame: Picture, i: int) -> Picture:
        """Frame `i` (height, width, 3) with its captions; `frame` itself is changed."""
        lines = self._headlines(i)
        columns: list[tuple[float, _Panel]] = [(262, self._attitude), (188, self._speeds)]
        if not self._compact:
            columns = [(262, self._position), *columns, (188, self._slews), (226, self._margins)]
        gap = max(0.0, (self._width - 48.0 - sum(width for width, _ in columns)) / (len(columns) - 1))
        lefts = [24.0 + gap * j + sum(width for width, _ in columns[:j]) for j in range(len(columns))]
        strip = self._height - _STRIP

        map_left, map_size = self._width - self._top_view.width - 16, (self._top_view.width, self._top_view.height)
        self._shade(
            frame, 16, 16, 24 + max(self._text_width(text, size) for text, size, _ in lines), 14 + 27 * len(lines)
        )
        self._shade(frame, map_left, 16, *map_size)
        if self._compact:
            for left, (width, _) in zip(lefts, columns, strict=True):
                self._shade(frame, left - 8, strip - 16, width + 16, _STRIP)
        else:
            self._shade(frame, 0, strip, self._width, _STRIP)

        image = Image.fromarray(frame)
        self._pen = ImageDraw.Draw(image)
        for j, (text, size, colour) in enumerate(lines):
            self.text(28, 38 + 27 * j, text, size=size, colour=colour, anchor="lm")
        self._top_view.draw(self, map_left, 16, i)
        for left, (_, panel) in zip(lefts, columns, strict=True):
            panel(left, strip + (-8.0 if self._compact else 10.0), i)
        return np.asarray(image)

    def text(
        self, x: float, y: float, text: str, *, size: float = 15, colour: Colour = WHITE, anchor: str = "la"
    ) -> None:
        """Write at a place; `anchor` is Pillow's, `ra` for right-aligned."""
        font = _font(max(6, round(size * self._scale)))
        self._pen.text((x * self._scale, y * self._scale), text, fill=colour, font=font, anchor=anchor)

    def box(self, x: float, y: float, width: float, height: float, colour: Colour) -> None:
        """Fill a rectangle; a negative width or height reaches to the left or up."""
        left, right = sorted((x * self._scale, (x + width) * self._scale))
        top, bottom = sorted((y * self._scale, (y + height) * self._scale))
        self._pen.rectangle(
            (round(left), round(top), max(round(right) - 1, round(left)), max(round(bottom) - 1, round(top))),
            fill=colour,
        )

    def line(self, points: Array, colour: Colour, *, width: float = 1.5) -> None:
        """Draw through points (n, 2)."""
        if len(points) > 1:
            self._pen.line(
                (points * self._scale).ravel().tolist(), fill=colour, width=max(1, round(width * self._scale))
            )

    def dot(self, place: Array, radius: float, colour: Colour) -> None:
        """Fill a circle."""
        self._pen.circle((place * self._scale).tolist(), radius * self._scale, fill=colour)

    def _shade(self, frame: Picture, x: float, y: float, width: float, height: float) -> None:
        rows = slice(round(y * self._scale), round((y + height) * self._scale))
        columns = slice(round(x * self._scale), round((x + width) * self._scale))
        frame[rows, columns] = _SHADE[frame[rows, columns]]

    def _limit(self, signal: str, i: int) -> Limit | None:
        """The first limit on a signal that is in force at frame `i`."""
        time = self._footage.times[i]
        return next((x for x in self._run.limits if x.signal == signal and x.start <= time <= x.stop), None)

    def _text_width(self, text: str, size: float) -> float:
        return _font(max(6, round(size * self._scale))).getlength(text) / self._scale

    def _headlines(self, i: int) -> list[tuple[str, float, Colour]]:
        """Text, size and colour of the lines in the corner."""
        control, k = self._run.log.control, self._footage.period[i]
        time = self._footage.times[i]
        lines: list[tuple[str, float, Colour]] = [(self._run.name, 21, WHITE)]
        if self._compact:
            return [*lines, (f"t = {time:.1f} s", 17, GREY)]
        good = control.status[k] in ACCEPTED and control.fallback[k] == 0
        report = control.status[k] + (f" (fallback {control.fallback[k]})" if control.fallback[k] else "")
        if control.iterations[k]:
            report += f"  ·  {control.iterations[k]} iterations  ·  {control.active[k]} active"
        lines += [(self._subtitle, 14, GREY), (f"t = {time:.2f} s", 20, WHITE), (report, 14, GREEN if good else RED)]
        reason = self._run.log.reason
        if reason is not None and time >= control.t[-1]:
            lines.append((f"aborted {reason}"[:100], 15, RED))
        return lines

    def _position(self, x: float, y: float, i: int) -> None:
        self.text(x + 118, y, "now", size=13, colour=GREY, anchor="ra")
        self.text(x + 192, y, "reference", size=13, colour=AMBER, anchor="ra")
        self.text(x + 262, y, "error", size=13, colour=GREY, anchor="ra")
        reference = self._run.log.control.reference[self._footage.period[i]]
        values = (*self._footage.position[i], self._footage.euler[i, 2])
        for j, (name, state) in enumerate(zip(REFERENCE_NAMES, REFERENCE_STATES, strict=True)):
            angle = state == INDEX["yaw"]
            factor, digits = (math.degrees(1.0), 1) if angle else (1.0, 2)
            now, wanted, row = factor * values[j], factor * reference[j], y + 24 + 27 * j
            self.text(x, row, f"{name} [{'deg' if angle else 'm'}]", colour=GREY)
            for right, value, colour in ((118, now, WHITE), (192, wanted, AMBER), (262, now - wanted, GREY)):
                shown = round(value, digits) + 0.0  # no "-0.00"
                self.text(x + right, row, f"{shown:+.{digits}f}", colour=colour, anchor="ra")

    def _attitude(self, x: float, y: float, i: int) -> None:
        self.text(x, y, "attitude [deg]", size=13, colour=GREY)
        for j, name in enumerate(("roll", "pitch")):
            value, limit, row = math.degrees(self._footage.euler[i, j]), self._limit(name, i), y + 32 + 50 * j
            finite = [abs(b) for b in _bounds(limit) if math.isfinite(b)]
            span = 2.0 * max(finite) if finite else 30.0
            broken = _breaks(limit, value)
            self.text(x, row, name, size=17)
            self.text(
                x + 262, row, f"{round(value, 2) + 0.0:+.2f}", size=17, colour=RED if broken else WHITE, anchor="ra"
            )
            self.box(x, row + 25, 262, 9, FAINT)
            centre, unit = x + 131, 131 / span
            self.box(centre, row + 25, unit * float(np.clip(value, -span, span)), 9, RED if broken else BLUE)
            self.box(centre - 0.5, row + 23, 1, 13, GREY)
            for bound in _bounds(limit):
                if math.isfinite(bound):
                    self.box(centre + unit * bound - 1, row + 21, 2.5, 17, RED if broken else AMBER)

    def _speeds(self, x: float, y: float, i: int) -> None:
        limit = self._limit("speed", i)
        upper = _bounds(limit)[1]
        top = 1.25 * (upper if math.isfinite(upper) else self._run.vehicle.speed_max)
        self.text(x, y, "rotor speed [rad/s]", size=13, colour=GREY)
        self._bars(x, y, self._footage.speeds[i], limit, (0.0, top), "{:.0f}")

    def _slews(self, x: float, y: float, i: int) -> None:
        limit = self._limit("slew", i)
        finite = [abs(bound) for bound in _bounds(limit) if math.isfinite(bound)]
        span = 1.6 * max(finite) if finite else 20.0
        self.text(x, y, "step per period [rad/s]", size=13, colour=GREY)
        self._bars(x, y, self._run.log.control.slews[self._footage.period[i]], limit, (-span, span), "{:+.1f}")

    def _bars(
        self, x: float, y: float, values: Array, limit: Limit | None, span: tuple[float, float], form: str
    ) -> None:
        top, height, low, high = y + 22, 88.0, *span
        unit = height / (high - low)
        zero = top + height + unit * min(low, 0.0)
        for j, value in enumerate(values):
            left, broken = x + 50 * j, _breaks(limit, value)
            self.box(left, top, 34, height, FAINT)
            self.box(left, zero, 34, -unit * float(np.clip(value, low, high)), RED if broken else BLUE)
            self.text(
                left + 17,
                top + height + 5,
                form.format(round(value, 1) + 0.0),
                size=13,
                colour=RED if broken else WHITE,
                anchor="ma",
            )
        for bound in _bounds(limit):
            if math.isfinite(bound) and bound != 0.0:
                self.box(x - 4, zero - unit * bound - 1, 192, 2, AMBER)

    def _margins(self, x: float, y: float, i: int) -> None:
        self.text(x, y, "limit", size=13, colour=GREY)
        self.text(x + 226, y, "worst margin so far", size=13, colour=GREY, anchor="ra")
        begun = [track for track in self._footage.margins if not math.isnan(track.worst[i])]
        for j, track in enumerate(begun[:_MOST_MARGINS]):
            worst, row = track.worst[i], y + 22 + 18.5 * j
            now_broken, once_broken = (margin < -track.limit.tolerance for margin in (track.now[i], worst))
            self.text(x, row, track.limit.name, size=14, colour=RED if now_broken else GREY)
            shown = f"{round(worst, 2) + 0.0:+.2f} {track.limit.unit}"
            self.text(x + 226, row, shown, size=14, colour=RED if once_broken else WHITE, anchor="ra")


class _TopView:
    """A map of the course seen from above, with the height beside it."""

    def __init__(self, footage: Footage, width: float, height: float) -> None:
        self._footage, self.width, self.height = footage, width, height
        low, high = footage.course.min(axis=0), footage.course.max(axis=0)
        slack = max(float((high - low).max()), 1.0)
        path = np.clip(footage.path, low - slack, high + slack)  # a lost vehicle leaves the map
        self._low, self._high = np.minimum(low, path.min(axis=0)), np.maximum(high, path.max(axis=0))
        self._middle = 0.5 * (self._low + self._high)

    def draw(self, page: Overlay, x: float, y: float, i: int) -> None:
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
        page.text(x + 10, y + 6, "from above", size=13, colour=GREY)
        page.line(place(footage.course), AMBER, width=1.2)
        page.line(place(np.concatenate([flown, footage.position[i : i + 1]])), BLUE, width=2.2)
        spot = place(footage.position[i])
        yaw = footage.euler[i, 2]
        page.line(np.stack([spot, spot + 11.0 * np.array([math.cos(yaw), -math.sin(yaw)])]), WHITE, width=2.5)
        page.dot(spot, 4.0, WHITE)
        metres = _round_length(0.22 * width / unit)
        page.box(x + width - 60 - unit * metres, y + 18, unit * metres, 2, GREY)
        page.text(x + width - 60, y + 4, f"{metres:g} m", size=12, colour=GREY, anchor="ra")

        rise = room[1] / extent[2]
        bar, bottom = x + width - 26, y + 32 + room[1]

        def level(z: float) -> float:
            return float(bottom - rise * (np.clip(z, self._low[2], self._high[2]) - self._low[2]))

        page.text(bar + 4, y + 6, "z", size=13, colour=GREY, anchor="ma")
        page.box(bar, bottom, 8, -room[1], FAINT)
        page.box(bar, bottom, 8, level(footage.position[i, 2]) - bottom, BLUE)
        for right, label, colour in ((0.05, "reference", AMBER), (0.40, "flown", BLUE), (0.64, "predicted", GREEN)):
            page.text(x + right * width, y + height - 20, label, size=0.056 * width, colour=colour)


def _round_length(length: float) -> float:
    """The largest of 1, 2, 5 times a power of ten that is no longer than a length."""
    power = 10.0 ** math.floor(math.log10(length))
    return max(power * factor for factor in (1.0, 2.0, 5.0) if power * factor <= length)


def _bounds(limit: Limit | None) -> tuple[float, float]:
    return (-math.inf, math.inf) if limit is None else (limit.lower, limit.upper)


def _breaks(limit: Limit | None, value: float) -> bool:
    lower, upper = _bounds(limit)
    tolerance = 0.0 if limit is None else max(limit.tolerance, 1e-6)
    return not lower - tolerance <= value <= upper + tolerance


@functools.lru_cache(maxsize=32)
def _font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(size)
