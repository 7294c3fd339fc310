"""The numbers of a study of what constraints cost."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final

import numpy as np

from quadsim.controller import ACCEPTED, UNCONSTRAINED
from quadsim.flight import metrics
from quadsim.state import Array


@dataclass(frozen=True, kw_only=True)
class Measure:
    """A number that each flight of a study gives: what it is called, and its unit."""

    label: str
    unit: str


MEASURES: Final[dict[str, Measure]] = {
    "tilt_sampled": Measure(label="peak tilt at the samples", unit="deg"),
    "tilt_plant": Measure(label="peak tilt at the physics rate", unit="deg"),
    "rmse_x": Measure(label="RMS error x", unit="m"),
    "rmse_y": Measure(label="RMS error y", unit="m"),
    "rmse_z": Measure(label="RMS error z", unit="m"),
    "rmse_yaw": Measure(label="RMS error yaw", unit="deg"),
    "end_error": Measure(label="largest error at the end", unit="m, rad"),
    "speed_max": Measure(label="highest rotor speed", unit="rad/s"),
    "step_max": Measure(label="largest step of a command", unit="rad/s"),
    "total_variation": Measure(label="total variation of the commands", unit="rad/s"),
}
"""The numbers of a flight, in order.  Tilt is the larger of |roll| and |pitch|, which are bounded one by one."""


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What became of one flight.

    Attributes:
        reason: why it ended early; None when it was completed.
        flown: time flown [s].
        statuses: periods by the controller's status.
        fallbacks: periods in which an earlier plan was held.
        active: periods with a constraint active at their optimum.
        numbers: a value for each of `MEASURES`, over what was flown; empty when not one period was.
        settling: the entries of `quadsim.flight.metrics.settling`, one per step of the course.
    """

    reason: str | None
    flown: float
    statuses: Mapping[str, int]
    fallbacks: int
    active: int
    numbers: Mapping[str, float]
    settling: Sequence[Mapping[str, Any]]

    @property
    def completed(self) -> bool:
        """Whether it was flown to its end."""
        return self.reason is None

    @property
    def periods(self) -> int:
        """Control periods flown."""
        return sum(self.statuses.values())

    def number(self, key: str) -> float | None:
        """One of `MEASURES`; None for a flight that was lost, whose numbers are not like those of others."""
        return self.numbers.get(key) if self.completed else None


@dataclass(frozen=True, kw_only=True)
class CandidateTimes:
    """A way to compute the commands, timed on the queries of one flight.

    Attributes:
        name: what it is called.
        step_ms: (K,) time of the whole controller step in each period, the median of all repeats [ms].
        statuses: K texts, what each step answered.
        repeats: how often each period was timed.
    """

    name: str
    step_ms: Array
    statuses: tuple[str, ...]
    repeats: int

    @property
    def shortcut(self) -> np.ndarray[Any, np.dtype[np.bool_]]:
        """(K,) the periods answered by an unconstrained optimum that satisfies every constraint."""
        return np.array([status == UNCONSTRAINED for status in self.statuses])

    @property
    def failures(self) -> int:
        """Periods without an optimum."""
        return sum(status not in ACCEPTED for status in self.statuses)

    def rate(self, measure: str) -> float:
        """The largest loop rate that a percentile of the step, such as `p99` or `max`, allows [Hz]."""
        return 1e3 / metrics.percentiles(self.step_ms)[measure]


@dataclass(frozen=True, kw_only=True)
class SweepPoint:
    """The flights at one value of what is swept.

    Attributes:
        value: that value.
        constrained: the flight with constraints.
        step_ms: median, percentiles and maximum of its controller's step [ms]; empty when not one period was flown.
        unconstrained: the flight without them, where it depends on what is swept.
    """

    value: float
    constrained: Outcome
    step_ms: Mapping[str, float]
    unconstrained: Outcome | None = None


@dataclass(frozen=True, kw_only=True)
class Sweep:
    """Flights that differ in one number.

    Attributes:
        name: what is swept.
        unit: its unit.
        base: its value in the study's own flight; None where that has no one value.
        points: in rising order of the value.
    """

    name: str
    unit: str
    base: float | None
    points: tuple[SweepPoint, ...]


@dataclass(frozen=True, kw_only=True)
class Variation:
    """The constrained flight with other values of the vehicle's parameters that the paper leaves out.

    Attributes:
        arm_length: L [m].
        drag_to_thrust: d/b [m].
        outcome: the flight.
    """

    arm_length: float
    drag_to_thrust: float
    outcome: Outcome


@dataclass(frozen=True, kw_only=True)
class CostStudy:
    """What constraints cost, and what they buy, on one course.

    Attributes:
        name: of the constrained flight.
        horizon: N, of both flights.
        deadline_ms: the control period [ms].
        duration: of the course [s].
        constrained: the flight with constraints.
        unconstrained: the same course, weights and horizon, without them.
        others: compared flights of the course by unconstrained controllers with weights or a horizon of their own.
        reference: settling of the filtered reference itself, had the vehicle followed it exactly.
        candidates: timed on the queries of the constrained flight: the gain of the unconstrained optimum, the
            constrained controller as it flew, and the QP in every period by one solver each.
        left_out: solvers that could not take part, and what to do about it.
        tilt: sweep of the bound on roll and pitch.
        horizons: sweep of N.
        variations: over the parameters that the paper leaves out.
        machine: what the times were measured on.
    """

    name: str
    horizon: int
    deadline_ms: float
    duration: float
    constrained: Outcome
    unconstrained: Outcome
    others: Mapping[str, Outcome]
    reference: Sequence[Mapping[str, Any]]
    candidates: tuple[CandidateTimes, ...]
    left_out: Mapping[str, str]
    tilt: Sweep
    horizons: Sweep
    variations: tuple[Variation, ...]
    machine: Mapping[str, Any]

    def to_json(self) -> dict[str, Any]:
        """Everything, as plain values; what a clock measured is under `contenders` and `step_ms` alone."""
        timed = [
            {
                "name": candidate.name,
                "repeats": candidate.repeats,
                "failures": candidate.failures,
                "shortcuts": int(candidate.shortcut.sum()),
                **metrics.percentiles(candidate.step_ms),
                "step_ms": [float(f"{value:.4g}") for value in candidate.step_ms],
            }
            for candidate in self.candidates
        ]
        return {**{name: value for name, value in asdict(self).items() if name != "candidates"}, "contenders": timed}
