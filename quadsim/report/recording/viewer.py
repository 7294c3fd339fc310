"""The rerun viewer, started on a recording."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Final

from quadsim.errors import FileError, ViewerUnavailableError

_VIEWER: Final = (
    sys.executable,
    "-c",
    "import sys; from rerun_cli.__main__ import main; sys.exit(main())",
    "--bind=127.0.0.1",
    "--port=auto",
)
"""Starts a viewer of its own, which only this machine can reach."""
_INTERRUPTED: Final = 130
"""The viewer's exit status after Ctrl-C."""


def viewer_problem() -> str | None:
    """Why rerun's own window cannot be opened on this machine, or None."""
    if sys.platform.startswith("linux") and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        return "there is no display (neither DISPLAY nor WAYLAND_DISPLAY is set)"
    return None


def open_viewer(path: Path, *, web: bool = False) -> None:
    """Show a recording; returns when the viewer is closed or Ctrl-C is pressed.

    Args:
        path: an `.rrd` file.
        web: whether to serve it, to this machine alone, for a browser; else rerun's own window shows it.

    Raises:
        FileError: there is no such file.
        ViewerUnavailableError: there is no display, or the viewer failed.
    """
    if not path.is_file():
        raise FileError(path, "there is no such recording")
    problem = None if web else viewer_problem()
    if problem:
        raise ViewerUnavailableError(f"{problem}: show it in a browser with --web, or open {path} on another machine")
    browser = ("--web-viewer", "--web-viewer-port=0") if web else ()
    try:
        status = subprocess.run([*_VIEWER, *browser, str(path)], check=False).returncode
    except KeyboardInterrupt:
        return
    if status not in (0, _INTERRUPTED):
        advice = "see its message above" if web else "see its message above, or show it in a browser with --web"
        raise ViewerUnavailableError(f"the rerun viewer ended with status {status}; {advice}")
