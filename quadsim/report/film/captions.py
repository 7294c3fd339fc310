"""The captions of a film: the flight's numbers at a frame, and the limits that it breaks.  Pillow alone."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Callable, Sequence
from typing import Final

import numpy as np
from PIL import Image

from quadsim.controller import LAW, OPTIMAL, STOPPED, Phase
from quadsim.flight.audit import Limit
from quadsim.mpc.laws import law_name
from quadsim.palette import ON_DARK
from quadsim.report.film import painter as ink
from quadsim.report.film.frames import Filmed, Footage, MarginTrack, ranked_tracks
from quadsim.report.film.painter import Painter, Picture, shade, text_width
from quadsim.report.table import ABSENT
from quadsim.state import INDEX, REFERENCE_NAMES, REFERENCE_STATES, Array

_STRIP: Final = 150  # height of the bottom strip, in design pixels of a 1280 x 720 frame
_LEGEND: Final = (
    (230, "reference", ON_DARK.reference),
    (150, "flown", ON_DARK.flown),
    (100, "predicted", ON_DARK.predicted),
)
"""How far left of the right edge [design pixels] the colours of the paths are named."""
_MOST_MARGINS: Final = 6


_LAST: Final = 1.0
"""Time of film, at its end [s], in which it states why a QP had no answer, or that the flight stayed in fallback."""
_SHOWN: Final = 2.0  # time of film [s] for which an event is shown
_MOST_EVENTS: Final = 3
_MOST_LINES: Final = 10  # of that: more would reach the strip at the bottom
_WIDEST: Final = 140  # letters of a line of that, between the frame's edge and the legend


class Overlay:
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
        columns: list[tuple[float, Callable[[Painter, float, float, int], None]]]
        columns = [
            *((262, self._position), (262, self._attitude), (188, self._speeds), (188, self._slews)),
            (226, self._margins),
        ]
        gap = max(0.0, (self._width - 48.0 - sum(width for width, _ in columns)) / (len(columns) - 1))
        lefts = [24.0 + gap * j + sum(width for width, _ in columns[:j]) for j in range(len(columns))]
        strip = self._height - _STRIP

        longest = max(text_width(text, size, scale=self._scale) for text, size, _ in lines)
        shade(frame, 16, 16, 24 + longest, 14 + 27 * len(lines), scale=self._scale)
        shade(frame, self._width - 246, 16, 230, 30, scale=self._scale)
        shade(frame, 0, strip, self._width, _STRIP, scale=self._scale)

        image = Image.fromarray(frame)
        painter = Painter(image, self._scale)
        for j, (text, size, colour) in enumerate(lines):
            painter.text(28, 38 + 27 * j, text, size=size, colour=colour, anchor="lm")
        for right, text, colour in _LEGEND:
            painter.text(self._width - right, 24, text, size=13, colour=colour)
        for left, (_, panel) in zip(lefts, columns, strict=True):
            panel(painter, left, strip + 10.0, i)
        return np.asarray(image)

    def _limit(self, signal: str, i: int) -> Limit | None:
        """The first limit on a signal that is in force at frame `i`."""
        time = self._footage.times[i]
        return next((x for x in self._run.limits if x.signal == signal and x.start <= time <= x.stop), None)

    def _headlines(self, i: int) -> list[tuple[str, float, str]]:
        """Text, size and colour of the lines in the corner."""
        control = self._run.log.control
        k = self._footage.period[i]
        time = self._footage.times[i]
        lines: list[tuple[str, float, str]] = [(self._run.name, 21, ink.WHITE)]
        if self._speed == 1.0:
            faster = ""
        else:
            faster = f"   {self._speed:g} times real speed"
        lines += [(self._subtitle, 14, ink.GREY), (f"t = {time:.2f} s{faster}", 20, ink.WHITE), self._answer(k)]
        for vectors, what, unit, colour in (
            (self._footage.wind, "wind", "m/s", ON_DARK.disturbance),
            (self._footage.force, "external force", "N", ON_DARK.disturbance),
        ):
            if vectors is not None:
                lines.append((f"{what} {np.linalg.norm(vectors[i]):.2g} {unit}", 14, colour))
        happened = []
        for event in self._run.events:
            if 0.0 <= time - event["time"] <= _SHOWN * self._speed:
                happened.append(event)
        lines += [(event["text"][:_WIDEST], 15, ON_DARK.warning) for event in happened[-_MOST_EVENTS:]]
        reason = self._run.log.reason
        if reason is not None and time >= control.t[-1]:
            lines.append((f"aborted {reason}"[:130], 15, ON_DARK.violated))
        if time >= self._footage.times[-1] - _LAST * self._speed:
            wrapped = [textwrap.wrap(sentence, _WIDEST) for sentence in self._run.failures]
            parts = [part for sentence in wrapped for part in sentence]
            lines += [(part, 14, ON_DARK.warning) for part in parts[:_MOST_LINES]]
            if len(parts) > _MOST_LINES:
                lines.append(("... all of it is in summary.json", 14, ON_DARK.warning))
        return lines

    def _answer(self, k: int) -> tuple[str, float, str]:
        """Phase, where the flight has a ground, and what the controller answered in period k; red for a failure."""
        control = self._run.log.control
        status = control.status[k]
        phase = control.phase[k]
        fallback = control.fallback[k]
        if self._grounded and status != phase:
            phrases = [phase]
        else:
            phrases = []
        phrases.append(status + (f" (fallback {fallback})" if fallback else ""))
        if not fallback and control.answered_by[k] not in (LAW, STOPPED):
            phrases.append(f"by {control.answered_by[k]}")
        if control.iterations[k]:
            phrases += [f"{control.iterations[k]} iterations", f"{control.active[k]} active"]
        good = fallback == 0 and status in OPTIMAL | {Phase.LANDED}
        return "  ·  ".join(phrases), 14, ON_DARK.satisfied if good else ON_DARK.violated

    def _position(self, painter: Painter, x: float, y: float, i: int) -> None:
        painter.text(x + 118, y, "now", size=13, colour=ink.GREY, anchor="ra")
        painter.text(x + 192, y, "reference", size=13, colour=ON_DARK.reference, anchor="ra")
        painter.text(x + 262, y, "error", size=13, colour=ink.GREY, anchor="ra")
        reference = self._run.log.control.reference[self._footage.period[i]]
        values = (*self._footage.position[i], self._footage.euler[i, 2])
        for j, (name, state) in enumerate(zip(REFERENCE_NAMES, REFERENCE_STATES, strict=True)):
            angle = state == INDEX["yaw"]
            if angle:
                factor, digits = (math.degrees(1.0), 1)
            else:
                factor, digits = (1.0, 2)
            now = factor * values[j]
            target = factor * reference[j]
            row = y + 24 + 27 * j
            painter.text(x, row, f"{name} [{'deg' if angle else 'm'}]", colour=ink.GREY)
            unknown = angle and self._footage.tilt is not None and self._footage.tilt[i] > 0.5 * math.pi
            columns = (118, now, ink.WHITE), (192, target, ON_DARK.reference), (262, now - target, ink.GREY)
            for right, value, colour in columns:
                shown = f"{round(value, digits) + 0.0:+.{digits}f}"  # no "-0.00"
                # no value is bounded upside down
                if unknown and colour is not ON_DARK.reference:
                    text = ABSENT
                else:
                    text = shown
                painter.text(x + right, row, text, colour=colour, anchor="ra")

    def _attitude(self, painter: Painter, x: float, y: float, i: int) -> None:
        painter.text(x, y, "attitude [deg]", size=13, colour=ink.GREY)
        signals = dict(zip(("roll", "pitch"), self._footage.euler[i], strict=False))
        tilted = self._footage.tilt
        if tilted is not None:  # past the vertical roll jumps by 180 deg
            signals = {"tilt": tilted[i], "pitch": signals["pitch"]}
        for j, (name, angle) in enumerate(signals.items()):
            value = math.degrees(angle)
            limit = self._limit(name, i)
            row = y + 32 + 50 * j
            whole = {"tilt": 180.0, "pitch": 90.0}
            if tilted is None:
                span = 2.0 * max(map(abs, _bounds(limit)), default=15.0)
            else:
                span = whole[name]
            broken = _breaks(limit, value)
            shown = f"{round(value, 2) + 0.0:+.2f}"
            painter.text(x, row, name, size=17)
            painter.text(x + 262, row, shown, size=17, colour=ON_DARK.violated if broken else ink.WHITE, anchor="ra")
            painter.box(x, row + 25, 262, 9, ink.FAINT)
            centre = x + 131
            unit = 131 / span
            painter.box(
                centre,
                row + 25,
                unit * float(np.clip(value, -span, span)),
                9,
                ON_DARK.violated if broken else ON_DARK.flown,
            )
            painter.box(centre - 0.5, row + 23, 1, 13, ink.GREY)
            for bound in _bounds(limit):
                painter.box(centre + unit * bound - 1, row + 21, 2.5, 17, ink.WHITE if broken else ON_DARK.bound)

    def _speeds(self, painter: Painter, x: float, y: float, i: int) -> None:
        limit = self._limit("speed", i)
        top = 1.25 * (limit.upper if limit and math.isfinite(limit.upper) else self._run.vehicle.speed_max)
        painter.text(x, y, "rotor speed [rad/s]", size=13, colour=ink.GREY)
        self._bars(painter, x, y, self._footage.speeds[i], limit, (0.0, top), "{:.0f}")

    def _slews(self, painter: Painter, x: float, y: float, i: int) -> None:
        limit = self._limit("slew", i)
        span = 1.6 * max(map(abs, _bounds(limit)), default=12.5)
        painter.text(x, y, "step per period [rad/s]", size=13, colour=ink.GREY)
        self._bars(painter, x, y, self._run.log.control.slews[self._footage.period[i]], limit, (-span, span), "{:+.1f}")

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
        top, height, low, high = y + 22, 88.0, *span
        unit = height / (high - low)
        zero = top + height + unit * min(low, 0.0)
        for j, value in enumerate(values):
            broken = _breaks(limit, value, sampled=limit is not None and limit.source.plant is None)
            left = x + 50 * j
            shown = form.format(round(value, 1) + 0.0)
            colour = ON_DARK.violated if broken else ink.WHITE
            painter.box(left, top, 34, height, ink.FAINT)
            painter.box(
                left, zero, 34, -unit * float(np.clip(value, low, high)), ON_DARK.violated if broken else ON_DARK.flown
            )
            painter.text(left + 17, top + height + 5, shown, size=13, colour=colour, anchor="ma")
        for bound in _bounds(limit):
            if bound != 0.0:
                painter.box(x - 4, zero - unit * bound - 1, 192, 2, ON_DARK.bound)

    def _margins(self, painter: Painter, x: float, y: float, i: int) -> None:
        painter.text(x, y, "limit", size=13, colour=ink.GREY)
        painter.text(x + 226, y, "worst margin so far", size=13, colour=ink.GREY, anchor="ra")
        shown, rest = margin_rows(self._ranked, i)
        if len(self._ranked) <= _MOST_MARGINS:
            pitch = 18.5
        else:
            pitch = 16.0
        for j, track in enumerate(shown):
            worst = track.worst[i]
            row = y + 22 + pitch * j
            now_broken = track.violated[i]
            once_broken = track.violated_before[i]
            painter.text(x, row, track.limit.name, size=14, colour=ON_DARK.violated if now_broken else ink.GREY)
            phrases = f"{round(worst, 2) + 0.0:+.2f} {track.limit.unit}"
            painter.text(
                x + 226, row, phrases, size=14, colour=ON_DARK.violated if once_broken else ink.WHITE, anchor="ra"
            )
        if "violated" in rest:
            colour = ON_DARK.violated
        else:
            colour = ink.GREY
        painter.text(x, y + 22 + pitch * len(shown), rest, size=14, colour=colour)


def margin_rows(ranked: Sequence[MarginTrack], i: int) -> tuple[list[MarginTrack], str]:
    """The limits that frame `i` shows, the first of those whose window has begun, and the text about the others."""
    begun = [track for track in ranked if not math.isnan(track.worst[i])]
    hidden = begun[_MOST_MARGINS:]
    broken = sum(track.violated_before[i] for track in hidden)
    phrases = {"more": len(hidden), "of them violated": broken, "not begun": len(ranked) - len(begun)}
    parts = [f"{count} {what}" for what, count in phrases.items() if count]
    return begun[:_MOST_MARGINS], f"and {', '.join(parts)}" if parts else ""


def _bounds(limit: Limit | None) -> list[float]:
    if limit is None:
        return []
    return [bound for bound in (limit.lower, limit.upper) if math.isfinite(bound)]


def _breaks(limit: Limit | None, value: float, *, sampled: bool = False) -> bool:
    return limit is not None and bool(limit.violated(limit.margin(np.array([value]))[0], sampled=sampled))
