"""Where the time of a flight goes: physics, the controller's solver and the rest of it, measurement, log."""

from __future__ import annotations

from functools import partial

import numpy as np
from timing import Record, Stopwatch, options, run, undisturbed

from quadsim.sim.loop import complete
from scenarios.assembly import Assembly
from scenarios.commands.app import load
from scenarios.progress import Progress
from scenarios.rollout import closed_loop


def measure(name: str, quick: bool, report: Progress) -> list[Record]:
    """Seconds of each part, the median over flights by turns with and without clocks around the parts."""
    scenario = load(name).replace({"duration": 2.0, "constraints": []}) if quick else load(name)
    assembly = Assembly(scenario)
    controller = assembly.controller()
    reference = assembly.reference(scenario.periods + controller.horizon)
    pieces = Stopwatch()
    walls: list[float] = []
    parts: list[Record] = []
    with assembly.plant() as plain, assembly.plant() as watched, undisturbed():
        pieces.watch(watched, "advance", "physics")
        pieces.watch(watched, "state", "measurement")
        rounds = 1 if quick else 5
        for i in range(rounds):
            for plant in (plain, watched):
                report("flights", 2 * i + (plant is watched), 2 * rounds)
                for laps in pieces.laps.values():
                    laps.clear()
                navigation, watch = assembly.navigation(), Stopwatch()
                loop = closed_loop(assembly, plant, controller, reference, navigation=navigation)
                complete(loop, periods=scenario.periods)
                log = loop.log()
                wall = watch.elapsed
                if plant is plain:
                    walls.append(wall)
            solver, step = 1e-3 * float(log.timing.solve_ms.sum()), 1e-3 * float(log.timing.step_ms.sum())
            spent = {part: sum(laps) for part, laps in pieces.laps.items()}
            parts.append(
                {
                    "physics": spent["physics"],
                    "controller: optimum": solver,
                    "controller: the rest": step - solver,
                    "measurement": spent["measurement"],
                    "log and loop": wall - step - sum(spent.values()),
                }
            )
    simulated, wall = log.control.t.size * scenario.control_period, float(np.median(walls))
    medians = {part: float(np.median([part_times[part] for part_times in parts])) for part in parts[0]}
    whole = sum(medians.values())
    rows = [{"part": part, "seconds": spent, "share_%": 100.0 * spent / whole} for part, spent in medians.items()]
    return [*rows, {"part": f"the whole, without clocks; {simulated / wall:.0f} times real time", "seconds": wall}]


def main() -> None:
    """Fly, print and write."""
    chosen = options(__doc__, scenario={"default": "paper-constrained", "help": "default: %(default)s"})
    run(partial(measure, chosen.scenario, chosen.quick), f"A flight of {chosen.scenario}", chosen.json)


if __name__ == "__main__":
    main()
