"""`quadsim bench campaign`: throughput, scaling, overhead and memory of many flights."""

from __future__ import annotations

import multiprocessing
import re
import tempfile
import time as clock
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from quadsim.bench import CampaignProfile, CampaignRun
from quadsim.campaign.store import FLIGHTS_FILE, TIMES_FILE
from quadsim.campaign.table import read_table
from quadsim.errors import ParameterError
from scenarios.build import build_vehicle, resolve_vehicle
from scenarios.campaign.local import LocalEngine
from scenarios.campaign.plan import Plan
from scenarios.campaign.run import Standing, fly_campaign
from scenarios.campaign.spec import CampaignSpec
from scenarios.loading import load_scenario
from scenarios.runner import Progress, machine, silent
from scenarios.spec import Scenario

GROWING: Final = ("hover", ("duration=0.5",))
"""What ever larger campaigns fly: so little that what a campaign adds shows."""
_LOOK_EVERY: Final = 1.0
"""Between two looks at the workers' memory [s]."""


def bench_campaign(
    scenario: Scenario,
    *,
    flights: int = 40,
    rounds: int = 3,
    sizes: Sequence[int] = (10, 100, 1000, 10000),
    progress: Progress = silent,
) -> CampaignProfile:
    """Fly campaigns by one worker and by two, in turns, and then ever larger ones.

    Args:
        scenario: what the first ones fly, each time the same.
        flights: per worker and round.
        rounds: how many.
        sizes: flights of the larger ones, by two workers.
        progress: told how far it is.

    Raises:
        ParameterError: nothing is asked for.
    """
    for name, value in (("flights", flights), ("rounds", rounds), ("sizes", min(sizes, default=1))):
        if value < 1:
            raise ParameterError("", f"--{name}", value, "at least 1")
    done, total = 0, 2 * rounds + len(sizes)

    def run(flown: Scenario, count: int, workers: int, *, report: bool = False) -> CampaignRun:
        nonlocal done
        found = _timed(flown, count, workers, report=report)
        done += 1
        progress("campaigns", done, total)
        return found

    _timed(load_scenario(GROWING[0], GROWING[1]), 2, 2, report=False)  # the server that starts workers is there now
    pairs = tuple((run(scenario, flights, 1), run(scenario, 2 * flights, 2)) for _ in range(rounds))
    small = load_scenario(GROWING[0], GROWING[1])
    growing = tuple(run(small, size, 2, report=True) for size in sizes)
    return CampaignProfile(
        scenario=scenario.name,
        duration=scenario.duration,
        rounds=pairs,
        growing=growing,
        growing_scenario=small.name,
        growing_duration=small.duration,
        machine=machine(),
    )


def _timed(scenario: Scenario, flights: int, workers: int, *, report: bool) -> CampaignRun:
    spec = CampaignSpec(name="bench", scenario=scenario.name, flights=flights)
    plan = Plan(spec, resolve_vehicle(scenario, build_vehicle(scenario)))
    memory = _Memory()
    with tempfile.TemporaryDirectory() as scratch:
        directory = Path(scratch) / "campaign"
        started = clock.perf_counter()
        result = fly_campaign(plan, directory, LocalEngine(workers), report=report, watch=memory.look)
        whole = clock.perf_counter() - started
        busy = sum(read_table(directory / TIMES_FILE)["wall_s"].to_pylist())
        wall = float(result.manifest["sessions"][-1]["wall_s"])
        return CampaignRun(
            flights=flights,
            workers=workers,
            wall_s=wall,
            busy_s=busy,
            concluding_s=whole - wall,
            memory_mb=memory.largest,
            bytes=(directory / FLIGHTS_FILE).stat().st_size,
        )


class _Memory:
    """The largest proportional set size [MB] that a worker was seen to have; None where the system does not tell."""

    def __init__(self) -> None:
        self.largest: float | None = None
        self._looked = clock.perf_counter()

    def look(self, standing: Standing) -> None:
        """Look, now and then."""
        if clock.perf_counter() - self._looked < _LOOK_EVERY:
            return
        self._looked = clock.perf_counter()
        sizes = [size for child in multiprocessing.active_children() if (size := _proportional(child.pid)) is not None]
        self.largest = max([*sizes, *([] if self.largest is None else [self.largest])], default=None)


def _proportional(pid: int | None) -> float | None:
    """A process's share of the memory that it uses [MB]; None where the system does not tell."""
    try:
        text = Path(f"/proc/{pid}/smaps_rollup").read_text(encoding="ascii")
    except OSError:
        return None
    found = re.search(r"^Pss:\s+(\d+) kB$", text, re.MULTILINE)
    return None if found is None else int(found[1]) / 1e3
