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
    foreign,
    is_file,
    is_folder,
    is_known,
    is_manifest,
    is_sealed,
    read_manifest,
    remove_empty,
    remove_listed,
)

STAGING: Final = re.compile(r"\.quadsim-\w+\.partial")  # names of staging directories

_HALF_MADE: Final = (
    "*.parquet", "*.rrd", "*.mp4", "*.gif", "*.png", "*.svg", "*.html", "*.log", "*.new", "new.*", "pieces.txt",
    "summary.json", "scenario.toml", "bench.json", "ladder.json", "comparison.json", "cost.json", "owner.json",
    "solvers.md", "ladder.md", "comparison.md", "cost.md", MANIFEST_FILE,
    "*.c", "*.h", "*.ld", "Makefile", "README.md", "LICENSE",
)  # fmt: skip
"""Names of the files that we make; anything else in the staging directory of a process that was killed stays."""
_SLOT, _PREVIOUS, _NAME = "swap-", "previous", "name"
"""In a staging directory: what is replaced, each in a slot; where it takes two steps, with the name that it had."""
_NO_REPLACE, _EXCHANGE = 1, 2
_CURRENT_DIRECTORY: Final = -100
_UNSUPPORTED: Final = (errno.ENOSYS, errno.EINVAL, errno.ENOTSUP)
_log: Final = logging.getLogger(__name__)


@dataclass(frozen=True)
class Staging:
    """A directory beside the outputs that are made in it; what they replace never enters where they are made."""

    path: Path  # its own

    @property
    def work(self) -> Path:
        """Where outputs are made."""
        return self.path / "work"

    @property
    def owner(self) -> Path:
        """Names the owner; locked as long as that process lives."""
        return self.path / "owner.json"

    def put(self, new: Path, target: Path, problem: Callable[[Path], str | None]) -> None:
        """Give what was made its name.

        What had the name is moved to a slot of its own, in the same step, and looked at there once more.

        Args:
            new: what was made.
            target: its name to be.
            problem: why something must not be replaced; None if it is quadsim's.

        Raises:
            OutputError: quadsim did not write what had the name; it has it again.
        """
        try:
            _rename(new, target)
        except FileExistsError:
            _refuse(target, problem(target))  # nearly always seen here, where nothing has been moved
            slot = Path(tempfile.mkdtemp(prefix=_SLOT, dir=self.path)) / new.name
            new.rename(slot)
            self._swap(slot, target, problem)

    def _swap(self, slot: Path, target: Path, problem: Callable[[Path], str | None]) -> None:
        self._exchange(slot, target)
        try:
            _refuse(target, problem(slot))
        except BaseException:  # also where it cannot be read, or by Ctrl-C
            self._exchange(slot, target)
            raise  # the new one may hold a user's files by now: `dissolve` takes only what is quadsim's
        with contextlib.suppress(OSError):  # the new one is in place; `dissolve` reports what cannot be removed
            slot.unlink() if is_file(slot) else remove_listed(slot)

    def _exchange(self, slot: Path, target: Path) -> None:
        """Swap two names; in one step where the system can."""
        if _renameat2(slot, target, _EXCHANGE):
            return
        previous = slot.with_name(_PREVIOUS)
        slot.with_name(_NAME).write_bytes(os.fsencode(os.path.relpath(target, self.path.parent)))
        target.rename(previous)
        try:
            _rename(slot, target)
        except OSError:
            _rename(previous, target)  # or it stays, where its name is taken by now
            raise
        previous.rename(slot)
        slot.with_name(_NAME).unlink()

    def close(self) -> None:
        """Remove what this process made; of what had a target's name, only what its content shows to be quadsim's."""
        with contextlib.suppress(OSError):
            shutil.rmtree(self.work, ignore_errors=True)  # nothing else is ever moved there
            self.dissolve()

    def dissolve(self) -> None:
        """Remove what is known as quadsim's, then the directory itself; it stays if there is anything else."""
        if is_folder(self.work):
            _remove_half_made(self.work)
        gone = [remove_empty(self.work)]
        for slot in [path for path in self.path.iterdir() if path.name.startswith(_SLOT) and is_folder(path)]:
            with contextlib.suppress(OSError, ValueError):
                _restore(slot, self.path.parent)
            for path in list(slot.iterdir()):
                with contextlib.suppress(OSError):
                    _remove_own(path, beside=self.path.parent)
            gone.append(remove_empty(slot))
        if not all(gone):
            _log.warning("%s holds files that are not quadsim's; move them out, then delete it", self.path)
            return
        self.owner.unlink(missing_ok=True)
        self.path.rmdir()


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
        clear_leftovers(target.parent)
        staging = Staging(Path(tempfile.mkdtemp(prefix=".quadsim-", suffix=".partial", dir=target.parent)))
        handle = _sign(staging)
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


def _sign(staging: Staging) -> int:
    """Write down whose a staging directory is; the open file is locked as long as the process lives."""
    inode = staging.path.stat().st_ino  # a copy of it has another
    owner = {"inode": inode, **_identity(os.getpid())}
    handle = os.open(staging.owner, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
    with contextlib.suppress(OSError):  # of a file system that knows no locks
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    os.write(handle, json.dumps(owner).encode())
    return handle


def _identity(pid: int) -> dict[str, Any]:
    """What identifies a process: its number, when it started, since which start of which machine."""
    started = boot = ""
    with contextlib.suppress(OSError, IndexError):
        started = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()[19]
    with contextlib.suppress(OSError):
        boot = Path("/proc/sys/kernel/random/boot_id").read_text(encoding="utf-8").strip()
    return {"pid": pid, "started": started, "boot": boot, "host": platform.node()}


def clear_leftovers(folder: Path) -> None:
    """Remove the staging directories in a folder whose processes were killed."""
    with os.scandir(folder) as entries:
        found = [Staging(Path(entry.path)) for entry in entries if STAGING.fullmatch(entry.name)]
    for staging in found:
        with contextlib.suppress(OSError, ValueError):
            if _is_abandoned(staging):
                staging.dissolve()


def _is_abandoned(staging: Staging) -> bool:
    """Whether a staging directory is one of quadsim's, and its process dead."""
    if not is_folder(staging.path) or not is_file(staging.owner):
        return False
    try:
        owner = json.loads(staging.owner.read_bytes())
        now, state = _identity(int(owner["pid"])), staging.path.lstat()
        safe = state.st_uid == os.geteuid() and not state.st_mode & 0o022  # no one else can move things in it
        ours = safe and owner["inode"] == state.st_ino and owner["host"] == now["host"]
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


def _remove_own(path: Path, *, beside: Path) -> None:
    """Unlink what its content shows to be quadsim's, or what the manifest of the directory around it lists."""
    if is_folder(path):
        manifest = read_manifest(path)
        if manifest is None or not foreign(path, manifest):
            remove_listed(path)
        return
    around = read_manifest(beside)
    known = [] if around is None else [digest for digests in around.files.values() for digest in digests]
    if is_file(path) and (is_sealed(path) or is_known(path, known) or is_manifest(path)):
        path.unlink()


def _restore(slot: Path, folder: Path) -> None:
    """Rename back what was moved, where a process died between two steps."""
    name = slot / _NAME
    if not is_file(name):
        return
    target = Path(os.fsdecode(name.read_bytes()))
    if os.path.lexists(slot / _PREVIOUS) and not target.is_absolute() and ".." not in target.parts:
        _rename(slot / _PREVIOUS, folder / target)  # refused where something has it by now
    name.unlink()


def _refuse(target: Path, reason: str | None) -> None:
    if reason is not None:
        raise OutputError(target, reason)


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
