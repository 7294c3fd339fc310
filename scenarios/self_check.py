"""What this machine can do: its packages, cores, rendering, viewer and solvers."""

from __future__ import annotations

import os
import shutil
import time as clock

from mpc.solvers import solver_entries
from quadsim.controller import SOLVED, Moment
from quadsim.errors import FlightError, QuadsimError
from quadsim.report.film.video import rendering_backend
from quadsim.report.recording import viewer_problem
from scenarios.loading import assemble
from scenarios.machine import machine, versions


def doctor() -> dict[str, dict[str, str]]:
    """What this machine can do; every installed QP solver is tried on a step of the paper's constrained flight.

    Returns:
        Checks by section (machine, packages, rendering, viewer, solvers), each a line that a person can act on.

    Examples:
        >>> import quadsim
        >>> found = quadsim.doctor()
        >>> found["solvers"]["piqp-multistage"].startswith("works")
        True
        >>> sorted(found)
        ['machine', 'packages', 'rendering', 'solvers', 'viewer']
    """
    here = machine()
    return {
        "machine": {
            "system": here["system"],
            "processor": f"{here['processor']}, {len(os.sched_getaffinity(0))} of {here['cores']} cores usable",
            "disk": f"{shutil.disk_usage('.').free / 1e9:.1f} GB free here",
        },
        "packages": versions(),
        "rendering": {"video": _rendering()},
        "viewer": {"native": viewer_problem() or "can be opened", "browser": "quadsim view RUN --web"},
        "solvers": {
            name: _try_solver(name) if entry.installed else entry.line for name, entry in solver_entries().items()
        },
    }


def _rendering() -> str:
    try:
        return f"renders off screen through {rendering_backend().upper()}"
    except QuadsimError as error:
        return str(error)


def _try_solver(name: str) -> str:
    """Solve the first step of the paper's constrained flight."""
    assembly = assemble("paper-constrained", [f"controller.solver={name}"])
    started = clock.perf_counter()
    controller = assembly.controller()
    built = clock.perf_counter()
    controller.reset(assembly.initial_speeds)
    reference = assembly.reference(controller.horizon + 1)[1:]
    try:
        command = controller.step(Moment(), assembly.initial_state(), reference)
    except FlightError as error:
        return f"fails: {error}"
    verdict = "works" if command.status == SOLVED else f"answers {command.status}"
    setup_ms, step_ms = 1e3 * (built - started), 1e3 * (clock.perf_counter() - built)
    return f"{verdict}: set up in {setup_ms:.0f} ms, first step in {step_ms:.1f} ms"
