"""A flight -> its film, rendered after the flight in child processes.

The caller never touches OpenGL: each child (`render_worker`) gets its own environment, renders and encodes a run of
frames, and ffmpeg joins the pieces without encoding again.
"""

from __future__ import annotations

import contextlib
import functools
import json
import logging
import os
import pickle
import selectors
import shutil
import subprocess
import sys
import time as clock
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import IO, Final

from quadsim.assets import own_packages
from quadsim.errors import OutputError, ParameterError, RenderingUnavailableError
from quadsim.flight.record import FlightRecord
from quadsim.outputs import writing_file
from quadsim.report.film.frames import Filmed, Shot, filmed

BACKENDS: Final = ("egl", "osmesa")  # off-screen back ends, in the order tried
_WORKER: Final = (sys.executable, "-P", "-m", "quadsim.report.film.render_worker")
_PROBE: Final = (
    "import mujoco\n"
    "model = mujoco.MjModel.from_xml_string("
    "\"<mujoco><worldbody><light pos='0 0 3'/><geom size='1'/></worldbody></mujoco>\")\n"
    "data = mujoco.MjData(model)\n"
    "mujoco.mj_forward(model, data)\n"
    "with mujoco.Renderer(model, 32, 32) as renderer:\n"
    "    renderer.update_scene(data)\n"
    "    assert renderer.render().any(), 'the picture is black'\n"
)
"""Renders one tiny picture, and fails unless there is something in it."""
_PROBE_SECONDS: Final = 60.0
_LEAST_FREE_BYTES: Final = 1024 * 1024
_FEWEST_FRAMES: Final = 30  # smallest number of frames that justifies a further worker
_LONG: Final = 30.0
"""Length of a flight [s] from which on its film has fewer frames per second, and beyond which it is shown faster."""
"""Length of a flight [s] from which on its film has fewer frames per second, and beyond which it is shown faster."""
_LONG_SPEED: Final = 3.0  # how many times as fast as it was flown a long flight is shown
_TIMING: Final = 2.0  # for how long frames are timed before an estimate [s]
FPS_RANGE: Final = (1, 120)  # frames per second that a film may have
_log: Final = logging.getLogger("quadsim")

FrameProgress = Callable[[int, int], None]


def rendering_backend() -> str:
    """The OpenGL back end, `egl` or `osmesa`, that renders on this machine; MUJOCO_GL names the one to try first.

    Raises:
        RenderingUnavailableError: none does; with the output of each.
    """
    preferred = os.environ.get("QUADSIM_GL")  # MUJOCO_GL as it was set, see quadsim/commands/entry.py
    if not preferred:
        preferred = os.environ.get("MUJOCO_GL", "").strip().lower()
    tried: dict[str, str] = {}
    for backend in sorted(BACKENDS, key=lambda name: name != preferred):
        try:
            _probe(backend)
        except subprocess.CalledProcessError as error:
            tried[backend] = _last_line(error.stderr)
        except subprocess.TimeoutExpired:
            tried[backend] = f"gave no picture within {_PROBE_SECONDS:g} s"
        else:
            return backend
    raise RenderingUnavailableError(tried)


@functools.cache  # a success is cached for this process; an exception is not
def _probe(backend: str) -> None:
    """Render one picture in a child process; it fails where the back end does."""
    command = (sys.executable, "-P", "-c", _PROBE)
    subprocess.run(command, env=_environment(backend), check=True, capture_output=True, timeout=_PROBE_SECONDS)


def worker_count(frames: int, most: int | None = None) -> int:
    """How many processes render a film of so many frames: `most`, or the usable cores, as far as that pays.

    Raises:
        ParameterError: there is to be none.
    """
    if most is None:
        if hasattr(os, "sched_getaffinity"):
            most = len(os.sched_getaffinity(0))
        else:
            most = os.cpu_count() or 1
    if most < 1:
        raise ParameterError("film", "workers", most, "at least 1")
    return max(1, min(most, frames // _FEWEST_FRAMES))


def frame_rate(length: float, fps: int | None = None) -> int:
    """Return `fps`, or else the default for a flight of a length [s]: 30 frames per second, 20 of a long one.

    Raises:
        ParameterError: `fps` is no whole number within `FPS_RANGE`.
    """
    if fps is None:
        if length < _LONG:
            return 30
        return 20
    least, most = FPS_RANGE
    if isinstance(fps, bool) or not isinstance(fps, int) or not least <= fps <= most:
        raise ParameterError("", "--fps", fps, f"a whole number from {least} to {most}")
    return fps


def film_speed(length: float) -> float:
    """How many times as fast as it was flown a flight of a length [s] is shown: three times if it is long."""
    if length > _LONG:
        return _LONG_SPEED
    return 1.0


def frame_count(length: float, fps: int, speed: float | None = None) -> int:
    """Number of frames of a film of a flight of a length [s], at a speed; None: `film_speed`."""
    if speed is None:
        speed = film_speed(length)
    return max(1, round(length / speed * fps))


class Estimate:
    """Tells the user once, from the time that the first frames take, how long films will take.

    Args:
        frames: of each film, in their order; a single film may leave it to its `total`.
        note: what can be opened meanwhile.
    """

    def __init__(self, frames: Sequence[int] = (), note: str = "") -> None:
        self._frames = frames
        self._note = note
        self._film = 0  # number of the present film
        self._told = False
        self._begun = clock.monotonic()  # when the present film was begun
        self._first: tuple[float, int] | None = None  # when frames of this film were first reported, and how many

    def __call__(self, done: int, total: int) -> None:
        """Take note of the frames done of the present film, of its `total`."""
        now = clock.monotonic()
        if self._told or not done:
            return
        if self._first is None:
            self._first = (now, done)
        first_time, first_done = self._first
        if done == total:
            self._film += 1
            self._begun = now
            self._first = None
        elif done > first_done and now - first_time >= _TIMING:
            frame_time = (now - first_time) / (done - first_done)
            start_time = first_time - self._begun
            later_films = self._frames[self._film + 1 :]
            seconds = (total - done + sum(later_films)) * frame_time + len(later_films) * start_time
            self._tell(seconds)
            self._told = True

    def _tell(self, seconds: float) -> None:
        subject = "film"
        if len(self._frames) > 1:
            subject = "films"
        note = ""
        if self._note:
            note = f"; {self._note}"
        _log.info("%s: about %s%s", subject, rough_time(seconds), note)


def rough_time(seconds: float) -> str:
    """Format a time that is only estimated: to 5 s, or to the minute from 90 s on."""
    if seconds >= 90.0:
        return f"{round(seconds / 60.0)} min"
    return f"{max(5, 5 * round(seconds / 5.0))} s"


def render_video(
    flight: FlightRecord,
    path: Path,
    *,
    workers: int | None = None,
    progress: FrameProgress | None = None,
    width: int = 1280,
    height: int = 720,
    fps: int | None = None,
    overwrite: bool = False,
) -> None:
    """Film a flight as an MP4 (H.264, 4:2:0), which appears at `path` complete or not at all; see `film_speed`.

    Width and height are even [pixels].  `workers` is how many processes render, at most; the machine's cores when None.
    `progress` is called with frames done and frames in all, in the caller's thread.  `fps` is in frames per second;
    None as in `frame_rate`.

    Raises:
        FileError: the flight holds nothing to film.
        OutputError: the film cannot be written, or a renderer failed; nothing is left behind.
        ParameterError: there are to be no workers, or `fps` is outside `FPS_RANGE`.
        RenderingUnavailableError: this machine cannot render.
    """
    run = filmed(flight)
    rate = frame_rate(run.end, fps)
    shot = Shot(width=width, height=height, fps=rate, speed=film_speed(run.end), count=frame_count(run.end, rate))
    with _making(path, overwrite) as new:
        _film(run, shot, new, workers, progress)


def render_gif(
    flight: FlightRecord,
    path: Path,
    *,
    workers: int | None = None,
    progress: FrameProgress | None = None,
    fps: int | None = None,
    overwrite: bool = False,
) -> None:
    """Film a flight as a small looping GIF without captions, six times as fast; arguments and errors as `render_video`.

    It is rendered at twice its size and scaled down, which smooths its edges.  Its `fps` is 8 by default.
    """
    run = filmed(flight)
    speed = 6.0
    if fps is None:
        fps = 8
    rate = frame_rate(0.0, fps)
    count = frame_count(run.end, rate, speed)
    shot = Shot(width=960, height=540, fps=rate, speed=speed, count=count, captions=False)
    with _making(path, overwrite) as new:
        film = new.with_suffix(".mp4")
        backend = _film(run, shot, film, workers, progress)
        # small by few colours and little noise
        scaled = "scale=480:-2:flags=area,hqdn3d=3:3:0:0,split[a][b]"
        colours = "[a]palettegen=max_colors=96:stats_mode=diff[p];[b][p]paletteuse=dither=none:diff_mode=rectangle"
        looping = ("-i", film.name, "-filter_complex", f"{scaled};{colours}", "-loop", "0", new.name)
        _work([(*_ffmpeg(), *looping)], backend, new.parent, there=True)


def write_poster(film: Path, poster: Path) -> bool:
    """Write a film's frame at 2 s, or its last, as a JPEG; return whether the film can be read."""
    frame = ("-t", "2", "-vf", "scale=640:-2", "-q:v", "4", "-update", "1", str(poster))
    done = subprocess.run([*_ffmpeg(), "-i", str(film), *frame], capture_output=True)
    return done.returncode == 0


def _film(run: Filmed, shot: Shot, path: Path, workers: int | None, progress: FrameProgress | None) -> str:
    """Film a shot in pieces and join them; the back end that did it."""
    folder = path.parent
    pieces = worker_count(shot.count, workers)
    backend = rendering_backend()
    content = folder / "flight.pickle"
    content.write_bytes(pickle.dumps(run))
    commands = []
    listed = []
    for piece in range(pieces):
        first = shot.count * piece // pieces
        stop = shot.count * (piece + 1) // pieces
        part = replace(shot, first=first, count=stop - first)
        name = f"piece{piece}.mp4"
        commands.append((*_WORKER, "film", str(content), json.dumps(asdict(part)), str(folder / name)))
        listed.append(f"file '{name}'\n")

    def report(done: int) -> None:
        if progress is not None:
            progress(done, shot.count)

    _work(commands, backend, folder, report)
    listing = folder / "pieces.txt"
    listing.write_text("".join(listed), encoding="utf-8")
    joined = ("-f", "concat", "-safe", "0", "-i", listing.name, "-c", "copy", "-movflags", "+faststart", path.name)
    _work([(*_ffmpeg(), *joined)], backend, folder, there=True)  # in a path, `#` and `?` would be a URL's
    return backend


def _ffmpeg() -> tuple[str, ...]:
    """The command of ffmpeg, without its banner and without standard input."""
    import imageio_ffmpeg

    return (imageio_ffmpeg.get_ffmpeg_exe(), "-nostdin", "-y", "-loglevel", "error")


class _WorkerFailure(Exception):
    """A worker ended badly; the text is its last line."""


@contextlib.contextmanager
def _making(path: Path, overwrite: bool) -> Iterator[Path]:
    """A file to be made in a folder of its own; see `writing_file`.  A worker's failure becomes an `OutputError`."""
    try:
        with writing_file(path, overwrite=overwrite) as new:
            yield new
    except _WorkerFailure as failure:
        raise OutputError(path, f"the renderer failed: {failure}") from failure


def worker_process(task: str, backend: str) -> subprocess.Popen[bytes]:
    """A worker that stays, with pipes to it and from it."""
    return subprocess.Popen(
        [*_WORKER, task],
        env=_environment(backend),
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
    )


def _environment(backend: str, workers: int = 1) -> dict[str, str]:
    """The environment of each of so many workers that render with a back end; the user's settings come before ours."""
    # Mesa's software renderer takes the floor's texture from one mipmap instead of two: no eye sees that, and it is a
    # tenth of the time.
    mesa = {"LP_PERF": "no_mip_linear"}
    if workers > 1:  # side by side each keeps a core busy: threads of Mesa's would but take turns with them
        mesa["LP_NUM_THREADS"] = "0"
    return {**mesa, **os.environ, **own_packages(), "MUJOCO_GL": backend, "PYOPENGL_PLATFORM": backend}


def _work(
    commands: Sequence[Sequence[str]],
    backend: str,
    folder: Path,
    report: Callable[[int], None] | None = None,
    *,
    there: bool = False,
) -> None:
    """Run commands of workers side by side; when one fails, or anything is raised here, the others are killed.

    Their stderr goes to `folder`, which is their working directory where they are to be `there`; `report` is called
    with the sum of the last numbers that they printed.
    """
    working_directory = None
    if there:
        working_directory = folder
    with contextlib.ExitStack() as stack:
        running = stack.enter_context(selectors.DefaultSelector())
        logs: list[IO[bytes]] = []
        done = [0] * len(commands)
        environment = _environment(backend, len(commands))
        for i, command in enumerate(commands):
            log = stack.enter_context((folder / f"worker{i}.log").open("w+b"))
            logs.append(log)
            process = stack.enter_context(
                subprocess.Popen(command, cwd=working_directory, env=environment, stdout=subprocess.PIPE, stderr=log)
            )
            stack.callback(process.kill)  # runs before Popen's own exit, which waits; kills none that has ended
            assert process.stdout is not None
            running.register(process.stdout, selectors.EVENT_READ, (i, process))
        while running.get_map():
            for key, _ in running.select():
                i, process = key.data
                line = process.stdout.readline()
                if line:
                    done[i] = int(line)
                    if report is not None:
                        report(sum(done))
                else:
                    running.unregister(process.stdout)
                    _check_end(process, logs[i], folder)


def _check_end(process: subprocess.Popen[bytes], log: IO[bytes], folder: Path) -> None:
    """Wait for a worker to end, and raise `_WorkerFailure` if it ended badly."""
    if process.wait() == 0:
        return
    if shutil.disk_usage(folder).free < _LEAST_FREE_BYTES:  # it could not even write that down
        raise _WorkerFailure("the disk is full")
    log.seek(0)
    raise _WorkerFailure(_last_line(log.read()))


def _last_line(text: bytes) -> str:
    lines = text.decode(errors="replace").strip().splitlines()
    if lines:
        return lines[-1].strip()
    return "it ended without a word"
