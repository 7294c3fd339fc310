"""Where the time of a flight goes: physics, the controller's solver and the rest of it, measurement, log."""

from __future__ import annotations

import numpy as np
from timing import Record, Stopwatch, options, run, undisturbed

from quadsim.sim.loop import complete
from scenarios.app import load
from scenarios.build import build_controller, build_plant
from scenarios.parts.navigation import build_navigation
from scenarios.parts.vehicle import build_vehicle
from scenarios.reference import build_reference
from scenarios.rollout import closed_loop


def measure(name: str, quick: bool) -> list[Record]:
    """Seconds of each part, the median over flights by turns with and without clocks around the parts."""
    scenario = load(name).replace({"duration": 2.0, "constraints": []}) if quick else load(name)
    vehicle = build_vehicle(scenario)
    controller = build_controller(scenario, vehicle)
    reference = build_reference(scenario, scenario.periods + controller.horizon)
    pieces = Stopwatch()
    walls: list[float] = []
    parts: list[Record] = []
    with build_plant(scenario, vehicle) as plain, build_plant(scenario, vehicle) as watched, undisturbed():
        pieces.watch(watched, "advance", "physics")
        pieces.watch(watched, "state", "measurement")
        for _ in range(1 if quick else 5):
            for plant in (plain, watched):
                for laps in pieces.laps.values():
                    laps.clear()
                navigation, watch = build_navigation(scenario, vehicle), Stopwatch()
                loop = closed_loop(scenario, vehicle, plant, controller, reference, navigation=navigation)
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
    flown, wall = log.control.t.size * scenario.control_period, float(np.median(walls))
    medians = {part: float(np.median([each[part] for each in parts])) for part in parts[0]}
    whole = sum(medians.values())
    rows = [{"part": part, "seconds": spent, "share_%": 100.0 * spent / whole} for part, spent in medians.items()]
    return [*rows, {"part": f"the whole, without clocks; {flown / wall:.0f} times real time", "seconds": wall}]


def main() -> None:
    """Fly, print and write."""
    chosen = options(__doc__, scenario={"default": "paper-constrained", "help": "default: %(default)s"})
    run(lambda: measure(chosen.scenario, chosen.quick), f"A flight of {chosen.scenario}", chosen.json)


if __name__ == "__main__":
    main()
