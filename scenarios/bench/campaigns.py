"""`quadsim bench campaign`: throughput, scaling, overhead and memory of many flights."""

from __future__ import annotations

import itertools
import math
import multiprocessing
import re
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from quadsim.errors import ParameterError
from quadsim.report.table import ABSENT, Grid, line
from scenarios.bench.bench_results import Target
from scenarios.bench.bench_tables import targets_table
from scenarios.bench.timing import Stopwatch
from scenarios.campaign.plan import Plan
from scenarios.campaign.results.store import FLIGHTS_FILE, TIMES_FILE
from scenarios.campaign.results.table import read_table
from scenarios.campaign.run import Standing, fly_campaign
from scenarios.campaign.spec import CampaignSpec
from scenarios.loading import load_scenario
from scenarios.machine import machine
from scenarios.parts.vehicle import build_vehicle, resolve_vehicle
from scenarios.progress import Progress, silent
from scenarios.schema.scenario import Scenario

GROWING: Final = ("hover", ("duration=0.5",))
"""What ever larger campaigns fly: so little that what a campaign adds shows."""
_LOOK_EVERY: Final = 1.0  # between two looks at the workers' memory [s]


@dataclass(frozen=True, kw_only=True)
class CampaignRun:
    """One campaign, as it was timed."""

    flights: int  # in it
    workers: int  # processes
    wall_s: float  # from the first process started to the last answer [s]
    busy_s: float  # what the flights took, summed [s]
    concluding_s: float  # final tables, estimates and report [s]
    memory_mb: float | None  # largest proportional set size of a worker [MB]; None where the system does not report it
    bytes: int  # size of `flights.parquet`

    @property
    def flight_s(self) -> float:
        """Of one flight, set-up and audit included [s]."""
        return self.busy_s / self.flights

    @property
    def rate(self) -> float:
        """Flights per second."""
        return self.flights / self.wall_s

    @property
    def overhead(self) -> float:
        """Share of the workers' time in which they did not fly: started, waited, reported."""
        return 1.0 - self.busy_s / (self.workers * self.wall_s)


@dataclass(frozen=True, kw_only=True)
class CampaignProfile:
    """What campaigns cost."""

    scenario: str  # what was flown
    duration: float  # of a flight [s]
    rounds: tuple[tuple[CampaignRun, CampaignRun], ...]  # campaigns by one worker and by two, flown in turns
    growing: tuple[CampaignRun, ...]  # campaigns of ever more flights
    growing_scenario: str  # what these flew
    growing_duration: float  # of a flight of these [s]
    machine: Mapping[str, Any]  # what the times were measured on

    @property
    def per_core_hour(self) -> float:
        """Flights per hour of one core, the median over the rounds."""
        return float(np.median([3600.0 * one.rate for one, _ in self.rounds]))

    @property
    def scaling(self) -> float:
        """How many times as fast two workers are as one, the median over the rounds."""
        return float(np.median([two.rate / one.rate for one, two in self.rounds]))

    @property
    def overhead(self) -> float:
        """Of two workers, the median over the rounds."""
        return float(np.median([two.overhead for _, two in self.rounds]))

    @property
    def memory_mb(self) -> float | None:
        """Of the largest worker."""
        runs = itertools.chain(*self.rounds, self.growing)
        return max((run.memory_mb for run in runs if run.memory_mb is not None), default=None)

    def to_json(self) -> dict[str, Any]:
        """Everything, as plain values."""
        own = ("per_core_hour", "scaling", "overhead", "memory_mb")
        return {**asdict(self), **{name: getattr(self, name) for name in own}}


def campaign_tables(profile: CampaignProfile) -> list[Grid]:
    """The rounds, the growth, and the targets."""
    rounds = Grid(
        key="campaign",
        title="What a campaign costs",
        head=(
            *(f"{profile.duration:g} s of {profile.scenario}", "workers", "a flight [s]", "flights/s"),
            *("flights/core-h", "not flying"),
        ),
        lines=tuple(
            line(
                *(f"round {i}", str(run.workers), f"{run.flight_s:.3f}", f"{run.rate:.2f}"),
                *(f"{3600 * run.rate / run.workers:.0f}", f"{100 * run.overhead:.1f} %"),
            )
            for i, pair in enumerate(profile.rounds, start=1)
            for run in pair
        ),
        note=f"{profile.rounds[0][0].flights} flights by one worker, {profile.rounds[0][1].flights} by two, in turns; "
        "every flight's set-up and audit included. Where a flight takes longer beside another one, cores share what "
        "both need. Not flying: share of the workers' time, their start included.",
    )
    targets = targets_table("Targets for campaigns", campaign_targets(profile))
    return [rounds, *([_growth(profile)] if profile.growing else []), targets]


def _growth(profile: CampaignProfile) -> Grid:
    return Grid(
        key="growth",
        title="How it grows",
        head=("flights", "flying [s]", "per flight [ms]", "concluding [s]", "flights.parquet [MB]", "worker [MB]"),
        lines=tuple(
            line(
                *(f"{run.flights}", f"{run.wall_s:.1f}", f"{1e3 * run.wall_s / run.flights:.1f}"),
                *(f"{run.concluding_s:.2f}", f"{run.bytes / 1e6:.3f}"),
                ABSENT if run.memory_mb is None else f"{run.memory_mb:.0f}",
            )
            for run in profile.growing
        ),
        note=f"{profile.growing_duration:g} s of {profile.growing_scenario}, so that what a campaign adds to its "
        f"flights shows; {profile.growing[0].workers} workers. Concluding: final tables, estimates, report. The last "
        "column is the largest worker's proportional set size.",
    )


def campaign_targets(profile: CampaignProfile) -> list[Target]:
    """The targets for throughput, scaling, overhead and memory."""
    hour = profile.per_core_hour * profile.duration / 60.0
    memory = math.nan if profile.memory_mb is None else profile.memory_mb
    throughput = f"60 s flights of {profile.scenario} per core-hour, the median round"
    scaling, overhead = profile.scaling, profile.overhead
    return [
        Target(throughput, ">= 3000", f"{hour:.0f}", hour >= 3000.0),
        Target("two workers against one, the median round", ">= 1.9", f"{scaling:.2f}", scaling >= 1.9),
        Target(
            "two workers' time not spent flying, the median round", "< 2 %", f"{100 * overhead:.1f} %", overhead < 0.02
        ),
        Target("memory of a worker", "< 300 MB", f"{memory:.0f} MB", memory < 300.0),
    ]


def bench_campaign(
    scenario: Scenario,
    *,
    flights: int = 40,
    rounds: int = 3,
    sizes: Sequence[int] = (10, 100, 1000, 10000),
    progress: Progress = silent,
) -> CampaignProfile:
    """Fly campaigns of `flights` per worker by one worker and by two, in turns, and then ever larger ones by two.

    Raises:
        ParameterError: nothing is requested.
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
        stopwatch = Stopwatch()
        result = fly_campaign(plan, directory, workers=workers, report=report, watch=memory.look)
        whole = stopwatch.elapsed
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
    """The largest proportional set size [MB] of any worker; None where the system does not report it."""

    def __init__(self) -> None:
        self.largest: float | None = None
        self._since = Stopwatch()

    def look(self, standing: Standing) -> None:
        if self._since.elapsed < _LOOK_EVERY:
            return
        self._since = Stopwatch()
        sizes = [_proportional(child.pid) for child in multiprocessing.active_children()]
        self.largest = max((size for size in (*sizes, self.largest) if size is not None), default=None)


def _proportional(pid: int | None) -> float | None:
    """A process's share of the memory that it uses [MB]; None where the system does not report it."""
    try:
        text = Path(f"/proc/{pid}/smaps_rollup").read_text(encoding="ascii")
    except OSError:
        return None
    found = re.search(r"^Pss:\s+(\d+) kB$", text, re.MULTILINE)
    return None if found is None else int(found[1]) / 1e3
