"""The library of quadsim's C; `quadsim.core.mirror` gives its functions their types."""

from __future__ import annotations

import ctypes
from functools import cache
from pathlib import Path

from quadsim.core.build import LIBRARY, ROOT, CompilationError, compile_library, is_current
from quadsim.errors import FileError


@cache
def load_library() -> ctypes.CDLL:
    """Return the library, loaded once per process; see `load_from`."""
    return load_from(ROOT)


def load_from(root: Path) -> ctypes.CDLL:
    """Load the library of the packages in a folder; compile it before if it is missing, stale or of another machine.

    Raises:
        FileError: it cannot be compiled, or cannot be loaded.
    """
    library = _loaded(root)
    if isinstance(library, str):
        problem = library
        try:
            compile_library(root)
        except CompilationError as error:
            lines = str(error).splitlines()
            reason = next((line for line in lines if "error:" in line), lines[0])
            problem = f"{problem}, and it cannot be compiled ({reason}); {remedy(root)}"
            raise FileError(root / LIBRARY, problem) from error
        library = _loaded(root)
        if isinstance(library, str):
            raise FileError(root / LIBRARY, f"{library}; {remedy(root)}")
    return library


def _loaded(root: Path) -> ctypes.CDLL | str:
    """Return the library, or why the file must not be used."""
    path = root / LIBRARY
    if not path.is_file():
        return "is missing"
    if not is_current(root):
        return "was compiled from other sources"
    try:
        return ctypes.CDLL(str(path))
    except OSError as error:
        return f"cannot be loaded ({error})"


def remedy(root: Path) -> str:
    """Return the command that compiles the library; pip fetches a compiler where there is none."""
    is_checkout = (root / "hatch_build.py").is_file()
    if is_checkout:
        return f"run: pip install --editable {root}"
    return "run: pip install --force-reinstall --no-deps quadsim"
