"""A table as plain data: rows of marked cells, for the terminal, the page and Markdown alike."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Final

from quadsim.errors import printable

ABSENT: Final = "-"
_NEGLIGIBLE: Final = {
    "m": (1e-9, "< 1 nm"),
    "deg": (1e-6, "0"),
    "rad/s": (1e-6, "0"),
    "m/s": (1e-9, "0"),
    "deg/s": (1e-6, "0"),
    "-": (1e-9, "0"),
}
"""By unit: below which magnitude a number is rounding, and what `short_number` shows instead; others show 0."""


class Mark(StrEnum):
    """What a reader should see in a cell at a glance; words are set otherwise than numbers."""

    NONE = ""
    BEST = "best"
    GOOD = "good"
    WARN = "warn"
    BAD = "bad"
    TEXT = "text"


@dataclass(frozen=True, kw_only=True)
class Cell:
    """One run's value in a row, as text."""

    text: str = ABSENT
    mark: Mark = Mark.NONE


@dataclass(frozen=True, kw_only=True)
class QuantityRow:
    """One quantity under the heading of its group: a cell for each run, in order.

    A headline is its group's answer in one line, such as the verdict on a constraint.
    """

    group: str
    label: str
    unit: str = ""
    cells: tuple[Cell, ...]
    headline: bool = False


@dataclass(frozen=True, kw_only=True)
class Grid:
    """A table of cases: a head, and a line of cells for each case, the first of which names it.

    `key` is its identifier in a page, `note` what a reader has to know of it.
    """

    key: str
    title: str
    head: tuple[str, ...]
    lines: tuple[tuple[Cell, ...], ...]
    note: str = ""


def line(*cells: Cell | str) -> tuple[Cell, ...]:
    """A line of a grid; a text is a cell without a mark."""
    marked = []
    for cell in cells:
        if isinstance(cell, Cell):
            marked.append(cell)
        else:
            marked.append(Cell(text=cell))
    return tuple(marked)


def to_markdown(rows: Sequence[QuantityRow], names: Sequence[str]) -> str:
    """A Markdown table of the rows: headlines and the best values in bold type."""
    lines = []
    group = ""
    for row in rows:
        heading = ""
        if row.group != group:
            heading = f"**{row.group}**"
        label = row.label
        if row.unit:
            label = f"{row.label} [{row.unit}]"
        cells = list(row.cells)
        if row.headline:
            cells = [replace(cell, mark=Mark.BEST) for cell in row.cells]
        lines.append(line(heading, label, *cells))
        group = row.group
    return _markdown(("", "", *names), 2, lines)


def grid_to_markdown(grid: Grid) -> str:
    """A Markdown table of the grid: the best values in bold type."""
    return _markdown(grid.head, 1, grid.lines)


def _markdown(head: Sequence[str], names: int, lines: Sequence[Sequence[Cell]]) -> str:
    """A table whose first columns, so many, are names, aligned to the left."""
    alignment = ["---"] * names + ["---:"] * (len(head) - names)
    rows = [_markdown_row(head), _markdown_row(alignment)]
    for cells in lines:
        rows.append(_markdown_row([_markdown_text(cell) for cell in cells]))
    return "".join(rows)


def _markdown_row(texts: Sequence[str]) -> str:
    escaped = [printable(text).replace("|", r"\|") for text in texts]
    return "| " + " | ".join(escaped) + " |\n"


def _markdown_text(cell: Cell) -> str:
    if cell.mark is Mark.BEST:
        return f"**{cell.text}**"
    return cell.text


def section(grid: Grid) -> str:
    """A grid under its title, with its note, as Markdown."""
    return f"## {grid.title}\n\n{grid_to_markdown(grid)}\n{grid.note}".rstrip() + "\n"


def format_number(value: float | None) -> str:
    """Four significant digits, or two where it takes an exponent; `-` for None and NaN."""
    if value is None or math.isnan(value):
        return ABSENT
    size = abs(value)
    if 1e4 <= size < 1e7:
        return f"{value:.0f}"
    if size == 0.0 or 1e-3 <= size < 1e7:
        return f"{value:.4g}"
    return f"{value:.1e}"


def without_rounding(value: float, unit: str) -> float:
    """Return a number, or 0 where its magnitude is only rounding in its unit."""
    least, _text = _NEGLIGIBLE.get(unit, (0.0, ""))
    if abs(value) < least:
        return 0.0
    return value


def format_quantity(value: float | None, unit: str) -> str:
    """Return a number in its unit as `format_number` does, and 0 where it is only rounding."""
    if value is None:
        return ABSENT
    return format_number(without_rounding(value, unit))


def signed_number(value: float, decimals: int) -> str:
    """A number with its sign and so many decimals, but no "-0.00"."""
    return f"{round(value, decimals) + 0.0:+.{decimals}f}"


def short_number(value: float, unit: str = "") -> str:
    """Three significant digits for a table to glance at, without what is only rounding in its unit; `-` for NaN."""
    if math.isnan(value):
        return ABSENT
    least, text = _NEGLIGIBLE.get(unit, (0.0, "0"))
    if value and abs(value) < least:
        return text
    if 1e3 <= abs(value) < 1e5:
        return f"{value + 0.0:.0f}"
    return f"{value + 0.0:.3g}".replace("e-0", "e-")
