"""What a film costs: the start of the renderer, and each frame."""

from __future__ import annotations

import tempfile
from functools import partial
from pathlib import Path

from timing import Record, Stopwatch, options, run

from quadsim.commands.app import load
from quadsim.console.progress import Progress
from quadsim.report.film.video import render_video, rendering_backend, worker_count
from quadsim.rollout.rollout import Rollout

FPS = 30


def measure(name: str, quick: bool, workers: int | None, report: Progress) -> list[Record]:
    """One record: seconds until the first frame is there, and from then on per frame [ms].

    Raises:
        RenderingUnavailableError: this machine cannot render.
    """
    backend = rendering_backend()
    width, height, seconds = (320, 180, 0.5) if quick else (1280, 720, 4.0)
    reports: list[tuple[int, int, float]] = []  # frames done, of how many, after how long [s]
    with tempfile.TemporaryDirectory() as scratch:
        rollout = Rollout(load(name).replace({"duration": seconds, "constraints": []}))
        flight = rollout.fly(report).as_stored()
        watch = Stopwatch()

        def reached(done: int, total: int) -> None:
            reports.append((done, total, watch.elapsed))
            report("film", done, total)

        render_video(
            flight,
            Path(scratch) / "film.mp4",
            workers=workers,
            width=width,
            height=height,
            fps=FPS,
            progress=reached,
        )
        wall = watch.elapsed
    frames, start = reports[0][1], reports[0][2]
    return [
        {
            "back_end": backend,
            "size": f"{width}x{height}",
            "workers": worker_count(frames, workers),
            "frames": frames,
            "start_s": start,
            "frame_ms": 1e3 * (wall - start) / frames,
            "whole_s": wall,
            "s_per_minute_of_film": start + 60.0 * FPS * (wall - start) / frames,
        }
    ]


def main() -> None:
    """Film, print and write."""
    chosen = options(
        __doc__,
        scenario={"default": "paper-constrained", "help": "default: %(default)s"},
        workers={"type": int, "metavar": "N", "help": "processes (default: one per core)"},
    )
    run(partial(measure, chosen.scenario, chosen.quick, chosen.workers), f"A film of {chosen.scenario}", chosen.json)


if __name__ == "__main__":
    main()
