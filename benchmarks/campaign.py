"""What many flights cost by one worker process and by two: flights per core-hour, scaling, and time not flying."""

from __future__ import annotations

import tempfile
from pathlib import Path

from timing import Record, Stopwatch, options, run

from scenarios.api import load
from scenarios.campaign.plan import Plan
from scenarios.campaign.results.store import FLIGHTS_FILE, TIMES_FILE
from scenarios.campaign.results.table import read_table
from scenarios.campaign.run import fly_campaign
from scenarios.campaign.spec import CampaignSpec
from scenarios.parts.vehicle import build_vehicle, resolve_vehicle
from scenarios.schema.scenario import Scenario


def campaign(scenario: Scenario, flights: int, workers: int, *, report: bool = False) -> Record:
    """Fly one campaign; what its flights took, and what it added to them."""
    spec = CampaignSpec(name="benchmark", scenario=scenario.name, flights=flights)
    plan = Plan(spec, resolve_vehicle(scenario, build_vehicle(scenario)))
    with tempfile.TemporaryDirectory() as scratch:
        directory, watch = Path(scratch) / "campaign", Stopwatch()
        result = fly_campaign(plan, directory, workers=workers, report=report)
        whole = watch.elapsed
        flying = sum(read_table(directory / TIMES_FILE)["wall_s"].to_pylist())
        size = (directory / FLIGHTS_FILE).stat().st_size
    wall = float(result.manifest["sessions"][-1]["wall_s"])  # from the first process started to the last answer
    return {
        "scenario": f"{scenario.duration:g} s of {scenario.name}",
        "flights": flights,
        "workers": workers,
        "flight_s": flying / flights,
        "flights_per_s": flights / wall,
        "per_core_hour": 3600.0 * flights / (wall * workers),
        "not_flying_%": 100.0 * (1.0 - flying / (workers * wall)),
        "concluding_s": whole - wall,
        "MB": size / 1e6,
    }


def measure(name: str, quick: bool) -> list[Record]:
    """Campaigns by one worker and by two, in turns, then ever larger ones of a short flight."""
    small = load("hover").replace({"duration": 0.5})
    scenario = small if quick else load(name)
    campaign(small, 2, 2)  # the server that workers are forked from is there now
    rounds, flights, sizes = (1, 2, [4]) if quick else (3, 40, [10, 100, 1000, 10000])
    pairs = [campaign(scenario, flights * workers, workers) for _ in range(rounds) for workers in (1, 2)]
    return [*pairs, *(campaign(small, size, 2, report=True) for size in sizes)]


def main() -> None:
    """Fly, print and write."""
    chosen = options(__doc__, scenario={"default": "paper-constrained", "help": "default: %(default)s"})
    run(lambda: measure(chosen.scenario, chosen.quick), "What campaigns cost", chosen.json)


if __name__ == "__main__":
    main()
