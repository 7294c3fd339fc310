"""The machine: versions of numerically relevant packages, cores, and capabilities."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import shutil
import time as clock
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from typing import Any, Final

from quadsim import __version__
from quadsim.errors import FlightError, QuadsimError

PACKAGES: Final = ("mujoco", "numpy", "scipy", "piqp", "rerun-sdk", "imageio", "pyarrow", "matplotlib")


def versions() -> dict[str, str]:
    """Return the versions of packages that affect numbers."""
    return {"quadsim": __version__, "python": platform.python_version(), **_packages()}


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
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()


def usable_cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def capabilities() -> dict[str, dict[str, str]]:
    """Return this machine's capabilities by section; every installed QP solver solves one constrained step."""
    from mpc.solvers import solver_entries
    from quadsim.report.recording import viewer_problem

    here = machine()
    return {
        "machine": {
            "system": here["system"],
            "processor": f"{here['processor']}, {usable_cores()} of {here['cores']} cores usable",
            "disk": f"{shutil.disk_usage('.').free / 1e9:.1f} GB free here",
        },
        "packages": versions(),
        "rendering": {"video": _tried(_rendering)},
        "viewer": {"native": viewer_problem() or "can be opened", "browser": "quadsim view RUN --web"},
        "solvers": {
            name: _tried(partial(_try_solver, name)) if entry.installed else entry.line
            for name, entry in solver_entries().items()
        },
    }


def _rendering() -> str:
    from quadsim.report.film.video import rendering_backend

    return f"renders off screen through {rendering_backend().upper()}"


def _tried(call: Callable[[], str]) -> str:
    """Return what a part of this machine can do, or why it cannot: a broken one must not hide the others."""
    try:
        return call()
    except QuadsimError as error:
        return str(error)
    except Exception as error:  # of a package that is installed and does not work
        return f"fails: {type(error).__name__}: {error}"


def _try_solver(name: str) -> str:
    """Solve the first step of the paper's constrained flight."""
    from quadsim.controller import SOLVED, StepInputs
    from scenarios.loading import assemble

    assembly = assemble("paper-constrained", [f"controller.solver={name}"])
    started = clock.perf_counter()
    controller = assembly.controller()
    built = clock.perf_counter()
    controller.reset(assembly.initial_speeds)
    reference = assembly.reference(controller.horizon + 1)[1:]
    try:
        command = controller.step(StepInputs(), assembly.initial_state(), reference)
    except FlightError as error:
        return f"fails: {error}"
    verdict = "works" if command.status == SOLVED else f"answers {command.status}"
    setup_ms, step_ms = 1e3 * (built - started), 1e3 * (clock.perf_counter() - built)
    return f"{verdict}: set up in {setup_ms:.0f} ms, first step in {step_ms:.1f} ms"
