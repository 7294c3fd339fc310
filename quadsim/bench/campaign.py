"""What flying many flights costs, measured by `quadsim bench campaign`."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from quadsim.bench.results import Target
from quadsim.bench.tables import line, targets_table
from quadsim.table import ABSENT, Grid


@dataclass(frozen=True, kw_only=True)
class CampaignRun:
    """One campaign, as it was timed.

    Attributes:
        flights: in it.
        workers: processes.
        wall_s: from the first process started to the last answer [s].
        busy_s: what the flights took, summed [s].
        concluding_s: final tables, estimates and report [s].
        memory_mb: largest proportional set size of a worker [MB]; None where the system does not tell.
        bytes: size of `flights.parquet`.
    """

    flights: int
    workers: int
    wall_s: float
    busy_s: float
    concluding_s: float
    memory_mb: float | None
    bytes: int

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
        """Share of the workers' time in which they did not fly: started, waited, told."""
        return 1.0 - self.busy_s / (self.workers * self.wall_s)


@dataclass(frozen=True, kw_only=True)
class CampaignProfile:
    """What campaigns cost.

    Attributes:
        scenario: what was flown.
        duration: of a flight [s].
        rounds: campaigns by one worker and by two, flown in turns.
        growing: campaigns of ever more flights.
        growing_scenario: what these flew.
        growing_duration: of a flight of these [s].
        machine: what the times were measured on.
    """

    scenario: str
    duration: float
    rounds: tuple[tuple[CampaignRun, CampaignRun], ...]
    growing: tuple[CampaignRun, ...]
    growing_scenario: str
    growing_duration: float
    machine: Mapping[str, Any]

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
        sizes = [run.memory_mb for pair in self.rounds for run in pair if run.memory_mb is not None]
        sizes += [run.memory_mb for run in self.growing if run.memory_mb is not None]
        return max(sizes, default=None)

    def to_json(self) -> dict[str, Any]:
        """Everything, as plain values."""
        own = ("per_core_hour", "scaling", "overhead", "memory_mb")
        return {**asdict(self), **{name: getattr(self, name) for name in own}}


def campaign_tables(profile: CampaignProfile) -> list[Grid]:
    """The rounds, the growth, and what was asked."""
    rounds = Grid(
        key="campaign",
        title="What a campaign costs",
        head=(
            f"{profile.duration:g} s of {profile.scenario}",
            "workers",
            "a flight [s]",
            "flights/s",
            "flights/core-h",
            "not flying",
        ),
        lines=tuple(
            line(
                f"round {i}",
                str(run.workers),
                f"{run.flight_s:.3f}",
                f"{run.rate:.2f}",
                f"{3600 * run.rate / run.workers:.0f}",
                f"{100 * run.overhead:.1f} %",
            )
            for i, pair in enumerate(profile.rounds, start=1)
            for run in pair
        ),
        note=f"{profile.rounds[0][0].flights} flights by one worker, {profile.rounds[0][1].flights} by two, in turns; "
        "every flight's set-up and audit included. Where a flight takes longer beside another one, cores share what "
        "both need. Not flying: share of the workers' time, their start included.",
    )
    targets = targets_table("Asked of campaigns, and measured", campaign_targets(profile))
    return [rounds, *([_growth(profile)] if profile.growing else []), targets]


def _growth(profile: CampaignProfile) -> Grid:
    return Grid(
        key="growth",
        title="How it grows",
        head=("flights", "flying [s]", "per flight [ms]", "concluding [s]", "flights.parquet [MB]", "worker [MB]"),
        lines=tuple(
            line(
                f"{run.flights}",
                f"{run.wall_s:.1f}",
                f"{1e3 * run.wall_s / run.flights:.1f}",
                f"{run.concluding_s:.2f}",
                f"{run.bytes / 1e6:.3f}",
                ABSENT if run.memory_mb is None else f"{run.memory_mb:.0f}",
            )
            for run in profile.growing
        ),
        note=f"{profile.growing_duration:g} s of {profile.growing_scenario}, so that what a campaign adds to its "
        f"flights shows; {profile.growing[0].workers} workers. Concluding: final tables, estimates, report. The last "
        "column is the largest worker's proportional set size.",
    )


def campaign_targets(profile: CampaignProfile) -> list[Target]:
    """What was asked of throughput, scaling, overhead and memory."""
    hour = profile.per_core_hour * profile.duration / 60.0
    memory = math.nan if profile.memory_mb is None else profile.memory_mb
    return [
        Target(
            what=f"60 s flights of {profile.scenario} per core-hour, the median round",
            asked=">= 3000",
            measured=f"{hour:.0f}",
            met=hour >= 3000.0,
        ),
        Target(
            what="two workers against one, the median round",
            asked=">= 1.9",
            measured=f"{profile.scaling:.2f}",
            met=profile.scaling >= 1.9,
        ),
        Target(
            what="two workers' time not spent flying, the median round",
            asked="< 2 %",
            measured=f"{100 * profile.overhead:.1f} %",
            met=profile.overhead < 0.02,
        ),
        Target(what="memory of a worker", asked="< 300 MB", measured=f"{memory:.0f} MB", met=memory < 300.0),
    ]
