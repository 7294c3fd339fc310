"""A campaign -> a page that works offline, and its figure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final
from urllib.parse import quote

import pyarrow as pa

from quadsim.outputs import to_json, writing
from quadsim.report.figures.canvas import write_drawings
from quadsim.report.pages.page import PAGE_FILE, render_page
from quadsim.report.plots.panels import plotly_script
from quadsim.report.table import Mark
from scenarios.campaign.report import campaign_tables
from scenarios.campaign.report.campaign_figure import draw_campaign
from scenarios.campaign.report.campaign_plots import campaign_plots, comparison_margins_plot
from scenarios.campaign.report.campaign_text import campaign_sentences, verdict_sentence
from scenarios.campaign.report.comparison_tables import (
    comparison_markdown,
    comparison_tables,
    difference_table,
    pairing,
)
from scenarios.campaign.results.table import Summary
from scenarios.campaign.statistics.comparison import Comparison
from scenarios.campaign.statistics.scatters import clipping, clouds, margins, thinning

_FILES: Final = {
    "campaign.toml": "campaign (TOML)",
    "scenario.toml": "scenario (TOML)",
    "flights.parquet": "flights (Parquet)",
    "timing.parquet": "clock times (Parquet)",
    "summary.json": "summary (JSON)",
    "manifest.json": "manifest (JSON)",
    "campaign.png": "figure (PNG)",
    "campaign.svg": "figure (SVG)",
}
"""What the page links to, where it is there, and under which name."""
COMPARISON_FILE: Final = "comparison.json"
TABLE_FILE: Final = "comparison.md"


def write_report(
    directory: Path,
    *,
    table: pa.Table,
    summary: Summary,
    manifest: Mapping[str, Any],
    name: str,
    description: str = "",
    failure: Sequence[str] = (),
    campaign: Path | None = None,
) -> Path:
    """Write `index.html`, `campaign.png` and `campaign.svg` into a directory that is being made; the page.

    The page links to the files of `campaign`, the campaign's own directory where that is another, as its commands do.

    Raises:
        OutputError: the directory cannot be written.
    """
    campaign = directory if campaign is None else campaign
    write_drawings({"campaign": lambda: draw_campaign(name, table, summary)}, directory)
    plots, drawn = campaign_plots(table, summary), margins(table)
    page = render_page(
        "campaign.html.j2",
        "campaign",
        title=name,
        description=description,
        verdict=verdict_sentence(summary),
        mark=_mark(summary),
        sentences=campaign_sentences(summary),
        events=campaign_tables.event_table(summary, failure),
        constraints=campaign_tables.constraint_table(summary),
        metrics=campaign_tables.metric_table(summary),
        drivers=campaign_tables.driver_table(summary),
        splits=campaign_tables.split_table(summary),
        groups=campaign_tables.group_table(summary),
        levels=campaign_tables.level_tables(summary),
        lost=summary["verdicts"]["lost"],
        worst=campaign_tables.worst_table(summary, str(campaign)),
        worst_draws=campaign_tables.worst_draws_table(summary),
        manifest=campaign_tables.manifest_table(manifest),
        plots=plots,
        clipping="" if drawn is None else clipping(drawn, clouds(table, drawn)),
        thinning=thinning(table),
        files=[
            (label, quote(file))
            for file, label in _FILES.items()
            if (directory / file).is_file() or (campaign / file).is_file()
        ],
        plotly=plotly_script() if plots else "",
    )
    (directory / PAGE_FILE).write_text(page, encoding="utf-8")
    return directory / PAGE_FILE


def _mark(summary: Summary) -> Mark:
    if not summary["flights"]:
        return Mark.NONE
    return Mark.BAD if summary["events"]["failure"]["count"] else Mark.GOOD


def write_comparison_report(comparison: Comparison, directory: Path, *, overwrite: bool = False) -> Path:
    """Write `index.html`, `comparison.json` and `comparison.md`, which appear together or not at all; the page.

    Raises:
        OutputError: the directory cannot be written, or holds something else.
    """
    plot = comparison_margins_plot(comparison)
    with writing(directory, overwrite=overwrite) as partial:
        (partial / COMPARISON_FILE).write_text(to_json(comparison.to_json()), encoding="utf-8")
        (partial / TABLE_FILE).write_text(comparison_markdown(comparison), encoding="utf-8")
        page = render_page(
            "campaign_comparison.html.j2",
            "campaign comparison",
            title=f"{comparison.names[1]} against {comparison.names[0]}",
            comparison=comparison,
            pairing=pairing(comparison),
            differences=difference_table(comparison),
            tables=comparison_tables(comparison),
            plot=plot,
            files=(COMPARISON_FILE, TABLE_FILE),
            plotly=plotly_script() if plot else "",
        )
        (partial / PAGE_FILE).write_text(page, encoding="utf-8")
    return directory / PAGE_FILE
