"""The mismatch benchmark as plain values: the outcome of each controller in each condition."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from typing import Any, Final

from quadsim.report.table import ABSENT, Cell, Grid, Mark, format_number

DIVERGED: Final = 10.0
"""Distance from the reference at the end [m] from which on a flight counts as lost, though nothing ended it."""
OVERTURNED: Final = 90.0  # roll or pitch [deg] from which on a flight counts as lost, whatever came after
ARRIVED: Final = 0.05  # distance from the reference at the end [m] that counts as arrived
FAR: Final = 0.5  # the same that a reader should notice [m]
TILT_TOLERANCE: Final = 0.05
"""How far beyond its bound tilt may be before a reader should notice [deg]; the paper scenarios' own tolerance."""


@dataclass(frozen=True, kw_only=True)
class MismatchFlight:
    """The outcome of one flight; numbers are over what was flown, None where that is not one period."""

    reason: str | None  # why it ended early; None when it was completed
    flown: float  # time flown [s]
    rmse: Mapping[str, float] | None  # tracking error by axis x, y, z [m]
    end_error: float | None  # distance of the vehicle from the reference at the last sample [m]
    peak_tilt: float | None  # largest magnitude of roll or pitch at the physics rate [deg]
    violated: float  # time at the physics rate with roll or pitch beyond its bound, tolerance 0 [s]
    fallbacks: int  # periods not flown by the controller's own optimum
    # 99th percentile of the processor time of the controller's step [ms]; None where it was not timed
    step_p99: float | None

    @property
    def survived(self) -> bool:
        """Whether it was completed, never overturned, and ended near its reference."""
        if self.reason is not None or self.end_error is None or self.peak_tilt is None:
            return False
        return self.end_error <= DIVERGED and self.peak_tilt <= OVERTURNED

    @property
    def fate(self) -> str:
        """How it was lost, in a word or two; empty for one that survived."""
        if self.survived:
            return ""
        if self.reason is not None:
            return f"lost, {self.flown:.0f} s"
        return "overturned" if (self.peak_tilt or 0.0) > OVERTURNED else "diverged"


@dataclass(frozen=True, kw_only=True)
class MismatchBench:
    """Controllers by conditions on one course."""

    scenario: str  # whose course
    duration: float  # of each flight [s]
    tilt_bound: float  # of roll and pitch [deg]
    controllers: Mapping[str, str]  # what each one is, by its name
    conditions: Mapping[str, str]  # what each one is, by its name
    flights: Mapping[tuple[str, str], MismatchFlight]  # by controller and condition
    machine: Mapping[str, Any]  # what step times were measured on

    def to_json(self) -> dict[str, Any]:
        """Everything, as plain values; what a clock measured stands under `step_p99` alone."""
        flights = [
            {"controller": controller, "condition": condition, "survived": flight.survived, **asdict(flight)}
            for (controller, condition), flight in self.flights.items()
        ]
        return {**vars(self), "flights": flights}


def mismatch_tables(measured: MismatchBench) -> list[Grid]:
    """The tables of the benchmark."""
    bound = measured.tilt_bound
    return [
        _grid(
            measured,
            "end",
            "Distance from the reference at the end, m",
            _end,
            f"Lost: the flight was aborted at that time. Overturned: beyond {OVERTURNED:g} deg. Diverged: beyond "
            f"{DIVERGED:g} m at the end. Bold: at most {ARRIVED:g} m.",
        ),
        _grid(
            measured,
            "tilt",
            f"Peak tilt at the physics rate, deg; the bound is {bound:g}",
            lambda flight: _tilt(flight, bound),
            "The larger of |roll| and |pitch|. Bold: within the bound, tolerance 0.",
        ),
        _grid(
            measured,
            "violated",
            f"Time with roll or pitch beyond {bound:g} deg, s",
            lambda flight: Cell(text=format_number(flight.violated)),
            "At the physics rate, tolerance 0.",
        ),
        _grid(measured, "rmse", "RMS tracking errors x, y, z, m", _rmse, "Against the filtered reference."),
        _grid(
            measured,
            "fallbacks",
            "Periods not flown by the controller's own optimum",
            lambda flight: Cell(text=str(flight.fallbacks), mark=Mark.WARN if flight.fallbacks else Mark.NONE),
            "By an earlier plan or, deeper, by level hover.",
        ),
        _grid(
            measured,
            "step",
            "99th percentile of the controller's step, ms",
            lambda flight: Cell(text=ABSENT if flight.step_p99 is None else f"{flight.step_p99:.2f}"),
            "Processor time, in flights flown for it one process at a time, each step the median of three; "
            f"{ABSENT} where none was.",
        ),
    ]


def mismatch_legend(measured: MismatchBench) -> str:
    """What controllers and conditions are, as Markdown lists."""
    lines = ["Controllers:", ""]
    lines += [f"- **{name}**: {about}" for name, about in measured.controllers.items()]
    lines += ["", "Conditions:", ""]
    lines += [f"- **{name}**: {about}" for name, about in measured.conditions.items()]
    return "\n".join(lines) + "\n"


def _grid(measured: MismatchBench, key: str, title: str, cell: Callable[[MismatchFlight], Cell], note: str) -> Grid:
    def shown(flight: MismatchFlight) -> Cell:
        return cell(flight) if flight.survived else Cell(text=flight.fate, mark=Mark.BAD)

    lines = tuple(
        (Cell(text=condition), *(shown(measured.flights[controller, condition]) for controller in measured.controllers))
        for condition in measured.conditions
    )
    return Grid(key=key, title=title, head=("", *measured.controllers), lines=lines, note=note)


def _end(flight: MismatchFlight) -> Cell:
    assert flight.end_error is not None
    mark = Mark.BEST if flight.end_error <= ARRIVED else Mark.WARN if flight.end_error > FAR else Mark.NONE
    return Cell(text=f"{flight.end_error:.3f}", mark=mark)


def _tilt(flight: MismatchFlight, bound: float) -> Cell:
    assert flight.peak_tilt is not None
    tilt = flight.peak_tilt
    mark = Mark.BEST if tilt <= bound else Mark.WARN if tilt > bound + TILT_TOLERANCE else Mark.NONE
    return Cell(text=f"{tilt:.3f}" if abs(tilt - bound) < 1.0 else f"{tilt:.1f}", mark=mark)


def _rmse(flight: MismatchFlight) -> Cell:
    assert flight.rmse is not None
    return Cell(text=", ".join(f"{flight.rmse[axis]:.2f}" for axis in "xyz"))
