"""Paths of outputs: their names, where links lead, and what may already be there."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Sequence
from pathlib import Path

from quadsim.errors import FileError, OutputError
from quadsim.outputs.manifest import foreign, is_folder, is_sealed, read_manifest, remove_empty


def real_path(path: Path | str) -> Path:
    """Where a path leads, links and `..` followed; the path as it is where it has none of them.

    Raises:
        OutputError: it leads nowhere.
    """
    path = Path(path)
    try:
        real = Path(os.path.realpath(path))
        if real.is_symlink():
            raise OutputError(path, "a symbolic link leads back to itself")
        return path if real == path.absolute() and ".." not in path.parts else real
    except ValueError as error:
        raise OutputError(ascii(str(path)), "it has a null byte") from error
    except OSError as error:
        raise as_output_error(path, error) from error


@contextlib.contextmanager
def parents_of(target: Path) -> Iterator[None]:
    """Make the parents that are missing; those that are empty afterwards go again."""
    missing = [parent for parent in target.parents if not parent.exists()]
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        yield
    except OSError as error:
        raise as_output_error(target, error) from error
    finally:
        for parent in missing:  # from the innermost outwards
            remove_empty(parent)


def problem_with_directory(path: Path, kind: str) -> str | None:
    """Why a directory must not be replaced; None if it is empty, or of that kind and all quadsim's."""
    if not is_folder(path):
        return occupied(())
    if path.resolve().is_mount():
        return "it is a mount point; name a directory in it"
    manifest = read_manifest(path)
    if manifest is None:
        there = sorted(entry.name for entry in path.iterdir())
        return occupied(there) if there else None
    if manifest.kind != kind:
        return f"{already(manifest.kind)}; choose another --out"
    others = foreign(path, manifest)
    built = kind == "export" and all(name.endswith((".elf", ".o", ".su")) for name in others)
    remedy = "run `make clean` in it, or choose another --out" if built else "choose another --out"
    return f"it holds {few(others)}, not as quadsim wrote it; {remedy}" if others else None


def already(kind: str) -> str:
    """What is there, for messages."""
    return f"{'an' if kind[0] in 'aeiou' else 'a'} {kind} is already there"


def problem_with_file(path: Path, form: str) -> str | None:
    """Why something must not be replaced by a file of that form; None if it is one that we wrote."""
    if is_folder(path):
        return "is a folder"
    return None if is_sealed(path, form) else "something else is already there; choose another file"


def occupied(names: Sequence[str]) -> str:
    """That something else is there, and what."""
    return f"something else is already there{f' ({few(names)})' if names else ''}; choose another --out"


def few(names: Sequence[str]) -> str:
    """Some names, in printable signs."""
    shown = [name if name.isprintable() else ascii(name)[1:-1] for name in names[:3]]
    return ", ".join(shown) + (f" and {len(names) - 3} more" if len(names) > 3 else "")


@contextlib.contextmanager
def output_errors(path: Path) -> Iterator[None]:
    """Raise the system's errors as those of an output."""
    try:
        yield
    except OSError as error:
        raise as_output_error(path, error) from error


def as_output_error(path: Path, error: OSError) -> OutputError:
    """The system's error as an `OutputError`, which it may be already."""
    return error if isinstance(error, OutputError) else OutputError(path, error.strerror or str(error))


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
