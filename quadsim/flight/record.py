"""What figures, films, recordings, tables and pages take of a flight.

`quadsim.rollout.flown.Flight` provides it; what only reads flights depends on this protocol, and on no rollout.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol

from quadsim.flight.audit import Finding, FlightVerdict, Limit
from quadsim.flight.departure import Departure
from quadsim.flight.log import FlightLog
from quadsim.vehicle import Vehicle


class FlightRecord(Protocol):
    """A flown scenario with its audit, in memory."""

    @property
    def name(self) -> str:
        """The scenario's name."""

    @property
    def label(self) -> str | None:
        """Its name in a comparison; None: see `quadsim.report.comparison.run_names`."""

    @property
    def directory(self) -> Path | None:
        """Where it was read from or written to; None if it is only in memory."""

    @property
    def log(self) -> FlightLog:
        """The flight as stacked arrays."""

    @property
    def actual(self) -> Vehicle:
        """The vehicle flown."""

    @property
    def findings(self) -> tuple[Finding, ...]:
        """The audit, one per constraint."""

    @property
    def limits(self) -> tuple[Limit, ...]:
        """The constraints it was audited against."""

    @property
    def outcome(self) -> FlightVerdict:
        """The verdict in one word."""

    @property
    def departure(self) -> Departure | None:
        """How it ended beside its course; None where that is not known."""

    @property
    def reason(self) -> str | None:
        """Why it ended early, or is lost though it was flown to its end; None if it is neither."""

    @property
    def diagnosis(self) -> Mapping[str, Any] | None:
        """Why the first QP without an answer had none, and what helps; flies the changes that it advises, once."""

    @property
    def numbers(self) -> Mapping[str, Any]:
        """`summary.json` without what its diagnosis flies."""

    @property
    def end(self) -> float:
        """Last time of the flight [s]."""

    def labelled(self, label: str) -> FlightRecord:
        """Return the flight with another label."""
