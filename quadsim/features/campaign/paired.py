"""Two campaigns flown on the same draws: is the second significantly better?

Flights of one number have the same drawn values and random numbers, so they are compared in pairs: this detects
far smaller differences than two campaigns side by side would.  Events: McNemar's exact test, on the pairs in which one
flight alone had them; metrics: Student's t interval of the differences (`statistics`).  `quadsim compare` shows it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa

from quadsim.console.results import Shown, Tabular
from quadsim.errors import InputError
from quadsim.features.campaign.events import (
    EVENT_NAMES,
    INCOMPLETE,
    UNAUDITED,
    FlightFlags,
    parse_event,
    standard_forms,
)
from quadsim.features.campaign.rows import (
    DRAW,
    MARGIN,
    SAMPLED,
    SATISFIED,
    TIME_VIOLATED,
    VIOLATION,
    constraint_names,
    draw_names,
    failure_of,
    is_counted,
    not_held,
    numbers,
    reached,
    texts,
    unit_of,
)
from quadsim.features.campaign.statistics import (
    ALPHA,
    CONFIDENCE,
    FAILURE,
    PairedDifference,
    holm,
    label,
    mcnemar,
    p_value,
    paired_difference,
    percent,
)
from quadsim.outputs import to_json, writing
from quadsim.palette import COLOUR, line_colour
from quadsim.report.comparison import different_audits
from quadsim.report.comparison_page import TABLE_FILE
from quadsim.report.figure import Bound, Figure, Panel, Series
from quadsim.report.page import PAGE_FILE, Section, render_page
from quadsim.report.table import (
    ABSENT,
    Cell,
    Grid,
    Mark,
    format_number,
    format_quantity,
    line,
    section,
    without_rounding,
)
from quadsim.report.to_plotly import to_plot
from quadsim.scenarios.schema.settings import field_text

COMPARISON_FILE: Final = "comparison.json"
COMPARED: Final = (
    "rmse.x",
    "rmse.y",
    "rmse.z",
    "rmse.yaw",
    "max_error.x",
    "max_error.y",
    "max_error.z",
    "peak_tilt",
    "worst_margin",
    "total_variation",
    "fallback_periods",
)
"""Metrics that are compared, where both campaigns have them."""
_AUDIT_EVENTS: Final = (VIOLATION, INCOMPLETE, UNAUDITED)
"""Events that depend on what flights are audited against."""
_AUDIT_COLUMNS: Final = (MARGIN, SAMPLED, SATISFIED, TIME_VIOLATED, "worst_")
"""How the columns begin that depend on it."""
_POSITION_ERRORS: Final = {"rmse.x": "x", "rmse.y": "y", "rmse.z": "z"}
"""Axis of each metric that the sentence on tracking is about."""
_VERDICT_MARKS: Final = {
    "better": Mark.GOOD,
    "worse": Mark.BAD,
    "not distinguishable": Mark.NONE,
    "not comparable": Mark.WARN,
}
_EVENTS_DRAWN: Final = 8  # largest number of events in the figure
Differences = tuple[tuple[str, Any, Any], ...]
"""Fields, with the value of the first and of the second; None where it is absent."""


@dataclass(frozen=True, kw_only=True)
class EventComparison:
    """Numbers of pairs in which an event happened to both flights, to only one, and to none."""

    event: str
    both: int
    only_a: int
    only_b: int
    neither: int
    p: float  # two-sided, of McNemar's exact test
    p_holm: float  # corrected for all compared events that happened to one flight of a pair alone
    difference: float  # share of b - share of a

    @property
    def counts(self) -> tuple[int, int]:
        """Flights of the first and of the second campaign in which it happened."""
        return self.both + self.only_a, self.both + self.only_b

    @property
    def pairs(self) -> int:
        """Number of pairs; of a constraint, those of which both flights count for it (`rows.reached`)."""
        return self.both + self.only_a + self.only_b + self.neither


@dataclass(frozen=True, kw_only=True)
class MetricComparison:
    """A metric over the pairs in which both flights were completed and have it."""

    name: str
    unit: str
    mean_a: float | None  # None of no pairs
    mean_b: float | None
    difference: PairedDifference  # of the second less the first

    @property
    def is_beyond_chance(self) -> bool:
        """Whether the interval of the mean difference does not hold 0, nor what is only rounding."""
        difference = self.difference
        if difference.lower is None or difference.upper is None:
            return False
        lower = without_rounding(difference.lower, self.unit)
        upper = without_rounding(difference.upper, self.unit)
        return lower > 0.0 or upper < 0.0


@dataclass(frozen=True, kw_only=True, repr=False)
class PairedComparison(Tabular):
    """Comparison of two campaigns on the same draws."""

    names: tuple[str, str]  # of the first and the second campaign
    flights: int  # pairs
    left_out: int  # flights that only one of them has, or of whose pair one is incomplete
    completed: int  # pairs in which both flights were completed
    shared_draws: tuple[str, ...]  # parameters that both drew, alike in every pair
    own_draws: tuple[str, ...]  # parameters that only one of them drew
    differences: Differences | None  # fields in which their scenarios and draws differ; None where not known
    events: tuple[EventComparison, ...]  # failure, then every other event with a name, then each constraint not held
    metrics: tuple[MetricComparison, ...]
    audits: tuple[str, ...] = ()  # in what their constraints or tolerances differ
    page: Path | None = None  # of the report, where it was written

    @property
    def verdict(self) -> str:
        """The second campaign by its failures at a level of 5 %: `better`, `worse` or `not distinguishable`.

        `not comparable` if the audits differ and failure depends on them.
        """
        failure = self.events[0]
        if failure.event != FAILURE.text:
            return "not comparable"
        if failure.p >= ALPHA:
            return "not distinguishable"
        if failure.only_b < failure.only_a:
            return "better"
        return "worse"

    @property
    def sentence(self) -> str:
        """Return the verdict with its numbers."""
        a, b = self.names
        if self.verdict == "not comparable":
            return different_audits(a, b, self.audits)
        failure = self.events[0]
        failures_a, failures_b = failure.counts
        if self.verdict == "not distinguishable":
            phrase = f"{b} and {a} are not distinguishable by their failures"
        else:
            phrase = f"{b} is {self.verdict} than {a}"
        return (
            f"{phrase}: of {self.flights} paired flights, {failures_b} failed with {b} and {failures_a} "
            f"with {a} (McNemar's exact test, {p_value(failure.p)})."
        )

    @property
    def tracking(self) -> str:
        """Return in which axes the second campaign tracks closer or farther beyond chance; empty without errors."""
        axes: dict[str, list[str]] = {"closer": [], "farther": [], "not distinguishable": []}
        for metric in self.metrics:
            difference = metric.difference
            if metric.name not in _POSITION_ERRORS or difference.lower is None or difference.upper is None:
                continue
            axis = _POSITION_ERRORS[metric.name]
            errors = f"{format_number(metric.mean_b)} against {format_number(metric.mean_a)} {metric.unit}"
            if not metric.is_beyond_chance:
                axes["not distinguishable"].append(axis)
            elif difference.upper < 0.0:
                axes["closer"].append(f"{axis} ({errors})")
            else:
                axes["farther"].append(f"{axis} ({errors})")
        findings = []
        for verdict, listed in axes.items():
            if listed:
                findings.append(f"{verdict} in {', '.join(listed)}")
        if not findings:
            return ""
        return f"RMS error, where both flights were completed: {self.names[1]} is {'; '.join(findings)}."

    @property
    def pairing(self) -> str:
        """Return the common and the differing settings of the pairs."""
        phrase = f"Pairs share {', '.join(('their seed', *self.shared_draws))}"
        if self.own_draws:
            phrase += f"; one campaign alone draws {', '.join(self.own_draws)}"
        if self.left_out:
            phrase += f"; {self.left_out} flights are left out, as one of their pair is absent or incomplete"
        if self.differences is not None:
            phrase += f". Fields in which the campaigns differ: {len(self.differences)}"
        return f"{phrase}."

    @property
    def difference_tables(self) -> tuple[Grid, ...]:
        """Return the fields in which the campaigns' scenarios and draws differ; no table without differences.

        Fields that only one of them has, and files by their paths, come last.
        """
        if not self.differences:
            return ()
        lines = []
        for field, a, b in sorted(self.differences, key=_is_minor):
            lines.append(line(field, field_text(a), field_text(b)))
        head = ("field", *self.names)
        return (Grid(key="differences", title="What differs", head=head, lines=tuple(lines)),)

    @property
    def tables(self) -> tuple[Grid, Grid]:
        """Return the tables of events and metrics."""
        return _event_table(self), _metric_table(self)

    def shown(self) -> Shown:
        """See `Result.shown`."""
        from quadsim.console import console

        yield from self._answer()
        yield ""
        yield from console.grids(self.tables)
        yield self.pairing
        yield from console.grids(self.difference_tables)
        if self.page is not None:
            yield console.to_open(self.page)

    def _answer(self) -> list[str]:
        """Return the verdict on failures, and on tracking where it is known."""
        sentences = [self.sentence]
        if self.tracking:
            sentences.append(self.tracking)
        return sentences

    def small_plot(self) -> Figure | None:
        """See `Result.small_plot`: differences of the metrics with their intervals."""
        return metrics_figure(self)

    def records(self) -> list[dict[str, Any]]:
        """Return a row per event, its shares of the pairs, and per metric, its means; `p_holm` is of events alone."""
        return [*map(_event_row, self.events), *map(_metric_row, self.metrics)]

    def to_markdown(self) -> str:
        """Return verdict, tables and differences as Markdown."""
        parts = [f"# {self.names[1]} against {self.names[0]}\n"]
        for sentence in self._answer():
            parts.append(f"{sentence}\n")
        for table in self.tables:
            parts.append(section(table))
        parts.append(f"{self.pairing}\n")
        for table in self.difference_tables:
            parts.append(section(table))
        return "\n".join(parts)

    def write_report(self, directory: Path, *, overwrite: bool = False) -> Path:
        """Write `index.html`, `comparison.json` and `comparison.md`, together or not at all; the page.

        Raises:
            OutputError: the directory cannot be written, or holds something else.
        """
        plots = []
        for figure in (events_figure(self), metrics_figure(self)):
            if figure is not None:
                plots.append(to_plot(figure))
        sections = [
            Section(title="Which is better", plots=tuple(plots), tables=self.tables),
            Section(title="What is compared", text=(self.pairing,), tables=self.difference_tables),
        ]
        title = f"{self.names[1]} against {self.names[0]}"
        verdict, *notes = self._answer()
        links = {COMPARISON_FILE: COMPARISON_FILE, TABLE_FILE: TABLE_FILE}
        cell = Cell(text=verdict, mark=_VERDICT_MARKS[self.verdict])
        page = render_page("campaign comparison", title, sections, verdict=cell, notes=notes, files=links)
        texts = {COMPARISON_FILE: to_json(self.to_json()), TABLE_FILE: self.to_markdown(), PAGE_FILE: page}
        with writing(directory, overwrite=overwrite) as partial:
            for name, text in texts.items():
                (partial / name).write_text(text, encoding="utf-8")
        return directory / PAGE_FILE

    def to_json(self) -> dict[str, Any]:
        """Return plain data for a file; differences are second campaign minus first."""
        differences = None
        if self.differences is not None:
            differences = [{"field": name, "values": [a, b]} for name, a, b in self.differences]
        return {
            "names": list(self.names),
            "verdict": self.verdict,
            "sentence": self.sentence,
            "tracking": self.tracking,
            "confidence": CONFIDENCE,
            "flights": self.flights,
            "left_out": self.left_out,
            "completed": self.completed,
            "shared_draws": list(self.shared_draws),
            "own_draws": list(self.own_draws),
            "differences": differences,
            "events": {event.event: asdict(event) for event in self.events},
            "metrics": {metric.name: asdict(metric) for metric in self.metrics},
        }


def _event_row(event: EventComparison) -> dict[str, Any]:
    """Return an event's row of `PairedComparison.records`."""
    first, second = event.counts
    return {
        "kind": "event",
        "name": event.event,
        "unit": "-",
        "pairs": event.pairs,
        "first": first / event.pairs,
        "second": second / event.pairs,
        "difference": event.difference,
        "lower": None,
        "upper": None,
        "p_holm": event.p_holm,
    }


def _metric_row(metric: MetricComparison) -> dict[str, Any]:
    """Return a metric's row of `PairedComparison.records`."""
    difference = metric.difference
    return {
        "kind": "metric",
        "name": metric.name,
        "unit": metric.unit,
        "pairs": difference.pairs,
        "first": metric.mean_a,
        "second": metric.mean_b,
        "difference": difference.mean,
        "lower": difference.lower,
        "upper": difference.upper,
        "p_holm": None,
    }


def compare_pairs(
    table_a: pa.Table,
    table_b: pa.Table,
    names: tuple[str, str],
    failures: tuple[Sequence[str], Sequence[str]] | None = None,
    differences: Differences | None = None,
    audits: Sequence[str] = (),
) -> PairedComparison:
    """Compare two campaigns, pairing their flights by number.

    Args:
        table_a: `flights.parquet` of the first.
        table_b: of the second.
        names: of the first and the second; where they are the same, the comparison distinguishes them as such.
        failures: the events that each counts as failure; None where they are known to be the same.
        differences: see `quadsim.features.campaign.plan.plan_differences`; None where not known.
        audits: in what their constraints or tolerances differ: then margins are compared, and neither violations nor
            failures that count them.

    Raises:
        InputError: they count other events as failure, or have other constraints; they have no flight in common; or a
            pair differs in its seed or in a value that both drew.
    """
    if names[0] == names[1]:
        names = (f"{names[0]} (first)", f"{names[1]} (second)")
    if failures is not None:
        _require_same_failures(names, failures)
    a, b = _paired_flights(table_a, table_b, names)
    draws_a = draw_names(a)
    draws_b = draw_names(b)
    shared_draws = tuple(name for name in draws_a if name in draws_b)
    _require_same_draws(a, b, names, shared_draws)
    completed = (texts(a, "status") == "completed") & (texts(b, "status") == "completed")
    metrics = []
    for name in COMPARED:
        if name in a.column_names and name in b.column_names:
            metrics.append(_compare_metric(a, b, name, completed))
    return PairedComparison(
        names=names,
        flights=a.num_rows,
        left_out=table_a.num_rows + table_b.num_rows - 2 * a.num_rows,
        completed=int(completed.sum()),
        shared_draws=shared_draws,
        own_draws=tuple(sorted(set(draws_a) ^ set(draws_b))),
        differences=differences,
        audits=tuple(audits),
        events=_compare_events(a, b, audited_alike=not audits),
        metrics=tuple(metrics),
    )


def _require_same_failures(names: Sequence[str], failures: tuple[Sequence[str], Sequence[str]]) -> None:
    """Refuse campaigns that count different events as failure."""
    first = sorted(set(standard_forms(failures[0])))
    second = sorted(set(standard_forms(failures[1])))
    if first != second:
        raise InputError(
            f"{names[0]!r} counts {', '.join(first)} as failure, and {names[1]!r} {', '.join(second)}: only "
            "campaigns with the same failure events can be compared; fly one of them again with the other's"
        )


def _paired_flights(table_a: pa.Table, table_b: pa.Table, names: Sequence[str]) -> tuple[pa.Table, pa.Table]:
    """Return the flights that both campaigns have, in order, without pairs of which one is incomplete or unaudited."""
    shared = np.intersect1d(numbers(table_a, "flight"), numbers(table_b, "flight"))
    if not shared.size:
        raise InputError(f"campaigns {names[0]!r} and {names[1]!r} have no flight of one number: nothing can be paired")
    a = table_a.filter(np.isin(numbers(table_a, "flight"), shared)).sort_by("flight")
    b = table_b.filter(np.isin(numbers(table_b, "flight"), shared)).sort_by("flight")
    complete = is_counted(a, FAILURE) & is_counted(b, FAILURE)
    if not complete.any():
        raise InputError(
            f"campaigns {names[0]!r} and {names[1]!r} have no pair of flights of which both reached every required "
            "constraint: fly them for longer"
        )
    return a.filter(complete), b.filter(complete)


def _require_same_draws(a: pa.Table, b: pa.Table, names: Sequence[str], shared_draws: Sequence[str]) -> None:
    """Refuse a pair of flights that differ in their seed, or in a value that both campaigns drew."""
    flights = a["flight"].to_pylist()
    for column in ("seed", *(DRAW + name for name in shared_draws)):
        for flight, value_a, value_b in zip(flights, a[column].to_pylist(), b[column].to_pylist(), strict=True):
            if value_a != value_b:
                raise InputError(
                    f"flight {flight} of {names[0]!r} has {column} = {value_a!r}, and of {names[1]!r} {value_b!r}: "
                    "only campaigns of one seed and the same draws can be compared in pairs; fly one of them again "
                    "with the other's seed, sampling and [[vary]]"
                )


def _compare_events(a: pa.Table, b: pa.Table, *, audited_alike: bool) -> tuple[EventComparison, ...]:
    """Every event with its test, corrected for all of them but those that no flight of a pair had alone.

    These have a p-value of 1 whatever the others are, so that there is nothing to correct for (Tarone, 1990).
    """
    happened = _happened(a, b, audited_alike=audited_alike)
    only_a = {}
    only_b = {}
    p = {}
    tested = {}
    for event, (in_a, in_b) in happened.items():
        only_a[event] = int((in_a & ~in_b).sum())
        only_b[event] = int((in_b & ~in_a).sum())
        p[event] = mcnemar(only_a[event], only_b[event])
        if only_a[event] or only_b[event]:
            tested[event] = p[event]
    p_holm = dict(zip(tested, holm([*tested.values()]), strict=True))
    comparisons = []
    for event, (in_a, in_b) in happened.items():
        comparisons.append(
            EventComparison(
                event=event,
                both=int((in_a & in_b).sum()),
                only_a=only_a[event],
                only_b=only_b[event],
                neither=int((~in_a & ~in_b).sum()),
                p=p[event],
                p_holm=p_holm.get(event, 1.0),
                difference=(only_b[event] - only_a[event]) / in_a.size,
            )
        )
    return tuple(comparisons)


def _happened(a: pa.Table, b: pa.Table, *, audited_alike: bool) -> dict[str, tuple[FlightFlags, FlightFlags]]:
    """Return to which flights of either campaign each event happened.

    Events that depend on the audit are left out unless both campaigns were audited alike.  A constraint is compared
    over the pairs of which both flights count for it (`rows.reached`), and left out where there is none.
    """
    left_out: set[str] = set()
    if not audited_alike:
        left_out.update(_AUDIT_EVENTS)
        if any(_depends_on_audit(event) for event in failure_of(a)):
            left_out.add(FAILURE.text)
    happened = {}
    for name in EVENT_NAMES:
        if name not in left_out:
            event = parse_event(name)
            happened[name] = (event.column(a), event.column(b))
    if audited_alike:
        for name in constraint_names(a):
            both = reached(a, name) & reached(b, name)
            if both.any():
                happened[f"{name} not held"] = (not_held(a, name)[both], not_held(b, name)[both])
    return happened


def _depends_on_audit(event: str) -> bool:
    """Return whether an event depends on what flights are audited against."""
    return event in _AUDIT_EVENTS or parse_event(event).column_name.startswith(_AUDIT_COLUMNS)


def _compare_metric(a: pa.Table, b: pa.Table, name: str, completed: FlightFlags) -> MetricComparison:
    first = numbers(a, name)
    second = numbers(b, name)
    valid = completed & np.isfinite(first) & np.isfinite(second)
    first = first[valid]
    second = second[valid]
    return MetricComparison(
        name=name,
        unit=unit_of(a, name),
        mean_a=float(first.mean()) if first.size else None,
        mean_b=float(second.mean()) if second.size else None,
        difference=paired_difference(first, second),
    )


def _event_table(comparison: PairedComparison) -> Grid:
    a, b = comparison.names
    lines = []
    for event in comparison.events:
        if not any(event.counts):
            continue
        counts = [f"{count} ({percent(count / event.pairs)})" for count in event.counts]
        pairs = [str(event.only_a), str(event.only_b), str(event.both)]
        mark = Mark.BEST if event.p_holm < ALPHA else Mark.NONE
        corrected = Cell(text=p_value(event.p_holm), mark=mark)
        lines.append(line(event.event, *counts, *pairs, p_value(event.p), corrected))
    return Grid(
        key="events",
        title="Events",
        head=("event", a, b, f"{a} alone", f"{b} alone", "both", "p", "after Holm"),
        lines=tuple(lines),
        note="Shares are of all pairs; of a constraint not held, of those of which both flights reached it or were "
        "lost before it. p: McNemar's exact test, two-sided, of each event by itself; the verdict is by that of "
        "failure. After Holm: corrected for all events that one flight of a pair alone had; bold: beyond chance at "
        f"{100.0 * ALPHA:g} %.",
    )


def _metric_table(comparison: PairedComparison) -> Grid:
    a, b = comparison.names
    lines = []
    for metric in comparison.metrics:
        difference = metric.difference
        if not difference.pairs:
            continue
        unit = metric.unit
        mark = Mark.BEST if metric.is_beyond_chance else Mark.NONE
        interval = ABSENT
        if difference.lower is not None and difference.upper is not None:
            interval = f"{format_quantity(difference.lower, unit)} to {format_quantity(difference.upper, unit)}"
        lines.append(
            line(
                label(metric.name, unit),
                format_quantity(metric.mean_a, unit),
                format_quantity(metric.mean_b, unit),
                Cell(text=format_quantity(difference.mean, unit), mark=mark),
                interval,
                str(difference.pairs),
            )
        )
    return Grid(
        key="metrics",
        title="Metrics",
        head=("metric", f"{a}, mean", f"{b}, mean", "mean difference", f"{100.0 * CONFIDENCE:g} % interval", "pairs"),
        lines=tuple(lines),
        note=f"Over the {comparison.completed} of {comparison.flights} pairs in which both flights were completed. "
        f"Differences are {b} less {a}; bold where Student's t interval does not hold 0.",
    )


def _is_minor(difference: tuple[str, Any, Any]) -> bool:
    """Return whether one of the campaigns lacks a field, or its values are paths of a machine."""
    _field, first, second = difference
    return _is_absent_or_path(first) or _is_absent_or_path(second)


def _is_absent_or_path(value: Any) -> bool:
    return value is None or (isinstance(value, str) and Path(value).is_absolute())


_DIRECTION_COLOURS: Final = {
    "better": COLOUR.satisfied,
    "worse": COLOUR.violated,
    "not beyond chance": COLOUR.measured,
}


def _direction(metric: MetricComparison, mean_difference: float) -> str:
    """Return whether the second campaign is better or worse in a metric, beyond chance."""
    if not metric.is_beyond_chance:
        return "not beyond chance"
    if metric.name == "worst_margin":  # the larger, the better; of all others the smaller
        mean_difference = -mean_difference
    if mean_difference < 0.0:
        return "better"
    return "worse"


def metrics_figure(comparison: PairedComparison) -> Figure | None:
    """Plot the metrics' differences, with intervals, as shares of the first campaign's means; None without any."""
    names: list[str] = []
    curves: list[Series] = []
    for metric in comparison.metrics:
        difference = metric.difference
        if not metric.mean_a or difference.mean is None or difference.lower is None or difference.upper is None:
            continue
        scale = 100.0 / abs(metric.mean_a)
        place = np.array([float(len(names))])
        label = _direction(metric, difference.mean)
        colour = _DIRECTION_COLOURS[label]
        ends = scale * np.array([difference.lower, difference.upper])
        mean = scale * np.array([difference.mean])
        curves.append(Series(x=np.repeat(place, 2), y=ends, colour=colour, width=2.0))
        curves.append(Series(x=place, y=mean, colour=colour, label=label, style="points", width=6.0))
        names.append(metric.name)
    if not names:
        return None
    a, b = comparison.names
    level = 100.0 * CONFIDENCE
    title = f"{b} less {a}, in % of {a}'s mean, with {level:g} % interval"
    panel = Panel(
        title=title,
        y_label="difference [%]",
        x_label="metric",
        x_names=tuple(names),
        series=tuple(curves),
        bounds=(Bound(value=0.0),),
        height=1.3,
    )
    return Figure(key="metrics", title="Tracking and commands", panels=(panel,), columns=1)


def events_figure(comparison: PairedComparison) -> Figure | None:
    """Plot the shares of the pairs in which events happened to each campaign's flight; None where none did."""
    happened = []
    for event in comparison.events:
        if any(event.counts):
            happened.append(event)
    if not happened:
        return None
    happened = happened[:_EVENTS_DRAWN]
    curves = []
    for i, name in enumerate(comparison.names):
        shares = np.array([100.0 * event.counts[i] / event.pairs for event in happened])
        places = np.arange(len(happened), dtype=np.float64) + 0.2 * (i - 0.5)
        curves.append(Series(x=places, y=shares, colour=line_colour(i), label=name, style="points", width=6.0))
    panel = Panel(
        title="share of the pairs",
        y_label="share [%]",
        x_label="event",
        series=tuple(curves),
        x_names=tuple(event.event for event in happened),
        whole=True,
        height=1.3,
    )
    return Figure(key="events", title="Failures and other events", panels=(panel,), columns=1)
