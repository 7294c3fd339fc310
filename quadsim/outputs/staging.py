"""Where outputs grow before they have their name: directories that say whose they are, and the step that names them."""

from __future__ import annotations

import contextlib
import ctypes
import errno
import fcntl
import json
import logging
import os
import platform
import re
import shutil
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from quadsim.errors import OutputError
from quadsim.outputs.manifest import (
    MANIFEST_FILE,
    below,
    is_file,
    is_folder,
    is_known,
    is_manifest,
    is_sealed,
    read_manifest,
    remove_empty,
    remove_listed,
)

STAGING: Final = re.compile(r"\.quadsim-\w+\.partial")
"""Names of staging directories."""

_HALF_MADE: Final = (
    "*.parquet", "*.rrd", "*.mp4", "*.gif", "*.png", "*.svg", "*.html", "*.log", "*.new", "new.*", "pieces.txt",
    "summary.json", "scenario.toml", "bench.json", "ladder.json", "comparison.json", "cost.json", "owner.json",
    "solvers.md", "ladder.md", "comparison.md", "cost.md", "swapping", MANIFEST_FILE,
)  # fmt: skip
"""Names of the files that we make; anything else in the staging directory of a process that was killed stays."""
_NO_REPLACE, _EXCHANGE = 1, 2
_CURRENT_DIRECTORY: Final = -100
_UNSUPPORTED: Final = (errno.ENOSYS, errno.EINVAL, errno.ENOTSUP)
_log: Final = logging.getLogger(__name__)


@dataclass(frozen=True)
class Staging:
    """A directory beside the outputs that are made in it.

    Attributes:
        path: its own.
    """

    path: Path

    @property
    def work(self) -> Path:
        """Where outputs are made."""
        return self.path / "work"

    @property
    def owner(self) -> Path:
        """Says whose it is; locked as long as that process lives."""
        return self.path / "owner.json"

    @property
    def aside(self) -> Path:
        """Where a target stands while it is replaced, on file systems that cannot swap two names in one step."""
        return self.path / "aside"

    @property
    def swapping(self) -> Path:
        """There from before a swap until what was replaced is removed: what is in `work` meanwhile may not be ours."""
        return self.path / "swapping"

    def put(self, new: Path, target: Path, problem: Callable[[Path], str | None]) -> None:
        """Give what was made its name.

        What had the name is moved to where the new was made, in the same step, and looked at there once more.

        Args:
            new: what was made.
            target: its name to be.
            problem: why something must not be replaced; None if it is ours.

        Raises:
            OutputError: what had the name is not ours; it has it again.
        """
        self.swapping.touch()
        try:
            _rename(new, target)
        except FileExistsError:
            self._exchange(new, target)
            reason = problem(new)
            if reason is not None:
                self._exchange(new, target)
                self.swapping.unlink()
                raise OutputError(target, reason) from None
            new.unlink() if is_file(new) else remove_listed(new)
        if not os.path.lexists(new):
            self.swapping.unlink()

    def _exchange(self, new: Path, target: Path) -> None:
        """Swap two names; in one step where the system can."""
        if _renameat2(new, target, _EXCHANGE):
            return
        target.rename(self.aside)
        try:
            _rename(new, target)
        except OSError:
            self.aside.rename(target)
            raise
        self.aside.rename(new)

    def close(self) -> None:
        """Remove it all; but during a swap only what says itself that it is ours."""
        with contextlib.suppress(OSError):
            if not self.swapping.exists():
                shutil.rmtree(self.work, ignore_errors=True)  # made by this process
            self.dissolve()

    def dissolve(self) -> None:
        """Remove what is known as ours, then the directory itself; it stays if there is anything else."""
        if os.path.lexists(self.aside):
            self._restore()
        if is_folder(self.work):
            if self.swapping.exists():
                _remove_own(self.work, beside=self.path.parent)
            else:
                _remove_half_made(self.work)
        gone = [remove_empty(folder) for folder in (self.work, self.aside)]
        if not all(gone):
            _log.warning("%s holds something that quadsim did not write; it was left as it is", self.path)
            return
        self.swapping.unlink(missing_ok=True)
        self.owner.unlink(missing_ok=True)
        self.path.rmdir()

    def _restore(self) -> None:
        """Give what was moved aside its name again, unless something has it by now."""
        target = self.path.parent / Path(str(json.loads(self.owner.read_bytes())["target"])).name
        if not os.path.lexists(target):
            self.aside.rename(target)
        elif is_sealed(self.aside):
            self.aside.unlink()
        elif is_folder(self.aside):
            remove_listed(self.aside)


@contextlib.contextmanager
def staging_beside(target: Path) -> Iterator[Staging]:
    """A staging directory in a target's folder, gone when the block ends; leftovers of dead processes go first.

    Args:
        target: what is to be made.

    Raises:
        OutputError: nothing can be written there; an error about a file that is made names it as if it were there.
    """
    handle = -1
    staging: Staging | None = None
    try:
        _clear_leftovers(target.parent)
        staging = Staging(Path(tempfile.mkdtemp(prefix=".quadsim-", suffix=".partial", dir=target.parent)))
        handle = _sign(staging, target)
        staging.work.mkdir()
        yield staging
    except OutputError as error:
        if staging is None or not error.path.is_relative_to(staging.work):
            raise
        raise OutputError(target / error.path.relative_to(staging.work), error.problem) from error
    except OSError as error:
        raise OutputError(target, error.strerror or str(error)) from error
    finally:
        if staging is not None:
            staging.close()
        if handle >= 0:
            os.close(handle)


def _sign(staging: Staging, target: Path) -> int:
    """Write down whose a staging directory is; the open file is locked as long as the process lives."""
    inode = staging.path.stat().st_ino  # a copy of it has another
    owner = {"target": target.name, "inode": inode, **_identity(os.getpid())}
    handle = os.open(staging.owner, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
    with contextlib.suppress(OSError):  # of a file system that knows no locks
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    os.write(handle, json.dumps(owner).encode())
    return handle


def _identity(pid: int) -> dict[str, Any]:
    """What tells a process from every other: its number, when it started, since which start of which machine."""
    started = boot = ""
    with contextlib.suppress(OSError, IndexError):
        started = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()[19]
    with contextlib.suppress(OSError):
        boot = Path("/proc/sys/kernel/random/boot_id").read_text(encoding="utf-8").strip()
    return {"pid": pid, "started": started, "boot": boot, "host": platform.node()}


def _clear_leftovers(folder: Path) -> None:
    """Remove the staging directories in a folder whose processes were killed."""
    with os.scandir(folder) as entries:
        found = [Staging(Path(entry.path)) for entry in entries if STAGING.fullmatch(entry.name)]
    for staging in found:
        with contextlib.suppress(OSError):
            if _is_abandoned(staging):
                staging.dissolve()


def _is_abandoned(staging: Staging) -> bool:
    """Whether a staging directory is one of ours, and its process dead."""
    if not is_folder(staging.path) or not is_file(staging.owner):
        return False
    try:
        owner = json.loads(staging.owner.read_bytes())
        now = _identity(int(owner["pid"]))
        ours = owner["inode"] == staging.path.stat().st_ino and owner["host"] == now["host"]
        alive = owner["boot"] == now["boot"] and owner["started"] == now["started"]
    except (ValueError, TypeError, LookupError, OverflowError, RecursionError):
        return False
    if alive or not ours:
        return False
    handle = os.open(staging.owner, os.O_RDWR | os.O_CLOEXEC | os.O_NOFOLLOW)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)  # an OSError where it lives after all, in a container say
    finally:
        os.close(handle)
    return True


def _remove_half_made(work: Path) -> None:
    """Unlink the files of names that we make, and remove the folders that are empty then."""
    for path in sorted(below(work), reverse=True):
        if is_folder(path):
            remove_empty(path)
        elif is_file(path) and any(path.relative_to(work).match(pattern) for pattern in _HALF_MADE):
            path.unlink()


def _remove_own(work: Path, *, beside: Path) -> None:
    """Unlink what says itself that it is ours, or what the manifest of the directory around it lists."""
    if read_manifest(work) is not None:
        remove_listed(work)
        return
    around = read_manifest(beside)
    known = [] if around is None else [digest for digests in around.files.values() for digest in digests]
    for path in list(work.iterdir()):
        if is_folder(path):
            remove_empty(path)
        elif is_file(path) and (is_sealed(path) or is_known(path, known) or is_manifest(path)):
            path.unlink()


def _renameat2(source: Path, target: Path, flags: int) -> bool:
    """Linux's rename with flags; False where the system or the file system does not have it."""
    try:
        call = ctypes.CDLL(None, use_errno=True).renameat2
    except (AttributeError, OSError):
        return False
    if call(_CURRENT_DIRECTORY, os.fsencode(source), _CURRENT_DIRECTORY, os.fsencode(target), flags) == 0:
        return True
    problem = ctypes.get_errno()
    if problem in _UNSUPPORTED:
        return False
    raise OSError(problem, os.strerror(problem), str(target))


def _rename(source: Path, target: Path) -> None:
    """Give something a name that nothing has.

    Raises:
        FileExistsError: something has it.
    """
    if _renameat2(source, target, _NO_REPLACE):
        return
    if is_folder(source):
        target.mkdir()
        source.rename(target)  # over an empty directory, or not at all
    else:
        os.link(source, target)
        source.unlink()
