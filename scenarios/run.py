"""The composition root: fly a scenario, audit it, write everything a person opens."""

from __future__ import annotations

import time as clock
from collections.abc import Callable, Sequence
from pathlib import Path

from threadpoolctl import threadpool_limits

from mpc.ocp import Unanswered
from quadsim.controller import Controller
from quadsim.flight import rundir
from quadsim.flight.audit import audit
from quadsim.flight.log import FlightLog
from quadsim.outputs import writing
from quadsim.sim.effects import Force
from quadsim.sim.loop import fly
from quadsim.sim.navigation import Navigation
from quadsim.sim.plant import Plant
from quadsim.state import Array
from quadsim.vehicle import Vehicle
from scenarios.build import build_controller, build_ground, build_plant, resolve
from scenarios.courses.make import build_motion, build_reference
from scenarios.flight import Flight, Outputs, write_run
from scenarios.gc_tuning import frozen
from scenarios.limits import build_limits
from scenarios.parts.effects import build_computation
from scenarios.parts.navigation import build_navigation
from scenarios.parts.randomness import generator
from scenarios.parts.vehicle import build_initial_speeds, build_initial_state, build_vehicle
from scenarios.progress import Progress, silent
from scenarios.schema.controller import NonlinearSpec
from scenarios.schema.scenario import Scenario


def fly_once(
    scenario: Scenario,
    vehicle: Vehicle,
    plant: Plant,
    controller: Controller,
    reference: Array,
    *,
    navigation: Navigation | None,
    progress: Callable[[int], None] | None = None,
) -> FlightLog:
    """Fly a scenario with a plant and a controller that were built for it, undisturbed by Python's cycle collector.

    Args:
        scenario: what is flown.
        vehicle: the modelled vehicle.
        plant: see `scenarios.build.build_plant`.
        controller: see `scenarios.build.build_controller`.
        reference: (K + N, 4); see `scenarios.courses.make.build_reference`.
        navigation: see `scenarios.parts.navigation.build_navigation`.
        progress: called with the number of periods flown, after each.
    """
    motion = build_motion(scenario, vehicle)
    with frozen():
        return fly(
            plant,
            controller,
            reference,
            initial_state=build_initial_state(scenario, motion),
            initial_speeds=build_initial_speeds(scenario, vehicle),
            periods=scenario.periods,
            steps_per_period=scenario.steps_per_period,
            navigation=navigation,
            computation=build_computation(scenario),
            rng=generator(scenario.seed, "computation"),
            ground=build_ground(scenario, vehicle),
            loss=scenario.lost.limits,
            motion=motion,
            quaternions=isinstance(scenario.controller, NonlinearSpec),
            progress=progress,
        )


def fly_scenario(
    scenario: Scenario,
    progress: Progress = silent,
    law: Controller | None = None,
    forces: Sequence[Force] | None = None,
) -> Flight:
    """Fly a scenario and audit it, writing nothing.

    Linear algebra is held to one thread: the matrices are small, and results do not depend on the core count.

    Args:
        scenario: what is flown.
        progress: called with (what, done, total).
        law: who flies it, instead of what is built from the scenario's `controller`.
        forces: what acts on it, instead of what is built from the scenario's `forces`.
    """
    vehicle = build_vehicle(scenario)
    with threadpool_limits(limits=1):
        controller = build_controller(scenario, vehicle) if law is None else law
        with build_plant(scenario, vehicle, forces=forces) as plant:
            navigation = build_navigation(scenario, vehicle)
            started = clock.perf_counter()
            reference = build_reference(scenario, scenario.periods + controller.horizon)
            progress("flight", 0, scenario.periods)
            log = fly_once(
                scenario,
                vehicle,
                plant,
                controller,
                reference,
                navigation=navigation,
                progress=lambda done: progress("flight", done, scenario.periods),
            )
            simulate_s = clock.perf_counter() - started
    unanswered = getattr(controller, "unanswered", None)  # a controller of another kind has none
    return Flight(
        scenario=resolve(scenario, vehicle),
        vehicle=vehicle,
        log=log,
        findings=audit(log, build_limits(scenario)),
        controller=controller.name,
        solver=controller.solver,
        simulate_s=simulate_s,
        tallies={} if navigation is None else navigation.tallies,
        unanswered=unanswered if isinstance(unanswered, Unanswered) else None,
    )


def run_scenario(
    scenario: Scenario,
    target: Path,
    outputs: Outputs,
    progress: Progress = silent,
    law: Controller | None = None,
    forces: Sequence[Force] | None = None,
) -> Flight:
    """Fly a scenario and write its run directory, which appears complete or not at all.

    A flight that its pilot interrupted is written without its video.

    Args:
        scenario: what is flown.
        target: the run directory; an earlier run there is replaced.
        outputs: which pictures.
        progress: called with (what, done, total).
        law: see `fly_scenario`.
        forces: see `fly_scenario`.

    Raises:
        RenderingUnavailableError: a video is wanted and cannot be made; nothing was flown.
        OutputError: the directory cannot be written; nothing is left there.
    """
    started = clock.perf_counter()
    outputs.check()
    with writing(target, rundir.KIND) as directory:
        flight = fly_scenario(scenario, progress, law, forces)
        write_run(flight, directory, outputs, progress, since=started)
    return flight
