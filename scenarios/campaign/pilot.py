"""One flight of a campaign, from its number to its row of the results."""

from __future__ import annotations

import contextlib
import time as clock

from quadsim.errors import QuadsimError
from scenarios.campaign.engine.protocol import describe
from scenarios.campaign.plan import Plan
from scenarios.campaign.results.table import Row, failed_row, flown_row
from scenarios.campaign.results.verdicts import ERROR, MEMORY
from scenarios.campaign.spec import LimitsSpec
from scenarios.flight import Flight
from scenarios.machine import processor_name
from scenarios.parts.plugin import import_plugin
from scenarios.progress import Progress, silent
from scenarios.run import fly_scenario
from scenarios.schema.plugin import PluginSpec


class CampaignPilot:
    """Flies the flights of a campaign; sent to each process once."""

    def __init__(self, plan: Plan) -> None:
        self._plan = plan

    @property
    def limits(self) -> LimitsSpec:
        """See `Pilot`."""
        return self._plan.spec.limits

    def prepare(self) -> None:
        """Import a plug-in controller, and what draws need."""
        self._plan.identity(0)
        controller = self._plan.scenario.controller
        if isinstance(controller, PluginSpec):
            with contextlib.suppress(Exception):
                import_plugin(controller)

    def fly(self, flight: int, progress: Progress = silent) -> Row:
        """The row of a flight; one that raises is a result too, with its reason."""
        started = clock.perf_counter()
        try:
            flown = fly_scenario(self._plan.of(flight), progress)
        except QuadsimError as error:
            return self._row(flight, failed_row(str(error)))
        except MemoryError as error:
            return self._row(flight, failed_row(f"{describe(error)} ({self._most})", MEMORY))
        except Exception as error:  # e.g. of a user-defined controller: the campaign continues without it
            return self._row(flight, failed_row(describe(error)))
        if raised := flown.log.traceback:  # no more of such a flight is kept than that it raised
            reason = str(flown.log.reason)
            short = raised[-1].startswith(MemoryError.__name__)
            row = failed_row(f"{reason} ({self._most})", MEMORY) if short else failed_row(reason)
            return self._row(flight, row)
        return self._row(flight, _recorded(flown, clock.perf_counter() - started))

    @property
    def _most(self) -> str:
        return f"limits.memory is {self.limits.memory:g} MB"

    def row_of(self, flight: int, flown: Flight) -> Row:
        """The row of a flight that was flown elsewhere; it has no clock times of its own."""
        return self._row(flight, _recorded(flown, 0.0))

    def lost(self, flight: int, reason: str, verdict: str = ERROR) -> Row:
        """The row of a flight that no process came back from."""
        return self._row(flight, failed_row(reason, verdict))

    def _row(self, flight: int, came_of_it: Row) -> Row:
        row = dict.fromkeys(self._plan.schema.names) | self._plan.identity(flight) | came_of_it
        return row | {"failed": any(event.holds(row) for event in self._plan.failure)}


def _recorded(flight: Flight, wall_s: float) -> Row:
    """What a campaign keeps of a flight."""
    return flown_row(flight.log, flight.findings, verdict=flight.outcome, wall_s=wall_s, machine=processor_name())
