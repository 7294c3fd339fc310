"""`quadsim bench flight`: where the time of a flight goes."""

from __future__ import annotations

import contextlib
import os
import time as clock
from collections.abc import Iterator
from typing import Final

import numpy as np
from threadpoolctl import threadpool_limits

from quadsim.controller import Controller
from quadsim.errors import InputError, ParameterError
from quadsim.flight.audit import audit
from quadsim.flight.log import FlightLog
from quadsim.sim.physics import Segment
from quadsim.sim.plant import Plant
from quadsim.state import Array
from quadsim.vehicle import Vehicle
from scenarios.bench.bench_results import FlightProfile
from scenarios.build import build_controller, build_plant
from scenarios.courses.make import build_reference
from scenarios.machine import machine
from scenarios.parts.limits import build_limits
from scenarios.parts.navigation import build_navigation
from scenarios.parts.vehicle import build_vehicle
from scenarios.progress import Progress, silent
from scenarios.run import fly_once
from scenarios.schema.scenario import Scenario

REPEATS: Final = 5


class _TimedPlant(Plant):
    """The plant, with a clock around what the loop asks of it."""

    physics_s = 0.0
    measurement_s = 0.0

    def state(self) -> Array:
        """See `quadsim.sim.plant.Plant.state`."""
        started = clock.perf_counter()
        try:
            return super().state()
        finally:
            self.measurement_s += clock.perf_counter() - started

    def advance(self, speeds: Array, steps: int) -> Segment:
        """See `quadsim.sim.plant.Plant.advance`."""
        started = clock.perf_counter()
        try:
            return super().advance(speeds, steps)
        finally:
            self.physics_s += clock.perf_counter() - started


def bench_flight(scenario: Scenario, *, repeats: int = REPEATS, progress: Progress = silent) -> FlightProfile:
    """Fly a scenario again and again on one core, in turns with and without clocks around its parts.

    Args:
        scenario: what to fly.
        repeats: flights of each kind.
        progress: called with how much is done, of how much.

    Raises:
        ParameterError: no repeat is asked for.
        InputError: the flight does not go to its end.
    """
    if repeats < 1:
        raise ParameterError("", "--repeats", repeats, "at least 1")
    with _one_core() as cores, threadpool_limits(limits=1):
        started = clock.perf_counter()
        vehicle = build_vehicle(scenario)
        controller = build_controller(scenario, vehicle)
        plant, limits = build_plant(scenario, vehicle), build_limits(scenario)
        reference = build_reference(scenario, scenario.periods + controller.horizon)
        setup_s = clock.perf_counter() - started
        timed = build_plant(scenario, vehicle, _TimedPlant)
        assert isinstance(timed, _TimedPlant)
        wall, profiles, audits = [], [], []
        with plant, timed:
            for done in range(repeats):
                wall.append(_fly(scenario, vehicle, plant, controller, reference)[0])
                timed.physics_s = timed.measurement_s = 0.0
                whole, log = _fly(scenario, vehicle, timed, controller, reference)
                if log.reason is not None:
                    raise InputError(f"{scenario.name}: a flight that is lost cannot be timed: {log.reason}")
                profiles.append(_pieces(whole, log, timed))
                started = clock.perf_counter()
                audit(log, limits)
                audits.append(clock.perf_counter() - started)
                progress("flights", done + 1, repeats)
    return FlightProfile(
        scenario=scenario.name,
        solver=controller.solver,
        duration=log.control.t.size * scenario.control_period,
        repeats=repeats,
        cores=cores,
        wall_s=tuple(wall),
        pieces={name: float(np.median([profile[name] for profile in profiles])) for name in profiles[0]},
        setup_s=setup_s,
        audit_s=float(np.median(audits)),
        machine=machine(),
    )


def _fly(
    scenario: Scenario, vehicle: Vehicle, plant: Plant, controller: Controller, reference: Array
) -> tuple[float, FlightLog]:
    """Wall time [s] of the closed loop, and what was flown."""
    started = clock.perf_counter()
    navigation = build_navigation(scenario, vehicle)
    log = fly_once(scenario, vehicle, plant, controller, reference, navigation=navigation)
    return clock.perf_counter() - started, log


def _pieces(whole: float, log: FlightLog, plant: _TimedPlant) -> dict[str, float]:
    """Seconds of a flight by what they were spent on."""
    solver, step = 1e-3 * float(log.timing.solve_ms.sum()), 1e-3 * float(log.timing.step_ms.sum())
    return {
        "physics": plant.physics_s,
        "controller: optimum": solver,
        "controller: the rest": step - solver,
        "measurement": plant.measurement_s,
        "log and loop": whole - plant.physics_s - step - plant.measurement_s,
    }


@contextlib.contextmanager
def _one_core() -> Iterator[int | None]:
    """Hold the process to one of its cores; None where the system does not offer that."""
    if not hasattr(os, "sched_setaffinity"):
        yield None
        return
    allowed = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {max(allowed)})
    try:
        yield 1
    finally:
        os.sched_setaffinity(0, allowed)
