"""What many flights cost: flights per core-hour by one worker process and by two, and the processor time of a flight.

Campaigns are timed by the wall clock, so they need undisturbed cores.  The flights of one that ships are timed by the
processor's, in this process: in the core, as a campaign flies them, and by the loop, with MuJoCo's step and with the
core's own.
"""

from __future__ import annotations

import tempfile
import time as clock
from functools import partial
from pathlib import Path
from typing import Final

from timing import Record, options, run

from quadsim.commands.app import load
from quadsim.console.progress import Progress
from quadsim.features.campaign.campaign import fly_campaign
from quadsim.features.campaign.campaign_file import CampaignFile
from quadsim.features.campaign.plan import Plan, load_plan
from quadsim.features.campaign.rows import read_table
from quadsim.features.campaign.store import FLIGHTS_FILE, TIMES_FILE
from quadsim.rollout.rollout import Rollout
from quadsim.scenarios.assembly import Assembly
from quadsim.scenarios.schema.scenario import Scenario

SHIPPED: Final = "paper-robustness-robust"
"""The campaign whose flights are timed one by one."""


def campaign(scenario: Scenario, solver: str, flights: int, workers: int) -> Record:
    """Fly one campaign; what its flights took, and what it added to them."""
    spec = CampaignFile(name="benchmark", scenario=scenario.name, flights=flights)
    plan = Plan(spec, Assembly(scenario).recorded.scenario)
    with tempfile.TemporaryDirectory() as scratch:
        directory = Path(scratch) / "campaign"
        result = fly_campaign(plan, directory, workers=workers, report=False)
        flying = sum(read_table(directory / TIMES_FILE)["wall_s"].to_pylist())
        violations = sum(read_table(directory / FLIGHTS_FILE)["violated"].to_pylist())
    wall = float(result.manifest["sessions"][-1]["wall_s"])  # from the first process started to the last answer
    return {
        "scenario": f"{scenario.duration:g} s of {scenario.name}",
        "solver": solver,
        "flights": flights,
        "workers": workers,
        "violations": violations,
        "wall_s": wall,
        "flight_s": flying / flights,
        "per_core_hour": 3600.0 * flights / (wall * workers),
        "not_flying_%": 100.0 * (1.0 - flying / (workers * wall)),
    }


def by_the_loop(plan: Plan, flight: int) -> None:
    """Fly a flight period by period, and make its row."""
    plan.row_of(flight, Rollout(plan.of(flight)).fly())


def single_flights(quick: bool, report: Progress) -> list[Record]:
    """The processor time of a flight of `SHIPPED`, in turns; the first of each is not counted."""
    count = 1 if quick else 12
    ways = {"core": Plan.fly, "loop": by_the_loop}
    plans = {}
    for integrator in ("mujoco", "rk4"):
        settings = [f"plant.integrator={integrator}", *(["duration=0.5"] if quick else [])]
        plans[integrator] = load_plan(SHIPPED, settings)
    cases = [(integrator, way) for integrator in plans for way in ways]
    taken: dict[tuple[str, str], list[float]] = {case: [] for case in cases}
    for flight in range(count + 1):
        report("flights", flight, count + 1)
        for integrator, way in cases:
            started = clock.process_time()
            ways[way](plans[integrator], flight)
            taken[integrator, way].append(clock.process_time() - started)
    records: list[Record] = []
    for (integrator, way), times in taken.items():
        seconds = sum(times[1:]) / count
        records.append(
            {
                "campaign": SHIPPED,
                "integrator": integrator,
                "flown_by": way,
                "flights": count,
                "processor_ms": 1e3 * seconds,
                "per_core_hour": 3600.0 / seconds,
            }
        )
    return records


def measure(quick: bool, report: Progress) -> list[Record]:
    """Campaigns by one worker and by two, by PIQP and by the core, in turns; then single flights."""
    rounds, flights = (1, 2) if quick else (2, 12)
    solvers = ("piqp", "core")
    cases = (("paper-constrained", 1), ("paper-constrained", 2), ("robust", 2))
    results: list[Record] = []
    for _ in range(rounds):
        for name, workers in cases:
            scenario = load(name).replace({"duration": 0.5, "constraints": []} if quick else {})
            for solver in solvers:
                report("campaigns", len(results), rounds * len(cases) * len(solvers))
                results.append(campaign(scenario.replace({"controller.solver": solver}), solver, flights, workers))
    return results + single_flights(quick, report)


def main() -> None:
    """Fly, print and write."""
    chosen = options(__doc__)
    run(partial(measure, chosen.quick), "What campaigns cost", chosen.json)


if __name__ == "__main__":
    main()
