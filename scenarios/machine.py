"""The machine and the packages that numbers depend on, and how many cores there are."""

from __future__ import annotations

import importlib.metadata
import os
import platform
from functools import cache
from pathlib import Path
from typing import Any, Final

from quadsim import __version__

PACKAGES: Final = ("mujoco", "numpy", "scipy", "piqp", "rerun-sdk", "imageio", "pyarrow", "matplotlib")


def versions() -> dict[str, str]:
    """Versions of what the numbers depend on."""
    return {"quadsim": __version__, "python": platform.python_version(), **_packages()}


@cache
def _packages() -> dict[str, str]:
    return {name: importlib.metadata.version(name) for name in PACKAGES}


def machine() -> dict[str, Any]:
    """What a reader of timings has to know."""
    return {"system": platform.platform(), "processor": processor_name(), "cores": os.cpu_count()}


@cache
def processor_name() -> str:
    """The processor's model, as far as the system reports it."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()


def usable_cores() -> int:
    """Cores that this process may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
