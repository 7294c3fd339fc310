"""The captions of a film: the flight's numbers at a frame, and the limits that it breaks.  Pillow alone."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Callable, Sequence
from typing import Final, NamedTuple

import numpy as np
from PIL import Image

from quadsim.controller import LAW, OPTIMAL, STOPPED, Phase
from quadsim.flight.audit import Limit
from quadsim.mpc.laws import law_name
from quadsim.palette import ON_DARK
from quadsim.report.film import painter as ink
from quadsim.report.film.frames import Filmed, Footage, MarginTrack, ranked_tracks
from quadsim.report.film.painter import Painter, Picture, shade, text_width
from quadsim.report.table import ABSENT, signed_number
from quadsim.state import INDEX, REFERENCE_NAMES, REFERENCE_STATES, Array

_STRIP: Final = 150  # height of the bottom strip, in design pixels of a 1280 x 720 frame
_LEGEND: Final = (
    (230, "reference", ON_DARK.reference),
    (150, "flown", ON_DARK.flown),
    (100, "predicted", ON_DARK.predicted),
)
"""How far left of the right edge [design pixels] the colours of the paths are named."""
_MOST_MARGINS: Final = 6  # shown at once
_ENDING: Final = 1.0
"""Time of film, at its end [s], in which it states why a QP had no answer, or that the flight stayed in fallback."""
_EVENT_TIME: Final = 2.0  # time of film [s] for which an event is shown
_MOST_EVENTS: Final = 3  # shown at once
_MOST_LINES: Final = 10  # of the statement at the end: more would reach the strip at the bottom
_WIDEST: Final = 140  # letters of a line, between the frame's edge and the legend


class Caption(NamedTuple):
    """A line of text in the upper left corner."""

    text: str
    size: float  # [design pixels]
    colour: str


class CaptionPainter:
    """Draws the captions of one film onto its frames.

    Lengths below are design pixels of a 1280 x 720 frame, scaled to the frame's real size.
    """

    def __init__(self, run: Filmed, footage: Footage, *, width: int, height: int, speed: float = 1.0) -> None:
        self._run = run
        self._footage = footage
        self._speed = speed  # simulated seconds per second of film
        self._scale = min(width / 1280.0, height / 720.0)
        self._width = width / self._scale
        self._height = height / self._scale
        self._subtitle = law_name(run.controller)
        self._grounded = any(phase != Phase.FLYING for phase in run.log.control.phase)
        self._ranked = ranked_tracks(footage.margins)  # fixed, so that rows keep their place

    def draw(self, frame: Picture, i: int) -> Picture:
        """Frame `i` (height, width, 3) with its captions; `frame` itself is changed."""
        lines = self._headlines(i)
        strip = self._height - _STRIP
        longest = max(text_width(line.text, line.size, scale=self._scale) for line in lines)
        shade(frame, 16, 16, 24 + longest, 14 + 27 * len(lines), scale=self._scale)
        shade(frame, self._width - 246, 16, 230, 30, scale=self._scale)
        shade(frame, 0, strip, self._width, _STRIP, scale=self._scale)

        image = Image.fromarray(frame)
        painter = Painter(image, self._scale)
        for j, line in enumerate(lines):
            painter.text(28, 38 + 27 * j, line.text, size=line.size, colour=line.colour, anchor="lm")
        for right, text, colour in _LEGEND:
            painter.text(self._width - right, 24, text, size=13, colour=colour)
        self._draw_strip(painter, strip + 10.0, i)
        return np.asarray(image)

    def _draw_strip(self, painter: Painter, y: float, i: int) -> None:
        """Write the columns of the bottom strip, as far apart as its width allows."""
        columns: tuple[tuple[float, Callable[[Painter, float, float, int], None]], ...] = (
            (262, self._position),
            (262, self._attitude),
            (188, self._speeds),
            (188, self._slews),
            (226, self._margins),
        )
        widths = [width for width, _ in columns]
        gap = max(0.0, (self._width - 48.0 - sum(widths)) / (len(columns) - 1))
        for j, (_, column) in enumerate(columns):
            left = 24.0 + gap * j + sum(widths[:j])
            column(painter, left, y, i)

    def _limit(self, signal: str, i: int) -> Limit | None:
        """The first limit on a signal that is in force at frame `i`."""
        time = self._footage.times[i]
        for limit in self._run.limits:
            if limit.signal == signal and limit.start <= time <= limit.stop:
                return limit
        return None

    def _headlines(self, i: int) -> list[Caption]:
        """The lines in the corner."""
        time = self._footage.times[i]
        clock = f"t = {time:.2f} s"
        if self._speed != 1.0:
            clock += f"   {self._speed:g} times real speed"
        lines = [
            Caption(self._run.name, 21, ink.WHITE),
            Caption(self._subtitle, 14, ink.GREY),
            Caption(clock, 20, ink.WHITE),
            self._answer(self._footage.period[i]),
        ]
        if self._footage.wind is not None:
            wind = np.linalg.norm(self._footage.wind[i])
            lines.append(Caption(f"wind {wind:.2g} m/s", 14, ON_DARK.disturbance))
        if self._footage.force is not None:
            force = np.linalg.norm(self._footage.force[i])
            lines.append(Caption(f"external force {force:.2g} N", 14, ON_DARK.disturbance))
        lines += self._recent_events(time)
        reason = self._run.log.reason
        if reason is not None and time >= self._run.log.control.t[-1]:
            lines.append(Caption(f"aborted {reason}"[:130], 15, ON_DARK.violated))
        if time >= self._footage.times[-1] - _ENDING * self._speed:
            lines += self._failures()
        return lines

    def _recent_events(self, time: float) -> list[Caption]:
        """The flight's events shortly before a time [s], the latest ones."""
        recent = []
        for event in self._run.events:
            if 0.0 <= time - event["time"] <= _EVENT_TIME * self._speed:
                recent.append(Caption(event["text"][:_WIDEST], 15, ON_DARK.warning))
        return recent[-_MOST_EVENTS:]

    def _failures(self) -> list[Caption]:
        """What failed other than a constraint."""
        lines = []
        for sentence in self._run.failures:
            for part in textwrap.wrap(sentence, _WIDEST):
                lines.append(Caption(part, 14, ON_DARK.warning))
        if len(lines) > _MOST_LINES:
            rest = Caption("... all of it is in summary.json", 14, ON_DARK.warning)
            return [*lines[:_MOST_LINES], rest]
        return lines

    def _answer(self, k: int) -> Caption:
        """Phase, where the flight has a ground, and what the controller answered in period k; red for a failure."""
        control = self._run.log.control
        status = control.status[k]
        phase = control.phase[k]
        fallback = control.fallback[k]
        phrases = []
        if self._grounded and status != phase:
            phrases.append(phase)
        if fallback:
            phrases.append(f"{status} (fallback {fallback})")
        else:
            phrases.append(status)
        if not fallback and control.answered_by[k] not in (LAW, STOPPED):
            phrases.append(f"by {control.answered_by[k]}")
        if control.iterations[k]:
            phrases += [f"{control.iterations[k]} iterations", f"{control.active[k]} active"]
        failed = fallback != 0 or status not in OPTIMAL | {Phase.LANDED}
        return Caption("  ·  ".join(phrases), 14, _red_if(failed, otherwise=ON_DARK.satisfied))

    def _position(self, painter: Painter, x: float, y: float, i: int) -> None:
        painter.text(x + 118, y, "now", size=13, colour=ink.GREY, anchor="ra")
        painter.text(x + 192, y, "reference", size=13, colour=ON_DARK.reference, anchor="ra")
        painter.text(x + 262, y, "error", size=13, colour=ink.GREY, anchor="ra")
        reference = self._run.log.control.reference[self._footage.period[i]]
        values = (*self._footage.position[i], self._footage.euler[i, 2])
        tilt = self._footage.tilt
        for j, (name, state) in enumerate(zip(REFERENCE_NAMES, REFERENCE_STATES, strict=True)):
            unit = "m"
            factor = 1.0
            decimals = 2
            undefined = False
            if state == INDEX["yaw"]:
                unit = "deg"
                factor = math.degrees(1.0)
                decimals = 1
                undefined = tilt is not None and bool(tilt[i] > 0.5 * math.pi)  # there is no heading upside down
            now = factor * values[j]
            target = factor * reference[j]
            shown = signed_number(now, decimals)
            error = signed_number(now - target, decimals)
            if undefined:
                shown = ABSENT
                error = ABSENT
            row = y + 24 + 27 * j
            painter.text(x, row, f"{name} [{unit}]", colour=ink.GREY)
            painter.text(x + 118, row, shown, colour=ink.WHITE, anchor="ra")
            painter.text(x + 192, row, signed_number(target, decimals), colour=ON_DARK.reference, anchor="ra")
            painter.text(x + 262, row, error, colour=ink.GREY, anchor="ra")

    def _attitude(self, painter: Painter, x: float, y: float, i: int) -> None:
        painter.text(x, y, "attitude [deg]", size=13, colour=ink.GREY)
        roll, pitch, _ = self._footage.euler[i]
        if self._footage.tilt is None:
            self._angle(painter, x, y + 32, i, "roll", roll, span=None)
            self._angle(painter, x, y + 82, i, "pitch", pitch, span=None)
        else:  # past the vertical roll jumps by 180 deg
            self._angle(painter, x, y + 32, i, "tilt", self._footage.tilt[i], span=180.0)
            self._angle(painter, x, y + 82, i, "pitch", pitch, span=90.0)

    def _angle(
        self, painter: Painter, x: float, y: float, i: int, name: str, angle: float, *, span: float | None
    ) -> None:
        """An angle [rad] in degrees, and a bar from -span to span [deg]; None: twice as far as its limit."""
        value = math.degrees(angle)
        limit = self._limit(name, i)
        bounds = _bounds(limit)
        if span is None:
            span = 2.0 * max(map(abs, bounds), default=15.0)
        broken = _breaks(limit, value)
        painter.text(x, y, name, size=17)
        colour = _red_if(broken, otherwise=ink.WHITE)
        painter.text(x + 262, y, signed_number(value, 2), size=17, colour=colour, anchor="ra")
        painter.box(x, y + 25, 262, 9, ink.FAINT)
        centre = x + 131
        unit = 131 / span
        length = unit * float(np.clip(value, -span, span))
        painter.box(centre, y + 25, length, 9, _red_if(broken, otherwise=ON_DARK.flown))
        painter.box(centre - 0.5, y + 23, 1, 13, ink.GREY)
        bound_colour = ON_DARK.bound
        if broken:
            bound_colour = ink.WHITE
        for bound in bounds:
            painter.box(centre + unit * bound - 1, y + 21, 2.5, 17, bound_colour)

    def _speeds(self, painter: Painter, x: float, y: float, i: int) -> None:
        limit = self._limit("speed", i)
        highest = self._run.vehicle.speed_max
        if limit is not None and math.isfinite(limit.upper):
            highest = limit.upper
        painter.text(x, y, "rotor speed [rad/s]", size=13, colour=ink.GREY)
        self._bars(painter, x, y, self._footage.speeds[i], limit, (0.0, 1.25 * highest), "{:.0f}")

    def _slews(self, painter: Painter, x: float, y: float, i: int) -> None:
        limit = self._limit("slew", i)
        span = 1.6 * max(map(abs, _bounds(limit)), default=12.5)
        slews = self._run.log.control.slews[self._footage.period[i]]
        painter.text(x, y, "step per period [rad/s]", size=13, colour=ink.GREY)
        self._bars(painter, x, y, slews, limit, (-span, span), "{:+.1f}")

    def _bars(
        self,
        painter: Painter,
        x: float,
        y: float,
        values: Array,
        limit: Limit | None,
        span: tuple[float, float],
        form: str,
    ) -> None:
        """A bar per rotor, its value beneath it in a form, and the limit across."""
        low, high = span
        top = y + 22
        height = 88.0
        unit = height / (high - low)
        zero = top + height + unit * min(low, 0.0)
        sampled = limit is not None and limit.source.plant is None
        for j, value in enumerate(values):
            broken = _breaks(limit, value, sampled=sampled)
            left = x + 50 * j
            length = unit * float(np.clip(value, low, high))
            shown = form.format(round(value, 1) + 0.0)
            painter.box(left, top, 34, height, ink.FAINT)
            painter.box(left, zero, 34, -length, _red_if(broken, otherwise=ON_DARK.flown))
            colour = _red_if(broken, otherwise=ink.WHITE)
            painter.text(left + 17, top + height + 5, shown, size=13, colour=colour, anchor="ma")
        for bound in _bounds(limit):
            if bound != 0.0:
                painter.box(x - 4, zero - unit * bound - 1, 192, 2, ON_DARK.bound)

    def _margins(self, painter: Painter, x: float, y: float, i: int) -> None:
        painter.text(x, y, "limit", size=13, colour=ink.GREY)
        painter.text(x + 226, y, "worst margin so far", size=13, colour=ink.GREY, anchor="ra")
        shown, rest = margin_rows(self._ranked, i)
        pitch = 16.0
        if len(self._ranked) <= _MOST_MARGINS:
            pitch = 18.5
        for j, track in enumerate(shown):
            row = y + 22 + pitch * j
            worst = f"{signed_number(track.worst[i], 2)} {track.limit.unit}"
            name_colour = _red_if(track.violated[i], otherwise=ink.GREY)
            worst_colour = _red_if(track.violated_before[i], otherwise=ink.WHITE)
            painter.text(x, row, track.limit.name, size=14, colour=name_colour)
            painter.text(x + 226, row, worst, size=14, colour=worst_colour, anchor="ra")
        rest_colour = _red_if("violated" in rest, otherwise=ink.GREY)
        painter.text(x, y + 22 + pitch * len(shown), rest, size=14, colour=rest_colour)


def margin_rows(ranked: Sequence[MarginTrack], i: int) -> tuple[list[MarginTrack], str]:
    """The limits that frame `i` shows, the first of those whose window has begun, and the text about the others."""
    begun = [track for track in ranked if not math.isnan(track.worst[i])]
    hidden = begun[_MOST_MARGINS:]
    broken = sum(track.violated_before[i] for track in hidden)
    counts = {"more": len(hidden), "of them violated": broken, "not begun": len(ranked) - len(begun)}
    parts = [f"{count} {what}" for what, count in counts.items() if count]
    rest = ""
    if parts:
        rest = f"and {', '.join(parts)}"
    return begun[:_MOST_MARGINS], rest


def _red_if(broken: object, *, otherwise: str) -> str:
    """The colour of what is violated, or another."""
    if broken:
        return ON_DARK.violated
    return otherwise


def _bounds(limit: Limit | None) -> list[float]:
    """The finite bounds of a limit."""
    if limit is None:
        return []
    return [bound for bound in (limit.lower, limit.upper) if math.isfinite(bound)]


def _breaks(limit: Limit | None, value: float, *, sampled: bool = False) -> bool:
    """Whether a value violates a limit."""
    if limit is None:
        return False
    margin = limit.margin(np.array([value]))[0]
    return bool(limit.violated(margin, sampled=sampled))
