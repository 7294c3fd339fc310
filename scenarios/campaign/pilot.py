"""One flight of a campaign, from its number to its row of the results."""

from __future__ import annotations

import time as clock

from quadsim.campaign.table import Row, failed_row, flown_row
from quadsim.errors import QuadsimError
from scenarios.campaign.engine import said
from scenarios.campaign.plan import Plan
from scenarios.runner import Flight, fly_scenario, processor_name


class CampaignPilot:
    """Flies the flights of a campaign; sent to each process once.

    Args:
        plan: the campaign.
    """

    def __init__(self, plan: Plan) -> None:
        self._plan = plan

    def fly(self, flight: int) -> Row:
        """The row of a flight; one that raises is a result too, with its reason."""
        started = clock.perf_counter()
        try:
            flown = fly_scenario(self._plan.of(flight))
        except QuadsimError as error:
            return self._row(flight, failed_row(str(error)))
        except Exception as error:  # of a controller that is not ours, say: the campaign goes on without it
            return self._row(flight, failed_row(said(error)))
        return self._row(flight, _kept(flown, clock.perf_counter() - started))

    def row_of(self, flight: int, flown: Flight) -> Row:
        """The row of a flight that was flown elsewhere; it has no clock times of its own."""
        return self._row(flight, _kept(flown, 0.0))

    def lost(self, flight: int, reason: str) -> Row:
        """The row of a flight that no process came back from."""
        return self._row(flight, failed_row(reason))

    def _row(self, flight: int, came_of_it: Row) -> Row:
        row = dict.fromkeys(self._plan.schema.names) | self._plan.identity(flight) | came_of_it
        return row | {"failed": any(event.holds(row) for event in self._plan.failure)}


def _kept(flight: Flight, wall_s: float) -> Row:
    """What a campaign keeps of a flight."""
    return flown_row(flight.log, flight.findings, verdict=flight.outcome, wall_s=wall_s, machine=processor_name())
