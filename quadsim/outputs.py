"""The only code that replaces and removes outputs.

An existing output directory that is not empty is refused.  A new one is built beside its place and renamed into it;
`files` in its `summary.json` has the SHA-256 of the other files, `unhashed` the names of those that differ between
directories with the same results.  Overwriting unlinks, by name, the regular files that these list, and refuses a
directory that holds anything else.  A directory that grows in place, such as a campaign's, is locked.  What a killed
process leaves, a lock or a half-written folder under a private name, does not block the next one.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import itertools
import json
import logging
import os
import re
import secrets
import shutil
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from stat import S_IMODE, S_ISDIR, S_ISREG
from typing import Any, Final

from quadsim.errors import OutputError, failure_line, printable

SUMMARY_FILE: Final = "summary.json"
UNHASHED: Final = "unhashed"  # entry of a summary: files that it lists without their SHA-256
LOCK_FILE: Final = ".lock"  # in a directory that grows
_LOCK_MARK: Final = b"quadsim\n"  # its content
_PARTIAL: Final = re.compile(r"\.quadsim-[a-z0-9_]{8}\.partial")  # folders as `_beside` names them
_FREE_BYTES_NEEDED: Final = 16 * 1024 * 1024
_log: Final = logging.getLogger("quadsim")


def absolute(path: Path | str) -> Path:
    """Return the absolute path with links, `..` and `~` resolved, so that a controller's `chdir` cannot move it.

    Raises:
        OutputError: it leads nowhere.
    """
    try:
        real = Path(os.path.realpath(Path(path).expanduser()))
        if real.is_symlink():
            raise ValueError("a symbolic link leads back to itself")
    except (ValueError, RuntimeError, OSError) as error:  # includes null bytes, unknown users, long names
        raise OutputError(ascii(str(path))[1:-1], getattr(error, "strerror", None) or str(error)) from error
    return real


def to_json(data: Mapping[str, Any]) -> str:
    """Serialise to strict JSON (no NaN), the format of all our files."""
    return json.dumps(data, indent=2, allow_nan=False) + "\n"


def digest_of(path: Path) -> str:
    """Return the SHA-256 of a file's content, as file lists record it."""
    with path.open("rb") as file:
        return f"sha256:{hashlib.file_digest(file, 'sha256').hexdigest()}"


def file_hashes(directory: Path) -> dict[str, str]:
    """SHA-256 of every regular file below a directory except its summary and lock, by relative path, sorted."""
    hashes = {}
    for name, mode in sorted(_modes_below(directory).items()):
        if S_ISREG(mode) and name not in (SUMMARY_FILE, LOCK_FILE):
            hashes[name] = digest_of(directory / name)
    return hashes


@contextlib.contextmanager
def reserving(
    path: Path | str, *, overwrite: bool = False, free: bool = False, first: Sequence[str] = ()
) -> Iterator[Path]:
    """Create an output directory before its contents are computed; it is removed if the block leaves it empty.

    `overwrite` allows an earlier output there; `free` takes the next free name instead: NAME, NAME-2, ...; `first` as
    in `growing`.

    Raises:
        OutputError: it cannot be made, or holds something that must not be replaced.
    """
    asked = target = absolute(path)
    made: list[Path] = []
    try:
        with _system_errors_named(target):
            for parent in target.parents:
                if not parent.exists():
                    made.append(parent)
            if made == [] and not target.parent.is_dir():
                raise OutputError(target, f"{target.parent} is a file")
            target.parent.mkdir(parents=True, exist_ok=True)
            for i in itertools.count(2):
                with contextlib.suppress(FileExistsError):
                    target.mkdir()
                    made.insert(0, target)
                if not free or target in made:
                    break
                target = asked.with_name(f"{asked.name}-{i}")
            _require_replaceable(target, overwrite=overwrite, first=first)
            if shutil.disk_usage(target).free < _FREE_BYTES_NEEDED:
                raise OutputError(target, "the disk is full")
        yield target
    finally:
        for folder in made:
            with contextlib.suppress(OSError):
                folder.rmdir()  # removes only an empty folder


def run_directory(name: str, out: Path | str | None, *, overwrite: bool) -> AbstractContextManager[Path]:
    """Reserve a run directory: `out`, or `runs/NAME`, or the next free name unless `overwrite`; see `reserving`."""
    if out is not None:
        return reserving(out, overwrite=overwrite)
    return reserving(Path("runs") / name, overwrite=overwrite, free=not overwrite)


@contextlib.contextmanager
def writing(path: Path | str, *, overwrite: bool = False) -> Iterator[Path]:
    """A directory to fill; it becomes `path`, with its file list, if the block succeeds, and vanishes otherwise.

    Raises:
        OutputError: see `reserving`; if `path` has been taken meanwhile, the result stays beside it.
    """
    with reserving(path, overwrite=overwrite) as target, _beside(target) as work:
        yield work
        amend(work, {"files": file_hashes(work)})
        work.chmod(S_IMODE(target.stat().st_mode))  # not before: it may allow nothing
        try:
            _require_replaceable(target, overwrite=overwrite)
            _remove_listed_files(target)
            work.rename(target)
        except OSError as error:
            kept = work.rename(work.with_suffix(".kept"))
            problem = error.strerror
            if isinstance(error, OutputError):
                problem = error.problem
            raise OutputError(target, f"{problem}; what was made is in {kept}") from error


@contextlib.contextmanager
def adding(directory: Path, **changes: Any) -> Iterator[Path]:
    """A folder to fill; if the block succeeds, its files go into a finished directory and `changes` into its summary.

    Raises:
        OutputError: they cannot be written, or files that the summary does not list have their names.
    """
    with _beside(directory) as work:
        yield work
        hashes = file_hashes(work)
        listed = _files_of_summary(directory) or set()
        for name in hashes:
            if os.path.lexists(directory / name) and name not in listed:
                raise OutputError(directory / name, f"{SUMMARY_FILE} does not list it; move it away first")
        for name in hashes:
            (directory / name).parent.mkdir(exist_ok=True)
            (work / name).rename(directory / name)
        amend(directory, {**changes, "files": hashes})


def amend(directory: Path, changes: Mapping[str, Any]) -> None:
    """Change entries of a directory's summary atomically; in a nested table, only the entries given."""
    path = directory / SUMMARY_FILE
    if path.exists():
        summary = json.loads(path.read_bytes())
    else:
        summary = {}
    for key, value in changes.items():
        if isinstance(value, Mapping):
            summary[key] = {**summary.get(key, {}), **value}
        else:
            summary[key] = value
    summary["files"] = dict(sorted(summary.pop("files", {}).items()))
    with writing_file(path, overwrite=True) as new:
        new.write_text(to_json(summary), encoding="utf-8")


@contextlib.contextmanager
def optional(name: str) -> Iterator[None]:
    """Make what decorates a result that is there already, such as a figure: a failure is a line, nothing more."""
    try:
        yield
    except Exception as error:
        _log.warning("%s %s", name, failure_line(error))


def require_file(path: Path | str, *, overwrite: bool = False) -> Path:
    """Return the absolute path of an output file; call it before the work for it starts.

    Raises:
        OutputError: it cannot be written, or exists and may not be overwritten.
    """
    path = absolute(path)
    with _system_errors_named(path):
        if os.path.lexists(path) and not (overwrite and path.is_file()):
            if path.is_dir():
                raise OutputError(path, "is a folder")
            raise OutputError(path, "it already exists; choose another file")
        with tempfile.TemporaryFile(dir=path.parent):
            return path


@contextlib.contextmanager
def writing_file(path: Path | str, *, overwrite: bool = False) -> Iterator[Path]:
    """A file to write in a temporary folder; it becomes `path` if the block succeeds; errors as in `require_file`."""
    path = require_file(path, overwrite=overwrite)
    with _beside(path) as work:
        yield work / f"new{path.suffix}"
        (work / f"new{path.suffix}").rename(require_file(path, overwrite=overwrite))


class Growing:
    """A directory to which files are added in place; see `growing`."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def write(self, files: Mapping[str, bytes]) -> None:
        """Write or replace files by their relative paths, each atomically."""
        for name, content in files.items():
            with _system_errors_named(self.path / name):
                (self.path / name).parent.mkdir(exist_ok=True)
                with writing_file(self.path / name, overwrite=True) as new:
                    new.write_bytes(content)

    def remove(self, names: Sequence[str]) -> None:
        """Remove files, and folders that become empty."""
        with _system_errors_named(self.path):
            for name in names:
                (self.path / name).unlink(missing_ok=True)
        folders = {(self.path / name).parent for name in names}
        for folder in folders - {self.path}:
            with contextlib.suppress(OSError):
                folder.rmdir()

    def finish(self, summary: Mapping[str, Any], *, unhashed: Sequence[str] = ()) -> None:
        """Write `summary.json`, with the list of all other files.

        Those named `unhashed` are listed without their SHA-256: it would differ where the results are the same.
        """
        hashes = file_hashes(self.path)
        named = []
        for name in unhashed:
            if name in hashes:
                del hashes[name]
                named.append(name)
        listed: dict[str, Any] = {"files": hashes}
        if named:
            listed[UNHASHED] = sorted(named)
        self.write({SUMMARY_FILE: to_json({**summary, **listed}).encode()})


@contextlib.contextmanager
def growing(path: Path | str, mark: str, *, overwrite: bool = False, first: Sequence[str] = ()) -> Iterator[Growing]:
    """A directory that grows in place, written by one process at a time: a new one, or one with a file `mark`.

    `first` names the files that are written before `mark`: a process that was killed then leaves these alone.

    Raises:
        OutputError: it cannot be written, holds something else, or another process writes there.
    """
    directory = absolute(path)
    goes_on = (directory / mark).is_file() and not overwrite
    place: AbstractContextManager[object] = contextlib.nullcontext()
    if not goes_on:
        place = reserving(directory, overwrite=overwrite, first=first)
    with place, _locked(directory, mark=True):
        odd = []
        for name, mode in _modes_below(directory).items():
            if not (S_ISREG(mode) or S_ISDIR(mode)):
                odd.append(name)
        if odd:
            raise OutputError(directory, f"{_first_names(odd)}: links are refused; move them away first")
        _clear_partial(directory)
        if not goes_on:
            _remove_listed_files(directory, keep=LOCK_FILE)
        try:
            yield Growing(directory)
        finally:
            with contextlib.suppress(OSError):  # the directory may be gone
                if list(_modes_below(directory)) == [LOCK_FILE]:
                    (directory / LOCK_FILE).unlink()


def _require_replaceable(target: Path, *, overwrite: bool, first: Sequence[str] = ()) -> None:
    """Refuse a directory that is not empty, unless its summary lists all its files and it may be overwritten.

    One in which another process writes is refused; one that a process of ours has only begun to fill is as good as
    empty: it has our lock, and perhaps files in `first`.
    """
    if not target.is_dir():
        raise OutputError(target, "a file is already there; choose another --out")
    with contextlib.suppress(FileNotFoundError):  # the current directory may be gone
        if target.samefile(Path.cwd()):
            raise OutputError(target, "it is the current directory; name one to be made")
    with _system_errors_named(target):
        there = _modes_below(target)
        listed = _files_of_summary(target)
    if S_ISREG(there.get(LOCK_FILE, 0)):
        with _locked(target):
            content = (target / LOCK_FILE).read_bytes()[: len(_LOCK_MARK) + 1]
        left = {LOCK_FILE}
        if content == _LOCK_MARK:
            left |= {*first}
        if content in (b"", _LOCK_MARK) and {*there} <= left and all(map(S_ISREG, there.values())):
            return
    if there and not overwrite:
        raise OutputError(
            target, f"it is not empty ({_first_names([*there])}); choose another --out, or add --overwrite"
        )
    if there and listed is None:
        raise OutputError(target, f"it has no {SUMMARY_FILE} that lists its files; choose another --out")
    files = {*(listed or ()), SUMMARY_FILE, LOCK_FILE}
    folders: set[str] = set()
    for name in files:
        folders |= {str(parent) for parent in Path(name).parents}
    others = []
    for name, mode in there.items():
        is_listed_file = S_ISREG(mode) and name in files
        is_listed_folder = S_ISDIR(mode) and name in folders
        if not (is_listed_file or is_listed_folder):
            others.append(name)
    if others:
        raise OutputError(target, f"its {SUMMARY_FILE} does not list {_first_names(others)}; move that away first")


def _remove_listed_files(target: Path, keep: str = "") -> None:
    """Unlink the listed files of a directory and its lock, remove its folders, and unlink its summary last."""
    _clear_partial(target)
    files = {*(_files_of_summary(target) or ()), LOCK_FILE} - {keep}
    for name, mode in reversed(_modes_below(target).items()):
        if S_ISDIR(mode):
            (target / name).rmdir()
        elif name in files:
            (target / name).unlink()
    (target / SUMMARY_FILE).unlink(missing_ok=True)


def _clear_partial(directory: Path) -> None:
    """Remove the half-written folders of killed processes, made here under private names."""
    for path in directory.iterdir():
        if _PARTIAL.fullmatch(path.name) and path.is_dir() and not path.is_symlink():
            _remove(path)


def _remove(partial: Path) -> None:
    """Remove a folder that `_beside` made, whatever its permissions."""
    with contextlib.suppress(OSError):
        partial.chmod(0o700)
    shutil.rmtree(partial, ignore_errors=True)


def _files_of_summary(directory: Path) -> set[str] | None:
    """Return the files that a directory's summary lists; None if it has no list."""
    with contextlib.suppress(OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError):
        summary = json.loads((directory / SUMMARY_FILE).read_bytes())
        files = summary["files"]
        if files and all(digest.startswith("sha256:") for digest in files.values()):
            return {*files, *map(str, summary.get(UNHASHED, ()))}
    return None


def _modes_below(directory: Path) -> dict[str, int]:
    """Return the modes of everything below a directory by relative path, parents first; links are not followed.

    Half-written folders of killed processes are left out.

    Raises:
        OSError: a folder cannot be read.
    """

    def fail(error: OSError) -> None:
        raise error

    modes = {}
    for folder, inner, files in os.walk(directory, onerror=fail):
        inner[:] = [name for name in inner if not _PARTIAL.fullmatch(name)]
        for name in sorted((*inner, *files)):
            path = Path(folder, name)
            modes[path.relative_to(directory).as_posix()] = path.lstat().st_mode
    return modes


def _first_names(names: Sequence[str]) -> str:
    listed = ", ".join(map(printable, names[:3]))
    if len(names) > 3:
        listed += f" and {len(names) - 3} more"
    return listed


@contextlib.contextmanager
def _beside(target: Path) -> Iterator[Path]:
    """A temporary folder beside a target; errors about its contents name them as if they were in the target."""
    with _system_errors_named(target):
        work = target.parent / f".quadsim-{secrets.token_hex(4)}.partial"
        try:
            work.mkdir(0o700)  # within the try: a signal may come as soon as it is there
            yield work
        except OutputError as error:
            if not error.path.is_relative_to(work):
                raise
            raise OutputError(target / error.path.relative_to(work), error.problem) from error
        finally:
            _remove(work)


@contextlib.contextmanager
def _locked(directory: Path, *, mark: bool = False) -> Iterator[None]:
    """Lock a directory for this process; `mark` says in the lock whose it is."""
    with _system_errors_named(directory / LOCK_FILE):
        handle = os.open(directory / LOCK_FILE, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o644)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise OutputError(directory, "another process is writing there") from error
        if mark and os.fstat(handle).st_size == 0:
            with _system_errors_named(directory / LOCK_FILE):
                os.write(handle, _LOCK_MARK)
        yield
    finally:
        os.close(handle)


@contextlib.contextmanager
def _system_errors_named(path: Path) -> Iterator[None]:
    """Raise the system's errors as output errors."""
    try:
        yield
    except OutputError:
        raise
    except OSError as error:
        raise OutputError(path, error.strerror or str(error)) from error
