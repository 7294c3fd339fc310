"""A tuning -> a page that works offline, and its figure."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import pyarrow as pa

from quadsim.report.figures.canvas import write_drawings
from quadsim.report.pages.page import PAGE_FILE, render_page
from quadsim.report.plots.panels import plotly_script
from quadsim.report.table import Mark
from scenarios.tuning.report import tuning_tables
from scenarios.tuning.report.tuning_figure import draw_tuning
from scenarios.tuning.report.tuning_plots import tuning_plots
from scenarios.tuning.spec import START

_FILES: Final = {
    "best.toml": "the answer (TOML)",
    "tuning.toml": "tuning (TOML)",
    "scenario.toml": "start (TOML)",
    "flights.parquet": "flights of the search (Parquet)",
    "timing.parquet": "clock times (Parquet)",
    "summary.json": "summary (JSON)",
    "manifest.json": "manifest (JSON)",
    "journal.log": "Optuna's journal",
    "tuning.png": "figure (PNG)",
    "tuning.svg": "figure (SVG)",
}
"""What the page links to, and under which name."""


def write_report(
    directory: Path, *, summary: tuning_tables.Summary, tables: Sequence[pa.Table], campaigns: Sequence[str]
) -> Path:
    """Write `index.html`, `tuning.png` and `tuning.svg` into a directory that is being made; the page.

    Args:
        directory: where they go.
        summary: `summary.json`.
        tables: the fresh flights of the start, and of the answer where that is another.
        campaigns: their folders beside the page, in that order.

    Raises:
        OutputError: the directory cannot be written.
    """
    write_drawings({"tuning": lambda: draw_tuning(summary, tables)}, directory)
    plots = tuning_plots(summary, tables)
    good = Mark.NONE if summary["answer"] == START else Mark.GOOD
    pages = {f"{folder}/index.html": f"fresh flights, {folder}" for folder in campaigns}
    if summary["answer"] != START:
        pages["comparison/index.html"] = "their comparison"
    fronts = {f"front-{candidate}.toml": f"candidate {candidate} (TOML)" for candidate in summary["front"]}
    page = render_page(
        "tuning.html.j2",
        "tuning",
        title=summary["tuning"],
        description=summary["description"],
        verdict=tuning_tables.verdict_sentence(summary),
        mark=good if summary["fresh"]["best"]["requirement"]["holds"] else Mark.BAD,
        sentences=tuning_tables.sentences(summary),
        objectives=tuning_tables.objective_table(summary),
        values=tuning_tables.values_table(summary),
        candidates=tuning_tables.candidate_table(summary),
        importance=tuning_tables.importance_table(summary),
        plots=plots,
        pages=pages,
        files={**_FILES, **(fronts if len(summary["objectives"]) == 2 else {})},
        plotly=plotly_script() if plots else "",
    )
    (directory / PAGE_FILE).write_text(page, encoding="utf-8")
    return directory / PAGE_FILE
