"""A study of what constraints cost -> its tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from quadsim.controller import SOLVED, UNCONSTRAINED
from quadsim.flight.metrics import SETTLING_BAND, percentiles
from quadsim.report.table import ABSENT, Cell, Grid, Mark, format_number, line, section
from quadsim.state import Array
from scenarios.cost.study import MEASURES, CandidateTimes, CostStudy, Outcome, Sweep, SweepPoint


def cost_tables(study: CostStudy) -> list[Grid]:
    """What the study measured: computation, the two flights, both sweeps, and the sensitivity."""
    return [
        _flights(study),
        *([_computation(study)] if study.candidates else []),
        _sweep(study.tilt, "tilt", "How it moves with the bound on roll and pitch"),
        _sweep(study.horizons, "horizon", "How it moves with the horizon"),
        _sensitivity(study),
    ]


def cost_markdown(study: CostStudy, sentences: Sequence[str]) -> str:
    """Sentences and tables as Markdown."""
    return "\n".join(["".join(f"- {sentence}\n" for sentence in sentences), *map(section, cost_tables(study))])


def format_outcome(outcome: Outcome) -> str:
    """`completed`, or when the flight was lost."""
    return "completed" if outcome.completed else f"lost at {outcome.flown:g} s"


def format_step(entry: Mapping[str, Any]) -> str:
    """A step of the course, e.g. `x at 10 s`."""
    return f"{entry['channel']} at {entry['time']:g} s"


def slowest(outcome: Outcome) -> float | None:
    """The longest settling time of the steps in position [s]; None where the vehicle was lost or one did not settle."""
    times = [entry["settled"] for entry in outcome.settling if entry["channel"] != "yaw"]
    settled = [time for time in times if time is not None]
    return max(settled, default=None) if outcome.completed and len(settled) == len(times) else None


def format_slowest(outcome: Outcome) -> str:
    """The longest settling time of the steps in position, e.g. `5.05 s` or `never (2 of 6 steps)`."""
    times = [entry["settled"] for entry in outcome.settling if entry["channel"] != "yaw"]
    longest, never = slowest(outcome), times.count(None)
    if longest is not None:
        return f"{longest:g} s"
    return f"never ({never} of {len(times)} steps)" if outcome.completed and never else ABSENT


def _computation(study: CostStudy) -> Grid:
    lines = []
    for candidate in study.candidates:
        lines.append(_times(study, candidate.name, candidate.step_ms, candidate))
        parts = {"by the unconstrained optimum": candidate.shortcut, "with active constraints": ~candidate.shortcut}
        if 0 < candidate.shortcut.sum() < candidate.shortcut.size:
            for how, periods in parts.items():
                label = f"... its {periods.sum()} periods answered {how}"
                lines.append(_times(study, label, candidate.step_ms[periods]))
    repeats = sorted({candidate.repeats for candidate in study.candidates})
    note = (
        f"Whole controller step, Python included, on the same {study.candidates[0].step_ms.size} queries, recorded in "
        f"the constrained flight, timed as a flight sees them: between two steps the plant flies a period, and each is "
        f"the median of {' or '.join(map(str, repeats))} repeats. The rates are those at which 99 % of the steps, or "
        "all, would end within one period."
    )
    left_out = "".join(f" Left out: {name}, {why}." for name, why in study.left_out.items())
    return Grid(
        key="computation",
        title="Computation per step",
        head=(
            *("", "median [ms]", "p95 [ms]", "p99 [ms]", "max [ms]", f"max, of {study.deadline_ms:g} ms"),
            *("rate at p99 [Hz]", "rate at max [Hz]", "failures"),
        ),
        lines=tuple(lines),
        note=note + left_out,
    )


def _times(study: CostStudy, name: str, step_ms: Array, candidate: CandidateTimes | None = None) -> tuple[Cell, ...]:
    """A line of the table of computation; rates and failures are those of a whole candidate."""
    found = percentiles(step_ms)
    late = Mark.BAD if found["max"] > study.deadline_ms else Mark.NONE
    whole = [ABSENT] * 3
    if candidate is not None:
        rates = (format_number(float(f"{candidate.rate(measure):.3g}")) for measure in ("p99", "max"))
        whole = [*rates, str(candidate.failures)]
    measures = (f"{found[measure]:.3g}" for measure in ("p50", "p95", "p99", "max"))
    return line(name, *measures, Cell(text=f"{100.0 * found['max'] / study.deadline_ms:.3g} %", mark=late), *whole)


def _flights(study: CostStudy) -> Grid:
    with_them, without = study.constrained, study.unconstrained
    others = list(study.others.values())
    lines = [line("outcome", *map(format_outcome, (with_them, without)), ABSENT, ABSENT, *map(format_outcome, others))]
    for key, measure in MEASURES.items():
        values = [outcome.number(key) for outcome in (with_them, without, *others)]
        lines.append(_compared(f"{measure.label} [{measure.unit}]", values))
    for i, step in enumerate(with_them.settling):
        values = [outcome.settling[i]["settled"] for outcome in (with_them, without, *others)]
        alone = study.reference[i]["settled"]
        phrase = "" if alone is None else f" (filtered reference: {alone:g})"
        lines.append(_compared(f"settling, {format_step(step)} [s]{phrase}", values))
    return Grid(
        key="bounds",
        title="The same course with constraints and without",
        head=("", study.name, "without its constraints", "difference", "ratio", *study.others),
        lines=tuple(lines),
        note=(
            f"Both first columns have the same weights and horizon, N = {study.horizon}. Tilt is the larger of |roll| "
            f"and |pitch|. Settling: from the step of the unfiltered course until the output stays within "
            f"{100.0 * SETTLING_BAND:g} % of the step around its new value, for as long as the controller does not see "
            "the next step coming; - where it does not."
        ),
    )


def _compared(label: str, values: Sequence[float | None]) -> tuple[Cell, ...]:
    """Values with constraints, without, and of others, with difference and ratio of the first two."""
    first, second, *_ = values
    texts = [format_number(value) for value in values]
    difference = ratio = ABSENT
    if first is not None and second is not None:
        difference = _difference(first, second)
        ratio = f"{first / second:.3g}" if second else ABSENT
    return line(label, *texts[:2], difference, ratio, *texts[2:])


def _difference(first: float, second: float) -> str:
    """How much `first` is more than `second`; 0 where both are shown with the same digits."""
    if format_number(first) == format_number(second):
        return "0"
    return f"{'+' if first > second else ''}{format_number(float(f'{first - second:.4g}'))}"


def _sweep(sweep: Sweep, key: str, title: str) -> Grid:
    free = any(point.unconstrained is not None for point in sweep.points)
    head = (
        *(f"{sweep.name} [{sweep.unit}]", "outcome", "solved", "unconstrained", "held", "active [%]"),
        *("RMS x [m]", "RMS y [m]", "RMS z [m]", "settling", "tilt, samples [deg]", "tilt, plant [deg]"),
        *("total variation [rad/s]", "step p50 [ms]", "step p99 [ms]"),
        *(("without: outcome", "RMS x [m]", "tilt, plant [deg]", "total variation [rad/s]") if free else ()),
    )
    return Grid(
        key=f"{key}-sweep",
        title=title,
        head=head,
        lines=tuple(_point(sweep, point, free=free) for point in sweep.points),
        note=(
            "solved, unconstrained, held: periods whose optimum has active constraints, is the unconstrained one, "
            "and by an earlier plan where the QP has no solution. active: share of periods with an active constraint. "
            "settling: of the slowest step in x, y or z, judged until the controller sees the next one coming, which a "
            "longer horizon does sooner. step: timed in the same way, on the flight's own queries. Bold: the flight "
            "that is studied."
        ),
    )


def _point(sweep: Sweep, point: SweepPoint, *, free: bool) -> tuple[Cell, ...]:
    flown, without, settling = point.constrained, point.unconstrained, format_slowest(point.constrained)
    cells: list[Cell | str] = [
        Cell(text=f"{point.value:g}", mark=Mark.BEST if point.value == sweep.base else Mark.NONE),
        _outcome_cell(flown),
        *(str(flown.statuses.get(status, 0)) for status in (SOLVED, UNCONSTRAINED)),
        Cell(text=str(flown.fallbacks), mark=Mark.BAD if flown.fallbacks else Mark.NONE),
        f"{100.0 * flown.active / max(flown.periods, 1):.0f}",
        *(format_number(flown.number(key)) for key in ("rmse_x", "rmse_y", "rmse_z")),
        Cell(text=settling, mark=Mark.WARN if settling.startswith("never") else Mark.NONE),
        *(format_number(flown.number(key)) for key in ("tilt_sampled", "tilt_plant", "total_variation")),
        *(f"{point.step_ms[key]:.3g}" if point.step_ms else ABSENT for key in ("p50", "p99")),
    ]
    if free and without is not None:
        tracked = (format_number(without.number(key)) for key in ("rmse_x", "tilt_plant", "total_variation"))
        cells += [_outcome_cell(without), *tracked]
    return line(*cells)


def _outcome_cell(outcome: Outcome) -> Cell:
    return Cell(text=format_outcome(outcome), mark=Mark.NONE if outcome.completed else Mark.BAD)


def _sensitivity(study: CostStudy) -> Grid:
    outcomes = [variation.outcome for variation in study.variations]
    lines = [line("outcome", *map(format_outcome, outcomes), "")]
    for status in (SOLVED, UNCONSTRAINED):
        counts = [float(outcome.statuses.get(status, 0)) for outcome in outcomes]
        lines.append(_spread(f"periods {status}", counts))
    lines.append(_spread("periods held", [float(outcome.fallbacks) for outcome in outcomes]))
    for key, measure in MEASURES.items():
        lines.append(_spread(f"{measure.label} [{measure.unit}]", [outcome.number(key) for outcome in outcomes]))
    for i, step in enumerate(study.constrained.settling):
        settled = [outcome.settling[i]["settled"] for outcome in outcomes]
        lines.append(_spread(f"settling, {format_step(step)} [s]", settled))
    names = (f"L {variation.arm_length:g}, d/b {variation.drag_to_thrust:g}" for variation in study.variations)
    return Grid(
        key="sensitivity",
        title="How it moves with what the paper leaves out",
        head=(f"{study.name}, L [m], d/b [m]", *names, "largest - smallest"),
        lines=tuple(lines),
        note="L is the arm length, d/b the ratio of drag to thrust of a rotor.",
    )


def _spread(label: str, values: Sequence[float | None]) -> tuple[Cell, ...]:
    found = [value for value in values if value is not None]
    spread = _difference(max(found), min(found)).removeprefix("+") if found else ABSENT
    return line(label, *map(format_number, values), spread)
