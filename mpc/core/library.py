"""The compiled core, if it exists and matches these sources."""

from __future__ import annotations

import ctypes
from functools import cache
from typing import Final

from mpc.core.build import FOLDER, NAME, source_hash
from quadsim.errors import MissingCoreError

MIRRORS: Final = (
    *("quadsim_axis", "quadsim_row", "quadsim_term", "quadsim_problem", "quadsim_work"),
    *("quadsim_robust", "quadsim_controller", "quadsim_mpc"),
)
"""Structs that Python writes or reads, in the order of `quadsim_library_sizes`."""


def load_library() -> ctypes.CDLL:
    """Return the library, loaded once per process; `MissingCoreError` if it is missing or of other sources."""
    reason = why_missing()
    if reason is not None:
        raise MissingCoreError(reason)
    library = _load()
    assert isinstance(library, ctypes.CDLL)
    return library


def check_mirrors(**mirrors: type[ctypes.Structure]) -> None:
    """Assert that the structs named in `MIRRORS` have the library's sizes."""
    sizes = (ctypes.c_size_t * len(MIRRORS))()
    load_library().quadsim_library_sizes(sizes)
    theirs = dict(zip(MIRRORS, sizes, strict=True))
    for name, mirror in mirrors.items():
        assert ctypes.sizeof(mirror) == theirs[name], f"{name} has {theirs[name]} bytes, not {ctypes.sizeof(mirror)}"


def why_missing() -> str | None:
    """Return why there is no core, in one line with a remedy; None if there is one."""
    library = _load()
    return library if isinstance(library, str) else None


@cache
def _load() -> ctypes.CDLL | str:
    path = FOLDER / NAME
    if not path.exists():
        return "it was not compiled when quadsim was installed: install a C compiler, then quadsim again"
    try:
        library = ctypes.CDLL(str(path))
        library.quadsim_library_source.restype = ctypes.c_char_p
        of = library.quadsim_library_source().decode()
    except (OSError, AttributeError) as error:
        return f"{path.name} cannot be loaded ({error}): install quadsim again"
    if of != source_hash():
        return f"{path.name} was compiled from other sources: run python {FOLDER / 'build.py'}"
    return library
