"""Report of a campaign: outcome in a sentence, tables, figure, and a page that works offline."""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import pyarrow as pa

from quadsim.features.campaign.campaign_file import CampaignFile
from quadsim.features.campaign.events import HARMLESS, INCOMPLETE, UNAUDITED, VERDICTS, parse_event
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
from quadsim.report.table import ABSENT, Cell, Grid, Mark, format_number, line
from quadsim.report.to_matplotlib import write_pngs
from quadsim.report.to_plotly import Plot, to_plot
from quadsim.state import Array

if TYPE_CHECKING:
    from rich.console import RenderableType


_TITLES: Final = {
    **{"events": "How often", "constraints": "Constraints", "metrics": "All metrics", "worst": "Worst flights"},
    **{"worst-draws": "Their parameters", "drivers-table": "Which parameters matter"},
    "groups": "Failures over each varied parameter",
}
_MOST_LINES: Final = 8  # of a table on the console; the report has them all
_MARKS: Final = {HARMLESS: Mark.NONE, INCOMPLETE: Mark.WARN, UNAUDITED: Mark.WARN}
_ENDS: Final = ("lower", "upper")
_ALWAYS: Final = ("failure", "violation", "lost")  # events that are listed even where they never happened


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
    tables = [event_table(summary), constraint_table(summary), worst_table(summary, where)]
    yield from console.grids([_brief(grid) for grid in tables if grid.lines], left=("constraint", "reason"))
    if summary["worst"]:
        command = replay_command(where, summary["worst"][0]["flight"])
        yield console.styled("to fly one of them again: ", (command, "bold"))
    for judgement in judgements:
        yield console.styled((judgement.sentence, "green" if judgement.holds else "red"))
    yield console.written_to(directory)
    if (directory / PAGE_FILE).exists():
        yield console.to_open(directory / PAGE_FILE)


def _brief(grid: Grid) -> Grid:
    """The first lines of a table, with a short last column."""
    ends = [(line, " ".join(line[-1].text.split())) for line in grid.lines[:_MOST_LINES]]
    lines = []
    for row, end in ends:
        lines.append((*row[:-1], replace(row[-1], text=end if len(end) <= 60 else f"{end[:57]}...")))
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
    units = {name: metric["unit"] for name, metric in summary["metrics"].items()}
    units |= {MARGIN + name: constraint["unit"] for name, constraint in summary["constraints"].items()}
    events = [parse_event(text) for text in failure]
    violation = summary["events"]["violation"]
    listed = []
    for text in (f"{event.text} {units.get(event.column_name, '')}" for event in events):
        listed.append(text.rstrip(" -"))
    sentence = f"Counted as failure: {', '.join(listed)}."
    if violation["count"] and "violation" not in (event.text for event in events):
        flights = count_of(violation["flights"], "flight")
        sentence += f" A violation alone does not count: {violation['count']} of {flights} had one."
    return sentence


def driver_sentence(summary: CampaignSummary) -> str:
    """Return the parameters on which the worst margin, or else failure, depends significantly, strongest first."""
    if any(related["worst_margin"] for related in drivers(summary).values()):
        outcome = "worst_margin"
    else:
        outcome = "failed"
    sure = {}
    for name, related in drivers(summary).items():
        if related[outcome] and min(related[outcome]["p_holm"], related[outcome]["p_xi_holm"]) < ALPHA:
            sure[name] = related[outcome]
    if outcome == "worst_margin":
        noun = "The worst margin"
    else:
        noun = "Failure"
    listed = ", ".join(f"{name} (rho {related['rho']:+.2f}, xi {related['xi']:.2f})" for name, related in sure.items())
    return f"{noun} depends on {listed or 'no varied parameter beyond chance'}."


def _grid(key: str, head: Sequence[str], lines: Iterable[tuple[Cell, ...]], note: str = "") -> Grid:
    return Grid(key=key, title=_TITLES[key], head=tuple(head), lines=tuple(lines), note=note)


def event_table(summary: CampaignSummary) -> Grid:
    """Return the frequency of each event that happened."""
    sure = f"{100.0 * summary['confidence']:g} %"
    head = ("event", "flights", "share", f"{sure} interval", f"at least, with {sure}", f"at most, with {sure}")
    lines = (
        line(name, str(share["count"]), *_shares(share), *(percent(share[f"{end}_one_sided"]) for end in _ENDS))
        for name, share in summary["events"].items()
        if share["count"] or name in _ALWAYS
    )
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
    sure = f"{100.0 * summary['confidence']:g} % interval"
    lines = []
    for name, constraint in summary["constraints"].items():
        failed = constraint["not_satisfied"]
        worst = (ABSENT, ABSENT)
        if constraint["worst_margin"] is not None:
            worst = f"{format_number(constraint['worst_margin'])} {constraint['unit']}", str(constraint["worst_flight"])
        count = Cell(text=str(failed["count"]), mark=Mark.BAD if failed["count"] else Mark.NONE)
        lines.append(line(name, count, *_shares(failed), *worst))
    head = ("constraint", "not held", "share", sure, "worst margin", "in flight")
    note = (
        "Margins are at the physics rate, without the tolerance; negative is beyond the bound. Shares are of the "
        "flights that reached the constraint or were lost before it; the latter did not hold it and have no margin."
    )
    return _grid("constraints", head, lines, note)


def metric_table(summary: CampaignSummary) -> Grid:
    """Return the distribution of every metric."""
    measures = ("mean", "sd", "min", "p5", "p50", "p95", "p99", "max")
    lines = (
        line(label(name, metric["unit"]), *(format_number(metric[m]) for m in measures), str(metric["flights"]))
        for name, metric in summary["metrics"].items()
    )
    note = "Over the flights that have the number, lost ones, up to where they were aborted, included."
    return _grid("metrics", ("metric", *measures, "flights"), lines, note)


def worst_table(summary: CampaignSummary, directory: str) -> Grid:
    """Return the worst flights and the commands that replay them."""
    worst = summary["worst"]
    lines = (
        line(
            str(flight["flight"]),
            Cell(text=flight["verdict"], mark=_MARKS.get(flight["verdict"], Mark.BAD)),
            *_worst_margin(summary, flight),
            format_number(flight["duration"]),
            Cell(text=flight["reason"] or ABSENT, mark=Mark.TEXT),
        )
        for flight in worst
    )
    note = "Lost flights first, then errors, limits, violations and the rest; among these, failed ones first, then "
    note += "the smaller worst margin as a share of half the band."
    if worst:
        note += f" To fly one of them again: {replay_command(directory, worst[0]['flight'])}"
    return _grid("worst", ("flight", "verdict", "worst margin", "constraint", "flown [s]", "reason"), lines, note)


def _worst_margin(summary: CampaignSummary, flight: Mapping[str, Any]) -> tuple[str, str]:
    name = flight["worst_constraint"]
    if name is None:
        return ABSENT, ABSENT
    return f"{format_number(flight['margin'])} {summary['constraints'][name]['unit']}", name


def worst_draws_table(summary: CampaignSummary) -> Grid:
    """Return the parameters of the worst flights, one column each."""
    worst = summary["worst"]
    lines = (
        line(label(name, parameter["unit"]), *(_drawn(flight["draws"][name]) for flight in worst))
        for name, parameter in summary["parameters"].items()
    )
    return _grid("worst-draws", ("flight", *(str(flight["flight"]) for flight in worst)), lines if worst else ())


def replay_command(directory: str, flight: int) -> str:
    """Return the command that replays a flight of a campaign."""
    return f"quadsim replay {shlex.quote(directory)} --flight {flight}"


def _drawn(value: Any) -> str:
    if isinstance(value, float):
        return format_number(value)
    return str(value)


def _shares(share: Mapping[str, Any]) -> tuple[str, str]:
    return percent(share["share"]), interval(share["lower"], share["upper"])


def driver_table(summary: CampaignSummary) -> Grid:
    """Return how the worst margin and failure depend on each varied parameter."""
    lines = (
        line(label(name, related["unit"]), *_association(related["worst_margin"]), *_association(related["failed"]))
        for name, related in drivers(summary).items()
    )
    measures = ("rho", "after Holm", "xi", "after Holm")
    head = ("varied parameter", *(f"{of}: {measure}" for of in ("worst margin", "failure") for measure in measures))
    note = (
        "rho: Spearman's rank correlation. xi: Chatterjee's (2021), of any dependence, also of harm at both ends "
        "of a range. p-values are corrected by Holm's method for all of this table; bold: beyond chance at "
        f"{100.0 * ALPHA:g} %."
    )
    return _grid("drivers-table", head, lines, note)


def group_table(summary: CampaignSummary) -> Grid:
    """Return failures over each varied parameter, lowest values first; no lines if none or all flights failed."""
    failure = summary["events"]["failure"]
    listed = {}
    for name, parameter in summary["parameters"].items() if 0 < failure["count"] < failure["flights"] else ():
        levels = []
        for level, share in parameter.get("levels", {}).items():
            levels.append(f"{level}: {percent(share['share'])}")
        if cells := levels + [_group(group) for group in parameter.get("groups", ())]:
            listed[label(name, parameter["unit"])] = cells
    size = max(map(len, listed.values()), default=0)
    lines = (line(name, *cells, *[ABSENT] * (size - len(cells))) for name, cells in listed.items())
    note = "Share of failed flights among those with such values; groups are of about equal size, or by value where "
    note += f"there are few. Over all flights it is {percent(failure['share'])}."
    return _grid("groups", ("varied parameter", *(f"group {k + 1}" for k in range(size))), lines, note)


def _association(related: Mapping[str, Any] | None) -> tuple[Cell, ...]:
    if related is None:
        return line(*[ABSENT] * 4)
    sure = [Mark.BEST if related[p] < ALPHA else Mark.NONE for p in ("p_holm", "p_xi_holm")]
    rho = Cell(text=f"{related['rho']:+.2f}", mark=sure[0])
    xi = Cell(text=f"{related['xi']:.2f}", mark=sure[1])
    return line(rho, p_value(related["p_holm"]), xi, p_value(related["p_xi_holm"]))


def _group(group: Mapping[str, Any]) -> str:
    low = format_number(group["low"])
    high = format_number(group["high"])
    return f"{low if low == high else f'{low} to {high}'}: {percent(group['share'])}"


_FILES: Final = (
    *("campaign.toml", "scenario.toml", "flights.parquet", "timing.parquet", SUMMARY_FILE, "manifest.json"),
    "campaign.png",
)
"""Files that the page links to, if they exist."""
_MARGINS: Final = (
    "The worst margin is that of a flight's required constraints, as a share of half the "
    "constraint's band: 1 in the middle, 0 (dashed) at its bound, negative beyond. What is measured "
    "of a lost flight ends where it was aborted. Flights beyond an axis are in its end bars."
)
_POINTS: Final = "Triangles at the edges are flights beyond the axes; at the foot also those without a margin."


MAIN_METRICS: Final = (
    "worst_margin",
    *(f"rmse.{name}" for name in ("x", "y", "z", "yaw")),
    *("peak_tilt", "total_variation", "fallback_periods"),
)
"""Metrics shown first."""
_MARGIN_LABEL: Final = "worst margin [half bands]"
_BINS: Final = 40
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
    often = (event_table(summary), constraint_table(summary))
    shapes = _plots("metrics", "Flights by verdict", histograms(table), _MARGINS)
    clouds = _plots("scatter", "Worst margin over each parameter", scatters(table), _POINTS)
    worst = (worst_table(summary, str(campaign)), worst_draws_table(summary))
    sections = [
        Section(title="How often", tables=often),
        Section(title="Distributions", plots=shapes, folded=(metric_table(summary),)),
        Section(
            title="What drives failure",
            text=(driver_sentence(summary),) if summary["parameters"] else (),
            plots=clouds,
            tables=(driver_table(summary), group_table(summary)),
        ),
        Section(title="Worst flights", tables=worst),
    ]
    files = {}
    for name in _FILES:
        if name == SUMMARY_FILE or any((d / name).is_file() for d in (directory, campaign)):
            files[name] = name
    if not summary["flights"]:
        mark = Mark.NONE
    elif summary["events"]["failure"]["count"]:
        mark = Mark.BAD
    else:
        mark = Mark.GOOD
    verdict = Cell(text=sentence, mark=mark)
    if summary["flights"] == spec.flights:
        ended = "complete"
    else:
        ended = "stopped"
    status = f"Status: {ended}, {summary['flights']} of {count_of(spec.flights, 'flight')} flown."
    notes = [definition_sentence(summary, spec.failure), spec.description, status]
    page = render_page("campaign", spec.name, sections, notes=[*filter(None, notes)], verdict=verdict, files=files)
    (directory / PAGE_FILE).write_text(page, encoding="utf-8")
    return directory / PAGE_FILE


def _plots(key: str, title: str, panels: Sequence[Panel], note: str) -> tuple[Plot, ...]:
    if panels:
        return (to_plot(Figure(key=key, title=title, panels=tuple(panels)), note=note),)
    return ()


def campaign_overview(table: pa.Table, summary: CampaignSummary, title: str) -> Figure:
    """Worst margins, or else the first metric that differs between flights, and the parameters that matter."""
    strongest = list(drivers(summary))
    clouds = {panel.x_label.partition(" [")[0]: panel for panel in scatters(table)}
    ranked = sorted(clouds, key=lambda name: strongest.index(name) if name in strongest else len(strongest))
    panels = [
        *histograms(table)[:1],
        *(clouds[name] for name in ranked[:_MOST_SCATTERS]),
    ]
    return Figure(key="campaign", title=title, panels=tuple(replace(panel, height=1.4) for panel in panels))


def histograms(table: pa.Table) -> list[Panel]:
    """Plot the distribution of the main metrics that differ between flights, by verdict."""
    panels = []
    for name in MAIN_METRICS:
        values = numbers(table, name)
        finite = values[np.isfinite(values)]
        if finite.size < 2 or np.ptp(finite) == 0.0:
            continue
        low, high = _ends(finite)
        width = (high - low or 1.0) / min(_BINS, max(8, int(2.0 * np.sqrt(finite.size))))
        edges = width * np.arange(np.floor(low / width), np.ceil(high / width) + 1.0)  # 0 is one, where it is inside
        inside = np.clip(values, edges[0], edges[-1])
        below = np.zeros(edges.size - 1)
        bars = []
        for verdict, rows in verdicts(table).items():
            counts = np.histogram(inside[rows & np.isfinite(values)], edges)[0].astype(float)
            if counts.any():
                middles = 0.5 * (edges[:-1] + edges[1:])
                colour = VERDICTS[verdict].colour
                bars.append(Series(x=middles, y=counts, base=below, colour=colour, label=verdict, style="bars"))
            below = below + counts
        beyond = int(np.count_nonzero((finite < edges[0]) | (finite > edges[-1])))
        zero = (Bound(value=0.0, vertical=True),) if name == "worst_margin" and edges[0] <= 0.0 <= edges[-1] else ()
        x_label = _MARGIN_LABEL if name == "worst_margin" else label(name, unit_of(table, name))
        x_label += f"; {beyond} beyond" if beyond else ""
        panels.append(Panel(title="", x_label=x_label, y_label="flights", series=tuple(bars), bounds=zero, whole=True))
    return panels


def scatters(table: pa.Table) -> list[Panel]:
    """The worst margin of each flight over each varied parameter; triangles are beyond the axes, or have no margin."""
    margins = numbers(table, "worst_margin")
    names = draw_names(table)
    if not np.isfinite(margins).any():
        return []
    low, high = _ends(margins[np.isfinite(margins)])
    # 0, the end of what is allowed, is among them
    low = min(0.0, low)
    high = max(0.0, high)
    y, beyond_y = _clip(np.where(np.isfinite(margins), margins, -np.inf), low, high, "down", "up")
    padding = 0.6 * _GAP * ((high - low) or 1.0)
    panels = []
    for name in names:
        kinds: tuple[str, ...] = ()
        if is_number(table, DRAW + name):
            values = numbers(table, DRAW + name)
        else:
            listed = texts(table, DRAW + name)
            kinds = tuple(sorted(set(listed)))
            spread = np.random.default_rng(0).uniform(-0.3, 0.3, listed.size)  # the same every time
            values = np.array([kinds.index(value) for value in listed], float) + spread
        x, beyond_x = _clip(values, *_ends(values[np.isfinite(values)]), "left", "right")
        beyond = np.where(beyond_y == "", beyond_x, beyond_y)
        points = list[Series]()
        for verdict, flown in verdicts(table).items():
            rows = np.flatnonzero(flown)
            _, colour, symbol = VERDICTS[verdict]
            even = np.linspace(0.0, rows.size - 1.0, min(rows.size, _MOST_POINTS // len(names)))
            rows = rows[np.unique(even.astype(int))]
            for edge in ("", "down", "up", "left", "right"):
                there = rows[beyond[rows] == edge]
                marker = f"triangle-{edge}" if edge else symbol
                if there.size:
                    points.append(
                        Series(x=x[there], y=y[there], flights=numbers(table, "flight")[there], colour=colour,
                               label=verdict, style="points", marker=marker, width=5.0 if edge else 3.5, opacity=0.7)
                    )  # fmt: skip
        panels.append(
            Panel(
                title="",
                x_label=label(name, unit_of(table, DRAW + name)),
                y_label="worst margin",
                series=tuple(points),
                bounds=(Bound(value=0.0),),
                x_names=kinds,
                y_range=(float(y.min()) - padding, float(y.max()) + padding),
            )
        )
    return panels


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
