"""A study of what constraints cost -> a section of the comparison page, and its files beside the page."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Final

from quadsim.flight.metrics import percentiles
from quadsim.outputs import to_json
from quadsim.report.pages.comparison_page import CostSection
from quadsim.report.table import format_number
from scenarios.campaign.statistics.wording import listing
from scenarios.cost.cost_figures import write_cost_figures
from scenarios.cost.cost_plots import cost_plots
from scenarios.cost.cost_tables import cost_markdown, cost_tables, format_outcome, format_slowest
from scenarios.cost.study import MEASURES, CandidateTimes, CostStudy, Outcome, Sweep, SweepPoint

COST_FILE: Final = "cost.json"
COST_TABLES_FILE: Final = "cost.md"


def cost_section(study: CostStudy) -> Callable[[Path], CostSection]:
    """What `quadsim.report.pages.comparison_page.write_comparison` adds for a study.

    It writes `cost.json`, `cost.md` and the figures `cost_*.png` and `.svg` into the page's directory.
    """

    def write(directory: Path) -> CostSection:
        sentences = cost_sentences(study)
        (directory / COST_FILE).write_text(to_json(study.to_json()), encoding="utf-8")
        text = f"# What do constraints cost?\n\n{cost_markdown(study, sentences)}"
        (directory / COST_TABLES_FILE).write_text(text, encoding="utf-8")
        figures = [path for path in write_cost_figures(study, directory) if path.suffix == ".svg"]
        return CostSection(
            name=study.name,
            sentences=tuple(sentences),
            tables=tuple(cost_tables(study)),
            plots=tuple(cost_plots(study)),
            files=(
                (COST_FILE, COST_FILE),
                (COST_TABLES_FILE, COST_TABLES_FILE),
                *((f"figure: {path.stem}", path.name) for path in figures),
            ),
        )

    return write


def cost_sentences(study: CostStudy) -> list[str]:
    """The answer: what constraints cost in computation and tracking, what they buy, and how far that holds."""
    return [
        *_computation(study),
        *_tracking(study),
        *_settling(study),
        *_bought(study),
        *_sweep(study.tilt, "{:g} deg"),
        *_sweep(study.horizons, "N = {:g}"),
        *_variations(study),
    ]


def _computation(study: CostStudy) -> Iterator[str]:
    if not study.candidates:
        return
    gain, flown, *others = study.candidates
    free, found = percentiles(gain.step_ms), percentiles(flown.step_ms)
    yield (
        f"Computation: with constraints a step takes {_two(found['p50'])} ms in the median, {_two(found['p99'])} ms at "
        f"the 99th percentile and {_two(found['max'])} ms at most. That is {_times(found['p50'], free['p50'])} and "
        f"{_times(found['p99'], free['p99'])} what the gain of the unconstrained optimum takes in the median and at "
        f"the 99th percentile; the longest step is {100.0 * found['max'] / study.deadline_ms:.3g} % of the period of "
        f"{study.deadline_ms:g} ms, and enough for {_rate(flown)}."
    )
    shortcuts = int(flown.shortcut.sum())
    if 0 < shortcuts < flown.shortcut.size:
        quick, slow = (percentiles(flown.step_ms[periods])["p50"] for periods in (flown.shortcut, ~flown.shortcut))
        yield (
            f"In {shortcuts} of {flown.shortcut.size} periods the unconstrained optimum satisfies every constraint, "
            f"and is the answer after {_two(quick)} ms in the median; the others have active constraints and take "
            f"{_two(slow)} ms."
        )
    phrases = []
    for candidate in others:
        found, late = percentiles(candidate.step_ms), int((candidate.step_ms > study.deadline_ms).sum())
        times = f"{_two(found['p50'])} ms in the median and {_two(found['max'])} ms at most"
        too_late = f", {late} of its steps too late" if late else ""
        phrases.append(f"{candidate.name} {times}, {_rate(candidate)}{too_late}")
    if phrases:
        yield f"With the QP solved in every period: {'; '.join(phrases)}."


def _rate(candidate: CandidateTimes) -> str:
    return f"{_short(candidate.rate('max'))} Hz"


def _times(value: float, other: float) -> str:
    return f"{_short(value / other)} times"


def _tracking(study: CostStudy) -> Iterator[str]:
    with_them, without = study.constrained, study.unconstrained
    for outcome, what in ((with_them, "with its constraints"), (without, "without its constraints")):
        if not outcome.completed:
            yield f"{study.name} is {format_outcome(outcome)} {what}: {outcome.reason}."
    parts = []
    for key in ("rmse_x", "rmse_y", "rmse_z", "rmse_yaw"):
        first, second = with_them.number(key), without.number(key)
        if first is not None and second is not None:
            name = key.removeprefix("rmse_")
            parts.append(f"{name} {_short(first)} instead of {_short(second)} {MEASURES[key].unit}")
    if parts:
        yield f"Tracking: RMS error of {', '.join(parts)}, with the same weights and horizon."


def _settling(study: CostStudy) -> Iterator[str]:
    if not (study.constrained.completed and study.unconstrained.completed and study.constrained.settling):
        return
    flights = (study.constrained, study.unconstrained)
    channels = dict.fromkeys(entry["channel"] for entry in study.constrained.settling)
    parts = (f"{name} {' instead of '.join(_settling_of(flight, name) for flight in flights)}" for name in channels)
    yield f"Settling after the steps of the course: {', '.join(parts)}."


def _settling_of(outcome: Outcome, channel: str) -> str:
    """The settling times of a channel's steps, e.g. `4.05 to 4.15 s`, or `never` where one does not settle."""
    times = [entry["settled"] for entry in outcome.settling if entry["channel"] == channel]
    if None in times:
        return "never"
    low, high = (f"{time:g}" for time in (min(times), max(times)))
    return f"{low} s" if low == high else f"{low} to {high} s"


def _bought(study: CostStudy) -> Iterator[str]:
    bought: list[str] = []
    paid: list[str] = []
    for key in ("tilt_plant", "speed_max", "step_max", "total_variation"):
        first, second = study.constrained.number(key), study.unconstrained.number(key)
        if first is not None and second is not None:
            measure = MEASURES[key]
            phrase = f"{measure.label} {_short(first)} instead of {_short(second)} {measure.unit}"
            (bought if first < second else paid).append(phrase)
    for what, parts in (("What they buy", bought), ("What they do not make smaller", paid)):
        if parts:
            yield f"{what}: {', '.join(parts)}."
    for name, outcome in study.others.items():
        tilt, error = outcome.number("tilt_plant"), outcome.number("rmse_x")
        if tilt is not None and error is not None:
            yield (
                f"{name}, without constraints and tuned by weights and a horizon of its own, tilts by up to "
                f"{_short(tilt)} deg at an RMS error of {_short(error)} m in x."
            )


def _sweep(sweep: Sweep, form: str) -> Iterator[str]:
    """From one end of a sweep to the other, and where flights are lost or plans held; `form` is that of its values."""

    def label(point: SweepPoint) -> str:
        return form.format(point.value)

    flown = [point for point in sweep.points if point.constrained.completed]
    if len(flown) > 1:
        first, last = flown[0], flown[-1]
        parts = []
        for key in ("rmse_x", "total_variation"):
            values = [point.constrained.number(key) for point in (first, last)]
            start, end = (_short(value) for value in values if value is not None)
            parts.append(f"{MEASURES[key].label} goes from {start} to {end} {MEASURES[key].unit}")
        if first.step_ms and last.step_ms:
            parts.append(f"the median step from {_two(first.step_ms['p50'])} to {_two(last.step_ms['p50'])} ms")
        parts.append(
            f"the slowest settling in position from {format_slowest(first.constrained)} to "
            f"{format_slowest(last.constrained)}"
        )
        yield f"From {sweep.name} {label(first)} to {label(last)}: {', '.join(parts)}."
    with_them = [label(point) for point in sweep.points if not point.constrained.completed]
    without = [label(point) for point in sweep.points if point.unconstrained and not point.unconstrained.completed]
    if with_them:
        yield f"With constraints the vehicle is lost at {listing(with_them)}."
    if without:
        nowhere = "" if with_them else "; with them, nowhere"
        yield f"Without constraints the vehicle is lost at {listing(without)}{nowhere}."
    held = [point for point in sweep.points if point.constrained.fallbacks]
    if held:
        phrases = [f"{label(point)} ({point.constrained.fallbacks} periods)" for point in held]
        yield f"The QP has no solution, and an earlier plan is held, at {listing(phrases)}."


def _variations(study: CostStudy) -> Iterator[str]:
    lost = [v for v in study.variations if not v.outcome.completed]
    if lost:
        phrases = [f"L = {v.arm_length:g} m, d/b = {v.drag_to_thrust:g} m" for v in lost]
        yield f"The vehicle is lost at {'; '.join(phrases)}."
    parts = []
    for key in ("tilt_plant", "rmse_x", "rmse_z", "total_variation"):
        values = [value for v in study.variations if (value := v.outcome.number(key)) is not None]
        if values:
            low, high = format_number(min(values)), format_number(max(values))
            parts.append(f"{MEASURES[key].label} {low} to {high} {MEASURES[key].unit}")
    if parts:
        yield f"Over the arm lengths and drag ratios that the paper leaves open: {', '.join(parts)}."


def _two(value: float) -> str:
    return f"{float(f'{value:.2g}'):g}"


def _short(value: float) -> str:
    """Three significant digits, of a number of 1000 and more all before the point."""
    return f"{value:.0f}" if abs(value) >= 1e3 else f"{value:.3g}"
