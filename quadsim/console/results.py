"""Results of commands, shown as tables on a console, as JSON, or as HTML in a notebook."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from html import escape
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeAlias

from quadsim.errors import MissingPackageError, OutputError, QuadsimError, failure_line

if TYPE_CHECKING:
    from rich.console import RenderableType

    from quadsim.report.figure import Figure

Shown: TypeAlias = "Iterable[RenderableType]"

EXIT_DONE = 0
EXIT_FAILED = 1
EXIT_WRONG_INPUT = 2
"""Exit statuses of commands."""
_MOST_LINES: Final = 9  # of the text of a result that `repr` shows


class Result:
    """What a function of `quadsim.commands.app` returns: users read its text, programs its data."""

    @property
    def exit_status(self) -> int:
        """Exit status of the command.

        It is 0, or 1 where a constraint or requirement is violated, or a number is not as expected.
        """
        return EXIT_DONE

    def shown(self) -> Shown:
        """Return its tables and sentences, in order."""
        raise NotImplementedError

    def outputs(self) -> Shown:
        """Return the last lines: what was written, and the commands that open it."""
        return ()

    def to_json(self) -> Any:
        """Return it as plain data, as `--json` prints it."""
        raise NotImplementedError

    def show(self) -> None:
        """Print the result."""
        from quadsim.console import console

        console.show(self._parts())

    def text(self) -> str:
        """Return the output of `show` without colours."""
        from quadsim.console import console

        return console.to_text(self._parts())

    def __repr__(self) -> str:
        """Return the first lines of its text."""
        lines = [line.rstrip() for line in self.text().splitlines()]
        if len(lines) > _MOST_LINES:
            lines = [*lines[:_MOST_LINES], "..."]
        return "\n".join(lines)

    def small_plot(self) -> Figure | None:
        """Return a small plot for notebooks, or None."""
        return None

    def _repr_html_(self) -> str:
        """Return its tables and its plot for a notebook."""
        from quadsim.console import console

        return console.to_html(self._parts()) + plot_html(self.small_plot())

    def _parts(self) -> Shown:
        """Return all that is shown: the result, then the last lines."""
        return [*self.shown(), *self.outputs()]


class Tabular(Result):
    """A result with rows of numbers that users can analyse further."""

    def records(self) -> list[dict[str, Any]]:
        """Return its rows by column, numbers as numbers; None where a row has no value."""
        raise NotImplementedError

    def to_pandas(self) -> Any:
        """Return its rows as a pandas DataFrame, numbers as numbers.

        Raises:
            MissingPackageError: pandas is not installed.
        """
        require_pandas()
        import pandas

        return pandas.DataFrame(self.records())


def require_pandas() -> None:
    """Raise if there is no pandas to make a DataFrame with.

    Raises:
        MissingPackageError: pandas is not installed.
    """
    if find_spec("pandas") is None:
        raise MissingPackageError("a DataFrame", "pandas", extra="pandas")


def plot_html(figure: Figure | None) -> str:
    """Return a plot for a notebook as HTML: empty without a plot, and a line of text where it cannot be drawn."""
    if figure is None:
        return ""
    from quadsim.report.to_matplotlib import figure_html

    try:
        return figure_html(figure)
    except Exception as error:
        return f"<p>the plot {escape(failure_line(error))}</p>"


@contextlib.contextmanager
def after(result: Result, output: Path) -> Iterator[None]:
    """Surround the writing of an output whose result is there already: an error carries the result, to be shown first.

    Raises:
        QuadsimError: as the block raised it.
        OutputError: in place of any other exception.
    """
    try:
        yield
    except QuadsimError as error:
        error.result = result
        raise
    except Exception as error:
        problem = OutputError(output, failure_line(error))
        problem.result = result
        raise problem from error


@dataclass(frozen=True)
class Document(Result):
    """A text, printed unchanged."""

    content: str
    data: Any = None
    status: int = EXIT_DONE

    @property
    def exit_status(self) -> int:
        """See `Result.exit_status`."""
        return self.status

    def show(self) -> None:
        """See `Result.show`."""
        print(self.content, end="")

    def text(self) -> str:
        """See `Result.text`."""
        return self.content

    def to_json(self) -> Any:
        """Return its data, or its text if it has none."""
        if self.data is None:
            return self.content
        return self.data

    def _repr_html_(self) -> str:
        return f"<pre>{escape(self.content)}</pre>"


class Listing(dict[str, Mapping[str, str]], Tabular):
    """Names by section, with a line about each."""

    def records(self) -> list[dict[str, Any]]:
        """See `Tabular.records`."""
        rows = []
        for section, entries in self.items():
            for name, line in entries.items():
                rows.append({"section": section, "name": name, "line": line})
        return rows

    def shown(self) -> Shown:
        """See `Result.shown`."""
        from quadsim.console import console

        return console.listing(self)

    def to_json(self) -> Any:
        """See `Result.to_json`."""
        return dict(self)
