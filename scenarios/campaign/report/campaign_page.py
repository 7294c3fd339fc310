"""A campaign -> a page that works offline, and its figure; two campaigns -> a page that compares them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import pyarrow as pa

from quadsim.outputs import to_json, writing
from quadsim.report.figure import Figure, Panel
from quadsim.report.page import PAGE_FILE, Section, render_page
from quadsim.report.table import Cell, Mark
from quadsim.report.to_matplotlib import write_pngs
from quadsim.report.to_plotly import Plot, to_plot
from scenarios.campaign.report import campaign_figures
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
from scenarios.campaign.results.table import Summary
from scenarios.campaign.spec import CampaignSpec
from scenarios.campaign.statistics.comparison import Comparison

_FILES: Final = {
    "campaign.toml": "campaign (TOML)",
    "scenario.toml": "scenario (TOML)",
    "flights.parquet": "flights (Parquet)",
    "timing.parquet": "clock times (Parquet)",
    "summary.json": "summary (JSON)",
    "manifest.json": "manifest (JSON)",
    "campaign.png": "figure (PNG)",
}
"""What the page links to, where it is there, and under which name."""
COMPARISON_FILE: Final = "comparison.json"
TABLE_FILE: Final = "comparison.md"
_MARGINS: Final = (
    "The worst margin is that of a flight's required constraints, tolerance included, as a share of half the "
    "constraint's band: 1 in the middle, 0 (dashed) at the end of what is allowed, negative beyond. What is measured "
    "of a lost flight ends where it was aborted."
)
_POINTS: Final = "Triangles at the edges are flights beyond the axes; at the foot also those without a margin."


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
    figure = campaign_figures.overview(table, summary, f"{spec.name}: {sentence}")
    write_pngs([figure] if figure.panels else [], directory)
    often = (event_table(summary, spec.failure), constraint_table(summary))
    shapes = _plots("metrics", "Flights by verdict", campaign_figures.histograms(table), _MARGINS)
    clouds = _plots("scatter", "Worst margin over each parameter", campaign_figures.scatters(table), _POINTS)
    worst = (worst_table(summary, str(campaign)), worst_draws_table(summary))
    sections = [
        Section(title="How often", tables=often),
        Section(title="Distributions", plots=shapes, folded=(metric_table(summary),)),
        Section(title="What drives failure", plots=clouds, tables=(driver_table(summary), group_table(summary))),
        Section(title="Worst flights", tables=worst),
    ]
    there = [file for file in _FILES if (directory / file).is_file() or (campaign / file).is_file()]
    files = {_FILES[file]: file for file in there}
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
