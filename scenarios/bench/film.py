"""`quadsim bench render`: what a film costs."""

from __future__ import annotations

import math
import tempfile
from pathlib import Path
from typing import Final

from quadsim.errors import ParameterError
from quadsim.report.film.video import render_video, rendering_backend, worker_count
from scenarios.bench.bench_results import RenderProfile
from scenarios.bench.timing import Stopwatch
from scenarios.flight import Outputs
from scenarios.machine import machine
from scenarios.progress import Progress, silent
from scenarios.run import run_scenario
from scenarios.schema.scenario import Scenario

SECONDS: Final = 4.0  # of film; the processes' start is timed apart, so that a longer film follows from a short one
WIDTH, HEIGHT, FPS = 1280, 720, 30


def bench_render(
    scenario: Scenario, *, seconds: float = SECONDS, workers: int | None = None, progress: Progress = silent
) -> RenderProfile:
    """Fly the first seconds of a scenario and film them, by one process per usable core, or at most `workers`.

    Raises:
        ParameterError: an argument is out of range.
        RenderingUnavailableError: this machine cannot render.
    """
    if workers is not None and workers < 1:
        raise ParameterError("", "--workers", workers, "at least 1")
    period = scenario.control_period
    if not period <= seconds < math.inf:
        raise ParameterError("", "--seconds", seconds, f"finite, and at least one control period, {period} s")
    backend = rendering_backend()
    periods = min(scenario.periods, round(seconds / period))
    short = scenario.model_copy(update={"duration": round(periods * period, 9)})
    with tempfile.TemporaryDirectory() as scratch:
        run = Path(scratch) / "run"
        run_scenario(short, run, Outputs(video=False, recording=False, figures=False), progress)
        first: list[float] = []
        frames = 0

        def report(done: int, total: int) -> None:
            nonlocal frames
            first.append(watch.elapsed)
            frames = total
            progress("frames", done, total)

        watch = Stopwatch()
        render_video(run, run / "film.mp4", workers=workers, width=WIDTH, height=HEIGHT, fps=FPS, progress=report)
        wall_s = watch.elapsed
    return RenderProfile(
        scenario=scenario.name,
        backend=backend,
        width=WIDTH,
        height=HEIGHT,
        fps=FPS,
        frames=frames,
        workers=worker_count(frames, workers),
        wall_s=wall_s,
        start_s=first[0],
        machine=machine(),
    )
