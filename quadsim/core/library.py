"""Load the library of quadsim's C, compiled before where it is missing or stale (`quadsim.core.build`).

Of several processes that need it at once, one compiles and the others wait.  `quadsim.core.mirror` gives its functions
their types.
"""

from __future__ import annotations

import contextlib
import ctypes
import fcntl
import logging
import os
import threading
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Final

from quadsim.core.build import LIBRARY, ROOT, CompilationError, compile_library, is_current
from quadsim.errors import FileError

_log: Final = logging.getLogger("quadsim")
_compiling: Final = threading.Event()


def is_compiling() -> bool:
    """Return whether this process compiles the library, or waits for one that does; for progress only."""
    return _compiling.is_set()


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
        with _alone(root):
            library = _loaded(root)  # another process may have compiled it meanwhile
            if isinstance(library, str):
                library = _compiled(root, problem=library)
    return library


def _compiled(root: Path, *, problem: str) -> ctypes.CDLL:
    """Compile and load the library; `problem` is why the file there must not be used.

    Raises:
        FileError: it cannot be compiled, or cannot be loaded.
    """
    _log.info("compiling the C library, once; this takes up to a minute, or more on a slow machine")
    try:
        compile_library(root)
    except CompilationError as error:
        problem = f"{problem}, and it cannot be compiled ({_first_error(str(error))}); {remedy(root)}"
        raise FileError(root / LIBRARY, problem) from error
    library = _loaded(root)
    if isinstance(library, str):
        raise FileError(root / LIBRARY, f"{library}; {remedy(root)}")
    return library


@contextlib.contextmanager
def _alone(root: Path) -> Iterator[None]:
    """Hold the lock of compiling, once whoever has it is done or dead: the system frees the lock of a dead process.

    It is a lock of the folder of the library itself: there is no file to be left behind, and a folder that cannot be
    written has it too.  Where it cannot be locked, each process compiles for itself, which is slow but safe: the
    library is replaced atomically.
    """
    with contextlib.ExitStack() as stack:
        _compiling.set()
        stack.callback(_compiling.clear)
        with contextlib.suppress(OSError):
            folder = os.open((root / LIBRARY).parent, os.O_RDONLY | os.O_CLOEXEC)
            stack.callback(os.close, folder)
            _lock(folder)
        yield


def _lock(folder: int) -> None:
    """Lock an open folder; say so if another process has to be waited for."""
    try:
        fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        _log.info("waiting for another process, which compiles the C library")
        fcntl.flock(folder, fcntl.LOCK_EX)


def _first_error(printed: str) -> str:
    """Return the first line of a compiler's output that names an error, or else its first line."""
    lines = printed.splitlines()
    for line in lines:
        if "error:" in line:
            return line
    return lines[0]


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
