"""The composition root: fly a scenario, audit it, write everything a person opens."""

from __future__ import annotations

import time as clock
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import ThreadpoolController, threadpool_limits

from mpc.ocp import Unanswered
from quadsim.controller import Command, Controller
from quadsim.errors import InputError
from quadsim.flight import rundir
from quadsim.flight.audit import audit, smallest_margins
from quadsim.flight.log import FlightLog
from quadsim.outputs import writing
from quadsim.sim.effects import Force
from quadsim.sim.loop import ClosedLoop, Observation, Reference, Sample, complete, one_period
from quadsim.sim.navigation import Navigation
from quadsim.sim.plant import Plant
from quadsim.state import Array
from quadsim.vehicle import Vehicle
from scenarios.build import build_controller, build_ground, build_plant, resolve
from scenarios.courses.make import build_motion, build_reference
from scenarios.flight import Flight, Outputs, write_run
from scenarios.gc_tuning import frozen
from scenarios.parts.effects import build_computation
from scenarios.parts.limits import build_limits
from scenarios.parts.navigation import build_navigation
from scenarios.parts.randomness import generator
from scenarios.parts.vehicle import build_initial_speeds, build_initial_state, build_vehicle
from scenarios.progress import Progress, silent
from scenarios.schema.controller import NonlinearSpec
from scenarios.schema.events import Event
from scenarios.schema.scenario import Scenario


def closed_loop(
    scenario: Scenario,
    vehicle: Vehicle,
    plant: Plant,
    controller: Controller,
    reference: Array | Reference,
    *,
    navigation: Navigation | None,
    recorded: bool = True,
) -> ClosedLoop:
    """The loop of a scenario, at t = 0.

    Args:
        scenario: what is flown.
        vehicle: the modelled vehicle.
        plant: see `scenarios.build.build_plant`.
        controller: see `scenarios.build.build_controller`.
        reference: (K + N, 4); see `scenarios.courses.make.build_reference`.
        navigation: see `scenarios.parts.navigation.build_navigation`.
        recorded: whether all periods are kept.
    """
    motion = build_motion(scenario, vehicle)
    return ClosedLoop(
        plant,
        controller,
        reference,
        initial_state=build_initial_state(scenario, motion),
        initial_speeds=build_initial_speeds(scenario, vehicle),
        steps_per_period=scenario.steps_per_period,
        navigation=navigation,
        computation=build_computation(scenario),
        rng=generator(scenario.seed, "computation"),
        ground=build_ground(scenario, vehicle),
        loss=scenario.lost.limits,
        motion=motion,
        quaternions=isinstance(scenario.controller, NonlinearSpec),
        recorded=recorded,
    )


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
        plant: see `closed_loop`, as the others.
        controller: what flies it.
        reference: (K + N, 4).
        navigation: what tells the controller the state.
        progress: called with the number of periods flown, after each.
    """
    loop = closed_loop(scenario, vehicle, plant, controller, reference, navigation=navigation)
    with frozen():
        return complete(loop, periods=scenario.periods, progress=progress)


class StartedFlight:
    """A scenario's flight that is flown period by period: everything built and checked, nothing flown yet.

    Linear algebra is held to one thread in each step.  It owns native memory: `close` it, or use it as a context
    manager.

    Attributes:
        scenario: what is flown, with the events that were applied.
        vehicle: the modelled vehicle.
        limits: what the flight is audited against.
        loop: the closed loop.
    """

    def __init__(
        self,
        scenario: Scenario,
        law: Controller | None = None,
        forces: Sequence[Force] | None = None,
        *,
        recorded: bool = True,
    ) -> None:
        """Set up at t = 0; see `start`."""
        self.scenario, self.vehicle, self.limits = scenario, build_vehicle(scenario), build_limits(scenario)
        with threadpool_limits(limits=1):
            controller = build_controller(scenario, self.vehicle) if law is None else law
            self._plant = build_plant(scenario, self.vehicle, forces=forces)
            self._navigation = build_navigation(scenario, self.vehicle)
            started = clock.perf_counter()
            self.loop = closed_loop(
                scenario,
                self.vehicle,
                self._plant,
                controller,
                build_reference(scenario, scenario.periods + controller.horizon),
                navigation=self._navigation,
                recorded=recorded,
            )
            self._simulate_s = clock.perf_counter() - started
        self._threads = ThreadpoolController()

    def __enter__(self) -> StartedFlight:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Give back what the plant holds; what was flown stays."""
        self._plant.close()

    @property
    def k(self) -> int:
        """Control periods flown so far."""
        return self.loop.k

    @property
    def done(self) -> bool:
        """Whether it has come to its scenario's end, or ended before."""
        return self.loop.reason is not None or self.k >= self.scenario.periods

    @property
    def observation(self) -> Observation:
        """What the period that starts now begins with.

        Raises:
            FlightError: the vehicle is lost; the flight has ended.
        """
        with self._threads.limit(limits=1):
            return self.loop.observation

    def step(self, command: Command | Array | None = None) -> Sample:
        """Fly one control period.

        Args:
            command: what to hold instead of the controller's answer: a command, or (4,) rotor speeds [rad/s].

        Raises:
            FlightError: the flight has ended in this period, which is not part of it.
            InputError: it had ended before.
        """
        if command is not None and not isinstance(command, Command):
            speeds = np.asarray(command, float)
            command = Command(speeds=speeds, plan=np.tile(speeds, (self.loop.controller.horizon, 1)), status="given")
        started = clock.perf_counter()
        try:
            with self._threads.limit(limits=1):
                return self.loop.step(command)
        finally:
            self._simulate_s += clock.perf_counter() - started

    def complete(self, progress: Progress = silent) -> None:
        """Fly on to the scenario's end; a flight error or Ctrl-C ends it early, in order."""
        started, periods = clock.perf_counter(), self.scenario.periods
        progress("flight", self.k, periods)
        with self._threads.limit(limits=1), frozen():
            complete(self.loop, periods=periods, progress=lambda done: progress("flight", done, periods))
        self._simulate_s += clock.perf_counter() - started

    def margins(self, sample: Sample | None = None) -> dict[str, float]:
        """The signed margin of each constraint at its worst within one period; negative = violated.

        At the physics rate, begin and end included, in the constraint's unit; NaN outside its time window.

        Args:
            sample: which period; the last one flown where absent.
        """
        sample = self.loop.last if sample is None else sample
        if sample is None:
            raise InputError("no period has been flown yet")
        return smallest_margins(one_period(sample, self._plant.timestep), self.limits)

    def apply(self, event: Event | Mapping[str, Any]) -> Event:
        """Let something happen from the period that starts now on, as an event of the scenario's file would.

        Args:
            event: an entry of `events`, but for its `at`.

        Returns:
            The event with its time, as the scenario has it now.

        Raises:
            InputError: it is not allowed, or the flight was not started for events of its kind.
        """
        raise NotImplementedError

    def flight(self) -> Flight:
        """What has been flown so far, audited."""
        log, controller = self.loop.log(), self.loop.controllers[0][1]
        unanswered = getattr(controller, "unanswered", None)  # a controller of another kind has none
        return Flight(
            scenario=resolve(self.scenario, self.vehicle),
            vehicle=self.vehicle,
            log=log,
            findings=audit(log, self.limits),
            controller=controller.name,
            solver=controller.solver,
            simulate_s=self._simulate_s,
            tallies={} if self._navigation is None else self._navigation.tallies,
            unanswered=unanswered if isinstance(unanswered, Unanswered) else None,
        )


def start(
    scenario: Scenario,
    law: Controller | None = None,
    forces: Sequence[Force] | None = None,
    *,
    recorded: bool = True,
) -> StartedFlight:
    """Build everything that a scenario's flight needs, and fly nothing yet.

    Args:
        scenario: what is flown.
        law: who flies it, instead of what is built from the scenario's `controller`.
        forces: what acts on it, instead of what is built from the scenario's `forces`.
        recorded: whether all periods are kept, for `StartedFlight.flight`.

    Raises:
        InputError: something cannot be built.
    """
    return StartedFlight(scenario, law, forces, recorded=recorded)


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
    with start(scenario, law, forces) as started:
        started.complete(progress)
        return started.flight()


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
