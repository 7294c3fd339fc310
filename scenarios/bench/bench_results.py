"""The measurements of `quadsim bench` as plain values."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, Final, NamedTuple

import numpy as np

from quadsim.flight import metrics
from quadsim.state import Array

FITTED_FROM: Final = 20  # N from which on the growth exponent is fitted: below, what every step costs hides what grows


class Target(NamedTuple):
    """A target, beside what was measured."""

    what: str  # the quantity
    required: str  # the target, in words
    measured: str  # the value, in words
    met: bool  # whether it is within the limit


@dataclass(frozen=True, kw_only=True)
class CandidateResult:
    """A controller timed on the queries of the flight's controller."""

    name: str  # what it is called
    solver: str  # its name in `mpc.solvers.SOLVERS`
    package: str  # the solver's distribution and its version
    shortcut: bool  # whether it tries less than the whole QP first; see `mpc.exact.shortcut`
    repeats: int  # how often each period was timed
    step_ms: Array  # (K,) whole controller step per period, the median of the repeats [ms]
    answered: tuple[str, ...]  # (K,) statuses
    raw_max_ms: float  # the longest of all steps of all repeats, the machine's stalls included [ms]
    statuses: Mapping[str, int]  # periods by what they were answered
    ways: Mapping[str, int]  # periods by how their optimum was found, or last looked for
    failures: int  # periods without an optimum
    input_error: float | None  # largest error of the first input over the periods answered [rad/s]; None without any
    kkt: float | None  # worst KKT residual of what it answered; None without any

    @property
    def quantiles(self) -> dict[str, float]:
        """`p50`, `p95`, `p99`, `max` [ms] over the periods."""
        return metrics.percentiles(self.step_ms)


@dataclass(frozen=True, kw_only=True)
class Growth:
    """How a candidate's step grows with the horizon."""

    name: str  # the candidate
    horizons: tuple[int, ...]  # N, as far as it went
    p50: tuple[float, ...]  # whole step at each N [ms]
    p99: tuple[float, ...]  # whole step at each N [ms]
    kind: str = ""  # which of its steps, by how their optimum was found; empty for all of them
    whole: bool = True  # whether these are steps that solve the whole QP
    # periods that the candidate left without their optimum, by the N at which it did
    failures: Mapping[int, int] = field(default_factory=dict)
    dropped: str = ""  # why it went no further; empty for one that reached the end

    @property
    def label(self) -> str:
        """The candidate, and which of its steps."""
        return f"{self.name}, by {self.kind}" if self.kind else self.name

    def exponent(self, quantile: str) -> float | None:
        """A in time ~ N^a, by least squares over the logarithms for N >= `FITTED_FROM`; None below three horizons."""
        N = np.array(self.horizons)
        times = np.array(self.p50 if quantile == "p50" else self.p99)[N >= FITTED_FROM]
        N = N[N >= FITTED_FROM]
        return float(np.polyfit(np.log(N), np.log(times), 1)[0]) if N.size >= 3 else None


@dataclass(frozen=True, kw_only=True)
class StageLength:
    """The QP alone, in one of its forms."""

    steps: int | None  # M, steps per stage; None for the condensed form
    variables: int  # of the QP
    p50: float  # time to update and solve it [ms]
    p99: float  # time to update and solve it [ms]
    default: bool  # whether it is the form that is flown


@dataclass(frozen=True, kw_only=True)
class SolverBench:
    """All candidates on one flight's queries, in one run."""

    scenario: str  # whose flight
    horizon: int  # N of that flight
    deadline_ms: float  # its control period [ms]
    asked: int  # periods timed, K
    flown: int  # periods of the flight
    candidates: tuple[CandidateResult, ...]  # the default controller first
    # (K,) whole step of the gain that the controller would be without its constraints [ms]; None where there is none
    gain_ms: Array | None
    left_out: Mapping[str, str]  # solvers that did not take part, and why
    growth: tuple[Growth, ...]  # of each candidate; empty where that was not measured
    growth_asked: int  # periods timed at each horizon
    stages: tuple[StageLength, ...]  # of the whole QP
    reference_kkt: float  # worst KKT residual of the optimum that first inputs are compared with
    versions: Mapping[str, str]  # of what the numbers depend on
    machine: Mapping[str, Any]  # what the times were measured on

    @property
    def default(self) -> CandidateResult:
        """The controller as scenarios fly it."""
        return self.candidates[0]

    def to_json(self) -> dict[str, Any]:
        """Everything, as plain values; a number that is none is null."""
        apart = ("candidates", "gain_ms", "growth", "stages")
        return {
            **{name: value for name, value in vars(self).items() if name not in apart},
            "gain_ms": None if self.gain_ms is None else metrics.percentiles(self.gain_ms),
            "contenders": [
                {
                    **{name: value for name, value in asdict(candidate).items() if name != "answered"},
                    "step_ms": candidate.quantiles,
                    "step_ms_by_period": np.round(candidate.step_ms, 5).tolist(),
                    "p99_to_default": candidate.quantiles["p99"] / self.default.quantiles["p99"],
                }
                for candidate in self.candidates
            ],
            "growth": [
                {**asdict(growth), "exponents": {name: growth.exponent(name) for name in ("p50", "p99")}}
                for growth in self.growth
            ],
            "stages": [asdict(stage) for stage in self.stages],
        }


@dataclass(frozen=True, kw_only=True)
class FlightProfile:
    """Where the time of a flight goes."""

    scenario: str  # what was flown
    solver: str  # by which solver; empty for a closed form
    duration: float  # simulated time of one flight [s]
    repeats: int  # flights
    cores: int | None  # cores that the process was held to; None where the system does not allow that
    # (repeats,) wall time of the closed loop of each flight, by an untouched plant and controller [s]
    wall_s: tuple[float, ...]
    # seconds of one flight by what they were spent on, the median over the repeats; they add up to the median flight
    # with clocks around its parts
    pieces: Mapping[str, float]
    setup_s: float  # building vehicle, plant, reference and controller [s]
    audit_s: float  # the audit after the flight [s]
    machine: Mapping[str, Any]  # what the times were measured on

    @property
    def best(self) -> float:
        """The quickest flight [s]."""
        return min(self.wall_s)

    @property
    def median(self) -> float:
        """The median flight [s]."""
        return float(np.median(self.wall_s))

    def to_json(self) -> dict[str, Any]:
        """Everything, as plain values."""
        return {**asdict(self), "best_s": self.best, "median_s": self.median}


@dataclass(frozen=True, kw_only=True)
class RenderProfile:
    """What a film costs."""

    scenario: str  # what was filmed
    backend: str  # how it was rendered, `egl` or `osmesa`
    width: int  # of a frame
    height: int  # of a frame
    fps: int  # frames per second of film
    frames: int  # filmed
    workers: int  # rendering processes
    wall_s: float  # from the run directory to the MP4 file, processes started and joined [s]
    start_s: float  # of which before the first frame: starting the processes and reading the run [s]
    machine: Mapping[str, Any]  # what the times were measured on

    @property
    def frame_ms(self) -> float:
        """Wall time per frame, all processes together, once they run [ms]."""
        return 1e3 * (self.wall_s - self.start_s) / self.frames

    def film_s(self, duration: float) -> float:
        """Wall time of a film of this many seconds [s], from the two numbers above."""
        return self.start_s + 1e-3 * self.frame_ms * math.ceil(duration * self.fps)

    def to_json(self) -> dict[str, Any]:
        """Everything, as plain values."""
        return {**asdict(self), "frame_ms": self.frame_ms, "film_of_60_s": self.film_s(60.0)}
