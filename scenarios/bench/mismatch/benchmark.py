"""`quadsim bench ladder`: what each controller survives, condition by condition."""

from __future__ import annotations

import itertools
import time as clock
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from threadpoolctl import threadpool_limits

from quadsim.errors import ParameterError
from quadsim.flight import metrics
from quadsim.flight.log import FlightLog
from quadsim.outputs import to_json
from quadsim.report.figures.canvas import write_drawings
from quadsim.report.table import section
from quadsim.state import INDEX, POSITION, Array
from scenarios.bench.mismatch.conditions import CONDITIONS, QUICK_CONDITIONS
from scenarios.bench.mismatch.controllers import FULL, QUICK_VARIANTS, VARIANTS, equip, tilt_bound
from scenarios.bench.mismatch.survival import MismatchBench, MismatchFlight, mismatch_legend, mismatch_tables
from scenarios.bench.timing import Stopwatch
from scenarios.build import build_controller, build_plant
from scenarios.courses.make import build_reference
from scenarios.loading import load_scenario
from scenarios.machine import machine
from scenarios.many import answers
from scenarios.parts.navigation import build_navigation
from scenarios.parts.vehicle import build_vehicle
from scenarios.progress import Progress, silent
from scenarios.run import fly_once
from scenarios.schema.scenario import Scenario

FORMAT: Final = "quadsim bench ladder"
RESULTS_FILE: Final = "ladder.json"
TABLES_FILE: Final = "ladder.md"
TIMED: Final = 3  # flights that steps are timed in: the machine's own slow spells are not the controller's
QUICK_DURATION: Final = 12.0  # of the flights with `--quick` [s]


@dataclass(frozen=True, kw_only=True)
class Cell:
    """One flight of the benchmark, as it is sent to a worker process."""

    scenario: str
    settings: tuple[str, ...]
    controller: str
    condition: str


def run_mismatch(
    scenario: str = "paper-constrained",
    settings: Sequence[str] = (),
    *,
    quick: bool = False,
    workers: int | None = None,
    progress: Progress = silent,
) -> MismatchBench:
    """Fly every controller in every condition.

    Flights are spread over processes; results are the same however many there are.  Steps are timed in further flights,
    one process at a time, each step the median of `TIMED` equal ones: those of `FULL` in every condition, and of every
    controller in the first one.

    Args:
        scenario: a constrained one whose bounds on roll and pitch are the same: a library name, or a file.
        settings: of it, before those of the conditions.
        quick: three controllers, three conditions, short flights.
        workers: processes; one per usable core by default.
        progress: called with how much is done, of how much.

    Raises:
        InputError: the scenario cannot be flown so, or the number of processes is none.
    """
    if workers is not None and workers < 1:
        raise ParameterError("", "--workers", workers, "at least 1")
    if quick:
        settings = [*settings, f"duration={QUICK_DURATION}"]
    controllers = QUICK_VARIANTS if quick else tuple(VARIANTS)
    conditions = QUICK_CONDITIONS if quick else tuple(CONDITIONS)
    flown = load_scenario(scenario, settings)
    bound = tilt_bound(flown)
    cells = [
        Cell(scenario=scenario, settings=tuple(settings), controller=controller, condition=condition)
        for controller, condition in itertools.product(controllers, conditions)
    ]
    for cell in cells[: len(conditions)]:
        _varied(cell)  # one that cannot be flown is refused here, before anything is
    timed = [cell for cell in cells if cell.controller == FULL or cell.condition == conditions[0]]

    def report_stage(stage: str) -> Callable[[int, int], None]:
        return lambda done, total: progress(stage, done, total)

    flights = dict(zip(cells, answers(fly_cell, cells, workers=workers, progress=report_stage("flights")), strict=True))
    alone = dict(zip(timed, answers(time_cell, timed, workers=1, progress=report_stage("step times")), strict=True))
    return MismatchBench(
        scenario=flown.name,
        duration=flown.duration,
        tilt_bound=bound,
        controllers={name: VARIANTS[name].about for name in controllers},
        conditions={name: CONDITIONS[name].about for name in conditions},
        flights={
            (cell.controller, cell.condition): replace(flight, step_p99=alone.get(cell))
            for cell, flight in flights.items()
        },
        machine=machine(),
    )


def fly_cell(cell: Cell) -> MismatchFlight:
    """Fly one controller in one condition, here."""
    log, step_ms, scenario = _fly(cell)
    return _judge(log, step_ms, tilt_bound(_varied(cell)), scenario)


def time_cell(cell: Cell) -> float | None:
    """The 99th percentile of the step's processor time [ms], each step the median of `TIMED` equal flights."""
    times = [_fly(cell)[1] for _ in range(TIMED)]
    return metrics.percentiles(np.median(times, axis=0))["p99"] if times[0].size else None


def _fly(cell: Cell) -> tuple[FlightLog, Array, Scenario]:
    """The flight, the processor time of each step [ms], and what was flown."""
    scenario = equip(_varied(cell), cell.controller, CONDITIONS[cell.condition])
    vehicle = build_vehicle(scenario)
    with threadpool_limits(limits=1):
        controller = build_controller(scenario, vehicle)
        watch = Stopwatch(clock.thread_time)
        watch.watch(controller, "step", "step")
        with build_plant(scenario, vehicle) as plant:
            log = fly_once(
                scenario,
                vehicle,
                plant,
                controller,
                build_reference(scenario, scenario.periods + controller.horizon),
                navigation=build_navigation(scenario, vehicle),
            )
    return log, 1e3 * np.array(watch.laps["step"]), scenario


def _varied(cell: Cell) -> Scenario:
    return load_scenario(cell.scenario, [*cell.settings, *CONDITIONS[cell.condition].settings])


def _judge(log: FlightLog, step_ms: Array, bound: float, scenario: Scenario) -> MismatchFlight:
    control = log.control
    flown = bool(control.t.size)
    end = control.truth[-1, list(POSITION)] - control.reference[-1, :3] if flown else None
    # A row of the plant covers the step that follows it; the last has none.
    tilts = np.degrees(np.abs(log.plant.state[:-1, [INDEX["roll"], INDEX["pitch"]]]).max(axis=1))
    violated = np.count_nonzero(tilts > bound) * scenario.plant.timestep
    return MismatchFlight(
        reason=log.reason,
        flown=round(control.t.size * scenario.control_period, 9),
        rmse={axis: metrics.tracking(control)["rmse"][axis] for axis in "xyz"} if flown else None,
        end_error=None if end is None else float(np.linalg.norm(end)),
        peak_tilt=metrics.peak_tilt(log.plant.state) if flown else None,
        violated=round(float(violated), 9),
        fallbacks=int(np.count_nonzero(control.fallback)),
        step_p99=metrics.percentiles(step_ms)["p99"] if flown else None,
    )


def write_mismatch(measured: MismatchBench, directory: Path) -> None:
    """Write `ladder.json`, `ladder.md`, `ladder.png` and `ladder.svg` into a directory.

    Raises:
        OutputError: it cannot be written.
    """
    from scenarios.bench.mismatch.survival_figure import draw_mismatch

    results = to_json({"format": FORMAT, **measured.to_json()})
    (directory / RESULTS_FILE).write_text(results, encoding="utf-8")
    (directory / TABLES_FILE).write_text(mismatch_markdown(measured), encoding="utf-8")
    write_drawings({"ladder": lambda: draw_mismatch(measured)}, directory)


def mismatch_markdown(measured: MismatchBench) -> str:
    """All tables, after the lists of controllers and conditions."""
    sections = "\n".join(map(section, mismatch_tables(measured)))
    return (
        f"# Model mismatch on {measured.scenario}, {measured.duration:g} s\n\n{mismatch_legend(measured)}\n{sections}"
    )
