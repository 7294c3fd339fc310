"""A console that prints any string literally, and the layout of tables, listings and progress on it."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO, Any, Final

from rich.box import SIMPLE_HEAD
from rich.console import Console, RenderableType
from rich.table import Table
from rich.text import Text

from quadsim.errors import printable
from quadsim.report.table import Cell, Grid, Mark

WIDTH: Final = 120  # characters, without a terminal
_STYLES: Final = {Mark.BEST: "bold", Mark.GOOD: "green", Mark.WARN: "yellow", Mark.BAD: "red"}


class PlainConsole(Console):
    """Prints every string literally, whatever its source: paths, names, reasons, summaries.

    Styled text is a `rich.text.Text`, made by `styled`.
    """

    def __init__(self, *, stderr: bool = False, width: int | None = None, file: IO[str] | None = None) -> None:
        recorded = file is not None
        super().__init__(
            stderr=stderr, width=width, file=file, record=recorded, highlight=False, markup=False, emoji=False
        )

    def render_str(self, text: str, **options: Any) -> Text:
        """See `rich.console.Console.render_str`; all strings come by here, those of tables too."""
        return super().render_str(printable(text), **(options | {"markup": False, "emoji": False, "highlight": False}))


def styled(*parts: str | tuple[str, str]) -> Text:
    """Join texts, each plain or with a style."""
    return Text.assemble(
        *(printable(part) if isinstance(part, str) else (printable(part[0]), part[1]) for part in parts)
    )


def stdout() -> PlainConsole:
    """Return stdout, wide enough for the tables if it is a file or a pipe."""
    console = PlainConsole()
    return console if console.is_terminal else PlainConsole(width=WIDTH)


def stderr() -> PlainConsole:
    """Return stderr."""
    return PlainConsole(stderr=True)


def show(parts: Iterable[RenderableType], console: PlainConsole | None = None) -> None:
    """Print sentences, which a terminal may wrap, and tables, which fit its width."""
    console = stdout() if console is None else console
    for part in parts:
        console.print(part, soft_wrap=isinstance(part, str | Text))


def to_text(parts: Iterable[RenderableType]) -> str:
    """Return sentences and tables as text without colours."""
    console = PlainConsole(width=WIDTH, file=io.StringIO())
    show(parts, console)
    return console.export_text()


def to_html(parts: Iterable[RenderableType]) -> str:
    """Return sentences and tables as HTML for a notebook."""
    console = PlainConsole(width=WIDTH, file=io.StringIO())
    show(parts, console)
    return console.export_html(inline_styles=True, code_format='<pre style="line-height: normal">{code}</pre>')


def say(text: str) -> None:
    """Print a message that is not a result."""
    show([f"quadsim: {text}"], stderr())


def written_to(path: Path) -> Text:
    """Return the line with the path of an output."""
    return styled("written to ", (short_path(path), "bold"))


def short_path(path: Path) -> str:
    """Shorten a path: relative to the current directory if it is inside."""
    with contextlib.suppress(ValueError, OSError):  # it is outside, or the current directory is gone
        return str(path.relative_to(Path.cwd()))
    return str(path)


def table(
    title: str,
    head: Sequence[str],
    lines: Iterable[Iterable[Any]],
    *,
    caption: str | None = None,
    left: Collection[str] = (),
    rigid: bool = False,
) -> Table:
    """Return a table; its first column and those in `left` hold words; cells of a `rigid` one are not wrapped."""
    table = Table(title=title, title_justify="left", title_style="bold", box=SIMPLE_HEAD, padding=0, pad_edge=False)
    table.caption, table.caption_justify = caption, "left"
    for i, name in enumerate(head):
        table.add_column(name, justify="right" if i and name not in left else "left", no_wrap=rigid or not i)
    for line in lines:
        table.add_row(*line)
    return table


def cell(cell: Cell) -> Text:
    """Return a cell of a report's table."""
    return styled((cell.text, _STYLES.get(cell.mark, "")))


def grids(grids: Iterable[Grid], *, left: Collection[str] = ()) -> Iterator[RenderableType]:
    """Return tables of a report with their notes; `left` names columns of words."""
    for grid in grids:
        lines = [[cell(value) for value in line] for line in grid.lines]
        yield table(grid.title, grid.head, lines, caption=grid.note.replace("`", "") or None, left=left)
        yield ""


def listing(sections: Mapping[str, Mapping[str, str]]) -> Iterator[RenderableType]:
    """Return names with one line each, by section."""
    for title, entries in sections.items():
        table = Table(
            title=title, title_justify="left", title_style="bold", box=None, show_header=False, padding=(0, 2)
        )
        table.add_column(no_wrap=True, style="cyan")
        table.add_column()
        for name, line in entries.items():
            table.add_row(name, line)
        yield table
        yield ""
