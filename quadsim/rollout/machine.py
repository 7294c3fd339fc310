"""What numbers depend on outside a scenario: the code, the versions of packages, and the machine; for summaries."""

from __future__ import annotations

import hashlib
import importlib.metadata
import os
import platform
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from typing import Any, Final

from quadsim.assets import library_dir, models_dir

PACKAGES: Final = ("mujoco", "numpy", "scipy", "piqp", "rerun-sdk", "imageio", "pyarrow", "matplotlib")
_PACKAGE: Final = Path(__file__).resolve().parents[1]


def versions() -> dict[str, str]:
    """Return the versions of quadsim, Python and the packages that affect numbers."""
    return {"quadsim": importlib.metadata.version("quadsim"), "python": platform.python_version(), **_packages()}


@cache
def _packages() -> dict[str, str]:
    return {name: importlib.metadata.version(name) for name in PACKAGES}


def machine() -> dict[str, Any]:
    """Return what a reader of timings must know."""
    return {"system": platform.platform(), "processor": processor_name(), "cores": os.cpu_count()}


@cache
def processor_name() -> str:
    """Return the processor's model, if the system reports it."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    names = []
    for line in lines:
        if line.startswith("model name"):
            names.append(line.partition(":")[2].strip())
    if names:
        return names[0]
    return platform.machine()


def usable_cores() -> int:
    """Return the number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@cache
def code_digest() -> str:
    """Return the SHA-256 of all quadsim files that affect numbers: code, models, scenarios."""
    return digest_below([_PACKAGE, library_dir(), models_dir()])


def digest_below(roots: Iterable[Path]) -> str:
    """Return the SHA-256 of the code, models and scenarios in files and folders."""
    digest = hashlib.sha256()
    for root in roots:
        paths = [root]
        if not root.is_file():
            paths = sorted(root.rglob("*"))
        for path in paths:
            if path.suffix in (".py", ".c", ".h", ".toml", ".xml") and path.is_file():
                digest.update(f"{root.name}/{path.relative_to(root).as_posix()}\0".encode())
                digest.update(path.read_bytes())
    return f"sha256:{digest.hexdigest()}"
