"""Pages that open without a network, all from one template: of flights, campaigns and comparisons."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from quadsim.errors import printable
from quadsim.palette import css
from quadsim.report.table import Cell, Grid, QuantityRow
from quadsim.report.to_plotly import Plot, plotly_script

if TYPE_CHECKING:
    from jinja2 import Environment

PAGE_FILE: Final = "index.html"


@dataclass(frozen=True, kw_only=True)
class Section:
    """A heading with text, plots and tables beneath it, in this order; one with none of them is left out."""

    title: str
    text: tuple[str, ...] = ()  # a paragraph each
    plots: tuple[Plot, ...] = ()
    tables: tuple[Grid, ...] = ()  # one without lines is left out
    folded: tuple[Grid, ...] = ()  # likewise; shown on demand


@dataclass(frozen=True, kw_only=True)
class RunView:
    """A run as a page shows it; URLs are relative to the page."""

    name: str
    colour: str
    description: str
    facts: tuple[str, ...]  # vehicle, versions and machine
    video: str | None  # URL; None without one
    length: float  # of the flight [s]
    poster: str | None  # URL of the video's picture before it plays; None if the video cannot be read
    files: Mapping[str, str]  # URL of each, by its label


def render_page(
    kind: str,
    title: str,
    sections: Sequence[Section],
    *,
    verdict: Cell | None = None,
    notes: Sequence[str] = (),
    runs: Sequence[RunView] = (),
    rows: Sequence[QuantityRow] = (),
    files: Mapping[str, str] | None = None,
) -> str:
    """A page of a kind, e.g. `campaign`.

    `verdict` is the answer in one line, `notes` a paragraph each beneath it, `rows` the table of `runs`, of which the
    first group stands before the sections and the others after them; plots toggle the group `run0` and so on; `files`
    has the URL of each file beside the page, by its label.
    """
    groups = []
    for group, of_group in itertools.groupby(rows, lambda row: row.group):
        groups.append((group, list(of_group)))
    shown = []
    for section in map(_without_empty, sections):
        if section.text or section.plots or section.tables or section.folded:
            shown.append(section)
    plotly = ""
    if any(section.plots for section in shown):
        plotly = plotly_script()
    return (
        _environment()
        .get_template("page.html.j2")
        .render(
            kind=kind,
            title=title,
            sections=shown,
            verdict=verdict,
            notes=notes,
            runs=runs,
            groups=groups,
            files=files or {},
            palette=css(),
            plotly=plotly,
        )
    )


def _without_empty(section: Section) -> Section:
    """A section without the tables that have no lines."""
    tables = tuple(grid for grid in section.tables if grid.lines)
    folded = tuple(grid for grid in section.folded if grid.lines)
    return Section(title=section.title, text=section.text, plots=section.plots, tables=tables, folded=folded)


@functools.cache  # it compiles the template once
def _environment() -> Environment:
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    return Environment(
        loader=FileSystemLoader(Path(__file__).resolve().parent / "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        finalize=_shown,
        trim_blocks=True,
        lstrip_blocks=True,
    )


def _shown(value: Any) -> Any:
    """Text and paths without what steers a reader's eye, or what no file can hold; markup of ours as it is."""
    is_text = isinstance(value, str | Path) and not hasattr(value, "__html__")
    if is_text:
        return printable(str(value), keep="\n")
    return value
