"""One flight of one candidate, from its number to its row."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from quadsim.errors import InputError
from scenarios.campaign.pilot import CampaignPilot
from scenarios.campaign.plan import Plan
from scenarios.campaign.results.table import Row
from scenarios.many import ERROR
from scenarios.tuning.plan import TuningPlan, Values


class TuningPilot:
    """Flies candidates on the draws of a campaign, the same for all of them; sent to each process once.

    The flight of candidate c on draw i has the number c * `TuningPlan.most` + i.
    """

    def __init__(self, plan: TuningPlan, candidates: Mapping[int, Values]) -> None:
        self._plan, self._candidates = plan, dict(candidates)
        self._start = CampaignPilot(plan.start)
        self._pilots: dict[int, CampaignPilot] = {}

    @property
    def plan(self) -> Plan:
        """See `scenarios.campaign.pilot.Pilot`."""
        return self._plan.start

    def fly(self, flight: int) -> Row:
        """The row of a flight; a candidate that is no scenario fails it."""
        candidate, draw = divmod(flight, self._plan.most)
        try:
            pilot = self._pilot(candidate)
        except InputError as error:
            return self.failed(flight, str(error), ERROR)
        return self._row(flight, pilot.fly(draw))

    def failed(self, flight: int, reason: str, verdict: str) -> Row:
        """See `scenarios.campaign.pilot.Pilot`."""
        return self._row(flight, self._start.failed(flight % self._plan.most, reason, verdict))

    def _pilot(self, candidate: int) -> CampaignPilot:
        if candidate not in self._pilots:
            self._pilots[candidate] = CampaignPilot(self._plan.of(self._candidates[candidate]))
        return self._pilots[candidate]

    def _row(self, flight: int, row: Row) -> Row:
        candidate = flight // self._plan.most
        own: dict[str, Any] = self._plan.identity(candidate, self._candidates[candidate])
        return {**row, **own, "flight": flight}
