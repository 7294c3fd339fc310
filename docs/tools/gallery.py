"""What docs/gallery.md shows: `films`, and scenario files, in `make docs`; `thumbnails` and posters, stored."""

from __future__ import annotations

import re
import sys
from concurrent.futures import ProcessPoolExecutor
from itertools import islice
from pathlib import Path
from typing import Any, Final

import film
import imageio
import numpy as np
from drawings import svg
from library import FILMS as NAMES

from quadsim.errors import RenderingUnavailableError
from quadsim.palette import COLOUR
from quadsim.report.film.frames import Filmed, Shot, filmed, make_footage, ranked_tracks, thin
from quadsim.state import Array
from quadsim.ties import first_smallest

DOCS: Final = Path(__file__).resolve().parents[1]
THUMBNAILS, FILMS, FILES = DOCS / "assets" / "gallery", DOCS / "films", DOCS / "scenarios"
WIDTH, HEIGHT, MARGIN = 160, 90, 8  # of a thumbnail [pixels]
FINEST: Final = 0.3  # how far a drawn path may be from the real one [pixels]
LEAST: Final = 0.5  # a thumbnail shows at least so much [m]
LONGEST, FPS = 12.0, 20  # of a film [s]; longer flights are shown faster
POSTER_FPS: Final = 5  # of the pictures among which a poster is chosen
VIEW: Final = np.array([[0.87, -0.87, 0.0], [0.3, 0.3, -1.0]])  # world -> right and down, seen from above at an angle


def thumbnail(name: str) -> None:
    """A scenario's path and its reference, dashed, with a dot at the end: red where the flight was lost or violated."""
    import quadsim

    flight = quadsim.fly(name, progress=False)
    paths = [np.stack([of[axis] for axis in "xyz"], axis=1) @ VIEW.T for of in (flight.reference, flight.plant)]
    low, high = (
        np.min([path.min(axis=0) for path in paths], axis=0),
        np.max([path.max(axis=0) for path in paths], axis=0),
    )
    room = np.array([WIDTH - 2 * MARGIN, HEIGHT - 2 * MARGIN])
    scale = float((room / np.maximum(high - low, LEAST)).min())
    shown = [0.5 * np.array([WIDTH, HEIGHT]) + scale * (path - 0.5 * (low + high)) for path in paths]
    end = shown[1][-1]
    colour = COLOUR.satisfied if flight.outcome == "satisfied" else COLOUR.violated
    parts = [
        polyline(shown[0], f'stroke="{COLOUR.reference}" stroke-dasharray="3 2"'),
        polyline(shown[1], f'stroke="{COLOUR.flown}" stroke-width="1.5"'),
        f'<circle cx="{end[0]:.1f}" cy="{end[1]:.1f}" r="3.5" fill="{colour}"/>',
    ]
    (THUMBNAILS / f"{name}.svg").write_text(svg(WIDTH, HEIGHT, parts, arrows=False), encoding="utf-8")


def polyline(points: Array, looks: str) -> str:
    """A path through points (n, 2), without those that no eye sees."""
    kept = thin(np.column_stack([points, np.zeros(len(points))]), FINEST)
    return f'<polyline points="{" ".join(f"{x:.1f},{y:.1f}" for x, y in points[kept])}" fill="none" {looks}/>'


def take(name: str, fps: int) -> tuple[Filmed, str, Shot]:
    """A scenario's flight, the title of its film, and its pictures, so many a second."""
    import quadsim

    run = filmed(quadsim.fly(name, progress=False))
    speed = max(1.0, run.end / LONGEST)
    shot = Shot(width=480, height=270, fps=fps, speed=speed, count=round(run.end * fps / speed))
    return run, name if speed == 1.0 else f"{name}, {speed:.1f} times as fast", shot


def poster(name: str) -> None:
    """What a film shows before it plays: the instant at which the nearest constraint is nearest."""
    run, title, shot = take(name, POSTER_FPS)
    tracks = [track for track in make_footage(run, shot.times).margins if track.limit.signal not in ("speed", "slew")]
    nearest = ranked_tracks(tracks)[0]
    margins = np.where(np.isnan(nearest.now), np.inf, nearest.now)
    picture = next(islice(film.panels(run, title, shot), first_smallest(margins, nearest.limit.tie), None))
    picture.save(THUMBNAILS / f"{name}.jpg", quality=80, optimize=True)


def film_flight(name: str) -> None:
    """The film of a scenario, H.264."""
    writer: Any = imageio.get_writer(
        FILMS / f"{name}.mp4", format="FFMPEG", fps=FPS, codec="libx264", pixelformat="yuv420p", quality=None,
        macro_block_size=1, ffmpeg_log_level="error", output_params=["-crf", "26", "-threads", "1"],
    )  # fmt: skip
    with writer:
        for picture in film.panels(*take(name, FPS)):
            writer.append_data(np.asarray(picture))


def texts() -> dict[str, str]:
    """What the name of each scenario opens: its file, or its row in the table of variants, with comments."""
    from quadsim.scenarios.catalogue import FLIGHTS, VARIANTS

    files = {path.stem: path.read_text(encoding="utf-8") for path in FLIGHTS.glob("*.toml")}
    table = re.sub(r"^# ---- .*\n", "", VARIANTS.read_text(encoding="utf-8"), flags=re.MULTILINE)  # without headings
    rows = re.split(r"\n\n+(?=(?:#.*\n)*\[[\w-]+\]\n)", table)[1:]
    return files | {re.findall(r"^\[([\w-]+)\]$", row, re.MULTILINE)[0]: f"{row.strip()}\n" for row in rows}


def main() -> None:
    """Make what is named; without off-screen OpenGL the page keeps its pictures and says so."""
    from quadsim.console.progress import reporting
    from quadsim.rollout.machine import usable_cores
    from quadsim.scenarios.catalogue import scenario_names

    for folder in (FILMS, FILES):
        folder.mkdir(exist_ok=True)
    for name, text in texts().items():
        (FILES / f"{name}.txt").write_text(text, encoding="utf-8")  # as text, which a browser shows
    try:
        film.start()  # here, as every flight imports MuJoCo
        with ProcessPoolExecutor(usable_cores()) as pool, reporting(True, "the films") as report:
            films = sys.argv[1:] == ["films"]
            stages = {film_flight: NAMES} if films else {thumbnail: scenario_names(), poster: NAMES}
            for make, of in stages.items():
                for i, _ in enumerate(pool.map(make, of), 1):
                    report(make.__name__.replace("_", " "), i, len(of))
    except RenderingUnavailableError as error:
        print(f"The gallery is built without films: {error}", file=sys.stderr)


if __name__ == "__main__":
    main()
