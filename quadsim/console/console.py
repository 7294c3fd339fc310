"""A console that prints any string literally, and the layout of tables, listings and progress on it."""

from __future__ import annotations

import contextlib
import io
import re
import shlex
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from copy import copy
from pathlib import Path
from typing import IO, Any, Final

from rich.box import SIMPLE_HEAD
from rich.cells import cell_len
from rich.console import Console, ConsoleOptions, JustifyMethod, RenderableType, RenderResult
from rich.measure import Measurement
from rich.table import Table
from rich.text import Text

from quadsim.errors import printable
from quadsim.report.table import Cell, Grid, Mark

CONSOLE_WIDTH: Final = 120  # characters, without a terminal
_UNBOUNDED: Final = 10_000  # characters, more than any table has
_HTML: Final = (
    '<pre style="line-height: normal; white-space: pre; overflow-x: auto; '
    "font-family: Menlo, 'DejaVu Sans Mono', Consolas, 'Courier New', monospace\">{code}</pre>"
)
_STYLES: Final = {Mark.BEST: "bold", Mark.GOOD: "green", Mark.WARN: "yellow", Mark.BAD: "red"}


class PlainConsole(Console):
    """Prints every string literally, whatever its source: paths, names, reasons, summaries.

    Styled text is a `rich.text.Text`, made by `styled`.
    """

    def __init__(self, *, stderr: bool = False, width: int | None = None, file: IO[str] | None = None) -> None:
        recorded = file is not None
        super().__init__(
            stderr=stderr,
            width=width,
            file=file,
            record=recorded,
            highlight=False,
            markup=False,
            emoji=False,
            force_jupyter=False,  # rich would display each line in the cell, also of what is only turned into text
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
    if console.is_terminal:
        return console
    return PlainConsole(width=CONSOLE_WIDTH)


def stderr() -> PlainConsole:
    """Return stderr."""
    return PlainConsole(stderr=True)


def show(parts: Iterable[RenderableType], console: PlainConsole | None = None) -> None:
    """Print sentences, wrapped at spaces, and tables; messages on a stderr that is no terminal have one line each."""
    console = stdout() if console is None else console
    on_one_line = console.stderr and not console.is_terminal
    for part in parts:
        if isinstance(part, str | Text) and not on_one_line:
            part = _wrapped(styled(part) if isinstance(part, str) else part, console.width)
        console.print(part, soft_wrap=isinstance(part, str | Text), crop=False)


def _wrapped(text: Text, width: int) -> Text:
    """Break lines at spaces; a word that is longer than a line, such as a path, stays whole."""
    if text.no_wrap:
        return text
    lines: list[Text] = []
    for line in text.split(allow_blank=True):
        starts = [0]
        plain = line.plain
        for word in re.finditer(r"\S+", plain):
            if plain[starts[-1] : word.start()].strip() and cell_len(plain[starts[-1] : word.end()]) > width:
                starts.append(word.start())
        lines += line.divide(starts[1:])
    for line in lines:
        line.rstrip()
    return Text("\n").join(lines)


def to_text(parts: Iterable[RenderableType]) -> str:
    """Return sentences and tables as text without colours."""
    console = PlainConsole(width=CONSOLE_WIDTH, file=io.StringIO())
    show(parts, console)
    return console.export_text()


def to_html(parts: Iterable[RenderableType]) -> str:
    """Return sentences and tables as HTML for a notebook."""
    console = PlainConsole(width=CONSOLE_WIDTH, file=io.StringIO())
    show(parts, console)
    return console.export_html(inline_styles=True, code_format=_HTML)


def say(text: str) -> None:
    """Print a message that is not a result."""
    show([f"quadsim: {text}"], stderr())


def written_to(path: Path) -> Text:
    """Return the line with the path of an output, which may have spaces."""
    line = styled("written to ", (short_path(path), "bold"))
    line.no_wrap = True
    return line


def to_open(path: Path, program: str = "open") -> Text:
    """Return a command that opens an output, on one line to copy."""
    return command(f"{program} {shlex.quote(short_path(path))}")


def command(text: str) -> Text:
    """Return a command, on one line to copy."""
    line = styled((text, "bold"))
    line.no_wrap = True
    return line


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
    spare: Sequence[str] = (),
) -> Table:
    """Return a table; its first column and those in `left` hold words.

    Where it is too wide, it does without the columns in `spare`, in this order, and then wraps the names in the first
    column instead of cells in the others; without `spare` it wraps cells.
    """
    table = _SparingTable(
        title=title, title_justify="left", title_style="bold", box=SIMPLE_HEAD, padding=0, pad_edge=False
    )
    table.caption = caption
    table.caption_justify = "left"
    table.spare = spare
    for i, name in enumerate(head):
        justify: JustifyMethod
        if i and name not in left:
            justify = "right"
        else:
            justify = "left"
        table.add_column(name, justify=justify, overflow="fold", no_wrap=bool(i) if spare else not i)
    for line in lines:
        table.add_row(*line)
    return table


class _SparingTable(Table):
    """A table that does without some columns where the console is too narrow for all of them."""

    spare: Sequence[str] = ()

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """See `rich.table.Table`."""
        shown = copy(self)
        for name in self.spare:
            if Measurement.get(console, options.update(width=_UNBOUNDED), shown).maximum <= options.max_width:
                break
            shown.columns = [column for column in shown.columns if column.header != name]
        yield from Table.__rich_console__(shown, console, options)


def styled_cell(cell: Cell) -> Text:
    """Return a cell of a report's table."""
    return styled((cell.text, _STYLES.get(cell.mark, "")))


def grids(grids: Iterable[Grid], *, left: Collection[str] = ()) -> Iterator[RenderableType]:
    """Return tables of a report with their notes; `left` names columns of words."""
    for grid in grids:
        lines = []
        for line in grid.lines:
            lines.append([styled_cell(value) for value in line])
        yield table(grid.title, grid.head, lines, caption=grid.note.replace("`", "") or None, left=left)
        yield ""


def listing(sections: Mapping[str, Mapping[str, str]]) -> Iterator[RenderableType]:
    """Return names with one line each, by section."""
    for title, entries in sections.items():
        yield _Entries(title, entries)
        yield ""


class _Entries:
    """Names with a line each: wrapped beside the names on a terminal, whole in a file or a pipe, for `grep`."""

    def __init__(self, title: str, entries: Mapping[str, str]) -> None:
        self._title = title
        self._entries = entries

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """See `rich.console.Console`."""
        yield styled((self._title, "bold"))
        if not options.is_terminal:
            width = max(map(cell_len, self._entries), default=0)
            for name, line in self._entries.items():
                padding = " " * (width - cell_len(name))
                whole = styled("  ", (name, "cyan"), f"{padding}  {line}")
                whole.no_wrap = True
                whole.overflow = "ignore"
                yield whole
            return
        table = Table(box=None, show_header=False, padding=(0, 2))
        table.add_column(no_wrap=True, style="cyan")
        table.add_column()
        for name, line in self._entries.items():
            table.add_row(name, line)
        yield table
