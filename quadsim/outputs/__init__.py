"""The one place that writes, replaces and removes files: complete or not at all, and never other people's.

Whatever is made grows in a staging directory beside its target and gets its name in one step.  What may be replaced is
known by its content: a directory of quadsim's has a manifest, `.quadsim.json`, of every file with its SHA-256, and a
file by itself ends in the SHA-256 of all that stands before.  That is looked at before work begins, and again when the
earlier one has been moved out of the way, in the very step in which the new one takes its name: if there is anything
else by then, it is moved back.  What is removed is unlinked file by file, each only if its content is the one listed.
A staging directory names its owner; those of killed processes are removed with the next output in the same folder.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import stat
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

from quadsim.errors import OutputError
from quadsim.outputs.growing import Growing, growing
from quadsim.outputs.manifest import (
    LOCK_FILE,
    MANIFEST_FILE,
    digest,
    digest_of,
    is_folder,
    read_manifest,
    seal,
    take_stock,
    to_json,
)
from quadsim.outputs.paths import (
    occupied,
    output_errors,
    parents_of,
    problem_with_directory,
    problem_with_file,
    real_path,
)
from quadsim.outputs.staging import clear_leftovers, staging_beside

__all__ = [
    "LOCK_FILE",
    "MANIFEST_FILE",
    "Growing",
    "digest",
    "digest_of",
    "growing",
    "real_path",
    "require_directory",
    "require_file",
    "to_json",
    "write_json",
    "write_new",
    "write_text",
    "writing",
    "writing_file",
]

_FREE_BYTES_NEEDED: Final = 16 * 1024 * 1024


def require_directory(target: Path | str, kind: str) -> None:
    """Refuse a place where `writing` would refuse, before any work is done for it.

    Raises:
        OutputError: see `writing`.
    """
    target = real_path(target)
    with output_errors(target):
        for parent in target.parents:
            if os.path.lexists(parent) and not parent.is_dir():
                raise OutputError(target, f"{parent} is a file")
        if os.path.lexists(target):
            if is_folder(target) and read_manifest(target) is not None:
                clear_leftovers(target)  # of a process that was killed while it added to it
            problem = problem_with_directory(target, kind)
            if problem is not None:
                raise OutputError(target, problem)
            if target.samefile(Path.cwd()):
                raise OutputError(target, "it is the current directory; name one to be made")


@contextlib.contextmanager
def writing(target: Path | str, kind: str) -> Iterator[Path]:
    """A directory to fill, which becomes `target` when the block ends well and vanishes when it does not.

    Parents that are missing are made, and vanish with it.

    Args:
        target: the directory to make; an empty one is taken, and an earlier one of the same kind is replaced if all in
            it is as we wrote it.
        kind: what it is, e.g. `run`; none replaces one of another kind.

    Yields:
        The directory to fill.

    Raises:
        OutputError: the folder cannot be written, is nearly full, or holds what quadsim did not write, now or when the
            block ends; whatever was there is still there.
    """
    target = real_path(target)
    require_directory(target, kind)
    with parents_of(target), staging_beside(target) as staging:
        if shutil.disk_usage(staging.path).free < _FREE_BYTES_NEEDED:
            raise OutputError(target, "the disk is full")
        if target.exists():
            staging.work.chmod(stat.S_IMODE(target.stat().st_mode))
        yield staging.work
        manifest = take_stock(staging.work, kind)
        (staging.work / MANIFEST_FILE).write_bytes(manifest.encode())
        staging.put(staging.work, target, lambda old: problem_with_directory(old, kind))


def write_text(path: Path, text: str) -> None:
    """Write a text file into a directory that is being made.

    Raises:
        OutputError: it cannot be written.
    """
    with output_errors(path):
        path.write_text(text, encoding="utf-8")


def write_json(path: Path, data: Mapping[str, Any]) -> None:
    """Write strict JSON (no NaN) into a directory that is being made; see `write_text`."""
    write_text(path, to_json(data))


def require_new(path: Path | str) -> None:
    """Refuse a place where `write_new` would refuse, before any work is done for it.

    Raises:
        OutputError: see `write_new`.
    """
    path = real_path(path)
    with output_errors(path):
        if os.path.lexists(path):
            raise OutputError(path, occupied(()))
        with tempfile.TemporaryFile(dir=path.parent):
            pass


def write_new(path: Path, content: bytes) -> None:
    """Write a file where there is none; it appears complete or not at all.

    Raises:
        OutputError: it cannot be written, or something is there.
    """
    with staging_beside(path) as staging:
        new = staging.work / "new.file"
        new.write_bytes(content)
        staging.put(new, path, lambda _: occupied(()))


def require_file(path: Path | str, form: str) -> None:
    """Refuse a place where `writing_file` would refuse, before any work is done for it.

    Raises:
        OutputError: see `writing_file`.
    """
    path = real_path(path)
    with output_errors(path):
        problem = problem_with_file(path, form) if os.path.lexists(path) else None
        if problem is not None:
            raise OutputError(path, problem)
        with tempfile.TemporaryFile(dir=path.parent):
            pass


@contextlib.contextmanager
def writing_file(path: Path | str, form: str) -> Iterator[Path]:
    """A file to write, in a folder of its own, which becomes `path` when the block ends well.

    Args:
        path: of the file; an earlier one is replaced if it is as we wrote it.
        form: `.xml`, `.mp4`, `.png` or `.gif`.

    Yields:
        The file to write; anything else in its folder vanishes.

    Raises:
        OutputError: it cannot be written, or something else is there, now or when the block ends; whatever was there
            is still there.
    """
    path = real_path(path)
    require_file(path, form)
    with staging_beside(path) as staging:
        new = staging.work / f"new{form}"
        yield new
        seal(new, form)
        staging.put(new, path, lambda old: problem_with_file(old, form))
