"""Directories of quadsim's that grow in place: a campaign's, or a run's that gets its film later."""

from __future__ import annotations

import contextlib
import fcntl
import itertools
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Final

from quadsim.errors import OutputError
from quadsim.outputs.manifest import (
    LOCK_FILE,
    MANIFEST_FILE,
    Manifest,
    digest,
    is_folder,
    is_known,
    read_manifest,
    remove_empty,
    remove_lock,
)
from quadsim.outputs.paths import already, occupied, output_errors, parents_of, real_path
from quadsim.outputs.staging import STAGING, Staging, staging_beside

_CHANGED: Final = "it is not as quadsim wrote it; move it away first"


class Growing:
    """A directory of quadsim's to which files are added in place; see `growing`.

    The manifest is ahead of the files: it lists what a file was together with what it is about to be, so that nothing
    of ours is unknown to it whenever the process is killed.
    """

    def __init__(self, path: Path, kind: str, staging: Staging) -> None:
        self.path = path
        self._staging, self._kind = staging, kind
        self._manifest = read_manifest(path)
        self._known = () if self._manifest is None else (digest(self._manifest.encode()),)
        self._numbers = itertools.count()

    @property
    def scratch(self) -> Path:
        """Where files may be made that are to be added; what stays there vanishes."""
        return self._staging.work

    @property
    def _files(self) -> Mapping[str, Sequence[str]]:
        return {} if self._manifest is None else self._manifest.files

    def require(self, names: Iterable[str]) -> None:
        """Refuse files that are there and not as we wrote them.

        Raises:
            OutputError: naming the first of them.
        """
        for name in names:
            path = self.path / name
            for folder in PurePosixPath(name).parents[:-1]:
                if os.path.lexists(self.path / folder) and not is_folder(self.path / folder):
                    raise OutputError(self.path / folder, "it is not a folder of quadsim's; move it away first")
            with output_errors(path):
                if os.path.lexists(path) and not is_known(path, self._files.get(name, ())):
                    raise OutputError(path, _CHANGED)

    def write(self, files: Mapping[str, bytes]) -> None:
        """Write or replace files, by their relative paths; each is on the disk, whole, when this returns.

        Raises:
            OutputError: one cannot be written, or one that is there is not as we wrote it, and still there.
        """
        after = {name: (digest(content),) for name, content in files.items()}
        with output_errors(self.path):
            self.require(files)
            self._list({**self._files, **{name: (*self._files.get(name, ()), *new) for name, new in after.items()}})
            for name, content in files.items():
                (self.path / name).parent.mkdir(exist_ok=True)
                self._put(name, content, self._files[name])
            self._list({**self._files, **after})

    def remove(self, names: Iterable[str]) -> None:
        """Remove files that are as we wrote them, and folders that are empty then.

        Raises:
            OutputError: one is not as we wrote it; it is still there.
        """
        there = [name for name in names if os.path.lexists(self.path / name)]
        with output_errors(self.path):
            for name in there:
                self.require([name])
                (self.path / name).unlink()
            self._list({name: known for name, known in self._files.items() if name not in there})
        for folder in {(self.path / name).parent for name in there} - {self.path}:
            remove_empty(folder)

    def _list(self, files: Mapping[str, Sequence[str]]) -> None:
        """Replace the manifest."""
        before = self._known
        manifest = Manifest(kind=self._kind, files=files)
        self._known = (*before, digest(manifest.encode()))  # whichever of them is there if this is interrupted
        self._put(MANIFEST_FILE, manifest.encode(), before)
        self._manifest, self._known = manifest, self._known[-1:]

    def _put(self, name: str, content: bytes, known: Sequence[str]) -> None:
        new, target = self._staging.work / f"{next(self._numbers)}.new", self.path / name
        with new.open("xb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        self._staging.put(new, target, lambda old: None if is_known(old, known) else _CHANGED)
        handle = os.open(target.parent, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


@contextlib.contextmanager
def growing(directory: Path | str, kind: str) -> Iterator[Growing]:
    """Add files to a directory of quadsim's, or to a new or empty one; one process at a time, by a lock.

    Raises:
        OutputError: it cannot be written, another process writes there, or it is of another kind, or not quadsim's.
    """
    directory = real_path(directory)
    with parents_of(directory):
        with output_errors(directory):
            is_new = not directory.exists()
            directory.mkdir(exist_ok=True)
            found = read_manifest(directory)
            names = {path.name for path in directory.iterdir()} - {LOCK_FILE}
        others = sorted(name for name in names if not STAGING.fullmatch(name))
        if found is None and others:
            raise OutputError(directory, occupied(others))
        if found is not None and found.kind != kind:
            raise OutputError(directory, f"{already(found.kind)}; choose another --out")
        try:
            with _held(directory), staging_beside(directory / MANIFEST_FILE) as staging:
                yield Growing(directory, kind, staging)
        finally:
            if is_new and read_manifest(directory) is None:  # nothing was written
                remove_empty(directory)


@contextlib.contextmanager
def _held(directory: Path) -> Iterator[None]:
    """Hold a directory for oneself; where nothing was written to it, the lock goes again."""
    flags = os.O_RDWR | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK
    path = directory / LOCK_FILE
    is_new = not os.path.lexists(path)
    with output_errors(path):
        handle = os.open(path, flags | (os.O_CREAT | os.O_EXCL if is_new else 0), 0o644)
    try:
        _lock(handle, directory)
        yield
    finally:
        if is_new and read_manifest(directory) is None:
            remove_lock(directory)
        os.close(handle)


def _lock(handle: int, directory: Path) -> None:
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise OutputError(directory, "another process is writing there") from error
    except OSError as error:  # of a file system that knows no locks
        raise OutputError(directory, f"cannot be held for one process alone ({error.strerror})") from error
