"""`quadsim bench flight`: where the time of a flight goes."""

from __future__ import annotations

from typing import Final

import numpy as np
from threadpoolctl import threadpool_limits

from quadsim.errors import InputError, ParameterError
from quadsim.flight.audit import audit
from quadsim.flight.log import FlightLog
from quadsim.sim.plant import Plant
from scenarios.bench.bench_results import FlightProfile
from scenarios.bench.timing import Stopwatch, one_core
from scenarios.build import build_controller, build_plant
from scenarios.courses.make import build_reference
from scenarios.limits import build_limits
from scenarios.machine import machine
from scenarios.parts.navigation import build_navigation
from scenarios.parts.vehicle import build_vehicle
from scenarios.progress import Progress, silent
from scenarios.run import fly_once
from scenarios.schema.scenario import Scenario

REPEATS: Final = 5


def bench_flight(scenario: Scenario, *, repeats: int = REPEATS, progress: Progress = silent) -> FlightProfile:
    """Fly a scenario again and again on one core, in turns with and without clocks around its parts.

    Raises:
        ParameterError: no repeat is requested.
        InputError: the flight does not go to its end.
    """
    if repeats < 1:
        raise ParameterError("", "--repeats", repeats, "at least 1")
    with one_core() as cores, threadpool_limits(limits=1):
        watch = Stopwatch()
        vehicle = build_vehicle(scenario)
        controller = build_controller(scenario, vehicle)
        plant, limits = build_plant(scenario, vehicle), build_limits(scenario)
        reference = build_reference(scenario, scenario.periods + controller.horizon)
        setup_s = watch.elapsed

        def fly(plant: Plant) -> tuple[float, FlightLog]:
            """Wall time of the closed loop [s], and what was flown."""
            watch = Stopwatch()
            navigation = build_navigation(scenario, vehicle)
            log = fly_once(scenario, vehicle, plant, controller, reference, navigation=navigation)
            return watch.elapsed, log

        timed, pieces = build_plant(scenario, vehicle), Stopwatch()
        pieces.watch(timed, "advance", "physics")
        pieces.watch(timed, "state", "measurement")
        wall, profiles, audits = [], [], []
        with plant, timed:
            for done in range(repeats):
                wall.append(fly(plant)[0])
                pieces.clear()
                whole, log = fly(timed)
                if log.reason is not None:
                    raise InputError(f"{scenario.name}: a flight that is lost cannot be timed: {log.reason}")
                profiles.append(_pieces(whole, log, **pieces.totals()))
                watch = Stopwatch()
                audit(log, limits)
                audits.append(watch.elapsed)
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


def _pieces(whole: float, log: FlightLog, *, physics: float, measurement: float) -> dict[str, float]:
    """Seconds of a flight by what they were spent on."""
    solver, step = 1e-3 * float(log.timing.solve_ms.sum()), 1e-3 * float(log.timing.step_ms.sum())
    return {
        "physics": physics,
        "controller: optimum": solver,
        "controller: the rest": step - solver,
        "measurement": measurement,
        "log and loop": whole - physics - step - measurement,
    }
