"""A campaign -> a page that works offline, and its figure; two campaigns -> a page that compares them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np
import pyarrow as pa

from quadsim.outputs import to_json, writing
from quadsim.report.figure import Bound, Figure, Panel, Series
from quadsim.report.page import PAGE_FILE, Section, render_page
from quadsim.report.table import Cell, Mark
from quadsim.report.to_matplotlib import write_pngs
from quadsim.report.to_plotly import Plot, to_plot
from quadsim.state import Array
from scenarios.campaign.report.campaign_tables import (
    constraint_table,
    driver_table,
    event_table,
    group_table,
    metric_table,
    verdict_sentence,
    worst_draws_table,
    worst_table,
)
from scenarios.campaign.report.comparison_tables import (
    comparison_markdown,
    comparison_tables,
    difference_table,
    pairing,
)
from scenarios.campaign.results.events import VERDICTS
from scenarios.campaign.results.table import (
    DRAW,
    Summary,
    draw_names,
    is_number,
    numbers,
    texts,
    unit_of,
    verdicts,
)
from scenarios.campaign.spec import CampaignSpec
from scenarios.campaign.statistics.comparison import Comparison
from scenarios.campaign.statistics.estimates import drivers
from scenarios.campaign.statistics.wording import label

_FILES: Final = (
    *("campaign.toml", "scenario.toml", "flights.parquet", "timing.parquet", "summary.json", "manifest.json"),
    "campaign.png",
)
"""What the page links to, where it is there."""
COMPARISON_FILE: Final = "comparison.json"
TABLE_FILE: Final = "comparison.md"
_MARGINS: Final = (
    "The worst margin is that of a flight's required constraints, tolerance included, as a share of half the "
    "constraint's band: 1 in the middle, 0 (dashed) at the end of what is allowed, negative beyond. What is measured "
    "of a lost flight ends where it was aborted."
)
_POINTS: Final = "Triangles at the edges are flights beyond the axes; at the foot also those without a margin."


MAIN_METRICS: Final = (
    "worst_margin",
    *(f"rmse.{name}" for name in ("x", "y", "z", "yaw")),
    *("peak_tilt", "total_variation", "fallback_periods"),
)
"""What a reader of a campaign looks for first."""
_BINS: Final = 40
_MOST_SCATTERS: Final = 3  # in the overview
_MOST_POINTS: Final = 9000  # of one verdict in all scatters of a page, which has a few MB then
_GAP: Final = 0.06  # from the axis' end to what is drawn at the edge, as a share of the axis
_FENCE: Final = 5.0  # quartile ranges beyond the quartiles up to which values are drawn where they are


def write_report(
    directory: Path, table: pa.Table, summary: Summary, spec: CampaignSpec, *, campaign: Path | None = None
) -> Path:
    """Write `index.html` and `campaign.png` into a directory that is being made; the page.

    The page links to the files of `campaign`, the campaign's own directory where that is another, as its commands do.

    Raises:
        OutputError: the directory cannot be written.
    """
    campaign = campaign or directory
    sentence = verdict_sentence(summary)
    figure = overview(table, summary, f"{spec.name}: {sentence}")
    write_pngs([figure] if figure.panels else [], directory)
    often = (event_table(summary, spec.failure), constraint_table(summary))
    shapes = _plots("metrics", "Flights by verdict", histograms(table), _MARGINS)
    clouds = _plots("scatter", "Worst margin over each parameter", scatters(table), _POINTS)
    worst = (worst_table(summary, str(campaign)), worst_draws_table(summary))
    sections = [
        Section(title="How often", tables=often),
        Section(title="Distributions", plots=shapes, folded=(metric_table(summary),)),
        Section(title="What drives failure", plots=clouds, tables=(driver_table(summary), group_table(summary))),
        Section(title="Worst flights", tables=worst),
    ]
    files = {name: name for name in _FILES if (directory / name).is_file() or (campaign / name).is_file()}
    mark = Mark.NONE if not summary["flights"] else Mark.BAD if summary["events"]["failure"]["count"] else Mark.GOOD
    verdict = Cell(text=sentence, mark=mark)
    page = render_page("campaign", spec.name, sections, description=spec.description, verdict=verdict, files=files)
    (directory / PAGE_FILE).write_text(page, encoding="utf-8")
    return directory / PAGE_FILE


def _plots(key: str, title: str, panels: Sequence[Panel], note: str) -> tuple[Plot, ...]:
    return (to_plot(Figure(key=key, title=title, panels=tuple(panels)), note=note),) if panels else ()


def write_comparison_report(comparison: Comparison, directory: Path, *, overwrite: bool = False) -> Path:
    """Write `index.html`, `comparison.json` and `comparison.md`, which appear together or not at all; the page.

    Raises:
        OutputError: the directory cannot be written, or holds something else.
    """
    sections = [
        Section(title="What is compared", text=(pairing(comparison),), tables=tuple(difference_table(comparison))),
        Section(title="Which is better", text=(comparison.sentence,), tables=tuple(comparison_tables(comparison))),
    ]
    title = f"{comparison.names[1]} against {comparison.names[0]}"
    files = {file: file for file in (COMPARISON_FILE, TABLE_FILE)}
    with writing(directory, overwrite=overwrite) as partial:
        (partial / COMPARISON_FILE).write_text(to_json(comparison.to_json()), encoding="utf-8")
        (partial / TABLE_FILE).write_text(comparison_markdown(comparison), encoding="utf-8")
        page = render_page("campaign comparison", title, sections, files=files)
        (partial / PAGE_FILE).write_text(page, encoding="utf-8")
    return directory / PAGE_FILE


def overview(table: pa.Table, summary: Summary, title: str) -> Figure:
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
    """How the main metrics that differ between flights are distributed, by verdict."""
    panels = []
    for name in MAIN_METRICS:
        values = numbers(table, name)
        finite = values[np.isfinite(values)]
        if finite.size < 2 or np.ptp(finite) == 0.0:
            continue
        low, high = _ends(finite)
        width = (high - low or 1.0) / min(_BINS, max(8, int(2.0 * np.sqrt(finite.size))))
        edges = width * np.arange(np.floor(low / width), np.ceil(high / width) + 1.0)  # 0 is one, where it is inside
        inside, below, bars = np.clip(values, edges[0], edges[-1]), np.zeros(edges.size - 1), []
        for verdict, rows in verdicts(table).items():
            counts = np.histogram(inside[rows & np.isfinite(values)], edges)[0].astype(float)
            if counts.any():
                middles, colour = 0.5 * (edges[:-1] + edges[1:]), VERDICTS[verdict].colour
                bars.append(Series(x=middles, y=counts, base=below, colour=colour, label=verdict, style="bars"))
            below = below + counts
        beyond = int(np.count_nonzero((finite < edges[0]) | (finite > edges[-1])))
        zero = (Bound(value=0.0, vertical=True),) if name == "worst_margin" and edges[0] <= 0.0 <= edges[-1] else ()
        x_label = label(name, unit_of(table, name)) + (f"; {beyond} beyond, in the end bars" if beyond else "")
        panels.append(Panel(title="", x_label=x_label, y_label="flights", series=tuple(bars), bounds=zero, whole=True))
    return panels


def scatters(table: pa.Table) -> list[Panel]:
    """The worst margin of each flight over each varied parameter; triangles are beyond the axes, or have no margin."""
    margins, names = numbers(table, "worst_margin"), draw_names(table)
    if not np.isfinite(margins).any():
        return []
    low, high = _ends(margins[np.isfinite(margins)])
    low, high = min(0.0, low), max(0.0, high)  # 0, the end of what is allowed, is among them
    y, beyond_y = _clip(np.where(np.isfinite(margins), margins, -np.inf), low, high, "down", "up")
    room, panels = 0.6 * _GAP * ((high - low) or 1.0), []
    for name in names:
        kinds: tuple[str, ...] = ()
        if is_number(table, DRAW + name):
            values = numbers(table, DRAW + name)
        else:
            listed = texts(table, DRAW + name)
            kinds = tuple(sorted(set(listed)))
            spread = np.random.default_rng(0).uniform(-0.3, 0.3, listed.size)  # the same every time
            values = np.array([kinds.index(each) for each in listed], float) + spread
        x, beyond_x = _clip(values, *_ends(values[np.isfinite(values)]), "left", "right")
        beyond, points = np.where(beyond_y == "", beyond_x, beyond_y), list[Series]()
        for verdict, found in verdicts(table).items():
            rows, (_, colour, symbol) = np.flatnonzero(found), VERDICTS[verdict]
            even = np.linspace(0.0, rows.size - 1.0, min(rows.size, _MOST_POINTS // len(names)))
            rows = rows[np.unique(even.astype(int))]
            for edge in ("", "down", "up", "left", "right"):
                there, marker = rows[beyond[rows] == edge], f"triangle-{edge}" if edge else symbol
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
                y_range=(float(y.min()) - room, float(y.max()) + room),
            )
        )
    return panels


def _ends(finite: Array) -> tuple[float, float]:
    """The smallest and the largest of some values, without those far out."""
    q1, q3 = np.percentile(finite, [25, 75])
    reach = _FENCE * (q3 - q1) or np.inf
    inside = finite[(finite >= q1 - reach) & (finite <= q3 + reach)]
    return float(inside.min()), float(inside.max())


def _clip(values: Array, low: float, high: float, below: str, above: str) -> tuple[Array, np.ndarray]:
    """Values (K,) with those beyond the ends a little outside, and on which side each is; empty inside."""
    side = np.where(values < low, below, np.where(values > high, above, ""))
    gap = _GAP * ((high - low) or 1.0)
    return np.select([side == below, side == above], [low - gap, high + gap], values), side
