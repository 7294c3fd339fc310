"""A study of what constraints cost -> a section of the comparison page, and its files beside the page."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Final

from quadsim.outputs import write_json, write_text
from quadsim.report.pages.comparison_page import CostSection
from scenarios.cost.cost_figures import write_cost_figures
from scenarios.cost.cost_plots import cost_plots
from scenarios.cost.cost_tables import cost_markdown, cost_tables
from scenarios.cost.cost_text import cost_sentences
from scenarios.cost.study import CostStudy

COST_FILE: Final = "cost.json"
COST_TABLES_FILE: Final = "cost.md"


def cost_section(study: CostStudy) -> Callable[[Path], CostSection]:
    """What `quadsim.report.pages.comparison_page.write_comparison` adds for a study.

    It writes `cost.json`, `cost.md` and the figures `cost_*.png` and `.svg` into the page's directory.
    """

    def write(directory: Path) -> CostSection:
        sentences = cost_sentences(study)
        write_json(directory / COST_FILE, study.to_json())
        text = f"# What do constraints cost?\n\n{cost_markdown(study, sentences)}"
        write_text(directory / COST_TABLES_FILE, text)
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
