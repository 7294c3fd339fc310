"""An hour of simulated flight on end: memory stays flat, and steps take no longer than at its beginning.

    python tests/soak.py --minutes 60

The full robust controller flies the paper's course lap after lap without ever being reset, with a vehicle heavier than
it believes, so that there is always something to estimate.  No log is recorded, which would grow by design.
"""

from __future__ import annotations

import argparse
import gc
import os
import sys
import time as clock
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from threadpoolctl import threadpool_limits

from quadsim.controller import ACCEPTED, Controller, Moment
from quadsim.sim.plant import Plant
from quadsim.state import POSITION, Array
from scenarios.bench.mismatch.conditions import CONDITIONS
from scenarios.bench.mismatch.controllers import FULL, equip
from scenarios.bench.timing import Stopwatch
from scenarios.build import build_controller, build_plant
from scenarios.courses.make import build_reference
from scenarios.loading import load_scenario
from scenarios.parts.vehicle import build_initial_speeds, build_initial_state, build_vehicle
from scenarios.schema.scenario import Scenario

CONDITION: Final = CONDITIONS["mass +30 %"]
GROWTH: Final = 0.01
"""Of memory, over what is in use after the first lap."""
DRIFT: Final = 0.1
"""Of the median step time, from the first tenth to the last."""
MEMORY: Final = Path("/proc/self/statm")


@dataclass(frozen=True, kw_only=True)
class Soak:
    """What was measured.

    Attributes:
        minutes: of simulated time.
        memory: (L,) resident memory at the end of each lap [bytes].
        step_ms: (K,) processor time of each controller step, which stands still while other processes run [ms].
        failures: periods without an accepted answer.
        end_error: largest distance from the reference towards the end of a lap, before the next comes into view [m].
        laps_compared: laps that make up the first and the last tenth.
    """

    minutes: float
    memory: Array
    step_ms: Array
    failures: int
    end_error: float
    laps_compared: int

    @property
    def growth(self) -> float:
        """Largest memory of the last tenth of the laps over that after the first lap, less 1."""
        return float(self.memory[-self.laps_compared :].max() / self.memory[0] - 1.0)

    @property
    def medians(self) -> tuple[float, float]:
        """Median step of the first tenth, its first lap left out, and of the last [ms]; whole laps, which are alike."""
        laps = self.step_ms.reshape(self.memory.size, -1)
        first, last = laps[1 : 1 + self.laps_compared], laps[-self.laps_compared :]
        return float(np.median(first)), float(np.median(last))

    @property
    def drift(self) -> float:
        """Last median over the first, less 1."""
        first, last = self.medians
        return last / first - 1.0


def soak(laps: int, lap: float = 60.0) -> Soak:
    """Fly the paper's course, of one minute or the start of it [s], so many times on end."""
    still = (f"duration={lap}", "initial.euler=[0.0, 0.0, 0.0]")
    paper = load_scenario("paper-constrained", [*still, *CONDITION.settings])
    scenario = equip(paper, FULL, CONDITION)
    vehicle = build_vehicle(scenario)
    controller = build_controller(scenario, vehicle)
    course = build_reference(scenario, scenario.periods)
    reference = np.concatenate([course, course[: controller.horizon + 1]])
    memory, watch = np.zeros(laps), Stopwatch(clock.thread_time)
    watch.watch(controller, "step", "step")
    failures, end_error = 0, 0.0
    with threadpool_limits(limits=1), build_plant(scenario, vehicle) as plant:
        acting = build_initial_speeds(scenario, vehicle)
        plant.reset(build_initial_state(scenario), acting)
        controller.reset(acting)
        for lap in range(laps):
            start = lap * scenario.duration
            acting, failed, off = _fly_lap(plant, controller, reference, acting, start, scenario)
            failures, end_error = failures + failed, max(end_error, off)
            gc.collect()
            memory[lap] = resident()
    return Soak(
        minutes=laps * scenario.duration / 60.0,
        memory=memory,
        step_ms=1e3 * np.array(watch.laps["step"]),
        failures=failures,
        end_error=end_error,
        laps_compared=max(1, laps // 10),
    )


def _fly_lap(
    plant: Plant, controller: Controller, reference: Array, acting: Array, start: float, scenario: Scenario
) -> tuple[Array, int, float]:
    """One lap from `start` [s]; the last command (4,), periods without an accepted answer, and the error at its end."""
    failed, off, steps = 0, np.inf, scenario.steps_per_period
    for k in range(scenario.periods):
        now = Moment(time=start + k * steps * plant.timestep, acting=acting)
        preview = reference[k + 1 : k + 1 + controller.horizon]
        state = plant.state()
        if k == scenario.periods - controller.horizon - 1:
            off = float(np.linalg.norm(state[list(POSITION)] - reference[k, :3]))
        command = controller.step(now, state, preview)
        failed += command.status not in ACCEPTED
        acting = command.speeds
        plant.advance(acting, steps)
    return acting, failed, off


def resident() -> float:
    """Memory of this process that is in use [bytes]; Linux only."""
    return float(MEMORY.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def main() -> int:
    """Soak, print what was measured; 1 where it is not flat."""
    parser = argparse.ArgumentParser(description="One long flight: memory and step time have to stay as they were.")
    parser.add_argument("--minutes", type=int, default=60, help="laps of one simulated minute, at least 3")
    parser.add_argument("--lap", type=float, default=60.0, help="simulated seconds of each lap (default: %(default)g)")
    parser.add_argument(
        "--drift", type=float, default=DRIFT, help="of the step time that passes (default: %(default)s)"
    )
    options = parser.parse_args()
    if options.minutes < 3:
        parser.error(f"argument --minutes: must be at least 3; got {options.minutes}")
    found = soak(options.minutes, options.lap)
    first, last = found.medians
    print(f"{found.minutes:g} simulated minutes, {found.step_ms.size} steps, {found.failures} without an optimum")
    print(f"largest distance from the reference towards the end of a lap: {found.end_error:.4f} m")
    print(f"memory: {found.memory[0] / 2**20:.1f} MiB after the first lap, {100.0 * found.growth:+.2f} % at the end")
    print(f"median step: {first:.3f} ms in the first tenth, {last:.3f} ms in the last, {100.0 * found.drift:+.1f} %")
    flat = found.growth <= GROWTH and found.drift <= options.drift and found.failures == 0
    print("flat" if flat else "NOT FLAT", f"(required: memory {100.0 * GROWTH:g} %, step {100.0 * options.drift:g} %)")
    return 0 if flat else 1


if __name__ == "__main__":
    sys.exit(main())
