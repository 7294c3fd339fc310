"""What quadsim wrote: files whose content is known, listed by a manifest or sealed by a digest of their own."""

from __future__ import annotations

import hashlib
import json
import os
import re
import stat
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, Final

MANIFEST_FILE: Final = ".quadsim.json"
LOCK_FILE: Final = ".lock"  # of a directory that grows: empty, and locked by the process that writes there

_FORMAT: Final = "quadsim directory"
_START: Final = b'{\n  "format": "quadsim directory",'
_SEALS: Final = {
    ".xml": (b"\n<!-- ", b" -->\n"),
    ".mp4": ((8 + len("quadsim sha256:") + 64).to_bytes(4, "big") + b"free", b""),  # a box that players pass over
    ".png": (b"\n", b"\n"),
    ".gif": (b"\n", b"\n"),
}
"""What is around a file's seal at its end, where readers of its format pass over it."""
_LONGEST_SEAL: Final = 200


@dataclass(frozen=True, kw_only=True)
class Manifest:
    """What we wrote into a directory."""

    kind: str  # of directory, for people, e.g. `run`
    files: Mapping[str, Sequence[str]]  # SHA-256 by relative path; of a file that is about to change, before and after

    def encode(self) -> bytes:
        """As it is written."""
        files = {name: [*known] for name, known in sorted(self.files.items())}
        return to_json({"format": _FORMAT, "kind": self.kind, "files": files}).encode()

    @property
    def folders(self) -> list[str]:
        """Those that the files are in, the innermost first."""
        found = {str(folder) for name in self.files for folder in PurePosixPath(name).parents} - {"."}
        return sorted(found, key=len, reverse=True)


def to_json(data: Mapping[str, Any]) -> str:
    """Strict JSON (no NaN), as all our files have it."""
    return json.dumps(data, indent=2, allow_nan=False) + "\n"


def digest(content: bytes) -> str:
    """SHA-256 of some content, as manifests have it."""
    return f"sha256:{hashlib.sha256(content).hexdigest()}"


def digest_of(path: Path) -> str:
    """SHA-256 of a file's content, as manifests have it."""
    with path.open("rb") as file:
        return f"sha256:{hashlib.file_digest(file, 'sha256').hexdigest()}"


def is_file(path: Path) -> bool:
    """Whether there is a plain file: no link, FIFO, device or folder."""
    return stat.S_ISREG(_mode(path))


def is_folder(path: Path) -> bool:
    """Whether there is a folder itself, not a link to one."""
    return stat.S_ISDIR(_mode(path))


def _mode(path: Path) -> int:
    try:
        return path.lstat().st_mode
    except (OSError, ValueError):  # there is nothing, or a name that nothing can have
        return 0


def is_known(path: Path, known: Sequence[str]) -> bool:
    """Whether there is a plain file with one of these digests."""
    return bool(known) and is_file(path) and digest_of(path) in known


def below(directory: Path) -> Iterator[Path]:
    """Everything below a directory, each folder before what is in it; links are not followed."""
    folders = [directory]
    while folders:
        with os.scandir(folders.pop()) as entries:
            for entry in entries:
                yield Path(entry.path)
                if entry.is_dir(follow_symlinks=False):
                    folders.append(Path(entry.path))


def take_stock(directory: Path, kind: str) -> Manifest:
    """The manifest of a directory that is all quadsim's."""
    files = {path.relative_to(directory).as_posix(): path for path in below(directory) if not is_folder(path)}
    return Manifest(kind=kind, files={name: (digest_of(path),) for name, path in files.items()})


def read_manifest(directory: Path) -> Manifest | None:
    """The manifest of a directory of quadsim's; None where there is none, or one that is not as we write it."""
    path = directory / MANIFEST_FILE
    if not is_file(path):
        return None
    content = path.read_bytes()
    try:
        data = json.loads(content)
        files = {str(name): tuple(map(str, known)) for name, known in data["files"].items()}
        manifest = Manifest(kind=str(data["kind"]), files=files)
        return manifest if manifest.encode() == content and all(map(_is_inside, files)) else None
    except (ValueError, TypeError, LookupError, AttributeError, RecursionError):
        return None


def _is_inside(name: str) -> bool:
    """Whether a name can be one of a file in a directory."""
    path = PurePosixPath(name)
    return bool(os.fsencode(name)) and "\0" not in name and not path.is_absolute() and ".." not in path.parts


def is_manifest(path: Path) -> bool:
    """Whether a file's content is a manifest, whatever its name."""
    with path.open("rb") as file:
        return file.read(len(_START)) == _START


def foreign(directory: Path, manifest: Manifest) -> list[str]:
    """What a directory holds beyond its manifest: other or changed files, links, empty folders; sorted names."""
    folders = set(manifest.folders)
    found = []
    for path in below(directory):
        name = path.relative_to(directory).as_posix()
        ours = name in folders if is_folder(path) else is_known(path, manifest.files.get(name, ()))
        if not ours and name != MANIFEST_FILE and not _is_lock(path, directory):
            found.append(name)
    return sorted(found)


def _is_lock(path: Path, directory: Path) -> bool:
    return path == directory / LOCK_FILE and is_file(path) and path.stat().st_size == 0


def remove_listed(directory: Path) -> None:
    """Unlink what a directory's manifest lists, and then its folders and itself, as far as they are empty by then."""
    manifest = read_manifest(directory)
    if manifest is not None:
        linked = {name for name in manifest.folders if not is_folder(directory / name)}
        for name, known in manifest.files.items():
            if not linked & {*map(str, PurePosixPath(name).parents)} and is_known(directory / name, known):
                (directory / name).unlink()
        for folder in manifest.folders:
            remove_empty(directory / folder)
        if not foreign(directory, manifest):
            (directory / MANIFEST_FILE).unlink()
            remove_lock(directory)
    remove_empty(directory)


def remove_lock(directory: Path) -> None:
    """Remove our lock."""
    if _is_lock(directory / LOCK_FILE, directory):
        (directory / LOCK_FILE).unlink()


def remove_empty(folder: Path) -> bool:
    """Remove a folder if it is empty; whether it is gone."""
    try:
        folder.rmdir()
    except FileNotFoundError:
        return True
    except OSError:
        return False
    return True


def seal(path: Path, form: str) -> None:
    """Let a file end in the SHA-256 of all that stands before, in a way that readers of its format pass over."""
    before, after = _SEALS[form]
    mark = b"quadsim " + digest_of(path).encode()
    with path.open("ab") as file:
        file.write(before + mark + after)


def is_sealed(path: Path, form: str | None = None) -> bool:
    """Whether this is a file that was sealed, in that form or any, and not changed since."""
    if not is_file(path):
        return False
    size = path.stat().st_size
    with path.open("rb") as file:
        file.seek(max(0, size - _LONGEST_SEAL))
        end = file.read()
        for before, after in [_SEALS[form]] if form else _SEALS.values():
            mark = re.search(re.escape(before) + rb"quadsim sha256:([0-9a-f]{64})" + re.escape(after) + rb"\Z", end)
            if mark:
                return _digest_of_start(path, size - len(end) + mark.start()) == mark[1].decode()
    return False


def _digest_of_start(path: Path, length: int) -> str:
    hashed = hashlib.sha256()
    with path.open("rb") as file:
        while length and (block := file.read(min(length, 1 << 20))):
            hashed.update(block)
            length -= len(block)
    return hashed.hexdigest()
