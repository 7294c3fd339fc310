"""MuJoCo's step for the compiled core, by its address in the installed wheel: no header, nothing to link."""

from __future__ import annotations

import ctypes
from functools import cache
from pathlib import Path
from typing import Any

import mujoco

from quadsim.core.mirror import core_library
from quadsim.errors import InputError


@cache
def step_address() -> int:
    """Return the address of `mj_step`, whose fatal errors are trapped from now on while the core calls it.

    Raises:
        InputError: this release of MuJoCo does not have what is needed.
    """
    try:
        folder = Path(mujoco.__file__).parent
        files = [*folder.glob("libmujoco.*"), *folder.glob("mujoco.dll")]
        library = ctypes.CDLL(str(files[0]))
        step = ctypes.cast(library.mj_step, ctypes.c_void_p).value
        trap = ctypes.c_void_p.in_dll(library, "mju_user_error")
        mujoco.MjData._address, mujoco.MjModel._address  # noqa: B018 - whether there are any
    except (OSError, AttributeError, ValueError, LookupError) as error:
        remedy = "install a release that pyproject.toml names"
        raise InputError(f"MuJoCo {mujoco.__version__} cannot be stepped from C ({error}): {remedy}") from error
    trap.value = ctypes.cast(core_library().quadsim_trap, ctypes.c_void_p).value
    assert step is not None
    return step


def addresses(model: Any, data: Any) -> tuple[int, int]:
    """Return the addresses of MuJoCo's model and data."""
    return model._address, data._address
