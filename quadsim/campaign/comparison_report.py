"""Two campaigns compared -> one directory to open and share."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from quadsim.campaign.comparison import Comparison
from quadsim.campaign.comparison_tables import comparison_markdown, comparison_tables, pairing
from quadsim.outputs import write_json, write_text, writing
from quadsim.page import PAGE_FILE, render_page
from quadsim.plots import plotly_script
from quadsim.plots.margins import comparison_margins_plot

COMPARISON_FILE: Final = "comparison.json"
TABLE_FILE: Final = "comparison.md"

KIND: Final = "campaign comparison"
"""What `quadsim.outputs` calls such a directory."""


def write_comparison_report(comparison: Comparison, directory: Path) -> Path:
    """Write `index.html`, `comparison.json` and `comparison.md`, which appear together or not at all.

    Args:
        comparison: what to tell.
        directory: what to write; an earlier comparison of campaigns or an empty directory there is replaced.

    Returns:
        The page.

    Raises:
        OutputError: the directory cannot be written, or holds something else.
    """
    plot = comparison_margins_plot(comparison)
    with writing(directory, KIND) as partial:
        write_json(partial / COMPARISON_FILE, comparison.to_json())
        write_text(partial / TABLE_FILE, comparison_markdown(comparison))
        page = render_page(
            "campaign_comparison.html.j2",
            KIND,
            title=f"{comparison.names[1]} against {comparison.names[0]}",
            comparison=comparison,
            pairing=pairing(comparison),
            tables=comparison_tables(comparison),
            plot=plot,
            files=(COMPARISON_FILE, TABLE_FILE),
            plotly=plotly_script() if plot else "",
        )
        write_text(partial / PAGE_FILE, page)
    return directory / PAGE_FILE
