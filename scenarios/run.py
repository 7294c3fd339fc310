"""The composition root: fly a scenario, audit it, write everything a person opens."""

from __future__ import annotations

import contextlib
import time as clock
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from threadpoolctl import threadpool_limits

from mpc.ocp import Unanswered
from quadsim.controller import Controller, Phase
from quadsim.flight import metrics, rundir
from quadsim.flight.audit import Finding, audit
from quadsim.flight.feasibility import to_json as feasibility_to_json
from quadsim.flight.log import FlightLog
from quadsim.flight.parquet import write_log
from quadsim.outputs import write_json, write_text, writing
from quadsim.sim.airframe import outline
from quadsim.sim.estimation.filter import Tally
from quadsim.sim.loop import fly
from quadsim.sim.navigation import Navigation
from quadsim.sim.plant import Plant
from quadsim.sim.sensing.sensor import SensorName
from quadsim.state import Array
from quadsim.vehicle import Vehicle
from scenarios.build import build_controller, build_ground, build_plant, resolve
from scenarios.courses.feasibility_check import report
from scenarios.courses.make import build_course_steps, build_reference
from scenarios.gc_tuning import frozen
from scenarios.machine import machine, usable_cores, versions
from scenarios.parts.effects import build_computation
from scenarios.parts.limits import build_limits, build_loss
from scenarios.parts.navigation import build_navigation
from scenarios.parts.randomness import generator
from scenarios.parts.vehicle import build_initial_speeds, build_initial_state, build_vehicle
from scenarios.progress import Progress, silent
from scenarios.schema.scenario import Scenario, Verdict


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
    with frozen():
        return fly(
            plant,
            controller,
            reference,
            initial_state=build_initial_state(scenario),
            initial_speeds=build_initial_speeds(scenario, vehicle),
            periods=scenario.periods,
            steps_per_period=scenario.steps_per_period,
            navigation=navigation,
            computation=build_computation(scenario),
            rng=generator(scenario.seed, "computation"),
            ground=build_ground(scenario, vehicle),
            loss=build_loss(scenario),
            progress=progress,
        )


@dataclass(frozen=True, kw_only=True)
class Outputs:
    """Which files a run makes besides its summary, scenario and Parquet tables."""

    video: bool = True
    recording: bool = True
    figures: bool = True


@dataclass(frozen=True, kw_only=True)
class Flight:
    """A flown scenario, in memory.

    Attributes:
        scenario: resolved, with every vehicle number in it.
        vehicle: what was flown.
        log: the flight, plant rows at the physics rate.
        findings: the audit, one per constraint of the scenario.
        controller: name of the control law.
        solver: name of its QP solver; empty for a closed form.
        simulate_s: wall time of the closed loop alone [s].
        tallies: what became of each sensor's samples in the estimator; empty without one.
        unanswered: the first period whose QP had no answer; None where all had, or there is none.
    """

    scenario: Scenario
    vehicle: Vehicle
    log: FlightLog
    findings: tuple[Finding, ...]
    controller: str
    solver: str
    simulate_s: float
    tallies: Mapping[SensorName, Tally]
    unanswered: Unanswered | None = None

    @property
    def satisfied(self) -> bool:
        """Whether the flight was completed, without a crash or fallback for good, and every required constraint held.

        What fallback for good is: `quadsim.flight.metrics.unrecovered`.
        """
        control = self.log.control
        whole = self.log.reason is None and str(Phase.CRASHED) not in control.phase
        held = all(finding.satisfied for finding in self.findings if finding.limit.required)
        return whole and held and not metrics.unrecovered(control)

    @property
    def outcome(self) -> Verdict:
        """The verdict in one word; `lost` is a flight that was aborted, whoever ended it."""
        if self.log.reason is not None:
            return "lost"
        return "satisfied" if self.satisfied else "violated"

    @cached_property
    def diagnosis(self) -> dict[str, Any] | None:
        """Why the first QP without an answer had none, see `scenarios.diagnosis`; made when it is first asked for."""
        from scenarios.diagnosis import diagnose

        return None if self.unanswered is None else diagnose(self.unanswered, self.scenario, self.vehicle)


def fly_scenario(scenario: Scenario, progress: Progress = silent) -> Flight:
    """Fly a scenario and audit it, writing nothing.

    Linear algebra is held to one thread: the matrices are small, and results do not depend on the core count.
    """
    vehicle = build_vehicle(scenario)
    with threadpool_limits(limits=1):
        controller = build_controller(scenario, vehicle)
        with build_plant(scenario, vehicle) as plant:
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


def run_scenario(scenario: Scenario, target: Path, outputs: Outputs, progress: Progress = silent) -> Flight:
    """Fly a scenario and write its run directory, which appears complete or not at all.

    A flight that its pilot interrupted is written without its video.

    Raises:
        RenderingUnavailableError: a video is wanted and cannot be made; nothing was flown.
        OutputError: the directory cannot be written; nothing is left there.
    """
    started = clock.perf_counter()
    if outputs.video:
        from quadsim.report.film.video import rendering_backend

        rendering_backend()
    with writing(target, rundir.KIND) as directory:
        flight = fly_scenario(scenario, progress)
        write_flight(flight, directory)
        _write_products(flight, directory, outputs, progress)
        summary = summarise(flight)
        summary["wall_s"]["total"] = clock.perf_counter() - started
        rundir.seal(directory, summary)
    return flight


def write_flight(flight: Flight, directory: Path) -> None:
    """Write the scenario, the Parquet tables and a summary, which is all that pictures are made from."""
    scenario = flight.scenario
    write_text(directory / rundir.SCENARIO_FILE, scenario.to_toml())
    metadata = {"scenario": scenario.name, "seed": str(scenario.seed)}
    write_log(directory, flight.log, plant_stride=scenario.plant_stride, metadata=metadata)
    write_json(directory / rundir.SUMMARY_FILE, summarise(flight))


def summarise(flight: Flight) -> dict[str, Any]:
    """`summary.json` of a flight, but for the hashes of its files and the total wall time."""
    scenario, log = flight.scenario, flight.log
    course = build_course_steps(scenario)
    ground = scenario.effects.ground
    flown = log.control.t.size > 0
    numbers = metrics.flight_numbers(log, deadline_ms=1e3 * scenario.control_period, course=course)
    return {
        "scenario": scenario.name,
        "description": scenario.description,
        "status": log.status,
        "reason": log.reason,
        "lost": log.lost,
        "satisfied": flight.satisfied,
        "group": scenario.group,
        "expected": scenario.expect,
        "as_expected": flight.outcome == scenario.expect and not log.interrupted,
        "duration": round(log.control.t.size * scenario.control_period, 9),
        "seed": scenario.seed,
        "course": feasibility_to_json(report(scenario, flight.vehicle)),
        "tracking": numbers["tracking"],
        "constraints": [rundir.limit_to_json(finding) for finding in flight.findings],
        "control": numbers["control"],
        "diagnosis": flight.diagnosis,
        "controller": {
            "name": flight.controller,
            "solver": flight.solver,
            "horizon": scenario.controller.horizon,
            **numbers["controller"],
        },
        **({"computation": metrics.computation(log.control)} if flown and build_computation(scenario) else {}),
        **({} if log.control.measured_perfectly else {"estimation": _estimation(flight)}),
        **({"ground": metrics.ground(log, outline(flight.vehicle))} if flown and ground and ground.contact else {}),
        "vehicle": rundir.vehicle_to_json(flight.vehicle),
        "wall_s": {"simulate": flight.simulate_s, "total": flight.simulate_s},
        "versions": versions(),
        "machine": machine(),
        "files": {},
    }


def _estimation(flight: Flight) -> dict[str, Any]:
    samples = {str(name): asdict(tally) for name, tally in flight.tallies.items()}
    return {**metrics.estimation(flight.log.control), "samples": samples}


def _write_products(flight: Flight, directory: Path, outputs: Outputs, progress: Progress) -> None:
    """Recording, figures and video, each made from the files that are already there."""
    run = rundir.load_run(directory)
    flown = bool(run.log.control.t.size)
    with contextlib.ExitStack() as beside:
        if outputs.recording:
            from quadsim.report.recording import recording_in_background, write_recording

            progress("recording", 0, 1)
            if outputs.figures and flown and usable_cores() > 1:  # while the figures are drawn: a tenth of a short run
                beside.enter_context(recording_in_background(directory))
            else:
                write_recording(run, directory / rundir.RECORDING_FILE)
        if outputs.figures and flown:
            from quadsim.report.figures.flight_figures import write_figures

            progress("figures", 0, 1)
            write_figures(run, directory / rundir.FIGURES_DIR)
            progress("figures", 1, 1)
    if outputs.recording:
        progress("recording", 1, 1)
    if outputs.video and flown and not flight.log.interrupted:
        from quadsim.report.film.video import render_video

        render_video(
            directory,
            directory / rundir.VIDEO_FILE,
            progress=lambda done, total: progress("video", done, total),
        )
