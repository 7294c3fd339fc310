"""What this machine can do, tried out: render, show flights, solve.

Each check runs the real thing once (a frame, a QP of each solver, a batch of flights) and says what to install where it
fails.
"""

from __future__ import annotations

import shutil
import time as clock
from collections.abc import Callable
from functools import partial

import numpy as np

from quadsim.errors import FlightError, QuadsimError
from quadsim.rollout.machine import machine, usable_cores, versions
from quadsim.scenarios.loading import assemble
from quadsim.sim.physics import Integrator
from quadsim.state import N_STATES


def capabilities() -> dict[str, dict[str, str]]:
    """Return this machine's capabilities by section; every installed QP solver solves one constrained step."""
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
        "many vehicles": {
            "own method": _tried(partial(_speed_of_many, "rk4", 40)),
            "MuJoCo's step": _tried(partial(_speed_of_many, "mujoco", 5)),
        },
        "solvers": _solvers(),
    }


def _solvers() -> dict[str, str]:
    """Return what each installed QP solver does with one step, and how the others are installed."""
    from quadsim.mpc.solvers import solver_entries

    lines = {}
    for name, entry in solver_entries().items():
        if entry.installed:
            lines[name] = _tried(partial(_try_solver, name))
        else:
            lines[name] = entry.line
    return lines


def _rendering() -> str:
    """Return the back end that renders here."""
    from quadsim.report.film.video import rendering_backend

    return f"renders off screen through {rendering_backend().upper()}"


def _speed_of_many(integrator: Integrator, periods: int) -> str:
    """Fly 32 vehicles at once by thrust and body rates, with the margins of a bound, and measure the time."""
    from quadsim.assets import vehicle_path
    from quadsim.flight.audit import Limit
    from quadsim.sim.autopilot import Autopilot
    from quadsim.sim.batch import PlantBatch
    from quadsim.sim.margins import Margins
    from quadsim.sim.plant import Plant
    from quadsim.vehicle import load_vehicle

    count = 32
    steps = 50
    timestep = 1e-3
    vehicle = load_vehicle(vehicle_path("hummingbird"))
    margins = Margins([Limit(name="tilt", signal="tilt", upper=30.0)], timestep)
    batch = PlantBatch(count, steps=steps, limits=1)
    for place in range(count):
        plant = Plant(vehicle, timestep=timestep, integrator=integrator)
        batch.put(place, plant, np.zeros(N_STATES), vehicle.hover_speeds, loop=Autopilot(vehicle), margins=margins)
    targets = np.tile([vehicle.mass * vehicle.gravity, 0.0, 0.0, 0.1], (count, 1))
    started = clock.process_time()
    for _ in range(periods):
        batch.fly(targets)
    rate = count * periods / (clock.process_time() - started)
    batch.close()
    share = rate * steps * timestep
    return f"{rate:.0f} steps of {1e3 * steps * timestep:.0f} ms per second of one core, {share:.0f} times real time"


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
    if command.status == SOLVED:
        verdict = "works"
    else:
        verdict = f"answers {command.status}"
    setup_ms = 1e3 * (built - started)
    step_ms = 1e3 * (clock.perf_counter() - built)
    return f"{verdict}: set up in {setup_ms:.0f} ms, first step in {step_ms:.1f} ms"
