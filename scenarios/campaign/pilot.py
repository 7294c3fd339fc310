"""One flight of a campaign, from its number to its row of the results; and many of them."""

from __future__ import annotations

import time as clock
from collections.abc import Generator, Sequence
from contextlib import closing
from typing import Any, Protocol

from quadsim.errors import QuadsimError
from scenarios.campaign.plan import Plan
from scenarios.campaign.results.table import Row, failed_row, flown_row
from scenarios.flight import Flight
from scenarios.machine import processor_name
from scenarios.many import MEMORY, fly_many
from scenarios.rollout import Rollout


class Pilot(Protocol):
    """Flies flights, known by their numbers; pickled, and sent to each process once."""

    @property
    def plan(self) -> Plan:
        """Whose limits hold, and whose code flies."""

    def fly(self, flight: int) -> Row:
        """The row of a flight."""

    def failed(self, flight: int, reason: str, verdict: str) -> Row:
        """The row of a flight that raised, met a limit, or whose process died."""


def fly_flights(
    pilot: Pilot, flights: Sequence[int], *, workers: int | None = None, cluster: str | None = None
) -> Generator[Row]:
    """The rows of a pilot's flights, each once, in whatever order they come; see `scenarios.many.fly_many`."""
    limits, isolate = pilot.plan.spec.limits, pilot.plan.flies_user_code
    options: dict[str, Any] = {"timeout": limits.flight, "memory": limits.memory, "isolate": isolate}
    with closing(fly_many(flights, pilot.fly, workers=workers, cluster=cluster, **options)) as rows:
        for place, row in rows:
            yield row if "flight" in row else pilot.failed(flights[place], row["reason"], row["verdict"])


class CampaignPilot:
    """Flies the flights of a campaign."""

    def __init__(self, plan: Plan) -> None:
        self.plan = plan

    def fly(self, flight: int) -> Row:
        """The row of a flight; one that cannot be flown has one too, with its reason."""
        started = clock.perf_counter()
        try:
            flown = Rollout(self.plan.of(flight)).fly()
        except QuadsimError as error:
            return self._row(flight, failed_row(str(error)))
        if raised := flown.log.traceback:  # no more of such a flight is kept than that it raised
            reason, limit = str(flown.log.reason), f"(it may take {self.plan.spec.limits.memory:g} MB)"
            short = raised[-1].startswith(MemoryError.__name__)
            return self._row(flight, failed_row(f"{reason} {limit}", MEMORY) if short else failed_row(reason))
        return self.row_of(flight, flown, clock.perf_counter() - started)

    def row_of(self, flight: int, flown: Flight, wall_s: float = 0.0) -> Row:
        """The row of a flight that was flown, in that time [s]."""
        machine = processor_name()
        row = flown_row(flown.log, flown.findings, verdict=flown.outcome, wall_s=wall_s, machine=machine)
        return self._row(flight, row)

    def failed(self, flight: int, reason: str, verdict: str) -> Row:
        """See `Pilot`."""
        return self._row(flight, failed_row(reason, verdict))

    def _row(self, flight: int, came_of_it: Row) -> Row:
        row = dict.fromkeys(self.plan.schema.names) | self.plan.identity(flight) | came_of_it
        return row | {"failed": any(event.holds(row) for event in self.plan.failure)}
