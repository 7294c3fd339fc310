"""Report of a campaign: its outcome in a sentence, tables and figures, and a page that works offline.

Everything is made from the summary of `statistics.estimate`; histograms and scatters also from the table of flights.
`campaign_lines` is for the console, `write_report` for the directory, `campaign_overview` for `campaign.png`.
"""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import pyarrow as pa

from quadsim.features.campaign.campaign_file import CampaignFile
from quadsim.features.campaign.events import ALL_SATISFIED, INCOMPLETE, UNAUDITED, VERDICTS, parse_event
from quadsim.features.campaign.rows import (
    DRAW,
    MARGIN,
    CampaignSummary,
    draw_names,
    is_number,
    numbers,
    texts,
    unit_of,
    verdicts,
)
from quadsim.features.campaign.statistics import ALPHA, Judgement, count_of, drivers, interval, label, p_value, percent
from quadsim.outputs import SUMMARY_FILE, optional
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
    without_rounding,
)
from quadsim.report.to_matplotlib import write_pngs
from quadsim.report.to_plotly import Plot, to_plot
from quadsim.state import Array

if TYPE_CHECKING:
    from rich.console import RenderableType


_TITLES: Final = {
    "events": "How often",
    "constraints": "Constraints",
    "metrics": "All metrics",
    "worst": "Worst flights",
    "worst-draws": "Their parameters",
    "drivers-table": "Which parameters matter",
    "groups": "Failures over each varied parameter",
}
_CONSOLE_LINES: Final = 8  # of a table on the console; the report has them all
_CONSOLE_WIDTH: Final = 60  # characters of a line's last cell on the console
_VERDICT_MARKS: Final = {ALL_SATISFIED: Mark.NONE, INCOMPLETE: Mark.WARN, UNAUDITED: Mark.WARN}  # of others: bad
_ALWAYS_LISTED: Final = ("failure", "violation", "lost")  # events that are listed even where they never happened


def campaign_lines(
    summary: CampaignSummary, judgements: Sequence[Judgement], directory: Path
) -> Iterator[RenderableType]:
    """Return the report for a console."""
    from quadsim.console import console

    where = console.short_path(directory)
    yield console.styled((summary["campaign"], "bold"), f": {verdict_sentence(summary)}")
    yield definition_sentence(summary, summary["failure"])
    if summary["parameters"]:
        yield driver_sentence(summary)
    tables = []
    for grid in (event_table(summary), constraint_table(summary), worst_table(summary, where)):
        if grid.lines:
            tables.append(_brief(grid))
    yield from console.grids(tables, left=("constraint", "reason"))
    if summary["worst"]:
        command = replay_command(where, summary["worst"][0]["flight"])
        yield console.styled("to fly one of them again: ", (command, "bold"))
    for judgement in judgements:
        colour = "green" if judgement.holds else "red"
        yield console.styled((judgement.sentence, colour))
    yield console.written_to(directory)
    if (directory / PAGE_FILE).exists():
        yield console.to_open(directory / PAGE_FILE)


def _brief(grid: Grid) -> Grid:
    """The first lines of a table, with a short last column."""
    lines = []
    for *cells, last in grid.lines[:_CONSOLE_LINES]:
        text = " ".join(last.text.split())
        if len(text) > _CONSOLE_WIDTH:
            text = f"{text[: _CONSOLE_WIDTH - 3]}..."
        lines.append((*cells, replace(last, text=text)))
    return replace(grid, note="", lines=tuple(lines))


def verdict_sentence(summary: CampaignSummary) -> str:
    """Return the failures with their confidence interval: `3 of 40 flights failed: 7.5 % (95 % interval: ...)`."""
    failure = summary["events"]["failure"]
    text = f"{failure['count']} of {count_of(failure['flights'], 'flight')} failed"
    if failure["flights"]:
        share, ends = _shares(failure)
        text += f": {share} ({100.0 * summary['confidence']:g} % interval: {ends})"
    verdicts = summary["verdicts"]
    for verdict in (INCOMPLETE, UNAUDITED):
        if summary["flights"] > failure["flights"] and verdicts.get(verdict):
            text += f"; {count_of(verdicts[verdict], f'{verdict} flight')} not counted"
    return text


def definition_sentence(summary: CampaignSummary, failure: Sequence[str]) -> str:
    """Return what counts as failure, and how many flights violated a constraint where that alone does not count."""
    units: dict[str, str] = {}
    for name, metric in summary["metrics"].items():
        units[name] = metric["unit"]
    for name, constraint in summary["constraints"].items():
        units[MARGIN + name] = constraint["unit"]
    events = [parse_event(text) for text in failure]
    listed = []
    for event in events:
        unit = units.get(event.column_name, "")
        listed.append(f"{event.text} {unit}".rstrip(" -"))
    sentence = f"Counted as failure: {', '.join(listed)}."
    violation = summary["events"]["violation"]
    violation_counts = any(event.text == "violation" for event in events)
    if violation["count"] and not violation_counts:
        flights = count_of(violation["flights"], "flight")
        sentence += f" A violation alone does not count: {violation['count']} of {flights} had one."
    return sentence


def driver_sentence(summary: CampaignSummary) -> str:
    """Return the parameters on which the worst margin, or else failure, depends significantly, strongest first."""
    if any(related["worst_margin"] for related in drivers(summary).values()):
        outcome = "worst_margin"
        noun = "The worst margin"
    else:
        outcome = "failed"
        noun = "Failure"
    listed = []
    for name, related in drivers(summary).items():
        measured = related[outcome]
        if measured and min(measured["p_holm"], measured["p_xi_holm"]) < ALPHA:
            listed.append(f"{name} (rho {measured['rho']:+.2f}, xi {measured['xi']:.2f})")
    if not listed:
        return f"{noun} depends on no varied parameter beyond chance."
    return f"{noun} depends on {', '.join(listed)}."


def _grid(key: str, head: Sequence[str], lines: Iterable[tuple[Cell, ...]], note: str = "") -> Grid:
    return Grid(key=key, title=_TITLES[key], head=tuple(head), lines=tuple(lines), note=note)


def event_table(summary: CampaignSummary) -> Grid:
    """Return the frequency of each event that happened."""
    level = f"{100.0 * summary['confidence']:g} %"
    head = ("event", "flights", "share", f"{level} interval", f"at least, with {level}", f"at most, with {level}")
    lines = []
    for name, share in summary["events"].items():
        if share["count"] or name in _ALWAYS_LISTED:
            at_least = percent(share["lower_one_sided"])
            at_most = percent(share["upper_one_sided"])
            lines.append(line(name, str(share["count"]), *_shares(share), at_least, at_most))
    note = (
        "Violation: a required constraint did not hold, or the flight was lost, raised an error or met a limit. Shares "
        "of failure and violation leave out incomplete flights, which ended before a required constraint was reached, "
        "and unaudited flights, which have no constraint. "
        "Intervals are Clopper-Pearson's, of independent draws; the last two "
        "columns are one-sided. Spread draws are more precise than that."
    )
    return _grid("events", head, lines, note)


def constraint_table(summary: CampaignSummary) -> Grid:
    """Return the number of violations and the worst margin of each constraint."""
    lines = []
    for name, constraint in summary["constraints"].items():
        not_held = constraint["not_satisfied"]
        mark = Mark.BAD if not_held["count"] else Mark.NONE
        margin = ABSENT
        flight = ABSENT
        if constraint["worst_margin"] is not None:
            unit = constraint["unit"]
            margin = f"{format_quantity(constraint['worst_margin'], unit)} {unit}"
            flight = str(constraint["worst_flight"])
        count = Cell(text=str(not_held["count"]), mark=mark)
        lines.append(line(name, count, *_shares(not_held), margin, flight))
    interval_head = f"{100.0 * summary['confidence']:g} % interval"
    head = ("constraint", "not held", "share", interval_head, "worst margin", "in flight")
    note = (
        "Margins are at the physics rate, without the tolerance; negative is beyond the bound. Shares are of the "
        "flights that reached the constraint or were lost before it; the latter did not hold it and have no margin."
    )
    return _grid("constraints", head, lines, note)


def metric_table(summary: CampaignSummary) -> Grid:
    """Return the distribution of every metric."""
    measures = ("mean", "sd", "min", "p5", "p50", "p95", "p99", "max")
    lines = []
    for name, metric in summary["metrics"].items():
        unit = metric["unit"]
        values = [format_quantity(metric[measure], unit) for measure in measures]
        lines.append(line(label(name, unit), *values, str(metric["flights"])))
    note = "Over the flights that have the number, lost ones, up to where they were aborted, included."
    return _grid("metrics", ("metric", *measures, "flights"), lines, note)


def worst_table(summary: CampaignSummary, directory: str) -> Grid:
    """Return the worst flights and the commands that replay them."""
    worst = summary["worst"]
    lines = []
    for flight in worst:
        verdict = Cell(text=flight["verdict"], mark=_VERDICT_MARKS.get(flight["verdict"], Mark.BAD))
        reason = Cell(text=flight["reason"] or ABSENT, mark=Mark.TEXT)
        margin, constraint = _worst_margin(summary, flight)
        duration = format_number(flight["duration"])
        lines.append(line(str(flight["flight"]), verdict, margin, constraint, duration, reason))
    note = "Lost flights first, then errors, limits, violations and the rest; among these, failed ones first, then "
    note += "the smaller worst margin as a share of half the band."
    if worst:
        note += f" To fly one of them again: {replay_command(directory, worst[0]['flight'])}"
    return _grid("worst", ("flight", "verdict", "worst margin", "constraint", "flown [s]", "reason"), lines, note)


def _worst_margin(summary: CampaignSummary, flight: Mapping[str, Any]) -> tuple[str, str]:
    """Return a flight's worst margin with its unit, and the constraint's name."""
    name = flight["worst_constraint"]
    if name is None:
        return ABSENT, ABSENT
    unit = summary["constraints"][name]["unit"]
    return f"{format_quantity(flight['margin'], unit)} {unit}", name


def worst_draws_table(summary: CampaignSummary) -> Grid:
    """Return the parameters of the worst flights, one column each."""
    worst = summary["worst"]
    flights = [str(flight["flight"]) for flight in worst]
    lines = []
    if worst:
        for name, parameter in summary["parameters"].items():
            values = [_drawn(flight["draws"][name]) for flight in worst]
            lines.append(line(label(name, parameter["unit"]), *values))
    return _grid("worst-draws", ("flight", *flights), lines)


def replay_command(directory: str, flight: int) -> str:
    """Return the command that replays a flight of a campaign."""
    return f"quadsim replay {shlex.quote(directory)} --flight {flight}"


def _drawn(value: Any) -> str:
    if isinstance(value, float):
        return format_number(value)
    return str(value)


def _shares(share: Mapping[str, Any]) -> tuple[str, str]:
    """Return a `proportion` and its interval as text."""
    return percent(share["share"]), interval(share["lower"], share["upper"])


def driver_table(summary: CampaignSummary) -> Grid:
    """Return how the worst margin and failure depend on each varied parameter."""
    head = ["varied parameter"]
    for outcome in ("worst margin", "failure"):
        head += [f"{outcome}: rho", f"{outcome}: after Holm", f"{outcome}: xi", f"{outcome}: after Holm"]
    lines = []
    for name, related in drivers(summary).items():
        with_margin = _dependence_cells(related["worst_margin"])
        with_failure = _dependence_cells(related["failed"])
        lines.append(line(label(name, related["unit"]), *with_margin, *with_failure))
    note = (
        "rho: Spearman's rank correlation. xi: Chatterjee's (2021), of any dependence, also of harm at both ends "
        "of a range. p-values are corrected by Holm's method for all of this table; bold: beyond chance at "
        f"{100.0 * ALPHA:g} %."
    )
    return _grid("drivers-table", head, lines, note)


def group_table(summary: CampaignSummary) -> Grid:
    """Return failures over each varied parameter, lowest values first; no lines if none or all flights failed."""
    failure = summary["events"]["failure"]
    cells: dict[str, list[str]] = {}
    if 0 < failure["count"] < failure["flights"]:
        for name, parameter in summary["parameters"].items():
            groups = _group_cells(parameter)
            if groups:
                cells[label(name, parameter["unit"])] = groups
    size = max(map(len, cells.values()), default=0)
    lines = []
    for name, groups in cells.items():
        missing = [ABSENT] * (size - len(groups))
        lines.append(line(name, *groups, *missing))
    head = ["varied parameter"]
    for k in range(size):
        head.append(f"group {k + 1}")
    note = "Share of failed flights among those with such values; groups are of about equal size, or by value where "
    note += f"there are few. Over all flights it is {percent(failure['share'])}."
    return _grid("groups", head, lines, note)


def _group_cells(parameter: Mapping[str, Any]) -> list[str]:
    """Return the share of failures for each level of a parameter, or for each group of its values."""
    cells = []
    for level, share in parameter.get("levels", {}).items():
        cells.append(f"{level}: {percent(share['share'])}")
    for group in parameter.get("groups", ()):
        low = format_number(group["low"])
        high = format_number(group["high"])
        if low == high:
            values = low
        else:
            values = f"{low} to {high}"
        cells.append(f"{values}: {percent(group['share'])}")
    return cells


def _dependence_cells(related: Mapping[str, Any] | None) -> tuple[Cell, ...]:
    """Return how an outcome depends on a parameter: rho, its p-value, xi, its p-value; bold beyond chance."""
    if related is None:
        return line(*[ABSENT] * 4)
    rho_mark = Mark.BEST if related["p_holm"] < ALPHA else Mark.NONE
    xi_mark = Mark.BEST if related["p_xi_holm"] < ALPHA else Mark.NONE
    rho = Cell(text=f"{related['rho']:+.2f}", mark=rho_mark)
    xi = Cell(text=f"{related['xi']:.2f}", mark=xi_mark)
    return line(rho, p_value(related["p_holm"]), xi, p_value(related["p_xi_holm"]))


_LINKED_FILES: Final = (
    "campaign.toml",
    "scenario.toml",
    "flights.parquet",
    "timing.parquet",
    SUMMARY_FILE,
    "manifest.json",
    "campaign.png",
)
"""Files that the page links to, if they exist."""
_HISTOGRAM_NOTE: Final = (
    "The worst margin is that of a flight's required constraints, as a share of half the "
    "constraint's band: 1 in the middle, 0 (dashed) at its bound, negative beyond. What is measured "
    "of a lost flight ends where it was aborted. Flights beyond an axis are in its end bars."
)
_SCATTER_NOTE: Final = "Triangles at the edges are flights beyond the axes; at the foot also those without a margin."


MAIN_METRICS: Final = (
    "worst_margin",
    "rmse.x",
    "rmse.y",
    "rmse.z",
    "rmse.yaw",
    "peak_tilt",
    "total_variation",
    "fallback_periods",
)
"""Metrics shown first."""
_MARGIN_LABEL: Final = "worst margin [half bands]"
_FEWEST_BINS: Final = 8
_MOST_BINS: Final = 40
_MOST_SCATTERS: Final = 3  # in the overview
_MOST_POINTS: Final = 9000  # of one verdict in all scatters of a page, which has a few MB then
_GAP: Final = 0.06  # from the axis' end to what is drawn at the edge, as a share of the axis
_FENCE: Final = 5.0  # quartile ranges beyond the quartiles up to which values are drawn where they are


def write_report(
    directory: Path, table: pa.Table, summary: CampaignSummary, spec: CampaignFile, *, campaign: Path | None = None
) -> Path:
    """Write `index.html` and `campaign.png` into a directory that is being made; the page.

    The page links to the files of `campaign`, the campaign's own directory where that is another, as its commands do.

    Raises:
        OutputError: the directory cannot be written.
    """
    campaign = campaign or directory
    sentence = verdict_sentence(summary)
    with optional("campaign.png"):
        figure = campaign_overview(table, summary, f"{spec.name}: {sentence}")
        write_pngs([figure] if figure.panels else [], directory)
    links = {}
    for name in _LINKED_FILES:
        exists = (directory / name).is_file() or (campaign / name).is_file()
        if exists or name == SUMMARY_FILE:
            links[name] = name
    page = render_page(
        "campaign",
        spec.name,
        _sections(table, summary, campaign),
        notes=_page_notes(summary, spec),
        verdict=Cell(text=sentence, mark=_page_mark(summary)),
        files=links,
    )
    (directory / PAGE_FILE).write_text(page, encoding="utf-8")
    return directory / PAGE_FILE


def _sections(table: pa.Table, summary: CampaignSummary, campaign: Path) -> list[Section]:
    """Return the parts of the page, in order."""
    driver_text: tuple[str, ...] = ()
    if summary["parameters"]:
        driver_text = (driver_sentence(summary),)
    return [
        Section(title="How often", tables=(event_table(summary), constraint_table(summary))),
        Section(
            title="Distributions",
            plots=_plots("metrics", "Flights by verdict", histograms(table), _HISTOGRAM_NOTE),
            folded=(metric_table(summary),),
        ),
        Section(
            title="What drives failure",
            text=driver_text,
            plots=_plots("scatter", "Worst margin over each parameter", scatters(table), _SCATTER_NOTE),
            tables=(driver_table(summary), group_table(summary)),
        ),
        Section(title="Worst flights", tables=(worst_table(summary, str(campaign)), worst_draws_table(summary))),
    ]


def _page_notes(summary: CampaignSummary, spec: CampaignFile) -> list[str]:
    """Return what the page says below its verdict."""
    if summary["flights"] == spec.flights:
        status = "complete"
    else:
        status = "stopped"
    notes = [definition_sentence(summary, spec.failure)]
    if spec.description:
        notes.append(spec.description)
    notes.append(f"Status: {status}, {summary['flights']} of {count_of(spec.flights, 'flight')} flown.")
    return notes


def _page_mark(summary: CampaignSummary) -> Mark:
    """Return the mark of the page's verdict."""
    if not summary["flights"]:
        return Mark.NONE
    if summary["events"]["failure"]["count"]:
        return Mark.BAD
    return Mark.GOOD


def _plots(key: str, title: str, panels: Sequence[Panel], note: str) -> tuple[Plot, ...]:
    """Return panels as one interactive plot; none without panels."""
    if panels:
        return (to_plot(Figure(key=key, title=title, panels=tuple(panels)), note=note),)
    return ()


def campaign_overview(table: pa.Table, summary: CampaignSummary, title: str) -> Figure:
    """Worst margins, or else the first metric that differs between flights, and the parameters that matter."""
    strongest = list(drivers(summary))

    def rank(name: str) -> int:
        if name in strongest:
            return strongest.index(name)
        return len(strongest)

    chosen = histograms(table)[:1]
    by_name = {}
    for panel in scatters(table):
        name, _, _unit = panel.x_label.partition(" [")
        by_name[name] = panel
    for name in sorted(by_name, key=rank)[:_MOST_SCATTERS]:
        chosen.append(by_name[name])
    panels = tuple(replace(panel, height=1.4) for panel in chosen)
    return Figure(key="campaign", title=title, panels=panels)


def histograms(table: pa.Table) -> list[Panel]:
    """Plot the distribution of the main metrics that differ between flights, by verdict."""
    panels = []
    for name in MAIN_METRICS:
        values = _without_rounding(table, name)
        finite = values[np.isfinite(values)]
        if finite.size >= 2 and np.ptp(finite) > 0.0:
            panels.append(_histogram(table, name, values, finite))
    return panels


def _histogram(table: pa.Table, name: str, values: Array, finite: Array) -> Panel:
    """Plot the distribution of a metric, (K,) and its finite values, as bars stacked by verdict."""
    edges = _bin_edges(finite)
    middles = 0.5 * (edges[:-1] + edges[1:])
    inside = np.clip(values, edges[0], edges[-1])
    below = np.zeros(edges.size - 1)
    bars = []
    for verdict, rows in verdicts(table).items():
        counts = np.histogram(inside[rows & np.isfinite(values)], edges)[0].astype(float)
        if counts.any():
            colour = VERDICTS[verdict].colour
            bars.append(Series(x=middles, y=counts, base=below, colour=colour, label=verdict, style="bars"))
        below = below + counts
    x_label = label(name, unit_of(table, name))
    bounds: tuple[Bound, ...] = ()
    if name == "worst_margin":
        x_label = _MARGIN_LABEL
        if edges[0] <= 0.0 <= edges[-1]:
            bounds = (Bound(value=0.0, vertical=True),)
    beyond = int(np.count_nonzero((finite < edges[0]) | (finite > edges[-1])))
    if beyond:
        x_label += f"; {beyond} beyond"
    return Panel(title="", x_label=x_label, y_label="flights", series=tuple(bars), bounds=bounds, whole=True)


def _bin_edges(finite: Array) -> Array:
    """Return the edges of a histogram's bins: whole multiples of their width, so that 0 is one where it is inside."""
    low, high = _ends(finite)
    bins = min(_MOST_BINS, max(_FEWEST_BINS, int(2.0 * np.sqrt(finite.size))))
    width = (high - low or 1.0) / bins
    return np.asarray(width * np.arange(np.floor(low / width), np.ceil(high / width) + 1.0))


def scatters(table: pa.Table) -> list[Panel]:
    """The worst margin of each flight over each varied parameter; triangles are beyond the axes, or have no margin."""
    margins = _without_rounding(table, "worst_margin")
    known = np.isfinite(margins)
    if not known.any():
        return []
    low, high = _ends(margins[known])
    # 0, the end of what is allowed, is among them
    low = min(0.0, low)
    high = max(0.0, high)
    y, beyond_y = _clip(np.where(known, margins, -np.inf), low, high, "down", "up")
    padding = 0.6 * _GAP * ((high - low) or 1.0)
    y_range = (float(y.min()) - padding, float(y.max()) + padding)
    names = draw_names(table)
    panels = []
    for name in names:
        values, levels = _drawn_values(table, name)
        x, beyond_x = _clip(values, *_ends(values[np.isfinite(values)]), "left", "right")
        beyond = np.where(beyond_y == "", beyond_x, beyond_y)
        panels.append(
            Panel(
                title="",
                x_label=label(name, unit_of(table, DRAW + name)),
                y_label="worst margin",
                series=tuple(_points(table, x, y, beyond, _MOST_POINTS // len(names))),
                bounds=(Bound(value=0.0),),
                x_names=levels,
                y_range=y_range,
            )
        )
    return panels


def _without_rounding(table: pa.Table, name: str) -> Array:
    """Return a metric (K,), with 0 where it is only rounding in its unit."""
    unit = unit_of(table, name)
    values = []
    for value in numbers(table, name):
        values.append(without_rounding(value, unit))
    return np.array(values, float)


def _drawn_values(table: pa.Table, name: str) -> tuple[Array, tuple[str, ...]]:
    """Return a parameter's values (K,) and its levels, empty for a number; a level's flights are spread about it."""
    if is_number(table, DRAW + name):
        return numbers(table, DRAW + name), ()
    drawn = texts(table, DRAW + name)
    levels = tuple(sorted(set(drawn)))
    spread = np.random.default_rng(0).uniform(-0.3, 0.3, drawn.size)  # the same every time
    return np.array([levels.index(value) for value in drawn], float) + spread, levels


def _points(table: pa.Table, x: Array, y: Array, beyond: np.ndarray, most: int) -> Iterator[Series]:
    """Yield the points of the flights, `most` of each verdict at most, with a marker for each edge they are beyond."""
    for verdict, flown in verdicts(table).items():
        rows = np.flatnonzero(flown)
        even = np.linspace(0.0, rows.size - 1.0, min(rows.size, most))
        rows = rows[np.unique(even.astype(int))]
        _, colour, symbol = VERDICTS[verdict]
        for edge in ("", "down", "up", "left", "right"):
            at_edge = rows[beyond[rows] == edge]
            if not at_edge.size:
                continue
            marker = symbol
            width = 3.5
            if edge:
                marker = f"triangle-{edge}"
                width = 5.0
            yield Series(
                x=x[at_edge],
                y=y[at_edge],
                flights=numbers(table, "flight")[at_edge],
                colour=colour,
                label=verdict,
                style="points",
                marker=marker,
                width=width,
                opacity=0.7,
            )


def _ends(finite: Array) -> tuple[float, float]:
    """Return the smallest and largest value without outliers."""
    q1, q3 = np.percentile(finite, [25, 75])
    reach = _FENCE * (q3 - q1) or np.inf
    inside = finite[(finite >= q1 - reach) & (finite <= q3 + reach)]
    return float(inside.min()), float(inside.max())


def _clip(values: Array, low: float, high: float, below: str, above: str) -> tuple[Array, np.ndarray]:
    """Values (K,) with those beyond the ends a little outside, and on which side each is; empty inside."""
    side = np.where(values < low, below, np.where(values > high, above, ""))
    gap = _GAP * ((high - low) or 1.0)
    return np.select([side == below, side == above], [low - gap, high + gap], values), side
