"""`quadsim video` and `view`."""

from __future__ import annotations

from argparse import Namespace
from pathlib import Path

from quadsim.errors import FileError, ParameterError, printable
from quadsim.flight import rundir
from quadsim.outputs import real_path
from quadsim.outputs.paths import require_inside
from scenarios.commands import EXIT_DONE, console
from scenarios.reaudit import reaudit


def video(options: Namespace) -> int:
    """`quadsim video`."""
    directory = Path(options.run)
    reaudit(directory, products=False)
    path = real_path(directory / rundir.VIDEO_FILE if options.out is None else options.out)
    if options.workers is not None and options.workers < 1:
        raise ParameterError("", "--workers", options.workers, "at least 1")
    if path.suffix not in (".mp4", ".gif"):
        raise ParameterError("", "--out", options.out, "a file ending in .mp4 or .gif")
    if path.resolve().parent == directory.resolve():
        with rundir.adding(directory, path.name) as film:
            _film(directory, film, options)
    else:
        _film(directory, path, options)
    print(f"written to {printable(str(path))}")
    return EXIT_DONE


def _film(directory: Path, path: Path, options: Namespace) -> None:
    from quadsim.report.film.video import render_gif, render_video

    with console.progress_bars(enabled=True) as progress:
        if path.suffix == ".gif":
            render_gif(directory, path, workers=options.workers)
        else:
            render_video(
                directory,
                path,
                workers=options.workers,
                progress=lambda done, total: progress("video", done, total),
            )


def view(options: Namespace) -> int:
    """`quadsim view`."""
    from quadsim.report.recording import open_viewer

    path = Path(options.run)
    recording = path / rundir.RECORDING_FILE if path.is_dir() else path
    if not path.exists():
        raise FileError(path, "no such run or recording")
    if path.is_dir():
        require_inside(path)
    if not recording.is_file():
        raise FileError(path, f"has no {rundir.RECORDING_FILE}; run the scenario again without --no-recording")
    if recording.suffix != ".rrd":
        raise FileError(path, "is no recording; give a run directory or a file ending in .rrd")
    open_viewer(recording, web=options.web)
    return EXIT_DONE
