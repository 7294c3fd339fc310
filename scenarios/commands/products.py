"""`quadsim video` and `view`."""

from __future__ import annotations

from argparse import Namespace
from pathlib import Path

from quadsim.errors import FileError, printable
from quadsim.flight import rundir
from quadsim.outputs.paths import require_inside
from scenarios.api import film
from scenarios.commands import EXIT_DONE


def video(options: Namespace) -> int:
    """`quadsim video`."""
    path = film(options.run, options.out, workers=options.workers)
    print(f"written to {printable(str(path))}")
    return EXIT_DONE


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
