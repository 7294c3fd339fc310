"""A console on which text from outside is text: no markup, no codes, nothing that steers a terminal."""

from __future__ import annotations

from typing import Any

from rich.console import Console
from rich.text import Text

from quadsim.printable import printable


class PlainConsole(Console):
    """Shows every string as it is, whoever wrote it: paths, names, reasons, summaries.

    What is to have a style is a `rich.text.Text`, made by `styled`.
    """

    def __init__(self, *, stderr: bool = False, width: int | None = None) -> None:
        super().__init__(stderr=stderr, width=width, highlight=False, markup=False, emoji=False)

    def render_str(self, text: str, **options: Any) -> Text:
        """See `rich.console.Console.render_str`; all strings come by here, those of tables too."""
        return super().render_str(printable(text), **(options | {"markup": False, "emoji": False, "highlight": False}))


def styled(*parts: str | tuple[str, str]) -> Text:
    """Texts in a row, each by itself or with its style."""
    return Text.assemble(
        *(printable(part) if isinstance(part, str) else (printable(part[0]), part[1]) for part in parts)
    )


def stdout() -> PlainConsole:
    """Stdout; wide enough for the tables where it is a file or a pipe."""
    console = PlainConsole()
    return console if console.is_terminal else PlainConsole(width=120)


def stderr() -> PlainConsole:
    """Stderr."""
    return PlainConsole(stderr=True)
