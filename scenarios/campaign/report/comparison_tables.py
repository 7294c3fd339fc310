"""Two campaigns compared -> tables, and all of it as Markdown."""

from __future__ import annotations

from quadsim.report.table import ABSENT, Cell, Grid, Mark, format_number, line, section
from scenarios.campaign.statistics.comparison import Comparison
from scenarios.campaign.statistics.inference import ALPHA, CONFIDENCE
from scenarios.campaign.statistics.wording import label, p_value, percent
from scenarios.schema.settings import shown


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
    phrase = f"Pairs share {', '.join(('their seed', *comparison.shared_draws))}"
    if comparison.own_draws:
        phrase += f"; one campaign alone draws {', '.join(comparison.own_draws)}"
    if comparison.left_out:
        phrase += f"; {comparison.left_out} flights are left out, as one of their pair is absent or incomplete"
    if comparison.differences is not None:
        phrase += f". Fields in which the campaigns differ: {len(comparison.differences)}"
    return f"{phrase}."


def _events(comparison: Comparison) -> Grid:
    a, b = comparison.names
    lines = []
    for event in comparison.events:
        counts = [f"{count} ({percent(count / event.pairs)})" for count in event.counts]
        pairs = map(str, (event.only_a, event.only_b, event.both))
        sure = Mark.BEST if event.p_holm < ALPHA else Mark.NONE
        if any(event.counts):
            corrected = Cell(text=p_value(event.p_holm), mark=sure)
            lines.append(line(event.event, *counts, *pairs, p_value(event.p), corrected))
    return Grid(
        key="events",
        title="Events",
        head=("event", a, b, f"{a} alone", f"{b} alone", "both", "p", "after Holm"),
        lines=tuple(lines),
        note="p: McNemar's exact test, two-sided, of each event by itself; the verdict is by that of failure. After "
        "Holm: corrected for all events that one flight of a pair alone had; bold: beyond chance at "
        f"{100.0 * ALPHA:g} %.",
    )


def _metrics(comparison: Comparison) -> Grid:
    a, b = comparison.names
    lines = []
    for metric in comparison.metrics:
        found, ends, mark = metric.difference, ABSENT, Mark.NONE
        if found.lower is not None and found.upper is not None:
            ends = f"{format_number(found.lower)} to {format_number(found.upper)}"
            mark = Mark.BEST if found.lower > 0.0 or found.upper < 0.0 else Mark.NONE
        means = map(format_number, (metric.mean_a, metric.mean_b))
        difference = Cell(text=format_number(found.mean), mark=mark)
        lines.append(line(label(metric.name, metric.unit), *means, difference, ends, str(found.pairs)))
    return Grid(
        key="metrics",
        title="Metrics",
        head=("metric", f"{a}, mean", f"{b}, mean", "mean difference", f"{100.0 * CONFIDENCE:g} % interval", "pairs"),
        lines=tuple(lines),
        note=f"Over the {comparison.completed} of {comparison.flights} pairs in which both flights were completed. "
        f"Differences are {b} less {a}; bold where Student's t interval does not hold 0.",
    )
