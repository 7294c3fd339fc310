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
        literally = {"markup": False, "emoji": False, "highlight": False}
        return super().render_str(printable(text), **(options | literally))


def styled(*parts: str | tuple[str, str]) -> Text:
    """Join texts, each plain or with a style."""
    line = Text()
    for part in parts:
        if isinstance(part, str):
            line.append(printable(part))
        else:
            text, style = part
            line.append(printable(text), style)
    return line


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
    if console is None:
        console = stdout()
    on_one_line = console.stderr and not console.is_terminal
    for part in parts:
        if not isinstance(part, str | Text):
            console.print(part, crop=False)
            continue
        sentence = part
        if not on_one_line:
            sentence = _wrapped(part, console.width)
        console.print(sentence, soft_wrap=True, crop=False)


def _wrapped(sentence: str | Text, width: int) -> Text:
    """Break lines at spaces; a word that is longer than a line, such as a path, stays whole."""
    if isinstance(sentence, str):
        sentence = styled(sentence)
    if sentence.no_wrap:
        return sentence
    lines: list[Text] = []
    for line in sentence.split(allow_blank=True):
        starts = [0]
        plain = line.plain
        for word in re.finditer(r"\S+", plain):
            before = plain[starts[-1] : word.start()]
            with_word = plain[starts[-1] : word.end()]
            if before.strip() and cell_len(with_word) > width:
                starts.append(word.start())
        lines += line.divide(starts[1:])
    for line in lines:
        line.rstrip()
    return Text("\n").join(lines)


def to_text(parts: Iterable[RenderableType]) -> str:
    """Return sentences and tables as text without colours."""
    return _recorded(parts).export_text()


def to_html(parts: Iterable[RenderableType]) -> str:
    """Return sentences and tables as HTML for a notebook."""
    return _recorded(parts).export_html(inline_styles=True, code_format=_HTML)


def _recorded(parts: Iterable[RenderableType]) -> PlainConsole:
    """Return a console that no one sees, with sentences and tables on it."""
    console = PlainConsole(width=CONSOLE_WIDTH, file=io.StringIO())
    show(parts, console)
    return console


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
        is_first = i == 0
        justify: JustifyMethod = "right"
        if is_first or name in left:
            justify = "left"
        if spare:
            wraps = is_first
        else:
            wraps = not is_first
        table.add_column(name, justify=justify, overflow="fold", no_wrap=not wraps)
    for line in lines:
        table.add_row(*line)
    return table


class _SparingTable(Table):
    """A table that does without some columns where the console is too narrow for all of them."""

    spare: Sequence[str] = ()

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """See `rich.table.Table`."""
        shown = copy(self)
        unbounded = options.update(width=_UNBOUNDED)
        for name in self.spare:
            if Measurement.get(console, unbounded, shown).maximum <= options.max_width:
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
            lines.append([styled_cell(cell) for cell in line])
        caption = grid.note.replace("`", "") or None
        yield table(grid.title, grid.head, lines, caption=caption, left=left)
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
        if options.is_terminal:
            yield self._table()
        else:
            yield from self._whole_lines()

    def _table(self) -> Table:
        table = Table(box=None, show_header=False, padding=(0, 2))
        table.add_column(no_wrap=True, style="cyan")
        table.add_column()
        for name, line in self._entries.items():
            table.add_row(name, line)
        return table

    def _whole_lines(self) -> Iterator[Text]:
        width = max(map(cell_len, self._entries), default=0)
        for name, line in self._entries.items():
            padding = " " * (width - cell_len(name))
            whole = styled("  ", (name, "cyan"), f"{padding}  {line}")
            whole.no_wrap = True
            whole.overflow = "ignore"
            yield whole
