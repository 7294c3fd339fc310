"""A flight of a campaign flown again, with everything a run directory has, and held against its row."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from quadsim.errors import ParameterError
from scenarios.campaign.manifest import other_than_flew, read_manifest, stored_plan
from scenarios.campaign.pilot import CampaignPilot
from scenarios.campaign.plan import Plan
from scenarios.campaign.results.store import FLIGHTS_FILE, read_flights
from scenarios.campaign.results.table import make_table
from scenarios.campaign.statistics.estimates import worst_flight
from scenarios.flight import Flight
from scenarios.many import MEMORY, TIMEOUT
from scenarios.results import EXIT_DONE, EXIT_FAILED, Result, Shown
from scenarios.schema.scenario import Scenario


@dataclass(frozen=True, kw_only=True)
class Recorded:
    """A flight of a finished campaign."""

    number: int
    row: Mapping[str, Any]  # of `flights.parquet`
    plan: Plan
    scenario: Scenario
    otherwise: Sequence[str]  # see `manifest.other_than_flew`

    @property
    def notes(self) -> list[str]:
        """What a person should know before it is flown again."""
        found = []
        if self.otherwise:
            found.append(f"other {', '.join(self.otherwise)} flew that campaign, so numbers may differ")
        if self.row["verdict"] in (TIMEOUT, MEMORY):
            ended = f"flight {self.number} was ended in the campaign ({self.row['reason']})"
            found.append(f"{ended}; here nothing ends it but Ctrl-C")
        return found


def recorded_flight(directory: Path, number: int | None) -> Recorded:
    """A flight of a campaign's directory; the worst one where no number is given.

    Raises:
        InputError: there is no such flight, or its parameters cannot be flown together.
        FileError: the directory is no campaign, or not a finished one.
    """
    plan = stored_plan(directory)
    table = read_flights(directory / FLIGHTS_FILE, plan.schema)
    number = worst_flight(table) if number is None else number
    flights = table["flight"].to_pylist()
    if number not in flights:
        raise ParameterError("", "--flight", number, f"one of the flights 0 to {flights[-1]} of {directory}")
    row = table.slice(flights.index(number), 1).to_pylist()[0]
    otherwise = other_than_flew(read_manifest(directory), plan)
    return Recorded(number=number, row=row, plan=plan, scenario=plan.of(number), otherwise=otherwise)


@dataclass(frozen=True, kw_only=True)
class Replay(Result):
    """A flight of a campaign, flown again."""

    recorded: Recorded  # as the campaign has it
    flight: Flight  # as it was flown now
    differing: Sequence[str]  # columns of the campaign's table that are not the same bit for bit

    @property
    def exit_status(self) -> int:
        """See `Result.exit_status`; 1 where its numbers are not the campaign's."""
        return EXIT_FAILED if self.differing else EXIT_DONE

    def shown(self) -> Shown:
        """See `Result.shown`."""
        from scenarios import console

        yield from self.flight.shown()
        number, count = self.recorded.number, len(self.recorded.row)
        if self.differing:
            yield console.styled((f"flight {number} differs from the campaign's in {', '.join(self.differing)}", "red"))
        else:
            yield f"flight {number}: {count} columns, each the same as in the campaign"

    def to_json(self) -> dict[str, Any]:
        """`summary.json` of the flight as it was flown now."""
        return self.flight.to_json()


def held_against(flight: Flight, recorded: Recorded) -> Replay:
    """A campaign's flight that was flown again, beside what the campaign has of it."""
    row = CampaignPilot(recorded.plan).row_of(recorded.number, flight)
    (again,) = make_table([row], recorded.plan.schema).to_pylist()
    differing = [name for name, value in recorded.row.items() if name not in again or again[name] != value]
    return Replay(recorded=recorded, flight=flight, differing=differing)
