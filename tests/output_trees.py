"""Directories of ours and what a tree holds, for the tests of what writes them."""

from __future__ import annotations

import hashlib
from pathlib import Path

from quadsim.outputs import writing

KIND = "run"


def listing(directory: Path) -> list[str]:
    """Everything below a directory, hidden files included, but for manifests and locks."""
    paths = sorted(path for path in directory.rglob("*") if path.name not in (".quadsim.json", ".lock"))
    return [path.relative_to(directory).as_posix() for path in paths]


def contents(directory: Path) -> dict[str, str | None]:
    """What a tree holds: digests of files, targets of links, kinds of others."""
    found = {}
    for path in sorted(directory.rglob("*")):
        if path.is_symlink():
            found[str(path)] = f"-> {path.readlink()}"
        else:
            found[str(path)] = hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else str(path.is_dir())
    return found


def make(target: Path, kind: str = KIND, **texts: str) -> None:
    """A directory of ours."""
    with writing(target, kind) as partial:
        (partial / "figures").mkdir()
        for name, text in {"summary": "{}", "figures/a": "png", **texts}.items():
            (partial / f"{name}.txt").write_text(text)


def write_half(target: Path, error: type[BaseException]) -> None:
    """Begin a directory and fail."""
    with writing(target, KIND) as partial:
        (partial / "new.txt").write_text("new")
        raise error("halfway")
