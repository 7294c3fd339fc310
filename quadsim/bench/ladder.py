"""The mismatch ladder as plain values: what became of each controller in each condition."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Final

ASTRAY: Final = 10.0
"""Distance from the reference at the end [m] from which on a flight counts as lost, though nothing ended it."""
OVERTURNED: Final = 90.0
"""Roll or pitch [deg] from which on a flight counts as lost, whatever came after."""


@dataclass(frozen=True, kw_only=True)
class LadderFlight:
    """What became of one flight; numbers are over what was flown, None where that is not one period.

    Attributes:
        reason: why it ended early; None when it was completed.
        flown: time flown [s].
        rmse: tracking error by axis x, y, z [m].
        end_error: distance of the vehicle from the reference at the last sample [m].
        peak_tilt: largest magnitude of roll or pitch at the physics rate [deg].
        violated: time at the physics rate with roll or pitch beyond its bound, tolerance 0 [s].
        fallbacks: periods not flown by the controller's own optimum.
        step_p99: 99th percentile of the processor time of the controller's step [ms]; None where it was not timed.
    """

    reason: str | None
    flown: float
    rmse: Mapping[str, float] | None
    end_error: float | None
    peak_tilt: float | None
    violated: float
    fallbacks: int
    step_p99: float | None

    @property
    def survived(self) -> bool:
        """Whether it was completed, never fell over, and ended near its reference."""
        if self.reason is not None or self.end_error is None or self.peak_tilt is None:
            return False
        return self.end_error <= ASTRAY and self.peak_tilt <= OVERTURNED

    @property
    def fate(self) -> str:
        """How it was lost, in a word or two; empty for one that survived."""
        if self.survived:
            return ""
        if self.reason is not None:
            return f"lost, {self.flown:.0f} s"
        return "fell over" if (self.peak_tilt or 0.0) > OVERTURNED else "astray"


@dataclass(frozen=True, kw_only=True)
class Ladder:
    """Controllers by conditions on one course.

    Attributes:
        scenario: whose course.
        duration: of each flight [s].
        tilt_bound: of roll and pitch [deg].
        controllers: what each one is, by its name.
        conditions: what each one is, by its name.
        flights: by controller and condition.
        machine: what step times were measured on.
    """

    scenario: str
    duration: float
    tilt_bound: float
    controllers: Mapping[str, str]
    conditions: Mapping[str, str]
    flights: Mapping[tuple[str, str], LadderFlight]
    machine: Mapping[str, Any]

    def to_json(self) -> dict[str, Any]:
        """Everything, as plain values; what a clock measured stands under `step_p99` alone."""
        flights = [
            {"controller": controller, "condition": condition, "survived": flight.survived, **asdict(flight)}
            for (controller, condition), flight in self.flights.items()
        ]
        return {**vars(self), "flights": flights}
