"""A directory that others made: what is read of it lies in it."""

from __future__ import annotations

import os
from pathlib import Path

from quadsim.errors import FileError


def require_inside(directory: Path) -> None:
    """Refuse a directory that holds a link out of it.

    Links within it, and a link that is the directory itself, are no harm.

    Raises:
        FileError: naming the first such link.
    """
    home = directory.resolve()
    for folder, folders, files in os.walk(directory):  # which follows no link to a folder
        for name in sorted((*folders, *files)):
            path = Path(folder, name)
            if path.is_symlink() and not _target(path).is_relative_to(home):
                raise FileError(path, f"is a link that leads out of {directory}; nothing is read through it")


def _target(link: Path) -> Path:
    """Where a link leads in the end; to itself, where it leads in a circle."""
    try:
        return link.resolve()
    except (OSError, RuntimeError):
        return link.parent.resolve() / link.name
