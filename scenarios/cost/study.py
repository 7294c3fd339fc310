"""The numbers of a study of what constraints cost."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final, NamedTuple

import numpy as np

from quadsim.controller import ACCEPTED, UNCONSTRAINED
from quadsim.flight import metrics
from quadsim.state import Array


class Measure(NamedTuple):
    """A number that each flight of a study gives: what it is called, and its unit."""

    label: str
    unit: str


MEASURES: Final[dict[str, Measure]] = {
    "tilt_sampled": Measure("peak tilt at the samples", "deg"),
    "tilt_plant": Measure("peak tilt at the physics rate", "deg"),
    "rmse_x": Measure("RMS error x", "m"),
    "rmse_y": Measure("RMS error y", "m"),
    "rmse_z": Measure("RMS error z", "m"),
    "rmse_yaw": Measure("RMS error yaw", "deg"),
    "end_error": Measure("largest error at the end", "m, rad"),
    "speed_max": Measure("highest rotor speed", "rad/s"),
    "step_max": Measure("largest step of a command", "rad/s"),
    "total_variation": Measure("total variation of the commands", "rad/s"),
}
"""The numbers of a flight, in order.  Tilt is the larger of |roll| and |pitch|, which are bounded one by one."""


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What became of one flight."""

    reason: str | None  # why it ended early; None when it was completed
    flown: float  # time flown [s]
    statuses: Mapping[str, int]  # periods by the controller's status
    fallbacks: int  # periods in which an earlier plan was held
    active: int  # periods with a constraint active at their optimum
    numbers: Mapping[str, float]  # a value for each of `MEASURES`, over what was flown; empty when not one period was
    # the entries of `quadsim.flight.metrics.settling`, one per step of the course
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
    """A way to compute the commands, timed on the queries of one flight."""

    name: str  # what it is called
    step_ms: Array  # (K,) time of the whole controller step in each period, the median of all repeats [ms]
    statuses: tuple[str, ...]  # K texts, what each step answered
    repeats: int  # how often each period was timed

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
    """The flights at one value of what is swept."""

    value: float  # that value
    constrained: Outcome  # the flight with constraints
    # median, percentiles and maximum of its controller's step [ms]; empty when not one period was flown
    step_ms: Mapping[str, float]
    unconstrained: Outcome | None = None  # the flight without them, where it depends on what is swept


@dataclass(frozen=True, kw_only=True)
class Sweep:
    """Flights that differ in one number."""

    name: str  # what is swept
    unit: str  # its unit
    base: float | None  # its value in the study's own flight; None where that has no one value
    points: tuple[SweepPoint, ...]  # in rising order of the value


@dataclass(frozen=True, kw_only=True)
class Variation:
    """The constrained flight with other values of the vehicle's parameters that the paper leaves out."""

    arm_length: float  # L [m]
    drag_to_thrust: float  # d/b [m]
    outcome: Outcome  # the flight


@dataclass(frozen=True, kw_only=True)
class CostStudy:
    """What constraints cost, and what they buy, on one course."""

    name: str  # of the constrained flight
    horizon: int  # N, of both flights
    deadline_ms: float  # the control period [ms]
    duration: float  # of the course [s]
    constrained: Outcome  # the flight with constraints
    unconstrained: Outcome  # the same course, weights and horizon, without them
    # compared flights of the course by unconstrained controllers with weights or a horizon of their own
    others: Mapping[str, Outcome]
    # settling of the filtered reference itself, had the vehicle followed it exactly
    reference: Sequence[Mapping[str, Any]]
    # timed on the queries of the constrained flight: the gain of the unconstrained optimum, the constrained controller
    # as it flew, and the QP in every period by one solver each
    candidates: tuple[CandidateTimes, ...]
    left_out: Mapping[str, str]  # solvers that could not take part, and what to do about it
    tilt: Sweep  # sweep of the bound on roll and pitch
    horizons: Sweep  # sweep of N
    variations: tuple[Variation, ...]  # over the parameters that the paper leaves out
    machine: Mapping[str, Any]  # what the times were measured on

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
