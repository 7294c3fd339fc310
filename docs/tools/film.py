"""Films with a flight's tilt and margins below its picture; `make numbers OPTIONS=pictures` makes docs/flight.gif.

The gallery has films of the same make.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import numpy as np
from PIL import Image, ImageDraw

from quadsim.flight.audit import SIGNALS
from quadsim.palette import ON_DARK
from quadsim.report.figure import bounds_of
from quadsim.report.film import painter as ink
from quadsim.report.film.frames import Filmed, Footage, MarginTrack, Shot, filmed, make_footage, ranked_tracks
from quadsim.report.film.painter import Painter
from quadsim.report.film.video import rendering_backend
from quadsim.state import Array

DOCS: Final = Path(__file__).resolve().parents[1]
SHARP: Final = 2  # pixels drawn for one that is shown, in each direction
HEAD, PLOT, ROW, GAP, LABEL = 28, 90, 21, 8, 66  # [pixels]: title, plot, row of margins, gap, label left of both
MOST_ROWS: Final = 4
NEAR: Final = 0.1  # share of its band below which a margin is in the colour of warnings
GROUND, FIELD = "#14181e", "#1e232b"
CURVES: Final = (ON_DARK.flown, ink.WHITE)  # of which a palette of few colours loses neither
COLOURS: Final = 96


def start() -> None:
    """Choose the OpenGL back end of this process, which has to be before MuJoCo is imported.

    Raises:
        RenderingUnavailableError: none renders here.
    """
    os.environ["MUJOCO_GL"] = os.environ["PYOPENGL_PLATFORM"] = rendering_backend()


def panels(run: Filmed, title: str, shot: Shot) -> Iterator[Image.Image]:
    """Frames of a flight, `shot.width` wide: title, picture (`shot.height`), tilt over time, nearest margins."""
    from quadsim.report.film.render_worker import FilmStage

    footage = make_footage(run, shot.times)
    nearest = ranked_tracks(footage.margins)[:MOST_ROWS]
    tracks = [track for track in footage.margins if track in nearest]
    plot_top = HEAD + shot.height + GAP
    rows_top = plot_top + PLOT + GAP
    height = 2 * ((rows_top + ROW * len(tracks) + GAP) // 2)
    plot = Plot(run, footage, LABEL, plot_top, shot.width - LABEL - GAP)
    with FilmStage(run, footage, width=SHARP * shot.width, height=SHARP * shot.height) as stage:
        for i in range(shot.count):
            image = Image.new("RGB", (SHARP * shot.width, SHARP * height), GROUND)
            image.paste(Image.fromarray(stage.render(i)), (0, SHARP * HEAD))
            painter = Painter(image, SHARP)
            painter.text(GAP, HEAD / 2, title, size=15, anchor="lm")
            time = f"t = {footage.times[i]:.1f} s"
            painter.text(shot.width - GAP, HEAD / 2, time, size=14, colour=ink.GREY, anchor="rm")
            plot.draw(image, painter, i)
            for j, track in enumerate(tracks):
                draw_margin(painter, track, i, shot.width, rows_top + ROW * j)
            yield image.reduce(SHARP)


class Plot:
    """Roll and pitch over time, or the tilt of a vehicle that may turn upside down: red beyond their bounds."""

    def __init__(self, run: Filmed, footage: Footage, left: float, top: float, width: float) -> None:
        names = ("roll", "pitch") if run.log.plant.attitude is None else ("tilt",)
        self._left, self._top, self._width, self._times = left, top, width, footage.times
        self._grid = np.linspace(footage.times[0], footage.times[-1], round(4 * width))
        rows = np.clip(np.searchsorted(run.log.plant.t, self._grid), 0, run.log.plant.t.size - 1)
        signals = {name: SIGNALS[name].plant for name in names}
        self._curves = {name: values(run.log.plant)[rows] for name, values in signals.items() if values is not None}
        self._limits = [limit for limit in run.limits if limit.signal in names]
        self._bounds = [bound for name in names for bound in bounds_of(run.limits, name, float(footage.times[-1]))]
        reach = 1.15 * max(float(np.abs(curve).max()) for curve in self._curves.values())
        widest = max((abs(bound) for bound, _, _ in self._bounds), default=reach)
        high = max(min(reach, 4.0 * widest), 1.8 * widest if names != ("tilt",) else 0.0, 1.0)  # a fall is cut off
        self._low, self._high = (0.0 if names == ("tilt",) else -high), high

    def _at(self, times: Array, values: Array) -> list[tuple[float, float]]:
        span = self._times[-1] - self._times[0]
        x = self._left + self._width * (times - self._times[0]) / span
        y = self._top + PLOT * (self._high - values) / (self._high - self._low)
        return list(zip((SHARP * x).tolist(), (SHARP * y).tolist(), strict=True))

    def draw(self, image: Image.Image, painter: Painter, i: int) -> None:
        """The curves up to frame `i`, and their bounds."""
        canvas, ends = ImageDraw.Draw(image), self._times[[0, -1]]
        (left, top), (right, bottom) = self._at(ends, np.array([self._high, self._low]))
        canvas.rectangle((left, top, right, bottom), fill=FIELD)
        for bound, start, stop in ((0.0, *ends), *self._bounds):
            line = self._at(np.clip([start, stop], *ends), np.full(2, bound))
            canvas.line(line, fill=ON_DARK.bound if bound else ink.FAINT, width=SHARP if bound else 1)
            if abs(bound) > 0.1 * self._high or not bound:
                painter.text(self._left - 5, line[0][1] / SHARP, f"{bound:g}", size=12, colour=ink.GREY, anchor="rm")
        now = np.searchsorted(self._grid, self._times[i], side="right")
        for j, ((name, curve), colour) in enumerate(zip(self._curves.items(), CURVES, strict=False)):
            points = self._at(self._grid[:now], np.clip(curve[:now], self._low, self._high))
            canvas.line(points, fill=colour, width=2 * SHARP, joint="curve")
            for limit in (limit for limit in self._limits if limit.signal == name):
                beyond = limit.holds_at(self._grid[:now]) & limit.violated(limit.margin(curve[:now]))
                for k in np.flatnonzero(beyond[1:]):
                    canvas.line(points[k : k + 2], fill=ON_DARK.violated, width=3 * SHARP)
            painter.text(GAP, self._top + 8 + 17 * j, name, size=12, colour=colour, anchor="lm")
        painter.text(GAP, self._top + PLOT - 8, "[deg]", size=12, colour=ink.GREY, anchor="lm")


def draw_margin(painter: Painter, track: MarginTrack, i: int, width: float, top: float) -> None:
    """A row: a limit's name, its margin now as a bar, and its worst so far; red where violated."""
    limit, now, worst = track.limit, track.now[i], track.worst[i]
    broken, once = track.violated[i], track.violated_before[i]
    share = float(np.nan_to_num(np.clip(now / limit.half_band, 0.0, 1.0)))
    left, bar = 92, width - 92 - 130
    name = limit.name.replace("_", " ")
    painter.text(GAP, top + ROW / 2, name, size=13, colour=ON_DARK.violated if once else ink.WHITE, anchor="lm")
    painter.box(left, top + 5, bar, ROW - 10, ON_DARK.violated if broken else ink.FAINT)
    painter.box(left, top + 5, bar * share, ROW - 10, ON_DARK.warning if share < NEAR else ON_DARK.satisfied)
    if not np.isnan(worst):
        words = f"{round(float(worst), 2) + 0.0:+.2f} {limit.unit}"
        painter.text(
            width - GAP, top + ROW / 2, words, size=13, colour=ON_DARK.violated if once else ink.GREY, anchor="rm"
        )


def side_by_side(path: Path) -> None:
    """The paper's two flights up to 28 s, three times as fast, as a looping GIF."""
    import quadsim

    films = []
    for name in ("paper-unconstrained", "paper-constrained"):
        run = quadsim.fly(name, progress=False)
        shot = Shot(width=396, height=216, fps=8, speed=3.0, count=75)
        films.append(panels(filmed(run), f"{name.removeprefix('paper-').capitalize()} MPC", shot))
    frames = []
    for left, right in zip(*films, strict=True):
        image = Image.new("RGB", (left.width + right.width + GAP, left.height), GROUND)
        image.paste(left, (0, 0))
        image.paste(right, (left.width + GAP, 0))
        frames.append(image)
    palette = Image.new("RGB", (frames[0].width, 4 * frames[0].height))
    for j, k in enumerate(range(0, len(frames), len(frames) // 4)):
        palette.paste(frames[k], (0, j * frames[0].height))
    palette = palette.quantize(COLOURS, dither=Image.Dither.NONE)
    few = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    few[0].save(path, save_all=True, append_images=few[1:], duration=1000 / 8, loop=0, optimize=True)


if __name__ == "__main__":
    start()
    side_by_side(DOCS / "flight.gif")
