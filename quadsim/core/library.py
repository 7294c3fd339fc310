"""The library of quadsim's C, for the modules that declare its functions."""

from __future__ import annotations

import ctypes
from functools import cache
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike

from quadsim.core.build import LIBRARY, ROOT, CompilationError, compile_library, is_current
from quadsim.errors import FileError

INT: Final = ctypes.c_int
REAL: Final = ctypes.c_double
AT: Final = ctypes.c_void_p


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
            problem = f"{problem}, and it cannot be compiled ({reason}); {_remedy(root)}"
            raise FileError(root / LIBRARY, problem) from error
        library = _loaded(root)
        if isinstance(library, str):
            raise FileError(root / LIBRARY, f"{library}; {_remedy(root)}")
    return library


def check_sizes(**mirrors: type[ctypes.Structure]) -> None:
    """Assert that structs have the sizes that the library states, e.g. of `quadsim_axis` in `quadsim_axis_size`."""
    for name, mirror in mirrors.items():
        size = ctypes.c_size_t.in_dll(load_library(), f"{name}_size").value
        assert ctypes.sizeof(mirror) == size, f"{name} has {size} bytes, not {ctypes.sizeof(mirror)}"


def struct_members(kind: type[Any], names: str) -> list[tuple[str, Any]]:
    """Return members of a struct, as `x n:3`."""
    parts = (name.partition(":") for name in names.split())
    return [(name, kind * int(size) if size else kind) for name, _, size in parts]


def set_arrays(struct: ctypes.Structure, **arrays: ArrayLike) -> None:
    """Set array members of a struct."""
    for name, values in arrays.items():
        getattr(struct, name)[:] = np.asarray(values, float).ravel().tolist()


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


def _remedy(root: Path) -> str:
    """Return the command that compiles the library; pip fetches a compiler where there is none."""
    checkout = (root / "hatch_build.py").is_file()
    return "run: pip install " + (f"--editable {root}" if checkout else "--force-reinstall --no-deps quadsim")
