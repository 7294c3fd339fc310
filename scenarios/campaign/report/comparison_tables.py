"""Two campaigns compared -> tables, and all of it as Markdown."""

from __future__ import annotations

from quadsim.report.table import ABSENT, Cell, Grid, Mark, format_number, line, section
from scenarios.campaign.statistics.comparison import Comparison, EventComparison, MetricComparison
from scenarios.campaign.statistics.inference import ALPHA, CONFIDENCE
from scenarios.campaign.statistics.wording import label, p_value, percent, signed_interval, signed_points
from scenarios.schema.settings import shown

_SURE = f"{100.0 * CONFIDENCE:g} %"


def comparison_tables(comparison: Comparison) -> list[Grid]:
    """Events, and metrics."""
    return [_events(comparison), _metrics(comparison)]


def comparison_markdown(comparison: Comparison) -> str:
    """What differs, the verdict, and its tables."""
    head = f"# {comparison.names[1]} against {comparison.names[0]}\n"
    verdict = (comparison.sentence + "\n", *map(section, comparison_tables(comparison)))
    return "\n".join([head, pairing(comparison) + "\n", *map(section, difference_table(comparison)), *verdict])


def difference_table(comparison: Comparison) -> list[Grid]:
    """The fields in which the campaigns' scenarios and draws differ; no table where none does."""
    if not comparison.differences:
        return []
    lines = tuple(line(field, shown(a), shown(b)) for field, a, b in comparison.differences)
    return [Grid(key="differences", title="What differs", head=("field", *comparison.names), lines=lines)]


def pairing(comparison: Comparison) -> str:
    """What the pairs have in common, and what they have not."""
    phrase = f"Pairs have their seed in common, and all of {', '.join(comparison.shared_draws)}"
    if not comparison.shared_draws:
        phrase = "Pairs have their seed in common"
    if comparison.own_draws:
        phrase += f"; one campaign alone draws {', '.join(comparison.own_draws)}"
    if comparison.left_out:
        phrase += (
            f"; {comparison.left_out} flights of one alone, or with an incomplete flight in the pair, are left out"
        )
    if comparison.differences is not None:
        count = len(comparison.differences)
        fields = f"{count} fields" if count > 1 else "one field"
        phrase += f". The campaigns differ in {fields}" if count else ". The campaigns differ in no field"
    return f"{phrase}."


def _events(comparison: Comparison) -> Grid:
    a, b = comparison.names
    return Grid(
        key="events",
        title="Events",
        head=(
            *("event", a, b, f"{a} alone", f"{b} alone", "both"),
            *("p", "after Holm", "difference [points]", f"{_SURE} interval"),
        ),
        lines=tuple(_event(event) for event in comparison.events),
        note="p: McNemar's exact test, two-sided, on the pairs in which one alone had the event, each event by itself; "
        "the verdict is by that of failure. After Holm: corrected for all events of this table that one flight of a "
        f"pair alone had; bold: beyond chance at {100.0 * ALPHA:g} %. Difference: share of "
        f"{b} less that of {a}, in percentage points, with Tango's score interval (1998) for pairs.",
    )


def _event(event: EventComparison) -> tuple[Cell, ...]:
    counts = [f"{count} ({percent(count / event.pairs)})" for count in event.counts]
    pairs = map(str, (event.only_a, event.only_b, event.both))
    corrected = Cell(text=p_value(event.p_holm), mark=Mark.BEST if event.p_holm < ALPHA else Mark.NONE)
    difference = signed_points(event.difference), signed_interval(event.lower, event.upper)
    return line(event.event, *counts, *pairs, p_value(event.p), corrected, *difference)


def _metrics(comparison: Comparison) -> Grid:
    a, b = comparison.names
    return Grid(
        key="metrics",
        title="Metrics",
        head=(
            *("metric", f"{a}, mean", f"{b}, mean", "mean difference", f"{_SURE} interval"),
            *("median difference", f"{_SURE} interval", "pairs"),
        ),
        lines=tuple(_metric(metric) for metric in comparison.metrics),
        note=(
            f"Over the {comparison.completed} of {comparison.flights} pairs in which both flights were completed. "
            f"Differences are {b} less {a}; bold where the interval does not hold 0. Intervals: Student's t of the "
            "mean, order statistics of the median; each by itself, not corrected for how many there are. For "
            "worst_margin more is better, for all others less."
        ),
    )


def _metric(metric: MetricComparison) -> tuple[Cell, ...]:
    found = metric.difference
    return line(
        *(label(metric.name, metric.unit), format_number(metric.mean_a), format_number(metric.mean_b)),
        *_difference(found.mean, found.lower, found.upper),
        *_difference(found.median, found.median_lower, found.median_upper),
        str(found.pairs),
    )


def _difference(value: float | None, lower: float | None, upper: float | None) -> tuple[Cell, ...]:
    if lower is None or upper is None:
        return line(format_number(value), ABSENT)
    mark = Mark.BEST if lower > 0.0 or upper < 0.0 else Mark.NONE
    return line(Cell(text=format_number(value), mark=mark), f"{format_number(lower)} to {format_number(upper)}")
