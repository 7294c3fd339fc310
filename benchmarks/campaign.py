"""What many flights cost by one worker process and by two, by PIQP and by the core: flights per core-hour."""

from __future__ import annotations

import tempfile
from functools import partial
from pathlib import Path

from timing import Record, options, run

from quadsim.commands.app import load
from quadsim.console.progress import Progress
from quadsim.features.campaign.campaign import fly_campaign
from quadsim.features.campaign.campaign_file import CampaignFile
from quadsim.features.campaign.plan import Plan
from quadsim.features.campaign.rows import read_table
from quadsim.features.campaign.store import FLIGHTS_FILE, TIMES_FILE
from quadsim.scenarios.assembly import Assembly
from quadsim.scenarios.schema.scenario import Scenario


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


def measure(quick: bool, report: Progress) -> list[Record]:
    """Campaigns by one worker and by two, by PIQP and by the core, in turns."""
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
    return results


def main() -> None:
    """Fly, print and write."""
    chosen = options(__doc__)
    run(partial(measure, chosen.quick), "What campaigns cost", chosen.json)


if __name__ == "__main__":
    main()
